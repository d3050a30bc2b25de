"""A small rig and literal transcriptions of what meshkit.data computes, for its tests."""

import numpy as np
import torch
from conftest import rand
from scipy.spatial import cKDTree
from torch import Tensor

from meshkit.data import PairBatch, RiggedModel


def volume(verts: Tensor, faces: Tensor) -> Tensor:
    a, b, c = verts.double()[..., faces, :].unbind(-2)
    return (a * torch.linalg.cross(b, c)).sum((-1, -2)) / 6


def synthetic_rig(correctives: bool = False) -> RiggedModel:
    """Seven joints with two branches, twelve vertices that all joints move, three shape directions; float64."""
    num_verts, num_shapes, parents = 12, 3, torch.tensor([-1, 0, 1, 1, 0, 4, 2])
    num_joints = len(parents)
    return RiggedModel(
        rand(num_verts, 3, seed=1),
        torch.tensor([[0, 1, 2], [2, 1, 3]]),
        rand(num_shapes, num_verts, 3, seed=2),
        rand(num_joints, 3, seed=3),
        rand(num_shapes, num_joints, 3, seed=4),
        rand(num_verts, num_joints, seed=5).abs(),
        parents,
        pose_correctives=0.1 * rand(9 * (num_joints - 1), num_verts, 3, seed=6) if correctives else None,
        identities=rand(4, num_shapes, seed=7),
        poses=rand(5, num_joints, 3, seed=8),
    )


def parts(model: RiggedModel, **changes: Tensor) -> dict[str, Tensor]:
    """The constructor's arguments that rebuild a model, some of them changed."""
    names = ("template", "faces", "shape_dirs", "joints", "joint_dirs", "weights", "parents")
    return {name: getattr(model, name) for name in names} | changes


def skin_literally(model: RiggedModel, betas: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """The equations of RiggedModel, one sample, one joint and one vertex at a time."""
    tables = {name: value.numpy() for name, value in model.named_buffers()}
    out = np.zeros((len(betas), *tables["template"].shape), tables["template"].dtype)
    for b in range(len(betas)):
        verts, joints = tables["template"].copy(), tables["joints"].copy()
        for k, beta in enumerate(betas[b]):
            verts += beta * tables["shape_dirs"][k]
            joints += beta * tables["joint_dirs"][k]
        if "pose_correctives" in tables:
            entry = 0
            for j in range(1, len(joints)):
                for row in range(3):
                    for column in range(3):
                        verts += (rotations[b, j, row, column] - (row == column)) * tables["pose_correctives"][entry]
                        entry += 1
        turn, place = [rotations[b, 0]], [joints[0]]
        for j in range(1, len(joints)):
            p = tables["parents"][j]
            turn.append(turn[p] @ rotations[b, j])
            place.append(place[p] + turn[p] @ (joints[j] - joints[p]))
        for v, vertex in enumerate(verts):
            for j, weight in enumerate(tables["weights"][v]):
                out[b, v] += weight * (turn[j] @ (vertex - joints[j]) + place[j])
    return out


def nearest(points: Tensor, mesh: Tensor) -> Tensor:
    """Index of the vertex of ``mesh`` that coincides with each point."""
    distance, index = cKDTree(mesh.double().numpy()).query(points.double().numpy())
    assert distance.max() < 1e-5
    return torch.from_numpy(index)


def centred(verts: Tensor) -> Tensor:
    return verts - (verts.amin(0) + verts.amax(0)) / 2


def assert_same(a: PairBatch, b: PairBatch) -> None:
    for name in PairBatch.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if x is None:
            assert y is None
        else:
            # Products of another batch size may round differently in the last bit.
            torch.testing.assert_close(x, y, rtol=0, atol=1e-6 if x.is_floating_point() else 0, msg=name)


def stack(batches: list[PairBatch]) -> PairBatch:
    columns = {name: [getattr(b, name) for b in batches] for name in PairBatch.__dataclass_fields__}
    return PairBatch(**{name: None if v[0] is None else torch.cat(v) for name, v in columns.items()})


def assert_closed_genus_0(verts: Tensor, faces: Tensor) -> None:
    """One closed, consistently oriented surface without handles, that every vertex belongs to."""
    num_verts = len(verts)
    assert faces.dtype == torch.int64
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    codes = directed[:, 0] * num_verts + directed[:, 1]
    # Each directed edge once, and its reverse too: every edge lies in exactly two faces, traversed in opposite ways.
    assert len(codes.unique()) == len(codes)
    assert torch.equal(codes.sort()[0], (directed[:, 1] * num_verts + directed[:, 0]).sort()[0])
    assert num_verts - len(codes) // 2 + len(faces) == 2
    assert torch.equal(faces.unique(), torch.arange(num_verts))
    fan = torch.bincount(faces.flatten(), minlength=num_verts)
    assert fan.min() >= 3
    # One component: the whole surface is reached from vertex 0.
    reached = torch.zeros(num_verts, dtype=torch.bool)
    reached[0] = True
    while True:
        grown = reached.clone()
        grown[directed[reached[directed[:, 0]], 1]] = True
        if torch.equal(grown, reached):
            break
        reached = grown
    assert reached.all()
    assert (verts[faces[:, 1]] - verts[faces[:, 0]]).norm(dim=1).min() > 1e-5
