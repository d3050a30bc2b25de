"""Damaged mesh files: whatever is cut or garbled, a mesh comes back or one line says which file is wrong and where."""

import io
import json
import re
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from meshkit.data import load_smpl
from meshkit.io import MeshFileError, MeshFileWarning, load_mesh, save_mesh
from meshkit.io._arrays import read_arrays
from meshkit.io._trimesh import trimesh_reads

BALL = trimesh.creation.icosphere(1)
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
FACES = "property list uchar int vertex_indices\nend_header\n"
TEXT = PLY.format("ascii", 3, 1) + FACES
BINARY = PLY.format("binary_little_endian", 3, 1) + FACES
ROWS = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
SOLID = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


A_FACE = "a face is its list vertex_indices, a list its length and so many numbers, three corners or more"


def content(kind: str) -> bytes:
    options = {"ply text": {"file_type": "ply", "encoding": "ascii"}, "stl text": {"file_type": "stl_ascii"}}
    data = BALL.export(**options.get(kind, {"file_type": kind}))
    return data if isinstance(data, bytes) else data.encode()


def binary_ply(order: str, polygons: list[list[int]]) -> bytes:
    """A binary PLY with other properties and elements around what is read."""
    header = "ply\r\nformat binary_{}_endian 1.0\r\ncomment x\r\nelement camera 2\r\nproperty short a\r\n"
    header += "element strip 1\r\nproperty list ushort int8 i\r\nelement vertex 5\r\nproperty uchar red\r\n"
    header += f"property double z\r\nproperty double x\r\nproperty double y\r\nelement face {len(polygons)}\r\n"
    header += "property float area\r\nproperty list uint ushort vertex_index\r\nproperty list uchar float uv\r\n"
    header += "element edge 1\r\nproperty int vertex1\r\nproperty int vertex2\r\nend_header\r\n"
    sign, name = {"<": ("<", "little"), ">": (">", "big")}[order]
    body = np.array([1, 2, 3], f"{sign}i2").tobytes() + bytes([1, 2, 3])
    for x, y, z in CORNERS:
        body += b"\7" + np.array([z, x, y], f"{sign}f8").tobytes()
    for face in polygons:
        body += np.array(0.5, f"{sign}f4").tobytes() + np.array(len(face), f"{sign}u4").tobytes()
        body += np.array(face, f"{sign}u2").tobytes() + b"\2" + np.array([0.5, 0.5], f"{sign}f4").tobytes()
    return header.format(name).encode() + body + np.array([0, 1], f"{sign}i4").tobytes()


CORNERS = [[0, 0, 0], [1, 0, 0.25], [1, 1, 0], [0, 1, 0], [0.5, 2, 3]]
QUADS = [[0, 1, 2, 3], [1, 2, 3, 4]]


@pytest.mark.parametrize("kind", ["obj", "off", "ply", "ply text", "stl", "stl text", "glb", "quads.ply"])
def test_cut_and_garbled_files_are_meshes_or_named(tmp_path: Path, kind: str) -> None:
    whole = binary_ply(">", QUADS) if kind == "quads.ply" else content(kind)
    file = tmp_path / f"m.{kind.split('.')[-1].split()[0]}"
    rng = np.random.default_rng(0)
    variants = [whole[: int(length)] for length in np.linspace(0, len(whole) - 1, 20)]
    for number in range(50):
        garbled = bytearray(whole)
        at = int(rng.integers(len(whole) if number % 2 else min(len(whole), 400)))
        size = int(rng.integers(1, 9)) if number % 4 else 1
        garbled[at : at + size] = rng.bytes(size)
        variants.append(bytes(garbled))
    failed = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", MeshFileWarning)
        for variant in variants:
            file.write_bytes(variant)
            try:
                verts, faces = load_mesh(file)
            except MeshFileError as error:
                failed += 1
                text = str(error)
                assert text.startswith(f"{file}: ")
                assert "\n" not in text
                assert len(text) < len(str(file)) + 600
                # Words of the readers below have no place in a message to a user, or are said to be theirs.
                theirs = ("unmatched", "reshape", "unpack", "loadtxt", "NoneType")
                assert " of trimesh, " in text or not any(word in text for word in theirs)
            else:
                assert torch.isfinite(verts).all()
                assert 0 <= faces.min() <= faces.max() < len(verts)
    assert failed >= 15, "damage went unnoticed"


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_with_more_in_it(tmp_path: Path, order: str) -> None:
    (tmp_path / "m.ply").write_bytes(binary_ply(order, QUADS))
    with pytest.warns(MeshFileWarning, match="4 faces in all"):
        verts, faces = load_mesh(tmp_path / "m.ply")
    assert verts.tolist() == CORNERS
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 3], [1, 3, 4]]


