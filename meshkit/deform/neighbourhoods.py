"""Neighbourhoods of a shape's vertices, as matrices of weights, and the rotations that carry them to a target."""

import torch
from torch import Tensor

from meshkit.batching import masked_mean
from meshkit.deform.rotation import closest_rotation

__all__: list[str] = []

_PRIOR = 0.02  # share of the whole shape's rotation in each neighbourhood's covariance


def check_target(rest: Tensor, target: Tensor, radius: float, features: Tensor | None) -> None:
    """Refuse what is no shape with a target."""
    if rest.dim() != 3 or rest.shape != target.shape or rest.shape[2] != 3:
        raise ValueError(f"rest and target must both be (B, N, 3), got {tuple(rest.shape)} and {tuple(target.shape)}")
    if features is not None and (features.shape[:-1] != rest.shape[:2] or features.shape[-1] == 0):
        raise ValueError(
            f"features must be ({rest.shape[0]}, {rest.shape[1]}, D) beside rest, got {tuple(features.shape)}"
        )
    if not radius > 0:
        raise ValueError(f"radius must be positive, got {radius}")


def centred(v: Tensor, t: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Shape and target about their means, padding as 0, and the mean (B, 1, 3) of the target."""
    middle = masked_mean(t, mask)[:, None]
    v, t = v - masked_mean(v, mask)[:, None], t - middle
    if mask is not None:
        v, t = v.masked_fill(~mask[..., None], 0.0), t.masked_fill(~mask[..., None], 0.0)
    return v, t, middle


def local_rotations(v: Tensor, t: Tensor, q: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The rotation (B, N, 3, 3) of each neighbourhood from ``v`` to ``t``, and its means (B, N, 3) in both."""
    # All moments of all neighbourhoods are one product with the weights.
    moments = torch.cat([v, t, (t[..., :, None] * v[..., None, :]).flatten(2)], 2)
    mean_v, mean_t, outer = (q @ moments / q.sum(2, keepdim=True)).split([3, 3, 9], 2)
    covariance = outer.unflatten(2, (3, 3)) - mean_t[..., :, None] * mean_v[..., None, :]
    return closest_rotation(covariance + _prior(v, t, mask, covariance)), mean_v, mean_t


def _prior(v: Tensor, t: Tensor, mask: Tensor | None, covariance: Tensor) -> Tensor:
    """A trace of the rotation of the whole shape, to settle what a neighbourhood leaves open.

    A limb shrunk to its axis fixes no rotation about that axis; left to chance, neighbours would disagree and the
    blend of their motions would shrink the limb again.
    """
    count = v.new_full((len(v), 1, 1), float(v.shape[1])) if mask is None else mask.sum(1).to(v.dtype)[:, None, None]
    mean_v, mean_t = v.sum(1, keepdim=True) / count.clamp_min(1), t.sum(1, keepdim=True) / count.clamp_min(1)
    whole = closest_rotation(t.mT @ v - count * mean_t.mT @ mean_v)
    size = torch.linalg.matrix_norm(covariance, keepdim=True)
    return _PRIOR * size * whole[:, None]


def neighbour_weights(v: Tensor, radius: float, mask: Tensor | None, features: Tensor | None) -> Tensor:
    """Weights q (B, N, N), symmetric; a padded vertex is its own neighbourhood."""
    # In place: these matrices are the largest tensors of a small network's step, and carry no gradient.
    q = torch.cdist(v, v).square_().mul_(-1 / radius**2).add_(1).clamp_min_(0).square_()
    if features is not None:
        f = features.detach().to(v.dtype)
        if mask is not None:
            f = f.masked_fill(~mask[..., None], 0.0)
        q.mul_(torch.cdist(f, f).square_().mul_(-1 / f.shape[2]).exp_())
    # Far from the origin, or in another unit than the radius, rounding takes a vertex out of its own reach: 0 / 0 then.
    q.diagonal(dim1=1, dim2=2).clamp_min_(0.5)
    if mask is not None:
        # A padded vertex is its own neighbourhood, so that no sum of weights is zero.
        own = torch.eye(v.shape[1], dtype=torch.bool, device=v.device)
        q = torch.where(mask[:, :, None] & mask[:, None, :], q, own.to(v.dtype))
    return q
