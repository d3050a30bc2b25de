"""New identities and poses like those of a rig's tables, to train on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from meshkit.data.rigged import check_parents

__all__ = ["sample_identities", "sample_poses"]


def sample_identities(
    identities: Tensor, count: int, *, spread: float = 1.0, generator: torch.Generator | None = None
) -> Tensor:
    r"""New identities like those of a table: drawn from the Gaussian that has their mean and covariance.

    .. math:: \beta = \bar\beta + \frac{s}{\sqrt{I - 1}} \sum_{i=1}^{I} z_i \, (\beta_i - \bar\beta),
              \qquad z_i \sim N(0, 1)

    So bodies are drawn for SMAL, whose shapes beyond the scanned toys are all of this kind. Rows whose coefficients are
    shares of given bodies, as those of the shipped animals, give rows that sum to one as well, some shares of which are
    negative.

    Args:
        identities: ``(I, K)`` shape coefficients, at least two rows.
        count: how many.
        spread: factor s on the standard deviations. At 1 a few animals in a hundred turn inside out somewhere.
        generator: of the numbers z, which are drawn on its device; on the CPU if ``None``.

    Returns:
        ``(count, K)``.

    Raises:
        ValueError: fewer than two rows, coefficients that are not finite, or a negative ``count`` or ``spread``.

    Example:
        >>> from meshkit.data import load_shipped
        >>> animals, split = load_shipped("animals")
        >>> new = sample_identities(animals.identities[split.train_identities], 5, spread=0.7)
        >>> animals(new, split.train_poses[:5]).shape
        torch.Size([5, 1962, 3])
    """
    if identities.dim() != 2 or len(identities) < 2:
        raise ValueError(f"a table of at least two rows (I, K) is needed, got {tuple(identities.shape)}")
    if count < 0 or not 0 <= spread < math.inf:
        raise ValueError(f"count and spread must not be negative, got {count} and {spread}")
    if not identities.isfinite().all():
        raise ValueError("the table has coefficients that are NaN or infinite")
    mean = identities.mean(0)
    device = "cpu" if generator is None else generator.device
    z = torch.randn(count, len(identities), generator=generator, device=device, dtype=identities.dtype).to(identities)
    return mean + spread * (z @ (identities - mean)) / (len(identities) - 1) ** 0.5


def sample_poses(poses: Tensor, parents: Tensor, count: int, *, generator: torch.Generator | None = None) -> Tensor:
    r"""New poses, put together from those of a table: the trunk of one, each limb of another.

    .. math:: R'_j = R^{(p_{l(j)})}_j, \qquad p_0, \dots, p_L \sim U\{1, \dots, P\}

    where l(j) is the limb of joint j, 0 for the trunk. The trunk is the path from the root that goes on to an only
    child, or to the child that carries more than half of all joints; limbs are what branches off it: legs, arms and
    head of the shipped humans (a hand moves with its arm), legs, neck and tail of the animals. Joints turn as they do
    somewhere in the table; that limbs do not meet is not looked after.

    Args:
        poses: ``(P, J, 3)`` rotation vectors or ``(P, J, 3, 3)`` rotation matrices, local to each joint.
        parents: ``(J,)`` parent of each joint, -1 for the root; parents come first.
        count: how many.
        generator: of the draws, which are made on its device; on the CPU if ``None``.

    Returns:
        ``(count, J, ...)``, as ``poses``.

    Raises:
        ValueError: a negative ``count``; no poses, or not of these joints; ``parents`` that do not come first, or
            several roots.

    Example:
        >>> from meshkit.data import load_shipped
        >>> humans, split = load_shipped("humans")
        >>> new = sample_poses(humans.poses[split.train_poses], humans.parents, 5)
        >>> humans(split.train_identities[:5], new).shape
        torch.Size([5, 1000, 3])
    """
    if poses.dim() not in (3, 4) or len(poses) == 0 or poses.shape[1] != len(parents):
        raise ValueError(
            f"a table of poses of {len(parents)} joints (P, {len(parents)}, 3) or (P, {len(parents)}, 3, 3) is needed, "
            f"got {tuple(poses.shape)}"
        )
    if count < 0:
        raise ValueError(f"count must not be negative, got {count}")
    check_parents(parents.tolist())
    limb = _limbs(parents.tolist())
    device = "cpu" if generator is None else generator.device
    donors = torch.randint(len(poses), (count, max(limb) + 1), generator=generator, device=device)
    joints = torch.arange(len(parents), device=poses.device)
    return poses[donors[:, limb].to(poses.device), joints]


def _limbs(parents: list[int]) -> list[int]:
    """Limb of each joint, counted from 1; 0 for the trunk."""
    children: list[list[int]] = [[] for _ in parents]
    for joint, parent in enumerate(parents[1:], 1):
        children[parent].append(joint)
    carried = [1] * len(parents)
    for joint in range(len(parents) - 1, 0, -1):
        carried[parents[joint]] += carried[joint]
    trunk = {0}
    for joint, parent in enumerate(parents[1:], 1):
        if parent in trunk and (len(children[parent]) == 1 or 2 * carried[joint] > len(parents)):
            trunk.add(joint)
    limb, found = [0] * len(parents), 0
    for joint, parent in enumerate(parents[1:], 1):
        if joint not in trunk:
            found += parent in trunk
            limb[joint] = found if parent in trunk else limb[parent]
    return limb
