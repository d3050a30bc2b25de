"""Damaged mesh files: whatever is cut or garbled, a mesh comes back or one line says which file is wrong and where."""

import io
import json
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

BALL = trimesh.creation.icosphere(1)
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
FACES = "property list uchar int vertex_indices\nend_header\n"
TEXT = PLY.format("ascii", 3, 1) + FACES
BINARY = PLY.format("binary_little_endian", 3, 1) + FACES
SOLID = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


def content(kind: str) -> bytes:
    options = {"ply text": {"file_type": "ply", "encoding": "ascii"}, "stl text": {"file_type": "stl_ascii"}}
    data = BALL.export(**options.get(kind, {"file_type": kind}))
    return data if isinstance(data, bytes) else data.encode()


def quads_and_triangles(order: str) -> bytes:
    """A binary PLY with other properties and elements around what is read."""
    header = "ply\r\nformat binary_{}_endian 1.0\r\ncomment x\r\nelement camera 2\r\nproperty short a\r\n"
    header += "element strip 2\r\nproperty list ushort int8 i\r\nelement vertex 5\r\nproperty uchar red\r\n"
    header += "property double z\r\nproperty double x\r\nproperty double y\r\nelement face 3\r\nproperty float area\r\n"
    header += "property list uint ushort vertex_index\r\nproperty list uchar float uv\r\nend_header\r\n"
    sign, name = {"<": ("<", "little"), ">": (">", "big")}[order]
    body = np.array([1, 2], f"{sign}i2").tobytes()
    for strip in ([1, 2, 3], []):
        body += np.array(len(strip), f"{sign}u2").tobytes() + np.array(strip, "i1").tobytes()
    for x, y, z in CORNERS:
        body += b"\7" + np.array([z, x, y], f"{sign}f8").tobytes()
    for face in POLYGONS:
        body += np.array(0.5, f"{sign}f4").tobytes() + np.array(len(face), f"{sign}u4").tobytes()
        body += np.array(face, f"{sign}u2").tobytes() + b"\2" + np.array([0.5, 0.5], f"{sign}f4").tobytes()
    return header.format(name).encode() + body


CORNERS = [[0, 0, 0], [1, 0, 0.25], [1, 1, 0], [0, 1, 0], [0.5, 2, 3]]
POLYGONS = [[0, 1, 2], [0, 1, 2, 3], [2, 3, 4]]


@pytest.mark.parametrize("kind", ["obj", "off", "ply", "ply text", "stl", "stl text", "glb", "mixed.ply"])
def test_cut_and_garbled_files_are_meshes_or_named(tmp_path: Path, kind: str) -> None:
    whole = quads_and_triangles(">") if kind == "mixed.ply" else content(kind)
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
                # Words of the readers below have no place in a message to a user.
                assert not any(word in text for word in ("unmatched", "reshape", "unpack", "loadtxt", "NoneType"))
            else:
                assert torch.isfinite(verts).all()
                assert 0 <= faces.min() <= faces.max() < len(verts)
    assert failed >= 15, "damage went unnoticed"


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_with_all_that_the_format_allows(tmp_path: Path, order: str) -> None:
    (tmp_path / "m.ply").write_bytes(quads_and_triangles(order))
    with pytest.warns(MeshFileWarning, match="4 faces in all"):
        verts, faces = load_mesh(tmp_path / "m.ply")
    assert verts.tolist() == CORNERS
    assert faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [2, 3, 4]]


