"""Mesh files: round trips in every format, row order, and what is said about files that are not meshes."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from meshkit.io import MeshFileError, atomic_write, load_mesh, save_mesh

FORMATS_WITH_VERTICES = ["obj", "off", "ply", "glb"]


@pytest.fixture
def sphere() -> tuple[Tensor, Tensor]:
    """A shuffled icosphere of 2 cm with a repeated and an unreferenced vertex, as registered scans have them."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.0123)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    verts = np.concatenate([mesh.vertices[order], mesh.vertices[order[:1]], [[7.0, -7.0, 1e-8]]])
    faces = np.argsort(order)[mesh.faces]
    return torch.tensor(verts, dtype=torch.float32), torch.tensor(faces)


@pytest.mark.parametrize("extension", FORMATS_WITH_VERTICES)
def test_round_trip_is_exact(tmp_path: Path, sphere: tuple[Tensor, Tensor], extension: str) -> None:
    verts, faces = sphere
    file = tmp_path / "new" / "folder" / f"mesh.{extension}"
    save_mesh(file, verts.double(), faces.int())
    loaded_verts, loaded_faces = load_mesh(file)
    assert loaded_verts.dtype == torch.float32
    assert loaded_faces.dtype == torch.int64
    assert torch.equal(loaded_verts, verts)
    assert torch.equal(loaded_faces, faces)
    assert os.listdir(file.parent) == [file.name]


@pytest.mark.parametrize("extension", FORMATS_WITH_VERTICES)
def test_written_files_are_read_by_trimesh(tmp_path: Path, sphere: tuple[Tensor, Tensor], extension: str) -> None:
    verts, faces = sphere
    save_mesh(tmp_path / f"m.{extension}", verts, faces)
    mesh = trimesh.load_mesh(tmp_path / f"m.{extension}", process=False)
    corners = np.asarray(mesh.vertices)[mesh.faces]
    np.testing.assert_allclose(corners, verts[faces].numpy(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("extension", ["stl", "stl_ascii"])
def test_stl_corners_are_welded(tmp_path: Path, extension: str) -> None:
    box = trimesh.creation.box()
    exported = box.export(file_type=extension)
    (tmp_path / "box.stl").write_bytes(exported if isinstance(exported, bytes) else exported.encode())
    verts, faces = load_mesh(tmp_path / "box.stl")
    assert verts.shape == (8, 3)
    np.testing.assert_allclose(verts[faces].numpy(), box.triangles, atol=1e-7)
    first_use = [int((faces.flatten() == i).nonzero()[0]) for i in range(8)]
    assert first_use == sorted(first_use)


def test_obj_keeps_its_rows_whatever_else_is_in_it(tmp_path: Path) -> None:
    """Normals, texture seams, materials, objects, colours, quads, pentagons, negative and continued lines."""
    (tmp_path / "m.OBJ").write_text(
        "mtllib none.mtl\no first # comment\n"
        "v 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 9 9 9\n"
        "vt 0 0\nvt 1 1\nvn 0 0 1\nvn 0 1 0\nusemtl red\n"
        "f 3/1/1 4/2/1 1/1/2 2/2/2\n"
        "o second\nv 0 0 1\nusemtl blue\nf 1//1 2//2 -1\nusemtl red\nf 1 2 3 \\\n4 6\n"
    )
    verts, faces = load_mesh(tmp_path / "m.OBJ")
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9], [0, 0, 1]]
    assert faces.tolist() == [[2, 3, 0], [2, 0, 1], [0, 1, 5], [0, 1, 2], [0, 2, 3], [0, 3, 5]]


def test_off_variants(tmp_path: Path) -> None:
    body = "4 2 0\n# corners\n0 0 0\n1 0 0\n\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 2 3 255 0 0\n"
    for header in ("OFF\n", "OFF ", "COFF\n"):
        (tmp_path / "m.off").write_text(header + body)
        verts, faces = load_mesh(tmp_path / "m.off")
        assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 3]]