@pytest.mark.parametrize("sizes", [(4, 3, 3), (4, 3, 5)])  # the second has as many bytes as three quads
def test_binary_ply_of_mixed_polygons_is_refused(tmp_path: Path, sizes: tuple[int, ...]) -> None:
    header = PLY.format("binary_little_endian", 5, len(sizes)) + FACES
    body = np.array(CORNERS, "<f4").tobytes()
    body += b"".join(bytes([size]) + np.arange(size, dtype="<i4").tobytes() for size in sizes)
    (tmp_path / "m.ply").write_bytes(header.encode() + body)
    with pytest.raises(MeshFileError, match=r"export it with triangles: in binary all faces must have as many corners"):
        load_mesh(tmp_path / "m.ply")


def test_text_ply_with_more_in_it(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty uchar red\nproperty float x\nproperty float y\n"
    header += "property float z\nelement edge 1\nproperty int a\nproperty int b\nelement face 2\nproperty list uchar "
    header += "float uv\nproperty int flags\nproperty list uchar uint vertex_index\nend_header\n"
    rows = "9 0 0 0\n9 1 0 0\n9 0 1 0\n9 0 1 1\n0 1\n2 .5 .5 7 4 0 1 2 3\n2 .5 .5 7 3 2 1 0\n"
    (tmp_path / "m.ply").write_text(header + rows)
    with pytest.warns(MeshFileWarning, match="3 faces in all"):
        verts, faces = load_mesh(tmp_path / "m.ply")
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 1]]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 1, 0]]


@pytest.mark.parametrize("row", ["2 5 5 7 3 0 1 2 2", "1 5 7 7 3 0 1 2", "-1 7 3 0 1 2", "1.5 5 7 3 0 1 2"])
def test_lists_before_the_corners_have_the_size_they_say(row: str, tmp_path: Path) -> None:
    """A number too many behind and before, a negative size, and one that is no whole number."""
    header = PLY.format("ascii", 3, 1) + "property list uchar float uv\nproperty int flags\n" + FACES
    (tmp_path / "m.ply").write_text(f"{header}{ROWS[:-8]}{row}\n")
    said = f"line 15, '{row}': a face is its numbers and lists uv, flags, vertex_indices, a list its length"
    with pytest.raises(MeshFileError, match=re.escape(said)):
        load_mesh(tmp_path / "m.ply")


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_ply_with_a_comment_that_is_no_ascii(kind: str, tmp_path: Path) -> None:
    data = TEXT + ROWS if kind == "text" else BINARY
    data = data.replace("element vertex", "comment caf\xe9\nelement vertex").encode("latin-1")
    if kind == "binary":
        data += np.eye(3, dtype="<f4").tobytes() + b"\3" + np.arange(3, dtype="<i4").tobytes()
    (tmp_path / "m.ply").write_bytes(data)
    assert load_mesh(tmp_path / "m.ply")[1].tolist() == [[0, 1, 2]]


