"""Report, repair, decimation and the way back, against closed forms, trimesh, libigl and the rig's true poses."""

import sys
import types
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from conftest import rand
from torch import Tensor

from meshkit.data import RiggedModel, load_humans
from meshkit.io import SurfaceBinding, _pymeshlab, clean_mesh, mesh_report, simplify
from meshkit.topology import cotangent_laplacian, face_normals, mass_matrix

NAN = float("nan")


def tensors(mesh: trimesh.Trimesh) -> tuple[Tensor, Tensor]:
    return torch.tensor(np.asarray(mesh.vertices)), torch.tensor(np.asarray(mesh.faces))


def union(*parts: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
    return torch.cat([v for v, _ in parts]), torch.cat([f + int(o) for (_, f), o in zip(parts, offsets, strict=False)])


SPHERE = tensors(trimesh.creation.icosphere(subdivisions=2))
TORUS = tensors(trimesh.creation.torus(1.0, 0.3))
TETRA = (torch.cat([torch.zeros(1, 3), torch.eye(3)]), torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
# Two triangles that meet at vertex 2 only, a bow tie.
BOW_TIE = (rand(5, 3).float(), torch.tensor([[0, 1, 2], [2, 3, 4]]))
# Three triangles at the edge 0-1.
FAN = (
    torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 2, 0], [-3, 0, 0]]),
    torch.tensor([[0, 1, 2], [0, 1, 3], [1, 0, 4]]),
)
MOEBIUS = (rand(5, 3), torch.tensor([[i, (i + 1) % 5, (i + 2) % 5] for i in range(5)]))


@pytest.mark.parametrize("mesh", [SPHERE, TORUS, TETRA], ids=["sphere", "torus", "tetrahedron"])
def test_report_agrees_with_trimesh(mesh: tuple[Tensor, Tensor]) -> None:
    report = mesh_report(*mesh)
    other = trimesh.Trimesh(mesh[0].numpy(), mesh[1].numpy(), process=False)
    assert (report.num_verts, report.num_faces) == (len(other.vertices), len(other.faces))
    assert report.num_edges == len(other.edges_unique)
    assert report.euler == other.euler_number
    assert report.genus == (2 - other.euler_number) // 2
    assert report.watertight and report.manifold and report.components == (len(mesh[1]),)
    assert report.volume == pytest.approx(other.volume)
    assert report.area == pytest.approx(other.area)
    np.testing.assert_allclose([report.low, report.high], other.bounds)
    assert report.problems == ()


