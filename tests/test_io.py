"""Mesh files: round trips in every format, row order, and what is said about files that are not meshes."""

import json
import os
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from meshkit.io import MeshFileError, MeshFileWarning, _lines, _obj, atomic_write, load_mesh, save_mesh

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
    with pytest.warns(MeshFileWarning, match=r"m\.OBJ: faces with more than three corners .* 6 faces in all"):
        verts, faces = load_mesh(tmp_path / "m.OBJ")
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9], [0, 0, 1]]
    assert faces.tolist() == [[2, 3, 0], [2, 0, 1], [0, 1, 5], [0, 1, 2], [0, 2, 3], [0, 3, 5]]


def test_off_variants(tmp_path: Path) -> None:
    body = "4 2 0\n# corners\n0 0 0\n1 0 0\n\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 2 3 255 0 0\n"
    for header in ("OFF\n", "OFF ", "COFF\n"):
        (tmp_path / "m.off").write_text(header + body)
        with pytest.warns(MeshFileWarning, match="split into triangles, 3 faces in all"):
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
        (
            "large.obj",
            "v 0 0 0\nv 1e39 0 0\nv 0 1 0\nf 1 2 3\n",
            "1 vertex has a NaN or infinite coordinate, first vertex 1",
        ),
        (
            "range.obj",
            SQUARE + "f 1 2 3\nf 1 2 9\n",
            "line 6, 'f 1 2 9': the file has 4 vertices, counted from 1, and 1 face refers to others; mend",
        ),
        (
            "back.obj",
            SQUARE + "f 1 2 -9\nf 1 3 4\nf 4 8 \\\n1",
            "line 5, 'f 1 2 -9': .* 2 faces refer to others, this one first",
        ),
        ("deep.obj", SQUARE + f"f 1 2 {10**30}\n", "line 5, 'f 1 2 10+': a face is three or more"),
        (
            "zero.obj",
            SQUARE + "f 0 1 2\n",
            r"zero\.obj: .*line 5, 'f 0 1 2': a face is .* from 1; it is the last",
        ),
        ("cut.obj", SQUARE + "f 1 2", "line 5, 'f 1 2': a face is three or more .* cut short: copy or export it again"),
        ("cut2.obj", "v 0 0 0\nv 1 0", "line 2, 'v 1 0': a vertex is three numbers; it is the last line"),
        (
            "blank.obj",
            "v 0 0 0\nv \nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
            "line 2, 'v': a vertex is .*; mend that line, or export",
        ),
        ("blank2.obj", SQUARE + "f 1 2 3\nf \nf 1 3 4\n", "line 6, 'f': a face is three or more"),
        ("words.obj", "v a b c\n" + SQUARE, "line 1, 'v a b c': a vertex is three numbers; mend that line"),
        ("joined.obj", SQUARE + "f 1 2 \\\nx 3\nf 1 2 3\n", "line 6, 'f 1 2  x 3': a face is three or more"),
        ("long.obj", SQUARE + f"f {'x' * 99}\nf 1 2 3\n", r"line 5, 'f x{58} \.\.\.': a face is"),
        ("empty.off", "", "the file ends too early"),
        ("prose.off", "once upon\n", "first word is 'once', not OFF"),
        ("cut.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "the file ends too early"),
        ("short.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "line 6, '3 0 1': a face is its number of corners"),
        (
            "words.off",
            "OFF\n3 1 0\n# a\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n",
            "line 5, '1 0': a vertex is three numbers",
        ),
        ("faces.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 b 2\n", "line 6, '3 0 b 2': a face is its number"),
        (
            "far.off",
            "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 3\n",
            "line 7, '3 0 1 3': the file has 3 vertices, counted from 0",
        ),
        ("minus.off", "OFF\n3 -1 0\n0 0 0\n1 0 0\n0 1 0\n", "line 2, '3 -1 0': the numbers of vertices and of faces"),
        ("last.off", "OFF\n3 1 0\n0 0 0\n1 0\n", "line 4, '1 0': a vertex is three numbers; it is the last line, so"),
        ("counts.off", "OFF\n\nthree faces\n", "line 3, 'three faces': the numbers of vertices and of faces"),
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


@pytest.mark.parametrize("extension", ["obj", "off", "ply", "stl"])
def test_truncated_text_files(tmp_path: Path, sphere: tuple[Tensor, Tensor], extension: str) -> None:
    """Cut at a line end as well, where what is left looks whole (an OBJ file has no end that could be missing)."""
    verts, faces = sphere
    mesh = trimesh.Trimesh(verts.numpy(), faces.numpy(), process=False)
    options = {"ply": {"encoding": "ascii"}, "stl": {"file_type": "stl_ascii"}}.get(extension, {})
    text = mesh.export(**{"file_type": extension, **options})
    lines = (text.decode() if isinstance(text, bytes) else text).splitlines(keepends=True)
    file = tmp_path / f"m.{extension}"
    file.write_text("".join(lines))
    assert len(load_mesh(file)[1]) == len(faces)
    for cut in (len(lines) // 4, len(lines) // 2, len(lines) - 2):
        file.write_text("".join(lines[:cut]))
        if extension == "obj" and cut > len(verts):
            continue
        with pytest.raises(MeshFileError, match=r"truncated|ends too early|no faces|not a readable"):
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
        (
            torch.zeros(4, 3),
            torch.tensor([[0, 1, 2], [-1, -1, -1]]),
            r"1 face refers to vertices outside 0\.\.3, the first is face 1 \(counting from 0\)",
        ),
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


@pytest.mark.parametrize("batch", [60, 2**25])
def test_obj_reads_the_same_in_any_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int) -> None:
    """Plain batches are parsed at once, others line by line: both give what trimesh reads."""
    monkeypatch.setattr(_obj, "_BATCH_BYTES", batch)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3)).round(4)
    faces = rng.integers(1, 41, (70, 3))
    plain = "".join(f"v {x} {y} {z}\n" for x, y, z in points) + "".join(f"f {a} {b} {c}\n" for a, b, c in faces)
    slashes = "".join(f"vt {i} 0\nv\t{x} {y} {z} .5 .5 .5\n" for i, (x, y, z) in enumerate(points))
    slashes += "".join(f"f {a}/{a}/1 {b}//2 {c}/3 # face\n" for a, b, c in faces)
    relative = "".join(f"  v {x} {y} {z}\r\n" for x, y, z in points) + "".join(
        f"f {a - 41} \\\n {b} {c}\r\n" for a, b, c in faces
    )
    for text in (plain, slashes, relative, plain.replace("\n", "\n\n# comment\n")):
        (tmp_path / "m.obj").write_text(text)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # triangles only: nothing to be said
            verts, triangles = load_mesh(tmp_path / "m.obj")
        np.testing.assert_array_equal(verts.numpy(), points.astype(np.float32))
        np.testing.assert_array_equal(triangles.numpy(), faces - 1)


