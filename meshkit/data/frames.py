"""Rigged models in other axes."""

from __future__ import annotations

import torch
from torch import Tensor

from meshkit.data.rigged import RiggedModel

__all__ = ["Y_UP_TO_Z_UP", "turn_axes"]

Y_UP_TO_Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
"""Rotation from y up, facing +z (SMPL, most files) to z up, facing -y (meshkit); x towards the body's left in both."""


def turn_axes(model: RiggedModel, rotation: Tensor) -> RiggedModel:
    r"""The same body in rotated axes: :math:`x' = C x` for every point, and :math:`R' = C R C^T` for every rotation.

    Rotation vectors turn like points, so a pose recorded in the old axes is ``vectors @ rotation.T`` in the new ones.
    Pose correctives are linear in the entries of :math:`R - I`; theirs are recombined, which changes no posed vertex.

    Args:
        model: the body.
        rotation: ``(3, 3)`` rotation C, for example ``torch.tensor(Y_UP_TO_Z_UP)``.

    Raises:
        ValueError: C is not a rotation.

    Example:
        >>> from meshkit.data import load_humans
        >>> body = load_humans()
        >>> torch.equal(turn_axes(body, torch.tensor(Y_UP_TO_Z_UP)).template[:, 2], body.template[:, 1])
        True
    """
    c = rotation.to(model.template)
    eye = torch.eye(3, dtype=c.dtype, device=c.device)
    if c.shape != (3, 3) or not torch.allclose(c @ c.mT, eye, atol=1e-5) or torch.linalg.det(c) < 0:
        raise ValueError(f"rotation must be a (3, 3) rotation matrix, got {rotation.tolist()}")
    correctives, poses = model.pose_correctives, model.poses
    if correctives is not None:
        blocks = correctives.unflatten(0, (-1, 3, 3))
        correctives = torch.einsum("ac,bd,ef,jcdvf->jabve", c, c, c, blocks).flatten(0, 2)
    if poses is not None:
        poses = poses @ c.mT if poses.dim() == 3 else c @ poses @ c.mT
    return RiggedModel(
        model.template @ c.mT,
        model.faces,
        model.shape_dirs @ c.mT,
        model.joints @ c.mT,
        model.joint_dirs @ c.mT,
        model.weights,
        model.parents,
        pose_correctives=correctives,
        identities=model.identities,
        poses=poses,
        identity_names=model.identity_names,
        pose_names=model.pose_names,
    )