def test_seams_are_no_holes() -> None:
    """Files with texture coordinates repeat vertices: their faces share places, not numbers."""
    verts, faces = SPHERE
    soup = verts[faces].reshape(-1, 3), torch.arange(3 * len(faces)).reshape(-1, 3)
    report = mesh_report(*soup)
    assert (report.boundary_edges, report.seam_edges, report.holes) == (3 * len(faces), 3 * len(faces), 0)
    assert not report.watertight and "closed but for seams" in str(report) and "hole" not in str(report)
    seams = f"{3 * len(faces)} boundary edges along seams of repeated vertices, which clean_mesh welds"
    clean = clean_mesh(*soup)
    assert seams in report.problems and mesh_report(clean.verts, clean.faces).watertight
    # Two faces that share no edge are gone, and half of the sphere is cut off from the other.
    rest = faces[verts[faces].mean(1)[:, 2].argsort()][1:-1]
    half = torch.cat([rest[: len(rest) // 2], rest[len(rest) // 2 :] + len(verts)])
    cut = mesh_report(torch.cat([verts, verts]), half)
    assert (cut.holes, cut.boundary_edges - cut.seam_edges, cut.boundary_loops) == (2, 6, 4)
    assert "2 holes (6 boundary edges)" in cut.problems and "surface  open" in str(cut)


def test_report_names_every_defect() -> None:
    verts, faces = union(SPHERE, (TETRA[0] / 2, TETRA[1]))
    verts = torch.cat([verts, verts[:1], torch.full((1, 3), 7.0)])  # repeated, and both unreferenced
    extra = torch.tensor([[0, 0, 1], faces[5].tolist()])
    faces = torch.cat([faces[1:, [0, 2, 1]], extra, torch.full((1, 3), -1)])
    faces[10] = faces[10, [0, 2, 1]]
    report = mesh_report(verts, faces)
    assert report.num_faces == len(faces) - 1  # padding does not count
    assert report.degenerate_faces == 1
    assert report.duplicate_faces == 1
    assert report.duplicate_verts == 1
    assert report.unreferenced_verts == 2
    assert report.components == (320, 4)
    assert (report.boundary_edges, report.boundary_loops, report.seam_edges, report.holes) == (3, 1, 0, 1)
    assert report.crowded_edges == 3
    assert report.flipped_edges == 3
    assert not report.watertight and not report.manifold and report.genus is None and report.volume is None
    text = str(report)
    for problem in report.problems:
        assert problem in text
    assert "2 parts (faces: 320, 4)" in text
    assert report.high == (1.0, 1.0, 1.0)  # the lost vertex is not part of the box
    inside_out = mesh_report(TETRA[0], TETRA[1].flip(1))
    assert inside_out.problems == ("turned inside out (negative volume)",)
    assert mesh_report(*BOW_TIE).touching_verts == 1
    assert mesh_report(*FAN).crowded_edges == 1


def test_only_degenerate_faces_are_reported_too() -> None:
    report = mesh_report(torch.eye(3), torch.tensor([[0, 0, 1]]))
    assert (report.degenerate_faces, report.components, report.num_edges) == (1, (), 0)


AXES = {"x": 0, "y": 1, "z": 2}


@pytest.mark.parametrize(("up", "facing"), [("+z", "-y"), ("+y", "+z"), ("-x", "+y"), ("+y", "-x")])
def test_frame_and_unit_of_a_body(up: str, facing: str) -> None:
    body = load_humans(1000)
    verts = body(torch.tensor([3]), torch.zeros(1, body.num_joints, 3))[0]

    def axis(name: str) -> Tensor:
        return torch.eye(3)[AXES[name[1]]] * (1 if name[0] == "+" else -1)

    left = torch.linalg.cross(axis(up), axis(facing))
    turned = verts @ torch.stack([left, -axis(facing), axis(up)])
    for unit, factor in {"m": 1, "cm": 100, "mm": 1000, "in": 39.3701}.items():
        report = mesh_report(turned * factor + 5, body.faces)
        assert (report.up, report.facing, report.unit) == (up, facing, unit)
        assert f"if this is a body in {unit}" in str(report)


def test_frame_is_left_open_where_the_shape_leaves_doubt() -> None:
    body = load_humans(1000)
    poses = body(torch.zeros(40, body.shape_dirs.shape[0]), torch.arange(40))
    guesses = {(r.up, r.facing) for r in (mesh_report(v, body.faces) for v in poses)}
    assert guesses <= {(None, None), ("+z", None), ("+z", "-y")}
    report = mesh_report(*SPHERE)
    assert (report.up, report.facing) == (None, None)
    assert "up unclear" in str(report) and "the size of no body" in str(mesh_report(SPHERE[0] * 1e5, SPHERE[1]))
    flat = mesh_report(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    assert (flat.up, flat.unit, flat.degenerate_faces) == (None, None, 1)


def test_clean_mesh_leaves_clean_ones_alone() -> None:
    for verts, faces in (SPHERE, TORUS, TETRA):
        result = clean_mesh(verts, faces)
        assert torch.equal(result.verts, verts) and torch.equal(result.faces, faces)
        assert result.changes == {} and str(result).startswith("clean as it was")
        assert torch.equal(result.source, torch.arange(len(verts))) and torch.equal(result.target, result.source)
        moved = rand(*verts.shape, seed=2)
        assert torch.equal(result.carry(moved), moved)


def test_clean_mesh_undoes_the_damage() -> None:
    """Loose triangles, as in an STL, with jitter, a second part, wrong turns, copies and rubbish."""
    verts, faces = SPHERE
    soup = verts[faces].reshape(-1, 3) + 1e-8 * rand(3 * len(faces), 3)
    loose = torch.arange(len(soup)).view(-1, 3)
    small = (SPHERE[0] * 0.2 + 0.1, SPHERE[1])
    soup, loose = union((soup, loose), small, (torch.full((1, 3), 3.0, dtype=torch.float64), loose[:0]))
    loose = torch.cat([loose, loose[7:8], torch.tensor([[0, 0, 5], [-1, -1, -1]])])
    turn = torch.rand(len(loose), generator=torch.Generator().manual_seed(0)) < 0.5
    turn[:3] = False
    loose[turn] = loose[turn].flip(1)
    result = clean_mesh(soup, loose)
    report = mesh_report(result.verts, result.faces)
    assert report.watertight and report.manifold and report.genus == 0
    assert report.problems == () and report.volume == pytest.approx(mesh_report(*SPHERE).volume)
    assert len(result.verts) == len(verts)
    assert torch.equal(result.verts, soup[result.source])
    kept = result.target >= 0
    assert kept.tolist() == [True] * (3 * len(faces)) + [False] * (len(soup) - 3 * len(faces))
    torch.testing.assert_close(result.verts[result.target[kept]], soup[kept], rtol=0, atol=1e-6)
    assert result.changes["smaller parts removed"] == 1
    assert result.changes["repeated faces removed"] == 1
    assert result.changes["faces with a repeated corner removed"] == 1
    assert "left: 162 vertices, 320 faces" in str(result)
    # A rigid motion of the clean mesh moves every original vertex, dropped ones too.
    turn_z = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    carried = result.carry(result.verts @ turn_z.T + 2)
    torch.testing.assert_close(carried, soup @ turn_z.T + 2, rtol=0, atol=1e-6)


def test_clean_mesh_options() -> None:
    both = union(SPHERE, (SPHERE[0] * 0.2, SPHERE[1]))
    assert len(clean_mesh(*both, keep_largest=False).faces) == 640
    turned = clean_mesh(TETRA[0], TETRA[1].flip(1))
    assert mesh_report(turned.verts, turned.faces).volume == pytest.approx(1 / 6)
    assert turned.changes == {"faces turned": 4}
    assert torch.equal(clean_mesh(TETRA[0], TETRA[1].flip(1), orient=False).faces, TETRA[1].flip(1))
    far = rand(6, 3).abs() + 1
    corners = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1e-4, 0, 0]])
    near = (torch.cat([far, corners]), torch.tensor([[0, 1, 6], [2, 3, 7], [4, 5, 8]]))
    welded = [clean_mesh(*near, weld=w, keep_largest=False).changes.get("vertices welded", 0) for w in (None, 0, 1e-3)]
    assert welded == [0, 1, 2]


def test_clean_mesh_makes_manifolds() -> None:
    fan = clean_mesh(*FAN)
    assert fan.changes["faces at an edge of more than two removed"] == 1  # the smallest one
    assert fan.source.tolist() == [0, 1, 3, 4]
    tie = clean_mesh(*BOW_TIE, keep_largest=False)
    assert tie.changes == {"vertices split where fans of faces touched": 1}
    assert tie.source.tolist() == [0, 1, 2, 3, 4, 2]
    assert torch.equal(tie.verts[tie.faces], BOW_TIE[0][BOW_TIE[1]])
    assert torch.equal(tie.carry(tie.verts + 1), BOW_TIE[0] + 1)
    for seed in range(5):  # random triangles on few vertices: everything wrong at once
        generator = torch.Generator().manual_seed(seed)
        faces = torch.randint(0, 12, (40, 3), generator=generator)
        result = clean_mesh(rand(12, 3, seed=seed), faces, keep_largest=False)
        report = mesh_report(result.verts, result.faces)
        assert report.manifold and report.unreferenced_verts == report.duplicate_faces == 0
    clean_mesh(*MOEBIUS)  # cannot be oriented: no error, and no endless loop


@pytest.fixture(scope="module")
def body() -> RiggedModel:
    return load_humans(6890)


def skinned(body: RiggedModel, verts: Tensor, faces: Tensor) -> RiggedModel:
    """The rig's own motion at other vertices: skinning weights of the nearest point of the body."""
    import igl

    rest, rest_faces = body.template.double().numpy(), body.faces.numpy()
    _, face, foot = igl.point_mesh_squared_distance(verts.double().numpy(), rest, rest_faces)
    corner = np.stack([rest[rest_faces[face, k]] for k in range(3)])
    inner = igl.barycentric_coordinates(np.ascontiguousarray(foot), *corner)
    weights = torch.einsum("vk,vkj->vj", torch.tensor(inner).float(), body.weights[body.faces[face]]).clamp_min(0)
    none = torch.zeros(1, len(verts), 3), body.joints, torch.zeros(1, body.num_joints, 3)
    return RiggedModel(verts, faces, none[0], none[1], none[2], weights, body.parents, poses=body.poses)


def test_simplified_body_carries_true_poses_back(body: RiggedModel) -> None:
    """6890 to 1000 vertices, posed there by the rig, carried to 6890: against the rig at 6890."""
    small = simplify(body.template, body.faces, 1000)
    assert (small.method, small.verts.shape, small.faces.shape) == ("libigl", (1000, 3), (1996, 3))
    report = mesh_report(small.verts, small.faces)
    assert report.watertight and report.manifold and report.genus == 0
    torch.testing.assert_close(small.carry(small.verts), body.template, rtol=0, atol=1e-6)
    coarse = skinned(body, small.verts, small.faces)
    errors, angles = [], []
    for pose in torch.arange(0, 1000, 125)[:, None]:
        true = body(torch.zeros(1, 40), pose)[0]
        carried = small.carry(coarse(torch.zeros(1, 1), pose)[0])
        errors.append((carried - true).norm(dim=1))
        cosine = (face_normals(carried, body.faces) * face_normals(true, body.faces)).sum(1)
        angles.append(torch.rad2deg(cosine.clamp(-1, 1).acos()).mean())
    error = torch.stack(errors)
    assert error.mean() < 1.6e-3  # metres
    assert error.quantile(0.99) < 14e-3
    assert torch.stack(angles).mean() < 4  # degrees; the coarse mesh alone would show its facets
    flat = torch.einsum(
        "vk,vkc->vc", small.binding.weights.float(), coarse(torch.zeros(1, 1), pose)[0][small.faces[small.binding.face]]
    )
    assert (flat - true).norm(dim=1).mean() > 1.4 * error[-1].mean()  # detail is more than interpolation


def test_affine_motions_are_followed(body: RiggedModel) -> None:
    small = simplify(body.template.double(), body.faces, 800)
    rotation = torch.linalg.qr(rand(3, 3))[0]
    rotation *= torch.linalg.det(rotation)
    shift = torch.tensor([1.0, 2, 3])
    expected = body.template.double() @ rotation.T + shift
    torch.testing.assert_close(small.carry(small.verts @ rotation.T + shift), expected, rtol=0, atol=1e-9)
    single = small.carry((small.verts @ rotation.T + shift).float())
    assert single.dtype == torch.float32
    grown = small.carry(small.verts * 1.3)
    foot = torch.einsum("vk,vkc->vc", small.binding.weights, small.verts[small.faces[small.binding.face]])
    gap = (body.template - foot).norm(dim=1).max()
    assert (grown - body.template * 1.3).norm(dim=1).max() < 0.31 * gap  # detail keeps its height


def test_binding_stays_on_its_side_of_a_thin_plate() -> None:
    """Decimation moved the two sides past each other: the nearest face in space is on the wrong side."""
    plate = trimesh.creation.box((1.0, 1.0, 0.01))
    for _ in range(4):
        plate = plate.subdivide()
    verts, faces = tensors(plate)
    small = simplify(verts, faces, 60)
    crossed = torch.stack([small.verts[:, 0], small.verts[:, 1], -0.5 * small.verts[:, 2]], dim=1)
    side = torch.sign(small.verts[small.faces][..., 2].mean(1))
    binding = SurfaceBinding(verts, faces, crossed, small.faces)
    flat = verts[:, :2].abs().amax(1) < 0.49
    assert flat.sum() > 400
    assert torch.equal(side[binding.face][flat], torch.sign(verts[:, 2])[flat])


def test_fingers_are_bound_to_themselves(body: RiggedModel) -> None:
    small = simplify(body.template, body.faces, 1000)
    near = SurfaceBinding(small.verts, small.faces, body.template, body.faces)
    seed = body.faces[near.face, near.weights.argmax(1)]  # a vertex of the body at each simple vertex
    back = small.faces[small.binding.face, small.binding.weights.argmax(1)]
    graph = trimesh.Trimesh(body.template.numpy(), body.faces.numpy(), process=False).vertex_adjacency_graph
    import networkx as nx

    edges = torch.tensor(list(graph.edges))
    length = (body.template[edges[:, 0]] - body.template[edges[:, 1]]).norm(dim=1)
    for (a, b), weight in zip(edges.tolist(), length.tolist(), strict=True):
        graph[a][b]["weight"] = weight
    for vertex in range(0, 6890, 23):
        path = nx.shortest_path_length(graph, vertex, int(seed[back[vertex]]), weight="weight")
        assert path < 0.12, f"vertex {vertex} is bound {path:.2f} m away along the body"


def test_weights_are_those_of_the_closest_point() -> None:
    import igl

    verts, faces = SPHERE
    small = simplify(verts, faces, 60)
    rng = np.random.default_rng(0)
    cloud = torch.tensor(rng.uniform(-1.3, 1.3, (300, 3)))
    binding = SurfaceBinding(cloud, torch.arange(300)[:, None].expand(-1, 3), small.verts, small.faces)
    foot = torch.einsum("vk,vkc->vc", binding.weights, small.verts[small.faces[binding.face]])
    assert (binding.weights >= 0).all() and torch.allclose(binding.weights.sum(1), torch.ones(300, dtype=torch.float64))
    squared = igl.point_mesh_squared_distance(cloud.numpy(), small.verts.numpy(), small.faces.numpy())[0]
    assert (cloud - foot).square().sum(1).numpy() == pytest.approx(squared, rel=1e-6, abs=1e-9)


def test_carry_is_the_minimum_of_its_energy() -> None:
    """The equations of the docstring, term by term, as one dense least-squares problem."""
    verts, faces = SPHERE
    small = simplify(verts, faces, 40)
    moved = small.verts * torch.tensor([1.0, 1.5, 0.7]) + 0.1 * rand(40, 3)
    coarse, corner = small.verts, small.faces[small.binding.face]

    def frames(v: Tensor) -> tuple[Tensor, Tensor]:
        a, b, c = v[small.faces].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        area = normal.norm(dim=1)
        return torch.stack([b - a, c - a, normal / area[:, None]], dim=2), area

    before, area = frames(coarse)
    gradients = frames(moved)[0] @ torch.linalg.inv(before)
    maps = torch.stack([
        sum(area[f] * gradients[f] for f in range(len(area)) if i in small.faces[f])
        / sum(area[f] for f in range(len(area)) if i in small.faces[f])
        for i in range(40)
    ])  # fmt: skip
    weights = small.binding.weights
    follow = torch.stack([
        sum(w * (moved[k] + maps[k] @ (v - coarse[k])) for w, k in zip(ws, ks, strict=True))
        for v, ws, ks in zip(verts, weights, corner, strict=True)
    ])  # fmt: skip
    bend = torch.einsum("vk,vkij->vij", weights, maps[corner])
    edges = torch.cat([small.faces[:, [0, 1]], small.faces[:, [1, 2]], small.faces[:, [2, 0]]])
    h = (coarse[edges[:, 0]] - coarse[edges[:, 1]]).norm(dim=1).mean()
    stiffness = cotangent_laplacian(verts, faces).to_dense()
    rows, right = [], []
    for i, j in torch.nonzero(torch.triu(stiffness, 1) < 0).tolist():
        root = (-stiffness[i, j]).sqrt()
        row = torch.zeros(len(verts), dtype=torch.float64)
        row[i], row[j] = root, -root
        rows.append(row)
        right.append(root * (bend[i] + bend[j]) / 2 @ (verts[i] - verts[j]))
    pull = (25 / h**2 * mass_matrix(verts, faces, kind="barycentric")).sqrt()
    system = torch.cat([torch.stack(rows), torch.diag(pull)])
    expected = torch.linalg.lstsq(system, torch.cat([torch.stack(right), pull[:, None] * follow])).solution
    torch.testing.assert_close(small.carry(moved), expected, rtol=0, atol=1e-6)


class FilterlessMeshSet:
    """pymeshlab's class as it is when its plugins could not be loaded."""


def pretend_pymeshlab(monkeypatch: pytest.MonkeyPatch, module: Any, missing: list[str]) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", module)
    monkeypatch.setattr(_pymeshlab, "missing_libraries", lambda: missing)
    _pymeshlab.load_pymeshlab.cache_clear()
    monkeypatch.setattr(_pymeshlab, "load_pymeshlab", _pymeshlab.load_pymeshlab.__wrapped__)


def test_missing_pymeshlab_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_pymeshlab(monkeypatch, None, [])
    with pytest.raises(ImportError, match=r"pymeshlab cannot be loaded|pip install"):
        simplify(*SPHERE, 60, method="pymeshlab")
    with pytest.raises(ImportError, match="1 edges have more than two faces: use clean_mesh first, or pymeshlab, but"):
        simplify(*FAN, 4)
    assert simplify(*SPHERE, 60).method == "libigl"  # needs none of it


def test_missing_system_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without OpenGL, pymeshlab imports and has no filters."""
    module = types.SimpleNamespace(MeshSet=FilterlessMeshSet)
    pretend_pymeshlab(monkeypatch, module, ["libgl1", "libegl1", "libopengl0"])
    with pytest.raises(ImportError, match=r"without its filters.*apt-get install libgl1 libegl1 libopengl0"):
        simplify(*SPHERE, 60, method="pymeshlab")


def test_missing_libraries_are_found_by_loading_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> None:
        if "EGL" in name:
            raise OSError(name)

    monkeypatch.setattr(_pymeshlab.ctypes, "CDLL", load)
    monkeypatch.setattr(_pymeshlab.sys, "platform", "linux")
    assert _pymeshlab.missing_libraries() == ["libegl1"]
    monkeypatch.setattr(_pymeshlab.sys, "platform", "darwin")
    assert _pymeshlab.missing_libraries() == []


def test_pymeshlab_simplifies_like_libigl(body: RiggedModel) -> None:
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    small = simplify(body.template, body.faces, 1000, method="pymeshlab")
    assert (small.method, len(small.verts)) == ("pymeshlab", 1000)
    assert mesh_report(small.verts, small.faces).watertight
    assert small.binding.weights.min() >= 0
    tangled = union(SPHERE, (SPHERE[0][:3], torch.tensor([[0, 1, 2]])))
    tangled = (tangled[0], torch.cat([SPHERE[1], SPHERE[1][:1]]))
    assert simplify(*tangled, 80).method == "pymeshlab"


def test_simplify_meets_the_number_on_open_meshes() -> None:
    grid = trimesh.creation.icosphere(subdivisions=3)
    half = grid.submesh([np.flatnonzero(grid.triangles_center[:, 2] > 0.05)], append=True)
    for n in (40, 101):
        small = simplify(*tensors(half), n)
        assert abs(len(small.verts) - n) <= 2
        report = mesh_report(small.verts, small.faces)
        assert report.manifold and report.boundary_loops == 1


def test_simplify_small_mesh_and_source() -> None:
    same = simplify(*SPHERE, 500)
    assert same.method == "none" and torch.equal(same.verts, SPHERE[0])
    assert torch.equal(same.carry(SPHERE[0] + 1), SPHERE[0] + 1)
    assert torch.equal(same.source, torch.arange(162))
    small = simplify(*SPHERE, 50)
    distance = torch.cdist(small.verts, SPHERE[0])
    torch.testing.assert_close(distance[torch.arange(50), small.source], distance.min(1).values)


@pytest.mark.parametrize(
    ("verts", "faces", "message"),
    [
        ([[0.0, 0, 0]], torch.tensor([[0, 0, 0]]), "verts must be a floating .* tensor, got list"),
        (torch.zeros(3, 3).long(), torch.tensor([[0, 1, 2]]), "floating"),
        (torch.zeros(1, 3, 3), torch.tensor([[0, 1, 2]]), r"got torch.float32 \(1, 3, 3\)"),
        (torch.zeros(3, 3), torch.tensor([[0, 1, 3]]), "face indices"),
        (torch.zeros(3, 3), torch.zeros(0, 3).long(), "3 vertices and 0 faces"),
        (torch.zeros(3, 3), torch.tensor([[-1, -1, -1]]), "3 vertices and 0 faces"),
        (torch.full((3, 3), NAN), torch.tensor([[0, 1, 2]]), "3 of 3 vertices have NaN"),
    ],
)
def test_bad_meshes_are_named_everywhere(verts: Any, faces: Tensor, message: str) -> None:
    for function in (
        mesh_report,
        clean_mesh,
        lambda v, f: simplify(v, f, 4),
        lambda v, f: SurfaceBinding(*TETRA, v, f),
    ):
        with pytest.raises(ValueError, match=message):
            function(verts, faces)


def test_bad_options_and_deformations_are_named() -> None:
    small = simplify(*SPHERE, 50)
    clean = clean_mesh(*SPHERE)
    binding, five = small.binding, torch.eye(5)[:, :3]
    cases = [
        (lambda: clean_mesh(*SPHERE, weld=-1), "weld must be 0 or more"),
        (lambda: clean_mesh(torch.eye(3), torch.tensor([[0, 0, 1]])), "nothing is left"),
        (lambda: simplify(*SPHERE, 3), "n must be 4 or more, got 3"),
        (lambda: simplify(*SPHERE, 50, method="blender"), "method must be 'auto', 'libigl' or 'pymeshlab'"),
        (lambda: simplify(*FAN, 4, method="libigl"), "libigl cannot simplify this mesh: 1 edges have more than two"),
        (lambda: simplify(*BOW_TIE, 4, method="libigl"), "fans of faces touch"),
        (
            lambda: simplify(five, torch.tensor([[0, 1, 2]]), 4, method="libigl"),
            "2 vertices belong to no",
        ),
        (
            lambda: simplify(five, torch.tensor([[0, 0, 2]]), 4, method="libigl"),
            "1 faces repeat a corner",
        ),
        (lambda: small.carry(torch.zeros(3, 3)), r"bound|binding is to 50 coarse vertices, got .* \(3, 3\)"),
        (lambda: binding.carry(torch.full((50, 3), NAN)), "50 coarse vertices are NaN"),
        (lambda: clean.carry(torch.zeros(3, 3)), r"deformed must be \(162, 3\), got \(3, 3\)"),
        (lambda: SurfaceBinding(*SPHERE, torch.zeros(3, 3), torch.tensor([[0, 1, 2]])), "no area"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()
