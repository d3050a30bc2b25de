"""New identities and poses like those of a rig's tables, to train on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from meshkit.data.rigged import check_parents, check_shapes

__all__ = ["sample_bone_factors", "sample_identities", "sample_poses", "scale_bones"]


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


def scale_bones(
    verts: Tensor, joints: Tensor, weights: Tensor, parents: Tensor, factors: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Bodies at rest with other proportions: what follows a joint is stretched about it, along the axes of space.

    .. math:: q_j = q_{p(j)} + S_{p(j)} (J_j - J_{p(j)}), \qquad
              v' = \sum_j w_j \bigl(S_j (v - J_j) + q_j\bigr), \qquad S_j = \mathrm{diag}(s_j)

    Linear-blend skinning with stretches instead of turns; a joint's stretch does not reach those after it. A leg that
    is straight down at rest is made longer by the third factor of its joints, and thicker by the others.

    Args:
        verts: ``(B, V, 3)`` at rest.
        joints: ``(B, J, 3)`` at rest.
        weights: ``(V, J)`` skinning weights, rows sum to one.
        parents: ``(J,)`` parent of each joint, -1 for the root; parents come first.
        factors: ``(B, J, 3)`` stretch of each joint's surroundings along x, y and z.

    Returns:
        vertices ``(B, V, 3)`` and joints ``(B, J, 3)``; the root stays where it is.

    Raises:
        ValueError: shapes that do not fit, or ``parents`` that do not come first.

    Example:
        >>> from meshkit.data import load_shipped
        >>> animals, _ = load_shipped("animals")
        >>> verts, joints = animals.shape(torch.tensor([0, 1]))
        >>> factors = sample_bone_factors(joints[0], animals.parents, 2, spread=0.2)
        >>> scale_bones(verts, joints, animals.weights, animals.parents, factors)[0].shape
        torch.Size([2, 1962, 3])
    """
    batch, number = len(verts), len(parents)
    expected = {
        "verts": (verts, (batch, len(weights), 3)),
        "joints": (joints, (batch, number, 3)),
        "weights": (weights, (len(weights), number)),
        "factors": (factors, (batch, number, 3)),
    }
    check_shapes(expected)
    ancestry = parents.tolist()
    check_parents(ancestry)
    moved = [joints[:, 0]]
    for joint, parent in enumerate(ancestry[1:], 1):
        moved.append(moved[parent] + factors[:, parent] * (joints[:, joint] - joints[:, parent]))
    placed = torch.stack(moved, 1)
    return verts * (weights @ factors) + weights @ (placed - factors * joints), placed


def sample_bone_factors(
    joints: Tensor, parents: Tensor, count: int, *, spread: float, generator: torch.Generator | None = None
) -> Tensor:
    r"""Factors for :func:`scale_bones`: limbs differ in length and girth, the same on the left and on the right.

    .. math:: s_j = \exp\bigl(\sigma (c_{l(j)} + \tfrac12 a_{l(j)} + \tfrac12 b_j)\bigr), \qquad
              a, b \sim N(0, I_3), \quad c \sim N(0, 1)

    where l(j) is the limb of joint j, as in :func:`sample_poses`. Joints and limbs that mirror one another in the plane
    x = 0 get the same numbers.

    Args:
        joints: ``(J, 3)`` rest joints, left and right apart along x.
        parents: ``(J,)`` parent of each joint, -1 for the root; parents come first.
        count: how many bodies.
        spread: standard deviation :math:`\sigma` of the logarithm by which a limb is stretched as a whole; that of a
            factor is :math:`\sqrt{3/2}` times as large.
        generator: of the draws, which are made on its device; on the CPU if ``None``.

    Returns:
        ``(count, J, 3)``, positive.

    Raises:
        ValueError: shapes that do not fit, a negative ``count`` or ``spread``, or ``parents`` that do not come first.
    """
    if joints.shape != (len(parents), 3):
        raise ValueError(f"joints must have shape {(len(parents), 3)}, got {tuple(joints.shape)}")
    if count < 0 or not 0 <= spread < math.inf:
        raise ValueError(f"count and spread must not be negative, got {count} and {spread}")
    ancestry = parents.tolist()
    check_parents(ancestry)
    # Joints may lie at one place, as those of a hand's fingers: what follows them tells them apart.
    places = torch.stack([joints, _subtree_means(joints, ancestry)], 1)
    opposite = places * joints.new_tensor([-1.0, 1.0, 1.0])
    mirrored = torch.cdist(opposite.flatten(1), places.flatten(1)).argmin(1).tolist()
    limbs = _limbs(ancestry)
    same_joint = [min(joint, other) for joint, other in enumerate(mirrored)]
    same_limb = [min(limbs[joint], limbs[other]) for joint, other in enumerate(mirrored)]
    device = "cpu" if generator is None else generator.device
    drawn = torch.randn(3, count, len(parents), 3, generator=generator, device=device, dtype=joints.dtype).to(joints)
    whole, limb, joint = drawn[0, :, same_limb, :1], drawn[1, :, same_limb], drawn[2, :, same_joint]
    return (spread * (whole + limb / 2 + joint / 2)).exp()


def _subtree_means(joints: Tensor, parents: list[int]) -> Tensor:
    """Mean (J, 3) of each joint and all that follow it."""
    sums, counts = list(joints), [1] * len(parents)
    for joint in range(len(parents) - 1, 0, -1):
        sums[parents[joint]] = sums[parents[joint]] + sums[joint]
        counts[parents[joint]] += counts[joint]
    return torch.stack([total / count for total, count in zip(sums, counts, strict=True)])


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
