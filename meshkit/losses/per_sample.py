"""Module forms of measures owned by other components, which give one value per sample."""

from typing import Literal, get_args

from torch import Tensor, nn

from meshkit._repr import settings
from meshkit.deform import arap_energy
from meshkit.deform.topology import check_energy
from meshkit.ot import sinkhorn_divergence
from meshkit.ot.divergence import read_divergence_options

__all__ = ["ARAPEnergyLoss", "SinkhornDivergenceLoss"]

SampleReduction = Literal["mean", "none"]


def _check_reduction(reduction: str) -> None:
    if reduction not in get_args(SampleReduction):
        raise ValueError(
            f"reduction must be one of {get_args(SampleReduction)}, over samples: the measure itself says how it "
            f"gathers its points; got {reduction!r}"
        )


class SinkhornDivergenceLoss(nn.Module):
    """Module form of :func:`meshkit.ot.sinkhorn_divergence` between two point sets, uniformly weighted.

    Unlike the Chamfer loss it sees how many points are where: every point of either set is matched.

    Args:
        eps: regularisation in squared units of length.
        n_iters: largest number of iterations.
        tol: stop when the column sums are this close to their weights; ``None`` runs all iterations. A warning tells
            if ``n_iters`` ends before: the gradient's error is of first order in what is missing.
        anneal: factor of the falling regularisation; it starts at the largest cost of the batch, so that short of
            convergence a value depends slightly on the other samples. ``None`` starts at ``eps``, sample by sample.
        debias: subtract the self-transport terms.
        reduction: ``"mean"`` over samples, or ``"none"``.

    Raises:
        ValueError: if the reduction is unknown or an option out of range, and as
            :func:`meshkit.ot.sinkhorn_divergence`.

    Example:
        >>> import torch
        >>> points = torch.rand(1, 5, 3)
        >>> round(SinkhornDivergenceLoss()(points, points + torch.tensor([3.0, 0, 0])).item(), 3)
        9.0
    """

    def __init__(
        self,
        *,
        eps: float = 0.01,
        n_iters: int = 500,
        tol: float | None = 1e-4,
        anneal: float | None = 0.5,
        debias: bool = True,
        reduction: SampleReduction = "mean",
    ) -> None:
        super().__init__()
        _check_reduction(reduction)
        read_divergence_options(eps, n_iters, tol, anneal, "auto", "auto")
        self.eps, self.n_iters, self.tol, self.anneal, self.debias = eps, n_iters, tol, anneal, debias
        self.reduction: SampleReduction = reduction

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "eps", "n_iters", "tol", "anneal", "debias", "reduction")

    def forward(
        self, pred: Tensor, target: Tensor, *, pred_mask: Tensor | None = None, target_mask: Tensor | None = None
    ) -> Tensor:
        """Return the divergence of ``pred (B, N, 3)`` and ``target (B, M, 3)``, a scalar or ``(B,)``."""
        values = sinkhorn_divergence(
            pred,
            target,
            eps=self.eps,
            n_iters=self.n_iters,
            tol=self.tol,
            anneal=self.anneal,
            debias=self.debias,
            mask_x=pred_mask,
            mask_y=target_mask,
        )
        return values.mean() if self.reduction == "mean" else values


class ARAPEnergyLoss(nn.Module):
    """Module form of :func:`meshkit.deform.arap_energy`: how far a mesh is from a locally rigid copy of another.

    Args:
        energy: ``"spokes_and_rims"``, ``"spokes"``, ``"spokes_unclamped"`` or ``"elements"``.
        reduction: ``"mean"`` over samples of the energies (sums over cells, squared units of length), or ``"none"``.

    Raises:
        ValueError: if the energy or the reduction is unknown, and as :func:`meshkit.deform.arap_energy`.

    Example:
        >>> import torch
        >>> verts = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        >>> ARAPEnergyLoss()(2 * verts, verts, torch.tensor([[0, 1, 2]]))
        tensor(3.)
    """

    def __init__(self, *, energy: str = "spokes_and_rims", reduction: SampleReduction = "mean") -> None:
        super().__init__()
        _check_reduction(reduction)
        check_energy(energy)
        self.energy = energy
        self.reduction: SampleReduction = reduction

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "energy", "reduction")

    def forward(self, verts: Tensor, reference: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Return the energy of ``verts (B, N, 3)`` against ``reference``, the rest shape; a scalar or ``(B,)``."""
        values = arap_energy(reference, faces, verts, energy=self.energy, mask=mask)
        return values.mean() if self.reduction == "mean" else values