def test_text_ply_with_empty_lines(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_text(TEXT + "\n" + ROWS.replace("\n", "\n \n"))
    assert load_mesh(tmp_path / "m.ply")[1].tolist() == [[0, 1, 2]]


def test_text_ply_takes_little_memory(tmp_path: Path) -> None:
    """Lines are parsed batch by batch, and no text of them is kept."""
    ball = trimesh.creation.icosphere(5)
    (tmp_path / "m.ply").write_bytes(ball.export(file_type="ply", encoding="ascii"))
    load_mesh(tmp_path / "m.ply")  # imports
    tracemalloc.start()
    verts, faces = load_mesh(tmp_path / "m.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * (tmp_path / "m.ply").stat().st_size
    np.testing.assert_array_equal(faces.numpy(), ball.faces)
    np.testing.assert_allclose(verts.numpy(), ball.vertices, atol=1e-6)


def test_a_solid_may_have_any_name(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_text(SOLID.replace("solid s", "solid endfacet") + "endsolid endfacet\n")
    assert load_mesh(tmp_path / "m.stl")[1].tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("m.ply", b"", "the file is empty"),
        ("m.ply", "solid\n", "the first line is 'solid', not ply"),
        ("m.ply", TEXT[:60], "'prope' is no line of the header of a PLY file; copy or export it again"),
        ("m.ply", TEXT.replace("end_header\n", ""), "the file ends too early; copy .* again: there is no end_header"),
        ("m.ply", TEXT.replace("format ascii", "format utf8"), "the second line is 'format utf8 1.0'; its format"),
        ("m.ply", TEXT.replace("format", "comment x\nformat"), "the second line is 'comment x'; its format, as"),
        ("m.ply", TEXT.replace("vertex 3", "vertex -3"), "'element vertex -3' is no line of the header of a PLY file"),
        ("m.ply", TEXT.replace("float y", "float x"), "'property float x' is no line of the header of a PLY file"),
        ("m.ply", TEXT.replace("element face", "element vertex"), "'element vertex 1' is no line of the header"),
        ("m.ply", TEXT.replace("end_header", "comment end_header"), "'comment end_header' is no line of the header"),
        ("m.ply", TEXT.replace("float y", "half y") + ROWS, "'property half y' is no line of the header of a PLY file"),
        ("m.ply", TEXT.replace("element vertex", "element point"), "it has no vertices with x, y, z"),
        ("m.ply", TEXT.replace("float y", "float v"), "it has no vertices with y"),
        ("m.ply", TEXT.replace("float z", "list uchar float z"), "it has no vertices with z"),
        ("m.ply", TEXT.replace("element face", "element tristrips"), "its faces are triangle strips; export it with"),
        ("m.ply", TEXT.replace("element face 1", "element face 0"), "no faces; a point cloud must be meshed first"),
        ("m.ply", TEXT.replace("vertex_indices", "corners"), "no list of integers vertex_indices or vertex_index"),
        ("m.ply", TEXT.replace("uchar int", "uchar float"), "no list of integers vertex_indices or vertex_index"),
        ("m.ply", TEXT + ROWS.replace("1 0 0", "1 0"), "line 11, '1 0': a vertex is three numbers; mend that line, or"),
        ("m.ply", TEXT + ROWS.replace("1 0 0", "1 b 0"), "line 11, '1 b 0': a vertex is three numbers; mend that line"),
        ("m.ply", TEXT + ROWS.replace("1 0 0", "7 1 0 0"), "line 11, .*names 3 numbers of a vertex, here are 4; mend"),
        ("m.ply", TEXT + "0 0 0\n", "the file ends too early: 1 of 3 vertices are there; copy or export it again"),
        ("m.ply", TEXT + ROWS[:-8], "the file ends too early: 0 of 1 faces are there; copy or export it again"),
        ("m.ply", TEXT + ROWS.replace("3 0 1 2", "2 0 1"), f"line 13, '2 0 1': {A_FACE}; mend that line, or export"),
        ("m.ply", TEXT + ROWS.replace("3 0 1 2", "4 0 1 2"), f"line 13, '4 0 1 2': {A_FACE}; mend that line, or"),
        ("m.ply", TEXT + ROWS.replace("3 0 1 2", "3 0 1 2 2"), f"line 13, '3 0 1 2 2': {A_FACE}; mend that line"),
        ("m.ply", TEXT + ROWS.replace("3 0 1 2", "3 0 1 .5"), f"line 13, '3 0 1 .5': {A_FACE}; mend that line, or"),
        ("m.ply", BINARY.encode() + bytes(30), "its header claims 37 bytes or more and 30 are there; copy or export"),
        ("m.ply", BINARY.encode() + bytes(36), "its header claims 37 bytes or more and 36 are there; copy or export"),
        ("m.ply", BINARY.encode() + bytes(38), "PLY is unexpected length!; copy it again, or export it with triangles"),
        ("m.ply", BINARY.encode() + bytes(37), "it has faces with fewer than three corners; copy it again, or export"),
        ("m.ply", BINARY.encode() + bytes(36) + b"\3\0", "PLY is unexpected length!; copy it again, or export it"),
        ("m.stl", b"", "the file is empty"),
        ("m.stl", bytes(50), "cut short: 50 bytes, a binary STL has 84 or more"),
        ("m.stl", bytes(80) + b"\2\0\0\0" + bytes(99), "of 2 triangles has 184 bytes, this file 183; copy or export"),
        ("m.stl", SOLID, "there is no endsolid at its end; copy or export it again"),
        ("m.stl", SOLID + "endsolid\n" + SOLID, "there is no endsolid at its end; copy or export it again"),
        (
            "m.stl",
            SOLID.replace("vertex 1 0", "vertex 1") + "endsolid\n",
            "damaged: ValueError of trimesh, .*; copy or",
        ),
        (
            "m.stl",
            SOLID.replace("vertex 1 0 0\n", "") + "endsolid",
            "damaged: ValueError of trimesh, .*; copy or export",
        ),
        ("m.stl", SOLID.replace("endfacet", "") + "endsolid\n", "0 triangles should be there, with 3 corners; copy"),
        ("m.glb", b"", "the file is empty"),
        ("m.glb", b"glTF\2\0\0\0", "cut short: 8 bytes, its header alone has 20"),
    ],
)
def test_what_is_wrong_is_said_and_where(tmp_path: Path, name: str, data: bytes | str, message: str) -> None:
    (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(MeshFileError, match=message) as caught:
        load_mesh(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: not a readable {name[2:].upper()} mesh (")


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("accessors", 0, "count"), 10**12, "an array of 1000000000000 elements cannot be in a file of"),
        (("accessors", 0, "count"), 999, r"accessor 0 ends at byte [\d,]+ of a bufferView of"),
        (("accessors", 0, "bufferView"), 7, "accessor.bufferView is 7, and there are 2"),
        (("accessors", 0, "componentType"), 1, "accessor 0 is of an unknown type"),
        (("accessors", 0, "count"), "many", "accessor.count is 'many', not a whole number"),
        (("accessors", 0, "sparse"), {}, "it has sparse arrays, which are not read; export it without them"),
        (("accessors", 1, "normalized"), True, "its positions are not plain triples; export it without quantization"),
        (("bufferViews", 0, "byteLength"), 10**12, "bufferView 0 ends at byte 1,000,000,000,000 of a buffer of"),
        (("buffers", 0, "byteLength"), 10**12, "its buffer has 1,000,000,000,000 bytes, its data"),
        (("nodes", 0, "children"), [0], "node 0 is below itself"),
        (("nodes",), [{"children": [1]}, {"children": [2]}, {"children": [1]}], "node 1 has two parents"),
        (("nodes",), [{}, {"children": [2]}, {"children": [1]}], "node 1 is below itself"),
        (("nodes", 0, "children"), [9], "node.children is 9, and there are"),
        (("nodes", 0, "mesh"), 9, "node.mesh is 9, and there are 1"),
        (("nodes",), 3, "its nodes are no list of objects"),
        (("meshes", 0, "primitives", 0, "attributes"), None, "a primitive has no attributes"),
        (("meshes", 0, "primitives", 0, "attributes"), {}, "primitive.attributes.POSITION is None, not a whole"),
        (("meshes", 0, "primitives"), [], "no mesh in it"),
        (("meshes", 0, "primitives", 0, "mode"), "x", "no mesh in it|damaged"),
        (("scenes",), [], "damaged: .* of trimesh"),
    ],
)
def test_glb_that_points_at_nothing(tmp_path: Path, place: tuple, value: object, message: str) -> None:
    data = content("glb")
    size = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + size])
    accessors = [a["type"] for a in tree["accessors"]]
    assert accessors[:2] == ["SCALAR", "VEC3"]  # the indices first, then the positions
    spot = tree
    for key in place[:-1]:
        spot = spot[key]
    spot[place[-1]] = value
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = len(text).to_bytes(4, "little") + b"JSON" + text + data[20 + size :]
    (tmp_path / "m.glb").write_bytes(data[:8] + (12 + len(body)).to_bytes(4, "little") + body)
    with pytest.raises(MeshFileError, match=message):
        load_mesh(tmp_path / "m.glb")


