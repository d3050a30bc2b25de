"""Connectivity and first-order geometry against libigl, SciPy, literal loops and closed forms."""

import math

import igl
import numpy as np
import pytest
import scipy.sparse.csgraph as csgraph
import torch
import trimesh

from meshkit.topology import (
    check_faces,
    connected_components,
    cotangent_laplacian,
    cotangent_weights,
    face_normals,
    mass_matrix,
    unique_edges,
    vertex_adjacency,
    vertex_normals,
)


def bumpy_sphere(seed: int = 0, subdivisions: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an icosphere shaken enough to have obtuse angles and negative cotangent weights."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    noise = np.random.default_rng(seed).normal(scale=0.06, size=mesh.vertices.shape)
    return torch.tensor(np.asarray(mesh.vertices) + noise), torch.tensor(np.asarray(mesh.faces), dtype=torch.int64)


PAD = torch.full((2, 3), -1)


def test_unique_edges_matches_a_set() -> None:
    _, faces = bumpy_sphere()
    expected = sorted({tuple(sorted(p)) for a, b, c in faces.tolist() for p in ((a, b), (b, c), (c, a))})
    assert unique_edges(torch.cat([PAD, faces])).tolist() == [list(p) for p in expected]


def test_unique_edges_of_nothing_and_of_a_point_face() -> None:
    assert unique_edges(torch.empty(0, 3, dtype=torch.int64)).shape == (0, 2)
    assert unique_edges(torch.tensor([[4, 4, 4]])).shape == (0, 2)
    assert unique_edges(torch.tensor([[4, 4, 2]], dtype=torch.int32)).tolist() == [[2, 4]]


def test_adjacency_matches_libigl() -> None:
    verts, faces = bumpy_sphere()
    got = vertex_adjacency(torch.cat([faces, PAD]), len(verts))
    assert torch.equal(got.to_dense(), torch.tensor(igl.adjacency_matrix(faces.numpy()).toarray()).float())


def test_components_match_scipy_up_to_relabelling() -> None:
    _, faces = bumpy_sphere(subdivisions=1)
    n = int(faces.max()) + 1
    perm = torch.randperm(2 * n + 1, generator=torch.Generator().manual_seed(0))
    faces = perm[torch.cat([faces, faces + n])]  # two spheres, interleaved, and one isolated vertex
    labels = connected_components(torch.cat([faces, PAD]), 2 * n + 1)
    count, expected = csgraph.connected_components(vertex_adjacency(faces, 2 * n + 1).to_dense().numpy())
    assert count == 3 == len(labels.unique())
    assert len({*zip(labels.tolist(), expected.tolist(), strict=True)}) == 3


def test_cotangents_of_a_known_triangle() -> None:
    angles = torch.tensor([50.0, 110.0, 20.0], dtype=torch.float64) * math.pi / 180
    b, c = torch.sin(angles[1]), torch.sin(angles[2])  # law of sines: sides opposite corners 1 and 2
    apex = torch.stack([b * torch.cos(angles[0]), b * torch.sin(angles[0])])
    verts = torch.zeros(3, 3, dtype=torch.float64)
    verts[1, 0], verts[2, :2] = c, apex
    got = cotangent_weights(verts, torch.tensor([[0, 1, 2]]))
    torch.testing.assert_close(got[0], 0.5 / torch.tan(angles))


def test_laplacian_matches_libigl_and_is_positive_semidefinite() -> None:
    verts, faces = bumpy_sphere()
    got = cotangent_laplacian(verts, torch.cat([faces, PAD])).to_dense()
    torch.testing.assert_close(got, torch.tensor(-igl.cotmatrix(verts.numpy(), faces.numpy()).toarray()))
    assert (got - torch.diag(got.diagonal())).max() > 0  # the mesh has negative weights, so this is not trivial
    assert torch.linalg.eigvalsh(got).min() > -1e-10


@pytest.mark.parametrize("kind", ["voronoi", "barycentric"])
def test_mass_matches_libigl_and_sums_to_the_area(kind: str) -> None:
    verts, faces = bumpy_sphere()
    which = getattr(igl.MassMatrixType, f"MASSMATRIX_TYPE_{kind.upper()}")
    got = mass_matrix(verts, torch.cat([faces, PAD]), kind=kind)
    torch.testing.assert_close(got, torch.tensor(igl.massmatrix(verts.numpy(), faces.numpy(), which).diagonal()))
    assert math.isclose(float(got.sum()), trimesh.Trimesh(verts.numpy(), faces.numpy(), process=False).area)


def test_normals_match_libigl() -> None:
    verts, faces = bumpy_sphere()
    v, f = verts.numpy(), faces.numpy()
    torch.testing.assert_close(face_normals(verts, faces), torch.tensor(igl.per_face_normals(v, f, np.zeros(3))))
    expected = igl.per_vertex_normals(v, f, igl.PerVertexNormalsWeightingType.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA)
    torch.testing.assert_close(vertex_normals(verts, faces), torch.tensor(expected))


@pytest.mark.parametrize("function", [cotangent_weights, mass_matrix, face_normals, vertex_normals])
def test_batches_equal_the_loop_and_padding_changes_nothing(function) -> None:
    meshes = [bumpy_sphere(seed=s, subdivisions=1) for s in range(3)]
    shared = torch.stack([v for v, _ in meshes])
    faces = meshes[0][1]
    alone = torch.stack([function(v, faces) for v in shared])
    torch.testing.assert_close(function(shared, faces), alone)
    torch.testing.assert_close(function(shared[:, None], faces), alone[:, None])
    own = torch.stack([torch.cat([faces.roll(s, 0), PAD]) for s in range(3)])
    got = function(shared, own)
    for b in range(3):
        expected = function(shared[b], faces.roll(b, 0))
        torch.testing.assert_close(got[b, : len(expected)], expected)
        assert not got[b, len(expected) :].any()


def dense_laplacian(verts: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    return cotangent_laplacian(verts, faces).to_dense()


@pytest.mark.parametrize("function", [cotangent_weights, dense_laplacian, mass_matrix, face_normals, vertex_normals])
def test_gradients(function) -> None:
    generator = torch.Generator().manual_seed(3)
    verts = torch.randn(5, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [-1, -1, -1]])
    assert torch.autograd.gradcheck(lambda v: function(v, faces), (verts,))


@pytest.mark.parametrize("third", [[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]], ids=["collinear", "zero length"])
@pytest.mark.parametrize("function", [cotangent_weights, mass_matrix, face_normals, vertex_normals])
def test_degenerate_faces_give_zero_and_finite_gradients(function, third: list[float]) -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], third], requires_grad=True)
    got = function(verts, torch.tensor([[0, 1, 2]]))
    assert not got.any()
    (gradient,) = torch.autograd.grad(got.sum(), verts)
    assert torch.isfinite(gradient).all()


