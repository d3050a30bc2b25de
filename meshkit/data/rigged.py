"""Linear-blend skinning of a rigged body with shape directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["RiggedModel", "rotation_matrices"]


def rotation_matrices(rotation_vectors: Tensor) -> Tensor:
    r"""Rotation matrices of rotation vectors (axis times angle in radians), by Rodrigues' formula.

    .. math:: R = I + \frac{\sin\theta}{\theta} [r]_\times + \frac{1 - \cos\theta}{\theta^2} [r]_\times^2,
              \qquad \theta = \lVert r \rVert

    Smooth at zero: both quotients are evaluated through sinc.

    Args:
        rotation_vectors: ``(..., 3)``.

    Returns:
        ``(..., 3, 3)``.

    Example:
        >>> rotation_matrices(torch.tensor([0.0, 0.0, torch.pi / 2])).round().int().tolist()
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    """
    dtype = rotation_vectors.dtype
    rotation_vectors = rotation_vectors.to(torch.promote_types(dtype, torch.float32))
    squared = rotation_vectors.square().sum(-1)[..., None, None]
    small = squared < 1e-12
    angle = torch.where(small, 1.0, squared).sqrt()
    sine = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    half = torch.sin(angle / 2) / angle
    cosine = torch.where(small, 0.5 - squared / 24, 2 * half.square())
    x, y, z = rotation_vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=cross.dtype, device=cross.device)
    return (identity + sine * cross + cosine * (cross @ cross)).to(dtype)


class RiggedModel(nn.Module):
    r"""A body with shape directions, a skeleton and skinning weights.

    Shape: :math:`v = \bar v + \sum_k \beta_k S_k`, joints alike. Forward kinematics with local rotations :math:`R_j`
    about the rest joints :math:`J_j`, root first:

    .. math:: G_j = G_{p(j)} R_j, \qquad q_j = q_{p(j)} + G_{p(j)} (J_j - J_{p(j)}), \qquad
              v' = \sum_j w_j \bigl(G_j (v - J_j) + q_j\bigr)

    Local rotations are expressed in axes aligned with the world at rest, so one set of rotations is the same pose on
    every identity. Everything is a buffer: ``.to(device)`` moves it, and gradients flow to shape and pose. No buffer is
    persistent: ``state_dict()`` is empty, and a model that holds a body stores none of it.

    Args:
        template: ``(V, 3)`` mean shape.
        faces: ``(F, 3)`` int64.
        shape_dirs: ``(K, V, 3)`` shape directions.
        joints: ``(J, 3)`` rest joints of the mean shape.
        joint_dirs: ``(K, J, 3)`` how joints follow the shape.
        weights: ``(V, J)`` skinning weights; normalised to sum to 1 per vertex.
        parents: ``(J,)`` parent of each joint, -1 for the root, which is joint 0; parents come before children.
        pose_correctives: ``(9 (J - 1), V, 3)`` linear offsets in the entries of ``R_j - I`` of all joints but the
            root (SMPL's pose blend shapes), or ``None``.
        identities: ``(I, K)`` a table of known identities, for use by index.
        poses: ``(P, J, 3)`` a table of known poses as rotation vectors, or ``(P, J, 3, 3)`` as rotation matrices, for
            use by index.
        identity_names: what each row of ``identities`` is called; kept as a tuple, empty if nobody said.
        pose_names: likewise for ``poses``.

    Raises:
        ValueError: shapes disagree, a parent does not precede its child, or names do not match their table.

    Example:
        >>> from meshkit.data import load_humans
        >>> body = load_humans(1000)
        >>> body(torch.tensor([3, 4]), torch.tensor([10, 10])).shape
        torch.Size([2, 1000, 3])
        >>> body(torch.zeros(1, 40), torch.zeros(1, 74, 3)).allclose(body.template, atol=1e-6)
        True
    """

    template: Tensor
    faces: Tensor
    shape_dirs: Tensor
    joints: Tensor
    joint_dirs: Tensor
    weights: Tensor
    parents: Tensor
    pose_correctives: Tensor | None
    identities: Tensor | None
    poses: Tensor | None
    _ancestors: Tensor

    def __init__(
        self,
        template: Tensor,
        faces: Tensor,
        shape_dirs: Tensor,
        joints: Tensor,
        joint_dirs: Tensor,
        weights: Tensor,
        parents: Tensor,
        *,
        pose_correctives: Tensor | None = None,
        identities: Tensor | None = None,
        poses: Tensor | None = None,
        identity_names: Sequence[str] = (),
        pose_names: Sequence[str] = (),
    ) -> None:
        super().__init__()
        num_verts, num_joints, num_shapes = len(template), len(joints), len(shape_dirs)
        expected = {
            "template": (template, (num_verts, 3)),
            "faces": (faces, (len(faces), 3)),
            "shape_dirs": (shape_dirs, (num_shapes, num_verts, 3)),
            "joints": (joints, (num_joints, 3)),
            "joint_dirs": (joint_dirs, (num_shapes, num_joints, 3)),
            "weights": (weights, (num_verts, num_joints)),
            "parents": (parents, (num_joints,)),
            "pose_correctives": (pose_correctives, (9 * (num_joints - 1), num_verts, 3)),
            "identities": (identities, (0 if identities is None else len(identities), num_shapes)),
            "poses": (poses, (0 if poses is None else len(poses), num_joints, 3)),
        }
        if poses is not None and poses.dim() == 4:
            expected["poses"] = (poses, (len(poses), num_joints, 3, 3))
        check_shapes(expected)
        for name, (value, _) in expected.items():
            self.register_buffer(name, value, persistent=False)
        ancestry = parents.tolist()
        check_parents(ancestry)
        sums = weights.sum(1, keepdim=True)
        if bool((sums <= 0).any()):
            raise ValueError(
                f"{int((sums <= 0).sum())} vertices follow no joint: every row of weights needs a positive sum"
            )
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < num_verts:
            raise ValueError(f"faces must index {num_verts} vertices, got {int(faces.min())} to {int(faces.max())}")
        for table, names in ((identities, identity_names), (poses, pose_names)):
            if names and (table is None or len(names) != len(table)):
                rows = "no table" if table is None else f"{len(table)} rows"
                raise ValueError(f"every row of a table needs one name, got {len(names)} names for {rows}")
        self.identity_names, self.pose_names = tuple(identity_names), tuple(pose_names)
        self.weights = weights / sums
        self.register_buffer("_ancestors", _ancestors(ancestry).to(parents.device), persistent=False)

    @property
    def num_joints(self) -> int:
        """Number of joints J."""
        return len(self.joints)

    def shape(self, identity: Tensor) -> tuple[Tensor, Tensor]:
        """Rest vertices ``(B, V, 3)`` and joints ``(B, J, 3)`` of identities, by index or coefficients."""
        betas = self._betas(identity)
        verts = self.template + torch.einsum("bk,kvc->bvc", betas, self.shape_dirs)
        joints = self.joints + torch.einsum("bk,kjc->bjc", betas, self.joint_dirs)
        return verts, joints

    def forward(self, identity: Tensor, pose: Tensor) -> Tensor:
        """Posed vertices.

        Args:
            identity: ``(B,)`` integers, indices into ``identities``, or ``(B, K)`` shape coefficients.
            pose: ``(B,)`` integers, indices into ``poses``; ``(B, J, 3)`` rotation vectors in radians; or
                ``(B, J, 3, 3)`` rotation matrices.

        Returns:
            ``(B, V, 3)``.

        Raises:
            ValueError: indices without a table or out of its range, shapes that do not fit, batches that differ.
        """
        verts, joints = self.shape(identity)
        rotations = self._rotations(pose)
        if len(rotations) != len(verts):
            raise ValueError(f"identity and pose batches differ: {len(verts)} and {len(rotations)}")
        if self.pose_correctives is not None:
            bend = (rotations[:, 1:] - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).flatten(1)
            verts = verts + torch.einsum("bp,pvc->bvc", bend, self.pose_correctives)
        # Columns of the affine maps, so that one matrix product blends those of the whole batch: (4, J, B * 3).
        columns = self._kinematics(rotations, joints)[:, :, :3].permute(3, 1, 0, 2).flatten(2)
        blended = (self.weights @ columns).unflatten(2, (len(verts), 3)).transpose(1, 2)
        x, y, z = verts.split(1, 2)
        return torch.addcmul(torch.addcmul(torch.addcmul(blended[3], blended[0], x), blended[1], y), blended[2], z)

    def _kinematics(self, rotations: Tensor, joints: Tensor) -> Tensor:
        """Affine maps ``(B, J, 4, 4)`` that take each joint's surroundings from rest to the pose.

        Each joint starts with its own turn about its rest place; in every round it is followed by what its ancestor
        has gathered so far, and the ancestor's ancestor takes over. That doubles the length of the chain: a skeleton
        of depth 16 needs four products instead of sixteen. The root's ancestor is an extra joint that never moves.
        """
        maps = torch.eye(4, dtype=rotations.dtype, device=rotations.device)
        maps = maps.expand(len(rotations), self.num_joints + 1, 4, 4).clone()
        maps[:, :-1, :3, :3] = rotations
        maps[:, :-1, :3, 3] = joints - (rotations @ joints[..., None])[..., 0]
        for above in self._ancestors.unbind():
            maps = maps.index_select(1, above) @ maps
        return maps[:, :-1]

    def _betas(self, identity: Tensor) -> Tensor:
        _check_tensor(identity, "identity")
        if identity.is_floating_point():
            if identity.dim() != 2 or identity.shape[1] != len(self.shape_dirs):
                raise ValueError(f"coefficients must be (B, {len(self.shape_dirs)}), got {tuple(identity.shape)}")
            return identity
        return _rows(self.identities, identity, "identity")

    def _rotations(self, pose: Tensor) -> Tensor:
        _check_tensor(pose, "pose")
        if not pose.is_floating_point():
            pose = _rows(self.poses, pose, "pose")
        if pose.dim() == 3 and pose.shape[1:] == (self.num_joints, 3):
            return rotation_matrices(pose)
        if pose.dim() == 4 and pose.shape[1:] == (self.num_joints, 3, 3):
            return pose
        raise ValueError(
            f"pose must be (B,) integers, (B, {self.num_joints}, 3) rotation vectors or (B, {self.num_joints}, 3, 3) "
            f"matrices, got {tuple(pose.shape)}"
        )


def _check_tensor(value: Any, name: str) -> None:
    if not isinstance(value, Tensor):
        said = f"{value!r}" if isinstance(value, int) else type(value).__name__
        raise ValueError(f"{name} must be a batch, a tensor such as torch.tensor([3]), got {said}")


def check_shapes(expected: Mapping[str, tuple[Tensor | None, tuple[int, ...]]]) -> None:
    """Check that tensors, by name, have the shapes beside them; what is not there need not."""
    for name, (value, shape) in expected.items():
        if value is not None and value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(value.shape)}")


def check_parents(parents: list[int]) -> None:
    """Check that the skeleton has one root, which comes first, and every joint comes after its parent."""
    if parents[:1] != [-1] or not all(0 <= parent < joint for joint, parent in enumerate(parents[1:], 1)):
        raise ValueError(
            f"joint 0 must be the root (parent -1) and every other joint must come after its parent, got {parents}"
        )


def _rows(table: Tensor | None, index: Tensor, what: str) -> Tensor:
    if table is None:
        raise ValueError(f"this model has no table of {what} entries: give coefficients instead of indices")
    if index.dim() != 1 or (len(index) and not 0 <= int(index.min()) <= int(index.max()) < len(table)):
        raise ValueError(f"{what} indices must be a vector of values in [0, {len(table)}), got {index.tolist()}")
    return table[index]


def _ancestors(parents: list[int]) -> Tensor:
    """Ancestor of each joint 1, 2, 4, ... levels up, until all are beyond the root, where one more joint stands."""
    above = torch.tensor([*(p if p >= 0 else len(parents) for p in parents), len(parents)], device="cpu")
    rounds = []
    while bool((above < len(parents)).any()):
        rounds.append(above)
        above = above[above]
    return torch.stack(rounds) if rounds else above.new_zeros(0, len(parents) + 1)