def test_claims_reserve_no_memory(tmp_path: Path) -> None:
    claims = [PLY.format(kind, 10**12, 10**12) + FACES for kind in ("ascii", "binary_big_endian")]
    claims.append(PLY.format("binary_little_endian", 0, 10**12).replace("vertex 0", "vertex 10") + FACES)
    load_mesh_of = [("m.ply", claim.encode() + bytes(200)) for claim in claims]
    load_mesh_of.append(("m.off", b"OFF\n1000000000000 1000000000000 0\n0 0 0\n"))
    load_mesh_of.append(("m.stl", bytes(80) + b"\xff" * 4 + bytes(50)))
    for name, data in load_mesh_of:
        (tmp_path / name).write_bytes(data)
        tracemalloc.start()
        with pytest.raises(MeshFileError):
            load_mesh(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**24


def test_what_trimesh_warns_of_is_an_error() -> None:
    message = "damaged: ValueError of trimesh, odd numbers; copy or export it again"
    with pytest.raises(ValueError, match=message), trimesh_reads():
        warnings.warn("odd numbers", RuntimeWarning, stacklevel=1)
    with trimesh_reads():  # how trimesh is written is no matter of the file
        warnings.warn("old code", DeprecationWarning, stacklevel=1)


def test_unreadable_files_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_mesh(tmp_path / "m.obj", torch.eye(3), torch.tensor([[0, 1, 2]]))

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(MeshFileError, match=r"m\.obj: it cannot be read \(Permission denied\)"):
        load_mesh(tmp_path / "m.obj")


def npz(path: Path, header: bytes, data: bytes = b"") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("v.npy", b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + data)
    return path


def test_arrays_in_damaged_archives(tmp_path: Path) -> None:
    good = {"v": np.arange(12.0).reshape(4, 3), "f": np.asfortranarray(np.arange(6).reshape(2, 3))}
    np.savez(tmp_path / "good.npz", **good)
    read = read_arrays(tmp_path / "good.npz", ["v", "f", "w"], 2**20)
    assert sorted(read) == ["f", "v"]
    for name, array in read.items():
        np.testing.assert_array_equal(array, good[name])
    whole = (tmp_path / "good.npz").read_bytes()
    rng = np.random.default_rng(0)
    variants = [whole[: int(length)] for length in np.linspace(0, len(whole) - 1, 20)]
    for _ in range(50):
        garbled = bytearray(whole)
        garbled[int(rng.integers(len(whole)))] ^= int(rng.integers(1, 256))
        variants.append(bytes(garbled))
    failed = 0
    for variant in variants:
        (tmp_path / "m.npz").write_bytes(variant)
        try:
            read_arrays(tmp_path / "m.npz", ["v", "f"], 2**20)
        except ValueError as error:
            failed += 1
            assert "\n" not in str(error)
    assert failed > 40
    for header, message in {
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }": "takes 24,000,000,000,000 bytes",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }": "'v' holds objects, not numbers",
        b"{'descr': '<f8', 'shape': (1,)": "the header of 'v' is damaged",
    }.items():
        with pytest.raises(ValueError, match=message):
            read_arrays(npz(tmp_path / "m.npz", header + b"\n", bytes(8)), ["v"], 2**20)
        with pytest.raises(MeshFileError, match=r"m\.npz: "):
            load_smpl(tmp_path / "m.npz")
    big = io.BytesIO()
    np.savez_compressed(big, v=np.zeros(2**18))
    (tmp_path / "m.npz").write_bytes(big.getvalue())
    with pytest.raises(ValueError, match=r"2,097,280 bytes, more than the 1,000 allowed"):
        read_arrays(tmp_path / "m.npz", ["v"], 1000)
