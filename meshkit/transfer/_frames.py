"""Axes: from any file's to those that the weights were trained in, and back."""

import itertools

import torch
from torch import Tensor

__all__ = ["among", "axis_name", "axis_vector", "rotations", "turn_up", "turns_about"]


def axis_vector(axis: str) -> Tensor:
    """Unit vector (3,) of a signed axis such as ``"+z"`` or ``"-y"``.

    Raises:
        ValueError: no such axis.
    """
    sign, letter = (axis[0], axis[1:]) if axis[:1] in "+-" else ("+", axis)
    if letter not in ("x", "y", "z"):
        raise ValueError(f"an axis is +x, -x, +y, -y, +z or -z, got {axis!r}")
    vector = torch.zeros(3, device="cpu")
    vector["xyz".index(letter)] = -1.0 if sign == "-" else 1.0
    return vector


def axis_name(vector: Tensor) -> str:
    """Signed axis nearest to a vector."""
    index = int(vector.abs().argmax())
    return f"{'-' if vector[index] < 0 else '+'}{'xyz'[index]}"


def rotations(up: str | None = None, facing: str | None = None) -> Tensor:
    """The rotations (R, 3, 3) along the axes that bring ``up`` to +z and ``facing`` to -y; the identity first.

    ``verts @ rotation.T`` turns. Without ``up`` and ``facing`` there are 24, with one of them 4, with both 1.

    Raises:
        ValueError: no such axis, or two parallel ones.
    """
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = torch.zeros(3, 3, device="cpu")
            matrix[range(3), order] = matrix.new_tensor(signs)
            fits = torch.linalg.det(matrix) > 0
            fits &= up is None or bool((matrix[2] == axis_vector(up)).all())
            fits &= facing is None or bool((matrix[1] == -axis_vector(facing)).all())
            found += [matrix] if fits else []
    if not found:
        raise ValueError(f"up and facing must be at right angles, got {up} and {facing}")
    return torch.stack(sorted(found, key=lambda matrix: -float(matrix.trace())))


def turns_about(rotation: Tensor) -> Tensor:
    """A rotation (3, 3) and the six that are a quarter turn away: (7, 3, 3), itself first."""
    quarters = [torch.eye(3, device="cpu"), *(turn for turn in rotations() if abs(float(turn.trace()) - 1) < 0.5)]
    return torch.stack(quarters).to(rotation) @ rotation


def among(turns: Tensor, others: Tensor) -> Tensor:
    """Which of the rotations (R, 3, 3) are equal to one of the others (K, 3, 3): (R,) bool."""
    return (turns[:, None] == others.to(turns)).all(-1).all(-1).any(1)


def turn_up(source: Tensor, target: Tensor) -> Tensor:
    """The least rotation (3, 3) along the axes that takes one up axis to another."""
    if bool((source == target).all()):
        return torch.eye(3, dtype=source.dtype, device=source.device)
    axis = torch.linalg.cross(source, target)
    if not bool(axis.any()):  # opposite: a half turn about x, or about y if x is up
        return torch.diag(source.new_tensor([1, -1, -1] if source[0] == 0 else [-1, 1, -1]))
    return torch.outer(axis, axis) + torch.outer(target, source) - torch.outer(source, target)
