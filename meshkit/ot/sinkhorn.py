"""Entropic optimal transport between feature sets or under a given cost, with the exact gradient of the iterations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from meshkit._compile import uncompiled
from meshkit.ot.costs import logit_features, logits_per_cost
from meshkit.ot.dual import iterate_between, iterate_within
from meshkit.ot.iterations import iterate_kernel, iterate_log
from meshkit.ot.kernel import GibbsKernel
from meshkit.ot.marginals import Sides, marginals
from meshkit.ot.options import Cost, Domain, Eps, Grad, Options, Reach, Store, check_choice, read_options
from meshkit.ot.plan import TransportPlan
from meshkit.ot.sample import SamplePlan
from meshkit.ot.stacked import solve_stacked, stackable
from meshkit.ot.tiles import LOG2_E, MatrixTiles, feature_tiles

__all__ = ["eps_schedule", "sinkhorn", "sinkhorn_from_cost", "sinkhorn_warp"]


@uncompiled
def sinkhorn(
    fx: Tensor,
    fy: Tensor,
    *,
    cost: Cost = "cosine",
    eps: Eps = 0.03,
    n_iters: int = 5,
    tol: float | None = None,
    a: Tensor | None = None,
    b: Tensor | None = None,
    mask_x: Tensor | None = None,
    mask_y: Tensor | None = None,
    reach: Reach = None,
    grad: Grad = "unroll",
    domain: Domain = "auto",
    store: Store = "auto",
    check_finite: bool = False,
) -> TransportPlan:
    r"""Transport plan between two sets of features.

    With the cost :math:`C_{ij}` and :math:`K = \exp(-C/\varepsilon)`, starting from :math:`a_0 = \mu`, the iterations

    .. math:: b_t = \nu / (K^\top a_{t-1}), \qquad a_t = \mu / (K b_t), \qquad T = \mathrm{diag}(a)\,K\,\mathrm{diag}(b)

    approach the plan that minimises :math:`\langle T, C \rangle + \varepsilon \sum T (\log T - 1)` with row sums
    :math:`\mu` and column sums :math:`\nu`. Row sums are exact after any number of iterations, column sums converge.

    Neither cost nor plan is stored, unless ``store`` asks for it: K is computed from the features in blocks of rows,
    and the gradient of all iterations is :math:`K \circ A B^\top` with 2T - 1 columns in A and B.

    Args:
        fx: ``(B, N, D)`` features of the rows (identity mesh).
        fy: ``(B, M, D)`` features of the columns (pose mesh).
        cost: ``"cosine"``, :math:`1 - \cos(x_i, y_j)`; ``"sqeuclidean"``, :math:`\lVert x_i - y_j \rVert^2`;
            ``"dot"``, :math:`-\langle x_i, y_j \rangle`. The cosine sees directions only: features with a common
            offset, such as raw signatures, all look alike; standardise them first.
        eps: entropic regularisation, in units of the cost (the cosine cost lies in [0, 2]). A scalar tensor receives
            a gradient. A sequence is annealed: one value per iteration, the last one kept, as from
            :func:`eps_schedule`. What is small depends on the features: with ``"sqeuclidean"`` and ``"dot"``, scale eps
            with the squares of their lengths.
        n_iters: number of iterations, the largest number if ``tol`` is given; at least the length of a sequence of eps.
        tol: stop a sample once its column sums are this close to :math:`\nu`, as a sum of absolute differences over the
            total; with ``reach``, once :math:`b` changes by so little, weighted by :math:`\nu`.
        a: ``(B, N)`` or ``(N,)`` row weights :math:`\mu`, uniform with sum 1 by default. Rows of weight 0 are left out.
        b: ``(B, M)`` or ``(M,)`` column weights :math:`\nu`.
        mask_x: ``(B, N)`` bool, True = real vertex. Masked rows are left out, whatever they hold.
        mask_y: ``(B, M)`` bool.
        reach: weight :math:`\rho` of the marginal penalty of unbalanced transport, in units of the cost: scalings are
            raised to the power :math:`\rho / (\rho + \varepsilon)`. A pair gives rows and columns their own, ``None``
            keeps a side exact.
        grad: ``"unroll"``, the exact gradient of the iterations as run; ``"implicit"``, that of their limit, for plans
            run to convergence (5 iterations are not); ``"last_step"``, through the last iteration only; ``"none"``, the
            plan is a constant.
        domain: ``"kernel"`` iterates on :math:`K` (fast), ``"log"`` on its logarithm (safe at any ``eps``), ``"auto"``
            takes the kernel where the range of the dtype allows: for uniform weights and the cosine cost
            ``eps >= 2 / (log(max) - log(N M))``, .0282 for 6890 x 6890 in float32. A plan forced into the kernel domain
            below that may be NaN. On a GPU, and on a CPU up to 65,536 entries each, samples of one size (cosine cost,
            no masks, weights, ``tol`` or ``check_finite``) are solved together in the kernel domain where that is
            allowed; else float32 features on a GPU go through Triton kernels, which always work in the log domain.
        store: ``"keep"`` holds K for all later sweeps and the backward pass, N x M numbers per sample; ``"stream"``
            computes it again, in :math:`O((N + M) D)` memory; ``"auto"`` keeps up to 1 GiB, on a GPU up to 128 MiB. A
            kept K lives as long as the plan or the graph of its readings. Triton kernels always stream; the
            environment variable ``MESHKIT_TRITON=0`` switches them off.
        check_finite: raise an error if a real vertex has a feature that is not finite.

    Returns:
        The :class:`~meshkit.ot.TransportPlan`, in float32 or better whatever the autocast state. A zero feature has
        cosine 0 with everything, and gradient 0. A sample with every vertex masked has a plan without mass. A feature
        that is not finite spoils the plan of its own sample alone.

    Raises:
        ValueError: shapes do not fit, a mesh is empty, an option is unknown or out of range, weights are negative or
            of different total.
        RuntimeError: a second derivative is asked for.

    Reference:
        X-DualNet, "Optimal transport problem" and Algorithm 1 (cosine, eps 0.03, 5 iterations). Unbalanced form: FLOT
        (Puy et al. 2020), after Chizat et al. 2018.

    Deviations:
        The released code adds 1e-8 to the denominators, which moves its warps by up to a few per cent; here nothing
        is added.

    Example:
        >>> features = torch.eye(3)[None]
        >>> sinkhorn(features, features[:, [2, 0, 1]]).argmax().tolist()
        [[1, 2, 0]]
    """
    check_features(fx, fy)
    check_choice("cost", cost, Cost)
    options = read_options(eps, n_iters, tol, reach, grad, domain, store)
    masks = {"mask_x": mask_x, "mask_y": mask_y}
    return solve_features(fx, fy, cost, options, a=a, b=b, **masks, check_finite=check_finite)


def solve_features(
    fx: Tensor,
    fy: Tensor,
    cost: Cost,
    options: Options,
    *,
    a: Tensor | None,
    b: Tensor | None,
    mask_x: Tensor | None,
    mask_y: Tensor | None,
    check_finite: bool = False,
) -> TransportPlan:
    """:func:`sinkhorn` with options read already."""
    shape = len(fx), fx.shape[1], fy.shape[1]
    dtype = torch.promote_types(torch.promote_types(fx.dtype, fy.dtype), torch.float32)
    with torch.autocast(fx.device.type, enabled=False):
        if not check_finite and stackable(fx, fy, cost, options, dtype, a, b, mask_x, mask_y):
            return TransportPlan(solve_stacked(fx.to(dtype), fy.to(dtype), options), shape)
        like = fx.new_empty(0, dtype=dtype)
        keep = options.keep(math.prod(shape) * dtype.itemsize)
        samples = []
        for s, sides in enumerate(marginals(a, b, mask_x, mask_y, shape, like, balanced=not options.unbalanced)):
            x, y = sides.rows_of(fx[s].to(dtype)), sides.columns_of(fy[s].to(dtype))
            if check_finite and not bool(x.isfinite().all() & y.isfinite().all()):
                raise ValueError(f"sample {s} has features that are not finite; mask those vertices or mend them")
            if options.settings.grad == "none":
                x, y, sides = x.detach(), y.detach(), sides.detached()
            x, y, spread, shift = logit_features(x, y, cost, options.eps, constant=options.unbalanced)
            chosen = "log" if options.dual == "within" else options.domain_for(spread, sides)
            tiles = feature_tiles(x, y, "none" if not keep else "kernel" if chosen == "kernel" else "logits")
            chosen = "log" if tiles.log_only and len(x) else chosen
            samples.append(solve(GibbsKernel(tiles, x, y), sides, options, chosen, shift))
        return TransportPlan(samples, shape)


def sinkhorn_from_cost(
    cost: Tensor,
    *,
    eps: Eps = 0.03,
    n_iters: int = 5,
    tol: float | None = None,
    a: Tensor | None = None,
    b: Tensor | None = None,
    mask_x: Tensor | None = None,
    mask_y: Tensor | None = None,
    reach: Reach = None,
    grad: Grad = "unroll",
    domain: Domain = "auto",
    store: Store = "auto",
) -> TransportPlan:
    r"""Transport plan under a given cost matrix, as :func:`sinkhorn` otherwise.

    Args:
        cost: ``(B, N, M)``, finite in real rows and columns. Its gradient is a dense matrix.
        eps: entropic regularisation, in units of the cost.
        n_iters: number of iterations.
        tol: see :func:`sinkhorn`, as all further arguments.
        a: row weights.
        b: column weights.
        mask_x: ``(B, N)`` real rows.
        mask_y: ``(B, M)`` real columns.
        reach: marginal penalty.
        grad: gradient mode.
        domain: ``"auto"`` looks at the range of the cost.
        store: ``"keep"`` holds the exponential of the cost beside the cost.

    Returns:
        The :class:`~meshkit.ot.TransportPlan`.

    Raises:
        ValueError: as :func:`sinkhorn`.

    Example:
        >>> plan = sinkhorn_from_cost(torch.tensor([[[0.0, 1.0], [1.0, 0.0]]]), eps=0.1)
        >>> (2 * plan.dense()[0]).round(decimals=3)
        tensor([[1., 0.],
                [0., 1.]])
    """
    return solve_cost(
        cost, read_options(eps, n_iters, tol, reach, grad, domain, store), a=a, b=b, mask_x=mask_x, mask_y=mask_y
    )


@uncompiled
def solve_cost(
    cost: Tensor,
    options: Options,
    *,
    a: Tensor | None = None,
    b: Tensor | None = None,
    mask_x: Tensor | None = None,
    mask_y: Tensor | None = None,
    start: Tensor | None = None,
) -> TransportPlan:
    """:func:`sinkhorn_from_cost` with options read already; ``start (B, N)`` is the log of the first row scaling."""
    if cost.dim() != 3 or 0 in cost.shape:
        raise ValueError(f"cost must be (B, N, M) with at least one sample, row and column, got {tuple(cost.shape)}")
    shape = cost.shape[0], cost.shape[1], cost.shape[2]
    dtype = torch.promote_types(cost.dtype, torch.float32)
    with torch.autocast(cost.device.type, enabled=False):
        like = cost.new_empty(0, dtype=dtype)
        keep = options.keep(math.prod(shape) * dtype.itemsize)
        samples = []
        for s, sides in enumerate(marginals(a, b, mask_x, mask_y, shape, like, balanced=not options.unbalanced)):
            matrix = sides.columns_of(sides.rows_of(cost[s].to(dtype)).mT).mT
            if options.settings.grad == "none":
                matrix, sides = matrix.detach(), sides.detached()
            shift = float(matrix.detach().amin()) if matrix.numel() and not options.unbalanced else 0.0
            logits = (shift - matrix) * logits_per_cost(options.eps, dtype)
            spread = float(logits.detach().abs().amax()) / LOG2_E if logits.numel() else 0.0
            chosen = "log" if start is not None else options.domain_for(spread, sides)
            first = None if start is None else LOG2_E * sides.rows_of(start[s].to(dtype))
            kernel = GibbsKernel(MatrixTiles(logits, "kernel" if keep and chosen == "kernel" else "none"), logits)
            samples.append(solve(kernel, sides, options, chosen, shift, first))
        return TransportPlan(samples, shape)


def sinkhorn_warp(fx: Tensor, fy: Tensor, values: Tensor, **options: object) -> Tensor:
    r"""Carry ``values`` of the columns to the rows, :math:`\sum_j T_{ij} v_j / \sum_j T_{ij}`.

    The last half step cancels in the quotient and is not computed: T iterations and the warp are T + 1 sweeps.

    Args:
        fx: ``(B, N, D)`` features of the rows.
        fy: ``(B, M, D)`` features of the columns.
        values: ``(B, M, C)``.
        options: keyword arguments of :func:`sinkhorn`.

    Returns:
        ``(B, N, C)``, each row a convex combination of the values; 0 for masked rows.

    Raises:
        ValueError: as :func:`sinkhorn`, and if ``values`` do not fit.

    Reference:
        X-DualNet, "Optimal transport problem", the warp of the pose mesh.

    Example:
        >>> features = torch.eye(2)[None]
        >>> sinkhorn_warp(features, features, torch.tensor([[[1.0], [2.0]]]))[0, :, 0]
        tensor([1., 2.])
    """
    return sinkhorn(fx, fy, **options).barycentric(values)  # type: ignore[arg-type]


def eps_schedule(start: float, final: float, *, factor: float = 0.5) -> list[float]:
    """Regularisations from ``start`` down to ``final`` in geometric steps, for :func:`sinkhorn`'s ``eps``.

    Raises:
        ValueError: unless ``start >= final > 0`` are finite and ``0 < factor < 1``.

    Example:
        >>> eps_schedule(1.0, 0.2)
        [1.0, 0.5, 0.25, 0.2]
        >>> features = torch.eye(3)[None]
        >>> sinkhorn(features, features, eps=eps_schedule(1.0, 0.01), n_iters=100, tol=1e-4).n_iters
        [9]
    """
    if not (float("inf") > start >= final > 0 and 0 < factor < 1):
        raise ValueError(f"need finite start >= final > 0 and 0 < factor < 1, got {start}, {final} and {factor}")
    values = []
    while start > final:
        values.append(start)
        start *= factor
    return [*values, final]


def solve(
    kernel: GibbsKernel, sides: Sides, options: Options, domain: str, shift: float, start: Tensor | None = None
) -> SamplePlan:
    """Iterate in the chosen domain."""
    if options.dual == "within" and len(sides.mu):
        solution = iterate_within(kernel, sides.mu, options.settings)
    elif options.dual == "between" and domain == "log" and len(sides.mu):
        solution = iterate_between(kernel, sides.mu, sides.nu, options.settings)
    elif domain == "kernel" or len(sides.mu) == 0:
        solution = iterate_kernel(kernel, sides.mu, sides.nu, options.settings)
    else:
        solution = iterate_log(kernel, sides.mu, sides.nu, options.settings, start)
    return SamplePlan(
        kernel=kernel,
        mu=sides.mu,
        nu=sides.nu,
        b=solution.b,
        reference=solution.reference,
        power_x=options.settings.power_x,
        eps=options.eps,
        shift=shift,
        index_x=sides.index_x,
        index_y=sides.index_y,
        n_iters=solution.n_iters,
        centred=options.settings.grad == "implicit" and not options.unbalanced,
    )


def check_features(fx: Tensor, fy: Tensor) -> None:
    """Shapes of two batches of features."""
    for features in (fx, fy):
        if not isinstance(features, Tensor) or not features.is_floating_point():
            kind = features.dtype if isinstance(features, Tensor) else type(features).__name__
            raise ValueError(f"features must be floating-point tensors, got {kind}; convert with torch.as_tensor")
    if fx.dim() != 3 or fy.dim() != 3 or fx.shape[0] != fy.shape[0] or fx.shape[2] != fy.shape[2]:
        hint = "; add a batch dimension with [None]" if fx.dim() == fy.dim() == 2 else ""
        raise ValueError(f"features must be (B, N, D) and (B, M, D), got {tuple(fx.shape)} and {tuple(fy.shape)}{hint}")
    if 0 in fx.shape or 0 in fy.shape:
        raise ValueError(f"a set is empty: got features {tuple(fx.shape)} and {tuple(fy.shape)}")