def test_off_rows_in_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_lines, "_BATCH_LINES", 2)
    (tmp_path / "m.off").write_text(
        "OFF\n5 3 0\n" + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 2 2\n" + "3 0 1 2\n5 0 1 2 3 4 9 9\n3 2 1 4\n"
    )
    with pytest.warns(MeshFileWarning):
        verts, faces = load_mesh(tmp_path / "m.off")
    assert len(verts) == 5
    assert faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4], [2, 1, 4]]


@pytest.mark.parametrize("extension", ["obj", "off", "ply"])
def test_polygons_become_fans_and_it_is_said(tmp_path: Path, extension: str) -> None:
    points = ["0 0 0", "1 0 0", "1 1 0", "0 1 0", "0 2 1"]
    text = {
        "obj": "".join(f"v {p}\n" for p in points) + "f 1 2 3 4\nf 4 3 5\n",
        "off": "OFF\n5 2 0\n" + "\n".join(points) + "\n4 0 1 2 3\n3 3 2 4\n",
        "ply": "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        + "\n".join(points)
        + "\n4 0 1 2 3\n3 3 2 4\n",
    }
    (tmp_path / f"m.{extension}").write_text(text[extension])
    with pytest.warns(MeshFileWarning, match="more than three corners were split into triangles, 3 faces in all"):
        verts, faces = load_mesh(tmp_path / f"m.{extension}")
    assert len(verts) == 5
    assert sorted(map(sorted, faces.tolist())) == [[0, 1, 2], [0, 2, 3], [2, 3, 4]]