def test_ply_with_texture_coordinates_and_quads_keeps_its_vertices(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n9 9 9\n"
        "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 .5 0 1 .5 1 1\n"
    )
    verts, faces = load_mesh(tmp_path / "m.ply")
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_scene_is_concatenated_in_place(tmp_path: Path) -> None:
    scene = trimesh.Scene([trimesh.creation.box()])
    scene.add_geometry(trimesh.creation.icosphere(1), transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.export(tmp_path / "scene.glb")
    verts, faces = load_mesh(tmp_path / "scene.glb")
    assert (len(verts), len(faces)) == (8 + 42, 12 + 80)
    assert verts[:, 0].max() == pytest.approx(6.0)
    on_the_right = (verts[:, 0] > 2)[faces]
    assert (on_the_right.all(1) | ~on_the_right.any(1)).all()  # no face joins the two


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("empty.obj", "", r"empty\.obj: not a readable OBJ mesh \(no vertices and no faces"),
        ("prose.obj", "once upon a time\n", "no vertices and no faces"),
        ("cloud.obj", SQUARE, "no faces; a point cloud must be meshed first"),
        ("one.obj", "v 0 0 0\nf 1 1 1\n", "needs 3 vertices or more, this one has 1"),
        ("nan.obj", "v 0 0 0\nv nan 0 0\nv 0 inf 0\nf 1 2 3\n", "2 vertices have NaN or infinite .* first vertex 1"),
        ("large.obj", "v 0 0 0\nv 1e39 0 0\nv 0 1 0\nf 1 2 3\n", "1 vertices have NaN or infinite"),
        ("range.obj", SQUARE + "f 1 2 3\nf 1 2 9\n", r"1 faces refer to vertices outside 0\.\.3.* face 1: \[0, 1, 8\]"),
        ("back.obj", SQUARE + "f 1 2 -9\n", r"outside 0\.\.3"),
        ("zero.obj", SQUARE + "f 0 1 2\n", "line 5: a face lists three or more vertices, counted from 1"),
        ("cut.obj", SQUARE + "f 1 2", "line 5: a face lists"),
        ("cut2.obj", "v 0 0 0\nv 1 0", "line 2: not enough values"),
        ("words.obj", "v a b c\n", "line 1: could not convert"),
        ("empty.off", "", "the file ends too early"),
        ("prose.off", "once upon\n", "first word is 'once', not OFF"),
        ("cut.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "the file ends too early"),
        ("short.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "face 0 lists 2 of its 3 vertices"),
        ("prose.ply", "once upon a time\n", "not a readable PLY mesh"),
        ("prose.glb", "once upon a time\n", "not a readable GLB mesh"),
        ("prose.stl", "once upon a time\n", "not a readable STL mesh"),
        ("pose.fbx", "", r"extension '\.fbx' cannot be read; use one of \.glb, \.obj, \.off, \.ply, \.stl"),
        ("mesh", "", "extension '' cannot be read"),
    ],
)
def test_what_is_not_a_mesh_is_said(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshFileError, match=message):
        load_mesh(tmp_path / name)


@pytest.mark.parametrize("extension", ["ply", "glb", "stl"])
def test_truncated_binary_files(tmp_path: Path, sphere: tuple[Tensor, Tensor], extension: str) -> None:
    file = tmp_path / f"m.{extension}"
    save_mesh(file, *sphere)
    whole = file.read_bytes()
    for length in (0, 40, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        with pytest.raises(MeshFileError, match=f"not a readable {extension.upper()} mesh"):
            load_mesh(file)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match=r"nowhere\.obj: no such file"):
        load_mesh(tmp_path / "nowhere.obj")


@pytest.mark.parametrize(
    ("verts", "faces", "message"),
    [
        (
            torch.zeros(1, 3, 3),
            torch.zeros(1, 3, dtype=torch.long),
            r"faces \(F, 3\), got \(1, 3, 3\)",
        ),
        (torch.zeros(4, 3), torch.zeros(2, 4, dtype=torch.long), r"got \(4, 3\) and \(2, 4\)"),
        (torch.zeros(4, 3), torch.zeros(0, 3, dtype=torch.long), "no faces"),
        (torch.full((4, 3), torch.nan), torch.tensor([[0, 1, 2]]), "4 vertices have NaN"),
        (torch.zeros(4, 3), torch.tensor([[0, 1, 2], [-1, -1, -1]]), "1 faces refer to vertices outside"),
    ],
)
def test_bad_meshes_are_not_written(tmp_path: Path, verts: Tensor, faces: Tensor, message: str) -> None:
    with pytest.raises(MeshFileError, match=message):
        save_mesh(tmp_path / "m.obj", verts, faces)
    with pytest.raises(MeshFileError, match=r"extension '\.txt' cannot be written"):
        save_mesh(tmp_path / "m.txt", verts, faces)
    assert os.listdir(tmp_path) == []


def test_atomic_write_replaces_whole_files_only(tmp_path: Path) -> None:
    target = tmp_path / "state.json"
    target.write_text("old")
    with pytest.raises(RuntimeError, match="power cut"), atomic_write(target) as temporary:
        temporary.write_text("ha")
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".json")
        raise RuntimeError("power cut")
    assert target.read_text() == "old"
    with atomic_write(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["state.json"]
