"""Matching layers around :func:`~meshkit.ot.sinkhorn`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from meshkit._repr import settings
from meshkit.ot.options import Cost, Domain, Eps, Grad, Reach, Store, check_choice, plain, read_options
from meshkit.ot.plan import TransportPlan
from meshkit.ot.sinkhorn import sinkhorn

__all__ = ["CorrespondenceWarp", "SinkhornCorrespondence"]


class SinkhornCorrespondence(nn.Module):
    r"""Soft correspondence between two sets of features, :func:`~meshkit.ot.sinkhorn` as a module.

    Args:
        cost: ``"cosine"``, ``"sqeuclidean"`` or ``"dot"``.
        eps: regularisation, see :func:`~meshkit.ot.sinkhorn`.
        n_iters: iterations.
        tol: stop early.
        reach: marginal penalty of unbalanced transport.
        grad: gradient mode.
        domain: kernel or log domain.
        store: keep or stream the kernel.
        learn_eps: make eps a parameter, :math:`\varepsilon = \varepsilon_{\min} + e^{p}`, that starts at ``eps``.
        min_eps: :math:`\varepsilon_{\min}`, where ``learn_eps`` ends.

    Shape:
        ``fx (B, N, D)``, ``fy (B, M, D)``, masks ``(B, N)`` and ``(B, M)``, weights ``a (B, N)`` and ``b (B, M)``; the
        result is a :class:`~meshkit.ot.TransportPlan` of shape ``(B, N, M)``.

    Raises:
        ValueError: an option is out of range; ``learn_eps`` together with a sequence of eps or with ``reach``.

    Reference:
        X-DualNet, "Optimal transport problem". A learned eps: FLOT (Puy et al. 2020), there with minimum 0.03.

    Example:
        >>> match = SinkhornCorrespondence(learn_eps=True)
        >>> plan = match(torch.randn(1, 6, 4), torch.randn(1, 5, 4))
        >>> plan.shape, round(match.eps.item(), 4)
        (torch.Size([1, 6, 5]), 0.03)
    """

    def __init__(
        self,
        *,
        cost: Cost = "cosine",
        eps: Eps = 0.03,
        n_iters: int = 5,
        tol: float | None = None,
        reach: Reach = None,
        grad: Grad = "unroll",
        domain: Domain = "auto",
        store: Store = "auto",
        learn_eps: bool = False,
        min_eps: float = 1e-3,
    ) -> None:
        super().__init__()
        check_choice("cost", cost, Cost)
        eps, n_iters, tol, reach = (plain(value) for value in (eps, n_iters, tol, reach))
        read_options(eps, n_iters, tol, reach, grad, domain, store)
        self.cost, self.n_iters, self.tol, self.reach = cost, n_iters, tol, reach
        self.grad, self.domain, self.store, self.min_eps = grad, domain, store, min_eps
        self.log_eps: nn.Parameter | None = None
        self._eps = eps
        if learn_eps:
            if not isinstance(eps, int | float) or reach is not None or not eps > min_eps > 0:
                raise ValueError(
                    f"learn_eps needs one number eps > min_eps > 0 and no reach, got eps {eps}, min_eps {min_eps} and "
                    f"reach {reach}"
                )
            self.log_eps = nn.Parameter(torch.tensor(math.log(eps - min_eps)))

    @property
    def eps(self) -> Eps:
        """The regularisation now, a scalar tensor if it is learned."""
        return self._eps if self.log_eps is None else self.min_eps + self.log_eps.exp()

    def forward(
        self,
        fx: Tensor,
        fy: Tensor,
        *,
        a: Tensor | None = None,
        b: Tensor | None = None,
        mask_x: Tensor | None = None,
        mask_y: Tensor | None = None,
    ) -> TransportPlan:
        """Match the rows ``fx`` with the columns ``fy``."""
        return sinkhorn(
            fx,
            fy,
            cost=self.cost,
            eps=self.eps,
            n_iters=self.n_iters,
            tol=self.tol,
            a=a,
            b=b,
            mask_x=mask_x,
            mask_y=mask_y,
            reach=self.reach,
            grad=self.grad,
            domain=self.domain,
            store=self.store,
        )

    def extra_repr(self) -> str:
        """Options in the printed module."""
        learned = "" if self.log_eps is None else f", learn_eps=True, {settings(self, 'min_eps')}"
        rest = settings(self, "cost", "n_iters", "tol", "reach", "grad", "domain", "store")
        return f"eps={self._eps}{learned}, {rest}"


class CorrespondenceWarp(nn.Module):
    r"""Carry values of one mesh to the vertices of another along their soft correspondence.

    .. math:: W_i = \sum_j T_{ij} v_j \Big/ \sum_j T_{ij}

    Args:
        correspondence: makes the plan from two sets of features; a :class:`SinkhornCorrespondence` by default.
        normalize: divide by the row sums (released code); ``False`` warps with the raw plan as the paper prints it,
            whose rows sum to 1/N.

    Shape:
        ``fx (B, N, D)``, ``fy (B, M, D)``, ``values (B, M, C)``; the result is the pair of ``(B, N, C)`` and the plan.

    Reference:
        X-DualNet, "Optimal transport problem", the warped pose mesh.

    Example:
        >>> features = torch.eye(2)[None]
        >>> warped, plan = CorrespondenceWarp()(features, features, torch.tensor([[[1.0], [2.0]]]))
        >>> warped[0, :, 0]
        tensor([1., 2.])
    """

    def __init__(self, correspondence: nn.Module | None = None, *, normalize: bool = True) -> None:
        super().__init__()
        self.correspondence = SinkhornCorrespondence() if correspondence is None else correspondence
        self.normalize = normalize

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "normalize")

    def forward(
        self,
        fx: Tensor,
        fy: Tensor,
        values: Tensor,
        *,
        a: Tensor | None = None,
        b: Tensor | None = None,
        mask_x: Tensor | None = None,
        mask_y: Tensor | None = None,
    ) -> tuple[Tensor, TransportPlan]:
        """Warp ``values`` of the columns to the rows; ``a`` and ``b`` are the weights of rows and columns."""
        plan = self.correspondence(fx, fy, a=a, b=b, mask_x=mask_x, mask_y=mask_y)
        return (plan.barycentric(values) if self.normalize else plan @ values), plan