def test_files_beyond_the_limit_are_refused(tmp_path: Path, sphere: tuple[Tensor, Tensor]) -> None:
    file = tmp_path / "m.obj"
    save_mesh(file, *sphere)
    size = file.stat().st_size
    with pytest.raises(MeshFileError, match=rf"m\.obj: {size:,} bytes, more than max_bytes=100"):
        load_mesh(file, max_bytes=100)
    assert len(load_mesh(file, max_bytes=size)[0]) == len(sphere[0])


def test_small_files_that_claim_to_be_large(tmp_path: Path) -> None:
    """Counts in a header reserve no memory, and a scene cannot place one mesh without end."""
    header = (
        "element vertex 99999999999\nproperty float x\nproperty float y\nproperty float z\nelement face 99999999999\n"
    )
    for kind in ("ascii", "binary_little_endian"):
        text = f"ply\nformat {kind} 1.0\n{header}property list uchar int vertex_indices\nend_header\n0 0 0\n"
        (tmp_path / "m.ply").write_text(text)
        with pytest.raises(MeshFileError, match="not a readable PLY mesh"):
            load_mesh(tmp_path / "m.ply")
    (tmp_path / "m.off").write_text("OFF\n99999999999 99999999999 0\n0 0 0\n")
    with pytest.raises(MeshFileError, match="ends too early: 1 of 99999999999 vertices"):
        load_mesh(tmp_path / "m.off")
    (tmp_path / "m.stl").write_bytes(b" " * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50)
    with pytest.raises(MeshFileError, match="not a readable STL mesh"):
        load_mesh(tmp_path / "m.stl")

    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(3)
    for number in range(80):
        scene.add_geometry(ball, geom_name="ball", node_name=f"node{number}")
    scene.export(tmp_path / "many.glb")
    with pytest.raises(MeshFileError, match=r"its 80 meshes would take .* MiB, more than max_bytes"):
        load_mesh(tmp_path / "many.glb", max_bytes=2**20)
    assert len(load_mesh(tmp_path / "many.glb")[0]) == 80 * len(ball.vertices)


def glb(tree: dict, data: bytes = b"") -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(data), len(text), b"JSON") + text + data


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"glTX" + b"\0" * 40, "does not start with glTF"),
        (glb({"asset": {"version": "2.0"}})[:-1], "damaged or truncated: .* bytes, its header says"),
        (
            glb({"accessors": [{"componentType": 5126, "count": 10**9, "type": "VEC3"}]}),
            "an array of 1000000000 elements cannot be in a file of",
        ),
        (glb({"extensionsRequired": ["KHR_draco_mesh_compression"]}), "compressed with Draco"),
        (glb({"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], "nodes": []}), "not a readable GLB"),
    ],
)
def test_bad_glb_files_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "m.glb").write_bytes(content)
    with pytest.raises(MeshFileError, match=message):
        load_mesh(tmp_path / "m.glb")


@pytest.mark.parametrize("extension", ["ply", "glb", "off", "stl"])
def test_bad_numbers_in_every_format(tmp_path: Path, extension: str) -> None:
    """NaN and faces out of range, written by trimesh, which does not mind."""
    points = np.eye(4, 3)
    points[1, 1] = np.nan
    trimesh.Trimesh(points, [[0, 1, 2]], process=False).export(tmp_path / f"nan.{extension}")
    with pytest.raises(MeshFileError, match="1 vertex has a NaN or infinite coordinate"):
        load_mesh(tmp_path / f"nan.{extension}")
    if extension in ("ply", "off"):
        kind = {"encoding": "ascii"} if extension == "ply" else {}
        trimesh.Trimesh(np.eye(4, 3), [[0, 1, 2]], process=False).export(tmp_path / f"far.{extension}", **kind)
        text = (tmp_path / f"far.{extension}").read_text()
        (tmp_path / f"far.{extension}").write_text(text.replace("3 0 1 2", "3 0 1 7"))
        said = {
            "off": r"line \d+, '3 0 1 7': the file has 4 vertices, counted from 0, and 1 face refers",
            "ply": r"1 face refers to vertices outside 0..3, the first is face 0 \(counting from 0\): \[0, 1, 7\]",
        }
        with pytest.raises(MeshFileError, match=said[extension]):
            load_mesh(tmp_path / f"far.{extension}")
