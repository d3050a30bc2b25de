"""Partial matching with a dustbin, as feature-matching networks use it."""

from __future__ import annotations

import torch
from torch import Tensor

from meshkit.batching import check_mask
from meshkit.ot.options import read_options
from meshkit.ot.sinkhorn import solve_cost

__all__ = ["log_optimal_transport"]


def log_optimal_transport(
    scores: Tensor,
    bin_score: Tensor | float,
    *,
    n_iters: int = 100,
    mask_x: Tensor | None = None,
    mask_y: Tensor | None = None,
) -> Tensor:
    r"""Logarithm of the soft assignment between two sets with a dustbin for what has no match.

    The scores :math:`S` get a row and a column that hold ``bin_score``. Each real row and column has mass 1, the
    dustbins as much as the other set has elements, and from :math:`v = 0` the iterations

    .. math:: u_i = \log \mu_i - \log \sum_j e^{S_{ij} + v_j}, \qquad v_j = \log \nu_j - \log \sum_i e^{S_{ij} + u_i}

    lead to :math:`\log P_{ij} = S_{ij} + u_i + v_j`: real columns sum to 1, real rows nearly.

    Args:
        scores: ``(B, N, M)``, larger is better.
        bin_score: score of leaving an element unmatched, a number or a scalar tensor, which may be learned.
        n_iters: iterations.
        mask_x: ``(B, N)`` bool, True = real row.
        mask_y: ``(B, M)`` bool.

    Returns:
        ``(B, N + 1, M + 1)``, the dustbins last; -inf in masked rows and columns. The gradient is that of the
        iterations, which keep their potentials alone.

    Raises:
        ValueError: ``scores`` or masks of the wrong shape, ``n_iters`` below 1, a sample without a real row or column.

    Reference:
        Sarlin et al. 2020, "SuperGlue", differentiable optimal transport layer.

    Example:
        >>> log_plan = log_optimal_transport(torch.tensor([[[9.0, 0.0, 0.0], [0.0, 9.0, 0.0]]]), 1.0)
        >>> log_plan.argmax(1)  # the third column goes to the dustbin of the rows
        tensor([[0, 1, 2, 2]])
    """
    if scores.dim() != 3 or 0 in scores.shape[1:]:
        raise ValueError(f"scores must be (B, N, M) with at least one row and column, got {tuple(scores.shape)}")
    batch, rows, columns = scores.shape
    check_mask(mask_x, batch, rows, name="mask_x")
    check_mask(mask_y, batch, columns, name="mask_y")
    options = read_options(1.0, n_iters, None, None, "unroll", "log", "auto")
    scores = scores.to(torch.promote_types(scores.dtype, torch.float32))
    real_x, real_y = _with_bin(scores, mask_x, rows), _with_bin(scores, mask_y, columns)
    count_x, count_y = real_x.sum(1, keepdim=True) - 1, real_y.sum(1, keepdim=True) - 1
    if bool(((count_x == 0) | (count_y == 0)).any()):
        raise ValueError("every sample needs at least one real row and one real column")
    couplings = torch.nn.functional.pad(scores, (0, 1, 0, 1))
    is_bin = torch.zeros_like(couplings, dtype=torch.bool)
    is_bin[:, -1], is_bin[:, :, -1] = True, True
    couplings = torch.where(is_bin, torch.as_tensor(bin_score, dtype=scores.dtype, device=scores.device), couplings)
    total = count_x + count_y
    mu = torch.cat([real_x[:, :-1], count_y], 1) / total
    nu = torch.cat([real_y[:, :-1], count_x], 1) / total
    # Solved with the sides exchanged, since rows come first here.
    plan = solve_cost(-couplings.mT, options, a=nu, b=mu, start=torch.zeros_like(nu))
    return plan.T.log_dense() + total.log()[..., None]


def _with_bin(scores: Tensor, mask: Tensor | None, size: int) -> Tensor:
    """1 for real elements and for the dustbin, ``(B, size + 1)``."""
    ones = scores.new_ones(len(scores), size + 1)
    return ones if mask is None else torch.cat([mask.to(scores.dtype), ones[:, :1]], 1)
