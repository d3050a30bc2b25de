"""Deformation transfer against the least squares with a fourth vertex, and across connectivities."""

from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from conftest import rand
from scipy import sparse

from meshkit.data import load_humans
from meshkit.deform import closest_rotation, deformation_transfer, key_point_correspondence
from meshkit.ot import sinkhorn

DOUBLE = torch.float64


def ellipsoid(subdivisions: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    verts = torch.tensor(np.asarray(mesh.vertices)) * torch.tensor([1.0, 0.8, 0.6], dtype=DOUBLE)
    return verts + 0.02 * rand(*verts.shape), torch.tensor(np.asarray(mesh.faces), dtype=torch.int64)


def bodies(size: int = 1000) -> tuple[torch.Tensor, ...]:
    """Two identities at rest, the first in three poses, the second in the same ones, and the faces."""
    rig = load_humans(size)
    who, poses = torch.tensor([0, 0, 0]), torch.tensor([7, 20, 33])
    rest = rig.shape(torch.tensor([0, 5]))[0].double()
    return rest[0], rig(who, poses).double(), rest[1], rig(who + 5, poses).double(), rig.faces


def four_vertex_least_squares(s: np.ndarray, p: np.ndarray, t: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Literal Sumner and Popovic: a fourth vertex per face, all vertices unknown, the first one fixed."""

    def corners(v: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, float]:
        a, b = v[f[1]] - v[f[0]], v[f[2]] - v[f[0]]
        normal = np.cross(a, b)
        length = np.linalg.norm(normal)
        return np.stack([a, b, normal / np.sqrt(length)], 1), length / 2

    count, rows = len(t), []
    right = np.zeros((3 * len(faces), 3))
    system = sparse.lil_array((3 * len(faces), count + len(faces)))
    for k, f in enumerate(faces):
        J = corners(p, f)[0] @ np.linalg.inv(corners(s, f)[0])
        frame, area = corners(t, f)
        # (x1 - x0, x2 - x0, x3 - x0) frame^-1 = J
        inverse = np.linalg.inv(frame)
        columns = np.array([f[1], f[2], count + k])
        for i in range(3):
            row = 3 * k + i
            system[row, columns] = np.sqrt(area) * inverse[:, i]
            system[row, f[0]] = -np.sqrt(area) * inverse[:, i].sum()
            right[row] = np.sqrt(area) * J[:, i]
            rows.append(row)
    dense = system.toarray()[:, 1:]
    x = np.linalg.lstsq(dense, right, rcond=None)[0][: count - 1]
    return np.concatenate([np.zeros((1, 3)), x])


def test_equals_the_least_squares_with_a_fourth_vertex() -> None:
    source, faces = ellipsoid()
    posed = source @ torch.diag(torch.tensor([1.5, 0.8, 1.0], dtype=DOUBLE)) + 0.15 * rand(42, 3, seed=1)
    target = source * torch.tensor([0.7, 1.1, 1.3], dtype=DOUBLE) + 0.05 * rand(42, 3, seed=2)
    expected = four_vertex_least_squares(*(v.numpy() for v in (source, posed, target, faces)))
    got = deformation_transfer(source, posed, target, faces=faces).numpy()
    np.testing.assert_allclose(got - got[0], expected, atol=1e-10)
    np.testing.assert_allclose(got.mean(0), (target + posed - source).mean(0).numpy(), atol=1e-12)


def test_a_mesh_transfers_to_itself_and_batches_equal_the_loop() -> None:
    source, posed, target, truth, faces = bodies()
    padded = torch.cat([faces, torch.full((2, 3), -1)])
    torch.testing.assert_close(deformation_transfer(source, posed, source, faces=padded), posed, rtol=0, atol=1e-10)
    got = deformation_transfer(source, posed, target, faces=faces)
    for one, pose in zip(got, posed, strict=True):
        torch.testing.assert_close(one, deformation_transfer(source, pose, target, faces=faces))
    single = deformation_transfer(source.float(), posed.float(), target.float(), faces=faces)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), got, rtol=0, atol=1e-4)
    # The pose of another identity: within 2 cm of the truth, where the rest shape is 20 cm off.
    error, still = ((x - x.mean(1, keepdim=True)) - (truth - truth.mean(1, keepdim=True)) for x in (got, target[None]))
    assert error.norm(dim=2).mean() < 0.1 * still.norm(dim=2).mean()


def test_affine_and_rigid_motions_are_repeated() -> None:
    source, faces = ellipsoid()
    target = source * torch.tensor([0.7, 1.1, 1.3], dtype=DOUBLE)
    turn = closest_rotation(rand(3, 3))
    got = deformation_transfer(source, source @ turn.T + 5, target, faces=faces)
    edges = got - got.mean(0) - (target - target.mean(0)) @ turn.T
    assert edges.abs().max() < 1e-12
    torch.testing.assert_close(got.mean(0), target.mean(0) + (source @ turn.T + 5 - source).mean(0))


def test_components_move_as_theirs_did() -> None:
    source, faces = ellipsoid()
    both, faces = torch.cat([source, source + 5]), torch.cat([faces, faces + 42])
    posed = torch.cat([source + 1, 1.2 * source + 3])
    got = deformation_transfer(both, posed, 2 * both, faces=faces)
    moved = (posed - both).view(2, 42, 3).mean(1) + 2 * both.view(2, 42, 3).mean(1)
    torch.testing.assert_close(got.view(2, 42, 3).mean(1), moved)


def test_gradient_reaches_the_posed_source() -> None:
    source, faces = ellipsoid(0)
    posed = (source + 0.1 * rand(2, 12, 3, seed=1)).requires_grad_()
    target = source * torch.tensor([0.7, 1.1, 1.3], dtype=DOUBLE)
    assert torch.autograd.gradcheck(
        lambda p: deformation_transfer(source, p, target, faces=faces), posed, fast_mode=True
    )
    options: dict[str, Any] = {"target_faces": faces, "correspondence": torch.softmax(rand(12, 12), 1)}
    assert torch.autograd.gradcheck(
        lambda p: deformation_transfer(source, p, target, faces=faces, **options), posed, atol=1e-5, fast_mode=True
    )


def test_kinds_of_correspondence_agree() -> None:
    source, posed, _, _, faces = bodies()
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    place = torch.argsort(order)  # target vertex i is source vertex order[i]
    options: dict[str, Any] = {"faces": faces, "target_faces": place[faces]}
    by_index = deformation_transfer(source, posed[0], source[order], correspondence=order, **options)
    dense = torch.eye(1000)[order]
    for other in (3 * dense, dense.to_sparse()):
        got = deformation_transfer(source, posed[0], source[order], correspondence=other, **options)
        torch.testing.assert_close(got, by_index)
    plan = sinkhorn(50 * source[order][None], 50 * source[None], eps=1e-3, cost="sqeuclidean", n_iters=20)
    got = deformation_transfer(source, posed[0], source[order], correspondence=plan, **options)
    torch.testing.assert_close(got, by_index, rtol=0, atol=5e-3)
    # Means over the faces around a vertex smooth the pose a little.
    error = (by_index - posed[0][order]).norm(dim=1)
    assert error.mean() < 0.02 < (source - posed[0]).norm(dim=1).mean()


def test_other_connectivity_through_key_points() -> None:
    fine, coarse = load_humans(2000), load_humans(1000)
    who, pose = torch.tensor([5]), torch.tensor([7])
    source, posed = fine.shape(torch.tensor([0]))[0][0].double(), fine(torch.tensor([0]), pose)[0].double()
    target, truth = coarse.shape(who)[0][0].double(), coarse(who, pose)[0].double()

    # The top of the head, the hands, the feet and a point in front: six points
    def marks(verts: torch.Tensor) -> torch.Tensor:
        ends = [verts[:, 2].argmax(), verts[:, 0].argmax(), verts[:, 0].argmin()]
        for side in (1, -1):
            leg = torch.where(side * verts[:, 0] > 0, verts[:, 2], torch.inf)
            ends.append(leg.argmin())
        middle = torch.where(verts[:, 0].abs() < 0.03, verts[:, 1], torch.inf)
        ends.append(middle.argmin())
        return torch.stack(ends)

    pairs = torch.stack([marks(target), marks(source)], 1)
    matrix = key_point_correspondence(source, target, pairs, source_faces=fine.faces, target_faces=coarse.faces)
    torch.testing.assert_close(matrix.to_dense().sum(1), torch.ones(1000, dtype=DOUBLE))
    got = deformation_transfer(
        source, posed, target, faces=fine.faces, target_faces=coarse.faces, correspondence=matrix
    )
    error, still = ((x - x.mean(0)) - (truth - truth.mean(0)) for x in (got, target))
    # 3 cm, where the rest shape is 24 cm off
    assert error.norm(dim=1).mean() < 0.2 * still.norm(dim=1).mean()


def test_spline_meets_key_points_and_repeats_affine_maps() -> None:
    source, faces = ellipsoid()
    affine = torch.eye(3, dtype=DOUBLE) + 0.3 * rand(3, 3)
    target = (source - 1) @ torch.linalg.inv(affine).T
    pairs = torch.tensor([0, 5, 11, 17, 30])[:, None].expand(-1, 2)
    options: dict[str, Any] = {"source_faces": faces, "target_faces": faces}
    matrix = key_point_correspondence(source, target, pairs, **options, k=1)
    assert torch.equal(matrix.to_dense(), torch.eye(42, dtype=DOUBLE))
    smooth = key_point_correspondence(source, target, pairs, **options, smoothing=10.0)
    assert torch.equal(smooth.to_dense().argmax(1), torch.arange(42))  # an affine map bends nothing


def test_a_flat_posed_face_is_fine() -> None:
    source, faces = ellipsoid(0)
    posed = source.clone()
    posed[faces[0, 1]] = posed[faces[0, 0]]
    posed.requires_grad_()
    got = deformation_transfer(source, posed, source, faces=faces)
    got.square().sum().backward()
    assert got.isfinite().all() and posed.grad.isfinite().all()


SOURCE, FACES = ellipsoid(0)
INDEX = torch.arange(12)
MAPPED: dict[str, Any] = {"target_faces": FACES, "correspondence": INDEX}
FLAT = SOURCE.clone()
FLAT[FACES[0, 0]] = 0.5 * (FLAT[FACES[0, 1]] + FLAT[FACES[0, 2]])
LOOSE = torch.cat([SOURCE, SOURCE[:1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source_rest": SOURCE.long()}, r"source_rest must be a floating \(V, 3\) tensor, got torch.int64"),
        ({"source_posed": SOURCE[:, :2]}, r"source_posed must be a floating \(V, 3\) or \(P, V, 3\) tensor, got"),
        ({"source_posed": SOURCE[:-1]}, r"source_posed \(11, 3\) must have the 12 vertices of source_rest"),
        ({"target_rest": SOURCE * torch.nan}, "target_rest holds NaN or infinity"),
        (
            {"target_rest": SOURCE[:0], "target_faces": FACES[:0], "correspondence": INDEX[:0]},
            r"target_rest \(0, 3\) holds no vertex",
        ),
        ({"target_rest": LOOSE}, "target_rest has 13 vertices and source_rest 12: .* need target_faces"),
        ({"faces": FACES + 1}, r"\[0, 12\) .* got a range of \[1, 12\]"),
        ({"target_faces": FACES}, "belong together; correspondence is missing"),
        ({"correspondence": INDEX}, "belong together; target_faces is missing"),
        ({"source_rest": FLAT}, "1 faces of the source have area zero at rest"),
        ({"target_rest": FLAT}, "1 faces of the target have area zero at rest"),
        (
            {"source_rest": LOOSE, "source_posed": LOOSE, "target_rest": LOOSE},
            "1 vertices of the target are in no face",
        ),
        (MAPPED | {"correspondence": INDEX[1:]}, r"as an index \(12,\), a matrix \(12, 12\) or a plan .* got \(11,\)"),
        (MAPPED | {"correspondence": INDEX.double()}, "must hold integer indices, got torch.float64"),
        (MAPPED | {"correspondence": INDEX + 1}, r"must index \[0, 12\), got a range of \[1, 12\]"),
        (MAPPED | {"correspondence": torch.diag(INDEX.float())}, "1 target vertices correspond to no source vertex"),
    ],
)
def test_transfer_rejects(change: dict, message: str) -> None:
    arguments = {"source_rest": SOURCE, "source_posed": SOURCE, "target_rest": SOURCE, "faces": FACES} | change
    with pytest.raises(ValueError, match=message):
        deformation_transfer(**arguments)


PAIRS = torch.arange(5)[:, None].expand(-1, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key_points": PAIRS.double()}, r"key_points must be an integer \(K, 2\) tensor, got torch.float64"),
        ({"key_points": PAIRS[:3]}, "3 key points do not span space; give at least 4"),
        ({"key_points": PAIRS + torch.tensor([8, 0])}, r"target vertices .* \[0, 12\), got a range of \[8, 12\]"),
        ({"key_points": PAIRS - torch.tensor([0, 1])}, r"source vertices .* got a range of \[-1, 3\]"),
        ({"key_points": PAIRS // 2 * 2}, "2 key points name a target vertex again"),
        ({"target_rest": SOURCE * torch.tensor([1.0, 1, 0])}, "lie in one plane"),
        ({"smoothing": -1.0}, "smoothing must be at least 0, got -1.0"),
        ({"k": 13}, "k must be between 1 and the 12 source vertices, got 13"),
    ],
)
def test_key_points_reject(change: dict, message: str) -> None:
    arguments: dict[str, Any] = {"source_rest": SOURCE, "target_rest": SOURCE, "key_points": PAIRS}
    arguments |= {"source_faces": FACES, "target_faces": FACES} | change
    with pytest.raises(ValueError, match=message):
        key_point_correspondence(**arguments)
