"""Matching loss: negative log-likelihood of the true matches under a transport plan."""

import math
from typing import Protocol

import torch
from torch import Tensor

from meshkit._numerics import safe_log
from meshkit.losses._common import ReducedLoss, Reduction, at_least_float32, check_reduction, reduce_samples

__all__ = ["MatchingLoss", "RowPlanLike", "matching_loss"]


class RowPlanLike(Protocol):
    """What the loss asks of a batch of transport plans T, which need not be stored."""

    @property
    def shape(self) -> torch.Size:
        """``(B, N, M)``."""

    def log_at(self, columns: Tensor, /) -> Tensor:
        """Return the logarithm of one entry of each row, ``(B, N)``; -inf at negative columns."""

    def row_sums(self) -> Tensor:
        """Return T 1, ``(B, N)``."""


def matching_loss(plan: Tensor | RowPlanLike, correspondence: Tensor, *, reduction: Reduction = "mean") -> Tensor:
    r"""Negative log-likelihood of known matches: each row of the plan is a distribution over the columns.

    .. math:: \frac1B \sum_b \frac{1}{|K_b|} \sum_{i \in K_b} -\log \frac{T_{i, c(i)}}{\sum_j T_{ij}}

    where :math:`K_b` are the rows whose match c(i) is known. A reconstruction loss on the warped mesh hardly reaches a
    vertex that is matched to the wrong leg: the entry of the right one is exponentially small, and so is its gradient.
    That of the logarithm is not.

    Args:
        plan: a :class:`~meshkit.ot.TransportPlan`, which is not stored for this, or a matrix ``(B, N, M)`` of positive
            entries.
        correspondence: int64 ``(B, N)``, the column c(i) of each row, -1 where it is not known and in the padding: what
            :class:`~meshkit.data.PairBatch` has.
        reduction: ``"mean"`` as above, ``"sum"`` for the mean over samples of the sums, ``"none"`` for the mean of each
            sample, ``(B,)``.

    Returns:
        A scalar, or ``(B,)``, in nats; log M for a uniform plan. A sample without known matches counts 0. An entry of
        zero counts as the smallest normal number, without a gradient.

    Raises:
        ValueError: if shapes or types do not fit, or the reduction is unknown.

    Reference:
        SuperGlue, equation 11, without its dustbin. Not in the papers of 3D-CoreNet and X-DualNet, which learn the
        matching through the reconstruction alone.

    Example:
        >>> from meshkit.ot import sinkhorn
        >>> plan = sinkhorn(torch.eye(3)[None], torch.eye(3)[None, [2, 0, 1]], eps=1.0)
        >>> matching_loss(plan, torch.tensor([[1, 2, 0]])), matching_loss(plan, torch.tensor([[1, 2, -1]]))
        (tensor(0.5514), tensor(0.5514))
    """
    check_reduction(reduction)
    if isinstance(plan, Tensor) and plan.dim() != 3:
        raise ValueError(f"a plan must have shape (B, N, M), got {tuple(plan.shape)}")
    if correspondence.shape != plan.shape[:2] or correspondence.dtype not in (torch.int64, torch.int32):
        raise ValueError(
            f"correspondence must be integers of shape (B, N) = {tuple(plan.shape[:2])}, got {correspondence.dtype} of "
            f"{tuple(correspondence.shape)}"
        )
    known = correspondence >= 0
    if isinstance(plan, Tensor):
        plan = at_least_float32(plan)
        entries = plan.gather(2, correspondence.clamp_min(0).long()[..., None])[..., 0]
        masses, at = plan.sum(2), safe_log(entries)
    else:
        masses, at = plan.row_sums(), plan.log_at(correspondence)
    known = known & (masses > 0)  # a row of no weight has no distribution
    at = torch.where(at.isneginf(), math.log(torch.finfo(at.dtype).tiny), at)
    bits = torch.where(known, masses, 1.0).log() - torch.where(known, at, 0.0)
    return reduce_samples(torch.where(known, bits, 0.0).sum(1), known.sum(1), reduction)


class MatchingLoss(ReducedLoss):
    """Module form of :func:`matching_loss`.

    Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if the reduction is unknown.

    Example:
        >>> MatchingLoss()(torch.full((1, 2, 4), 0.1), torch.tensor([[0, 3]]))  # log 4
        tensor(1.3863)
    """

    def forward(self, plan: Tensor | RowPlanLike, correspondence: Tensor) -> Tensor:
        """Return the loss, see :func:`matching_loss`."""
        return matching_loss(plan, correspondence, reduction=self.reduction)