def test_text_ply_with_other_properties_first(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty uchar red\nproperty float x\nproperty float y\n"
    header += "property float z\nelement edge 1\nproperty int a\nproperty int b\nelement face 1\nproperty list uchar "
    header += "float uv\nproperty int flags\nproperty list uchar uint vertex_index\nend_header\n"
    (tmp_path / "m.ply").write_text(header + "9 0 0 0\n9 1 0 0\n9 0 1 0\n0 1\n2 .5 .5 7 3 2 1 0\n")
    verts, faces = load_mesh(tmp_path / "m.ply")
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.tolist() == [[2, 1, 0]]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("m.ply", b"", "the file is empty"),
        ("m.ply", "solid\n", "the first line is 'solid', not ply"),
        ("m.ply", TEXT[:60], "the file ends too early; copy or export it again: there is no end_header"),
        ("m.ply", TEXT.replace("format ascii", "format utf8"), "line 2, 'format utf8 1.0': no line of the header"),
        ("m.ply", TEXT.replace("vertex 3", "vertex -3"), "line 3, 'element vertex -3': no line of the header"),
        ("m.ply", TEXT.replace("float y", "float x"), "line 5, 'property float x': vertex has two properties of this"),
        ("m.ply", TEXT.replace("float y", "half y"), "line 5, 'property half y': 'half' is no type of a PLY file"),
        ("m.ply", TEXT.replace("format ascii 1.0\n", ""), "its header has no line of the format"),
        ("m.ply", TEXT.replace("element vertex", "element point"), "its header has no element vertex"),
        ("m.ply", TEXT.replace("float y", "float v"), "no property y; they have x, v, z"),
        ("m.ply", TEXT.replace("float z", "list uchar float z"), "its vertices have properties that are lists"),
        ("m.ply", TEXT.replace("element face", "element vertex"), "its header names an element twice"),
        ("m.ply", TEXT.replace("element face", "element tristrips"), "its faces are triangle strips; export it with"),
        ("m.ply", TEXT.replace("vertex_indices", "corners"), "no list of integers vertex_indices or vertex_index"),
        ("m.ply", TEXT + "0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "line 11, '1 0': a vertex is three numbers; mend that line"),
        ("m.ply", TEXT + "0 0 0\n1 0\n", "line 11, '1 0': a vertex is three numbers; it is the last line, so the file"),
        ("m.ply", TEXT + "0 0 0\n", "the file ends too early: 1 of 3 vertices are there; copy or export it again"),
        ("m.ply", TEXT + "0 0 0\n1 0 0\n0 1 0\n2 0 1\n", "line 13, '2 0 1': a face is its number of corners"),
        (
            "m.ply",
            TEXT + "0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n",
            "line 13, '3 0 1 3': the file has 3 vertices, counted from 0",
        ),
        (
            "m.ply",
            BINARY.encode() + bytes(30),
            "cut short: the vertices end at byte 205, the file at 199; copy or export it again",
        ),
        ("m.ply", BINARY.encode() + bytes(36), "cut short: the faces end at byte 206 or later, the file at 205"),
        ("m.ply", BINARY.encode() + bytes(37), r"face 0 \(counting from 0, at byte 205\): it has 0 corners, three or"),
        ("m.ply", BINARY.encode() + bytes(36) + b"\3\0", "a list of 3 entries ends at byte 218 of 207; copy or export"),
        ("m.stl", b"", "the file is empty"),
        ("m.stl", bytes(50), "cut short: 50 bytes, a binary STL has 84 or more"),
        (
            "m.stl",
            bytes(80) + b"\2\0\0\0" + bytes(99),
            "a binary STL of 2 triangles has 184 bytes, this file 183; copy",
        ),
        ("m.stl", SOLID, "there is no endsolid after 1 triangle; copy or export it again"),
        ("m.stl", SOLID.replace("vertex 1 0", "vertex 1"), "line 5, 'vertex 1 0': a vertex is three numbers"),
        ("m.stl", SOLID.replace("vertex 1 0 0\n", ""), "line 7, 'endfacet': triangle 1 has not three vertices"),
        ("m.stl", SOLID.replace("outer", "inner"), "line 3, 'inner loop': no line of an STL file starts like this"),
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


def test_reader_of_ply_agrees_with_trimesh(tmp_path: Path) -> None:
    for kind in ("ply", "ply text"):
        (tmp_path / "m.ply").write_bytes(content(kind))
        verts, faces = load_mesh(tmp_path / "m.ply")
        mesh = trimesh.load_mesh(tmp_path / "m.ply", process=False)
        np.testing.assert_array_equal(verts.numpy(), mesh.vertices.astype(np.float32))
        np.testing.assert_array_equal(faces.numpy(), mesh.faces)


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