def test_float32_and_device_follow_the_input() -> None:
    verts, faces = bumpy_sphere(subdivisions=1)
    for got in (cotangent_weights(verts.float(), faces), cotangent_laplacian(verts.float(), faces)):
        assert got.dtype == torch.float32
    assert mass_matrix(verts.float(), faces.int()).dtype == torch.float32


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (np.zeros((1, 3), dtype=np.int64), "must be a torch.Tensor, got ndarray"),
        (torch.zeros(4, 2, dtype=torch.int64), r"shape \(F, 3\), got \(4, 2\)"),
        (torch.zeros(1, 4, 3, dtype=torch.int64), r"shape \(F, 3\), got \(1, 4, 3\)"),
        (torch.zeros(4, 3), "integer tensor, got torch.float32"),
        (torch.zeros(4, 3, dtype=torch.bool), "integer tensor, got torch.bool"),
        (torch.tensor([[0, 1, 5]]), r"\[0, 5\).*got a range of \[0, 5\]"),
        (torch.tensor([[0, 1, -2]]), r"got a range of \[-2, 1\]"),
        (torch.tensor([[0, 1, -1]]), "1 faces mix -1 with vertex indices"),
    ],
)
def test_bad_faces(faces, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_faces(faces, 5)


def test_bad_verts_and_kind() -> None:
    verts, faces = torch.zeros(3, 3), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match=r"verts must be a floating \(..., V, 3\) tensor, got torch.int64"):
        cotangent_weights(verts.long(), faces)
    with pytest.raises(ValueError, match=r"same batch size, got \(3, 3\)"):
        face_normals(verts, faces[None])
    with pytest.raises(ValueError, match=r"takes one mesh, verts \(V, 3\), got \(1, 3, 3\)"):
        cotangent_laplacian(verts[None], faces)
    with pytest.raises(ValueError, match="kind must be"):
        mass_matrix(verts, faces, kind="full")
    with pytest.raises(ValueError, match=r"shape \(F, 3\) or \(B, F, 3\)"):
        vertex_normals(verts, faces[0])
