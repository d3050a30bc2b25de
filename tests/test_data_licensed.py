"""SMPL and SMAL readers on synthetic files of the published layout, and pickles that mean harm."""

import io
import os
import pickle
import struct
import sys
import tracemalloc
import types
from collections import OrderedDict
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from conftest import rand
from literal_data import skin_literally
from scipy.sparse import csc_matrix, csr_matrix
from scipy.spatial.transform import Rotation

from meshkit.data import SMAL_FAMILIES, Y_UP_TO_Z_UP, load_animals, load_smal, load_smpl, turn_axes
from meshkit.data._unpickle import read_pickle
from meshkit.io import MeshFileError

V, J, K = 30, 5, 12
PARENTS = [-1, 0, 0, 1, 3]


class Python2Pickler(pickle._Pickler):
    """Writes what Python 2 wrote: protocol 2, byte strings for every string, modules under their old names."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def __init__(self, stream: io.BytesIO) -> None:
        super().__init__(stream, protocol=2)

    def save_bytes(self, value: bytes) -> None:
        self.write(b"T" + struct.pack("<i", len(value)) + value)
        self.memoize(value)

    def save_text(self, value: str) -> None:
        self.write(b"T" + struct.pack("<i", len(value)) + value.encode("latin1"))
        self.memoize(value)

    def save_global(self, value, name=None):
        old = {"numpy._core.multiarray": "numpy.core.multiarray", "scipy.sparse._csc": "scipy.sparse.csc"}
        module = getattr(value, "__module__", "")
        if module in old:
            self.write(f"c{old[module]}\n{value.__name__}\n".encode())
            self.memoize(value)
        else:
            super().save_global(value, name)

    dispatch[bytes], dispatch[str] = save_bytes, save_text
    dispatch[types.FunctionType] = dispatch[types.BuiltinFunctionType] = dispatch[type] = save_global


@pytest.fixture
def chumpy(monkeypatch) -> type:
    """A stand-in for chumpy.ch.Ch with its published state; gone again when the file is read."""
    module = types.ModuleType("chumpy.ch")

    class Ch:
        def __init__(self, x: np.ndarray) -> None:
            self.__dict__ |= {"x": x, "_dirty_vars": set(), "_itr": None, "_make_dense": False, "_status": "new"}

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module.Ch = Ch
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return Ch


def parts(*, seed: int = 0) -> dict[str, np.ndarray]:
    regressor = rand(J, V, seed=seed).abs() * (rand(J, V, seed=seed + 1) > 1)
    regressor[:, 0] += 0.1
    return {
        "v_template": rand(V, 3, seed=seed + 2).numpy(),
        "f": torch.arange(27).reshape(9, 3).numpy().astype(np.uint32),
        "shapedirs": rand(V, 3, K, seed=seed + 3).numpy(),
        "posedirs": 0.1 * rand(V, 3, 9 * (J - 1), seed=seed + 4).numpy(),
        "J_regressor": (regressor / regressor.sum(1, keepdim=True)).numpy(),
        "weights": torch.softmax(rand(V, J, seed=seed + 5), 1).numpy(),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(J)], dtype=np.uint32),
    }


def write_python2(path: Path, content: object) -> Path:
    stream = io.BytesIO()
    Python2Pickler(stream).dump(content)
    path.write_bytes(stream.getvalue())
    return path


def published(chumpy: type, **changes: object) -> dict[str, object]:
    """The dictionary of a published SMPL pickle: chumpy shape directions, sparse regressor, further entries."""
    body = parts()
    extra = {"bs_style": "lbs", "bs_type": "lrotmin", "J": body["J_regressor"] @ body["v_template"]}
    body |= {"J_regressor": csc_matrix(body["J_regressor"]), "shapedirs": chumpy(body["shapedirs"])}
    return body | extra | changes


def forget(monkeypatch) -> None:
    """chumpy is not installed where the file is read."""
    monkeypatch.setitem(sys.modules, "chumpy", None)
    monkeypatch.setitem(sys.modules, "chumpy.ch", None)


def smpl_literally(body: dict[str, np.ndarray], betas: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """SMPL as its paper has it: shape, regress joints, add pose blend shapes, chain 4 x 4 transforms, blend."""
    shaped = body["v_template"] + body["shapedirs"][:, :, : len(betas)] @ betas
    joints = body["J_regressor"] @ shaped
    turns = Rotation.from_rotvec(vectors).as_matrix()
    shaped = shaped + body["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
    chain: list[np.ndarray] = []
    for j, p in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turns[j], joints[j] - (joints[p] if p >= 0 else 0)
        chain.append(local if p < 0 else chain[p] @ local)
    out = np.zeros((V, 3))
    for v in range(V):
        total = np.zeros((4, 4))
        for j in range(J):
            away = np.eye(4)
            away[:3, 3] = -joints[j]
            total += body["weights"][v, j] * (chain[j] @ away)
        out[v] = (total @ [*shaped[v], 1])[:3]
    return out


@pytest.mark.parametrize("layout", ["python2 and chumpy", "python3", "protocol 5", "protocol 0", "npz", "rows"])
def test_smpl_files_give_the_model_of_the_paper(layout, tmp_path, chumpy, monkeypatch):
    body, path = parts(), tmp_path / ("body.npz" if layout == "npz" else "body.pkl")
    if layout == "npz":
        np.savez_compressed(path, **body)
    elif layout == "python2 and chumpy":
        write_python2(path, published(chumpy))
        text = path.read_bytes()
        assert b"cchumpy.ch\nCh\n" in text and b"cscipy.sparse.csc\ncsc_matrix\n" in text
        assert b"cnumpy.core.multiarray\n_reconstruct\n" in text and b"_codecs" not in text
    elif layout == "rows":
        path.write_bytes(pickle.dumps(body | {"J_regressor": csr_matrix(body["J_regressor"])}))
    else:
        protocol = {"python3": 4, "protocol 5": 5, "protocol 0": 0}[layout]
        path.write_bytes(pickle.dumps(published(chumpy), protocol=protocol))
    forget(monkeypatch)
    model = load_smpl(path)
    assert model.shape_dirs.shape == (10, V, 3) and model.parents.tolist() == PARENTS
    assert model.faces.dtype == torch.int64 and model.template.dtype == torch.float32
    assert load_smpl(path, num_betas=None).shape_dirs.shape == (K, V, 3)
    betas, vectors = rand(10, seed=8).numpy(), rand(J, 3, seed=9).numpy()
    expected = smpl_literally(body, betas, vectors)
    found = model(torch.from_numpy(betas)[None].float(), torch.from_numpy(vectors)[None].float())[0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=2e-5)
    turned = load_smpl(path, z_up=True)
    c = torch.tensor(Y_UP_TO_Z_UP)
    there = turned(torch.from_numpy(betas)[None].float(), torch.from_numpy(vectors)[None].float() @ c.T)[0]
    np.testing.assert_allclose(there.numpy(), expected[:, [0, 2, 1]] * [1, -1, 1], rtol=0, atol=3e-5)


def test_kinematic_tables_may_number_joints_otherwise(tmp_path):
    body = parts()
    body["kintree_table"] = np.array([[2**32 - 1, 10, 10, 11, 13], [10, 11, 12, 13, 14]], dtype=np.int64)
    np.savez(tmp_path / "b.npz", **body)
    assert load_smpl(tmp_path / "b.npz").parents.tolist() == PARENTS


@pytest.mark.parametrize("python2", [True, False])
def test_smal_has_its_toys_and_families(python2, tmp_path, chumpy, monkeypatch):
    toys, means = rand(41, K - 2, seed=1).numpy(), [rand(K, seed=s).numpy() for s in range(5)]
    data = {"toys_betas": toys, "cluster_means": means, "cluster_cov": [np.eye(K)] * 5}
    model_path, data_path = tmp_path / "smal.pkl", tmp_path / "data.pkl"
    write_python2(model_path, published(chumpy))
    if python2:
        write_python2(data_path, data)
    else:
        data_path.write_bytes(pickle.dumps(data | {"cluster_means": np.stack(means)}))
    forget(monkeypatch)
    model = load_smal(model_path, data_path)
    assert model.identity_names[:2] == ("toy_0", "toy_1") and model.identity_names[41:] == SMAL_FAMILIES
    np.testing.assert_allclose(model.identities[:41, : K - 2].numpy(), toys, atol=1e-7)
    assert (model.identities[:41, K - 2 :] == 0).all()
    np.testing.assert_allclose(model.identities[43].numpy(), means[2], atol=1e-7)
    assert load_smal(model_path).identities is None
    few = load_smal(model_path, data_path, num_betas=3)
    assert torch.equal(few.identities, model.identities[:, :3])
    assert few(torch.tensor([0, 45]), torch.zeros(2, J, 3)).shape == (2, V, 3)


def test_turning_axes_turns_every_posed_vertex(tmp_path):
    np.savez(tmp_path / "b.npz", **parts())
    model = turn_axes(load_smpl(tmp_path / "b.npz").double(), torch.eye(3))  # weights that sum to 1 in float64
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -1.0, 0.8]).as_matrix())
    betas, vectors = rand(2, 10), rand(2, J, 3)
    turned = turn_axes(model, turn)
    expected = model(betas, vectors) @ turn.T
    torch.testing.assert_close(turned(betas, vectors @ turn.T), expected, rtol=0, atol=1e-12)
    # The literal transcription agrees about the correctives.
    matrices = Rotation.from_rotvec((vectors @ turn.T).reshape(-1, 3).numpy()).as_matrix().reshape(2, J, 3, 3)
    np.testing.assert_allclose(skin_literally(turned, betas.numpy(), matrices), expected.numpy(), rtol=0, atol=1e-12)
    animals = load_animals()  # a table of matrices turns as well
    c = torch.tensor(Y_UP_TO_Z_UP)
    who, how = torch.tensor([3]), torch.tensor([11])
    torch.testing.assert_close(turn_axes(animals, c)(who, how), animals(who, how) @ c.T, rtol=0, atol=1e-5)
    for wrong in (torch.eye(3) * 2, -torch.eye(3), torch.eye(2)):
        with pytest.raises(ValueError, match=r"rotation must be a \(3, 3\) rotation matrix, got"):
            turn_axes(model, wrong)


class Evil:
    """Unpickles by calling a function of its choice."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (os.system, ("touch {}",)),
        (eval, ("open('{}', 'w')",)),
        (exec, ("open('{}', 'w')",)),
        (open, ("{}", "w")),
        (os.mkdir, ("{}",)),
        (getattr, ("text", "upper")),
        (np.loadtxt, ("{}",)),
        (np.memmap, ("{}", "uint8", "w+", 0, (4,))),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_malicious_pickle_cannot_run_code(tmp_path, function, arguments, protocol):
    trap = tmp_path / "trap"
    evil = Evil(function, *(str(a).format(trap) if isinstance(a, str) else a for a in arguments))
    path = tmp_path / "body.pkl"
    path.write_bytes(pickle.dumps({**parts(), "v_template": evil}, protocol=protocol))
    with pytest.raises(MeshFileError, match=r"body.pkl: not a readable pickle of arrays .*it asks for .* no need of"):
        load_smpl(path)
    assert not trap.exists()


OPCODES = {
    "instance opcode": b"(S'touch TRAP'\nios\nsystem\n.",
    "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0cmemmap.mro.x\x93)R.",
    "numpy's test runner": b'cnumpy.testing._private.utils\nrunstring\n(S\'open("TRAP", "w")\'\n}tR.',
    "build on a class": b"cchumpy.ch\nCh\n}S'__init__'\ncos\nsystem\nsb.",
    "build on a function": b"cnumpy.core.multiarray\n_reconstruct\n(NN}S'function'\ncos\nsystem\nstb.",
    "persistent id": b"Ptouch TRAP\n.",
    "extension registry": b"\x80\x02\x82\x01.",
    "memory in a dimension": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I99999999999\ntS'b'\ntR"
    b"(I1\n(I99999999999\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntRI00\nS'abcdefgh'\ntb.",
    "objects in an array": b"cnumpy\ndtype\n(S'O8'\nI0\nI1\ntR.",
    "records in an array": b"cnumpy\ndtype\n(S'V800000'\nI0\nI1\ntR.",
    "other codec": b"c_codecs\nencode\n(Va\nS'zlib_codec'\ntR.",
    "unknown class through the registry": b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.",
    "array of what is no buffer": b"cnumpy\nndarray\n)\x81(I1\n(I1\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntRI00\n]tb.",
    "scalar of no number": b"cnumpy.core.multiarray\nscalar\n(S'f8'\nS'abcdefgh'\ntR.",
    "not a dictionary": b"]q\x00.",
    "empty": b"",
    "text": b"solid cube",
}


@pytest.mark.parametrize("name", OPCODES)
def test_hand_written_pickles_come_to_nothing(name, tmp_path):
    trap, path = tmp_path / "trap", tmp_path / "body.pkl"
    path.write_bytes(OPCODES[name].replace(b"TRAP", str(trap).encode()))
    with pytest.raises(MeshFileError, match=r"body\.pkl"):
        load_smpl(path)
    assert not trap.exists()


DTYPE = b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR"
HUNGRY = {
    "dtype code that is a container": b"cnumpy\ndtype\n(" + b"(lp0\n" + b"(g0\ng0\nlp0\n" * 30 + b"I0\nI1\ntR.",
    "byte order that is a container": DTYPE + b"(I3\n(lp0\n" + b"(g0\ng0\nlp0\n" * 30 + b"tb.",
    "a number for a buffer": b"cnumpy.core.numeric\n_frombuffer\n(I1000000000000\n" + DTYPE + b"(I1\ntS'C'\ntR.",
    "a number for a scalar": b"cnumpy.core.multiarray\nscalar\n(" + DTYPE + b"I1000000000000\ntR.",
    "an array's shape in words": b"cnumpy\nndarray\n)\x81(I1\n(S'1'\nt" + DTYPE + b"I00\nS'abcdefgh'\ntb.",
    "memo slot": b"\x80\x02}r\xff\xff\xff\x7f.",
    "length of bytes": b"\x80\x04\x8e\x00\x00\x00\x00\x00\x01\x00\x00abc.",
    "deep tuples": b"\x80\x02})" + 100_000 * b"\x85" + b"Ns.",
    "deep tuples from the memo": b"\x80\x04})\x94" + b"".join(b"h%c\x85\x94" % k for k in range(200)) + b"Ns.",
    "deep tuples behind marks": b"\x80\x02}" + 300 * b"(" + 300 * b"t" + b"Ns.",
    "text encoded over and over": b"\x80\x02]c_codecs\nencode\nq\x01X\xe8\x03\x00\x00" + 1000 * b"a"
    + b"q\x02h\x02" + b"".join(b"h\x01h\x02\x85R" for _ in range(1000)) + b".",
    "sets of one list": b"\x80\x02c__builtin__\nset\nq\x01](" + 1000 * b"K\x01" + b"eq\x02"
    + 1000 * b"h\x01h\x02\x85R" + b".",
}  # fmt: skip


@pytest.mark.parametrize("name", HUNGRY)
def test_small_pickles_take_little_memory(name, tmp_path):
    path = tmp_path / "body.pkl"
    path.write_bytes(HUNGRY[name])
    tracemalloc.start()
    with pytest.raises(MeshFileError, match=r"body\.pkl: not a readable pickle of arrays \((Unpickling|Value)Error"):
        load_smpl(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


def test_a_container_under_many_keys_is_copied_once(tmp_path):
    shared = [np.zeros(1)] * 10_000
    path = tmp_path / "body.pkl"
    path.write_bytes(pickle.dumps({str(k): shared for k in range(2000)}))
    content = read_pickle(path, max_bytes=1 << 20)
    assert content["0"] is content["1999"] and len(content["0"]) == 10_000
    assert all(part is content["0"][0] or part.shape == (1,) for part in content["0"])


def test_deep_enough_tuples_and_ordered_dictionaries_are_read(tmp_path):
    deep: tuple = ()
    for _ in range(50):
        deep = (deep,)
    path = tmp_path / "body.pkl"
    for protocol in range(6):
        path.write_bytes(pickle.dumps(OrderedDict(a={1, 2}, b={deep: 3}, c=b"bytes"), protocol=protocol))
        assert read_pickle(path, max_bytes=1 << 20) == {"a": {1, 2}, "b": {deep: 3}, "c": b"bytes"}


def test_objects_without_state_are_left_alone(tmp_path, chumpy, monkeypatch):
    """An entry that nobody needs may be an object of chumpy that was stored bare."""
    path = write_python2(tmp_path / "body.pkl", published(chumpy, spare=types.SimpleNamespace))
    content = path.read_bytes().replace(b"ctypes\nSimpleNamespace\n", b"cchumpy.ch\nCh\n)\x81")
    assert content != path.read_bytes()
    path.write_bytes(content)
    forget(monkeypatch)
    assert load_smpl(path).template.shape == (V, 3)


def test_containers_shared_many_times_do_not_grow(tmp_path):
    """A list of two of the list before it, forty times over: 80 entries in the file, a million million unfolded."""
    nest: list[object] = []
    for _ in range(40):
        nest = [nest, nest]
    (tmp_path / "body.pkl").write_bytes(pickle.dumps({"v_template": nest}))
    with pytest.raises(MeshFileError, match="'v_template' is not an array of numbers"):
        load_smpl(tmp_path / "body.pkl")


def test_files_that_are_no_models_are_named(tmp_path, chumpy):
    good = tmp_path / "good.pkl"
    write_python2(good, published(chumpy))
    cut = tmp_path / "cut.pkl"
    cut.write_bytes(good.read_bytes()[:-100])
    np.savez(tmp_path / "good.npz", **parts())
    (tmp_path / "cut.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:2000])
    (tmp_path / "wrong.npz").write_bytes(b"not a zip file at all")
    np.savez(tmp_path / "objects.npz", **(parts() | {"f": np.array([{}], dtype=object)}))
    np.savez(tmp_path / "spare.npz", **(parts() | {"training": np.array([{}], dtype=object)}))
    assert load_smpl(tmp_path / "spare.npz").template.shape == (V, 3)
    (tmp_path / "body.json").write_text("{}")
    for name, message in {
        "missing.pkl": "no such file",
        "cut.pkl": "not a readable pickle of arrays",
        "cut.npz": r"not a readable .npz",
        "wrong.npz": r"not a readable .npz",
        "objects.npz": r"not a readable .npz",
        "body.json": r"extension '.json' cannot be read; use .pkl or .npz",
        "": "a folder, not a model file",
    }.items():
        with pytest.raises(MeshFileError, match=message):
            load_smpl(tmp_path / name)
    for name in ("good.pkl", "good.npz"):
        with pytest.raises(MeshFileError, match=rf"{name}: .* bytes, more than the 1,000 allowed \(max_bytes\)"):
            load_smpl(tmp_path / name, max_bytes=1000)


def test_a_model_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    (tmp_path / "body.pkl").write_bytes(b"x")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(MeshFileError, match=r"body\.pkl: it cannot be read \(Permission denied\)"):
        load_smpl(tmp_path / "body.pkl")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("posedirs", None, "no 'posedirs' in it; it has J_regressor, f, kintree"),
        ("v_template", np.zeros((V, 2)), r"v_template and kintree_table must be \(V, 3\) and \(2, J\), got \(30, 2\)"),
        ("shapedirs", np.zeros((V, 2, K)), r"'shapedirs' must have shape \(30, 3, any\), got \(30, 2, 12\)"),
        ("posedirs", np.zeros((V, 3, 207)), r"'posedirs' must have shape \(30, 3, 36\), got \(30, 3, 207\)"),
        ("weights", np.zeros((V, J)), "30 vertices follow no joint"),
        ("weights", np.full((V, J), np.nan), "'weights' has values that are NaN or infinite"),
        ("f", np.array([[0, 1, V]]), "faces must index 30 vertices, got 0 to 30"),
        ("f", np.array([["a", "b", "c"]]), "'f' is not an array of numbers"),
        ("kintree_table", np.array([[-1, 2, 0, 1, 3], range(J)]), "every other joint must come after its parent"),
    ],
)
def test_arrays_that_do_not_fit_are_named(key, value, message, tmp_path):
    body = parts()
    if value is None:
        del body[key]
    else:
        body[key] = value
    np.savez(tmp_path / "body.npz", **body)
    with pytest.raises(MeshFileError, match=message):
        load_smpl(tmp_path / "body.npz")


def test_sparse_matrices_and_tables_that_do_not_fit_are_named(tmp_path):
    body, path = parts(), tmp_path / "body.pkl"
    wrong = csc_matrix(body["J_regressor"])
    wrong.indices = wrong.indices + J
    for matrix in (wrong, csc_matrix(np.zeros((J, V + 1)))):
        path.write_bytes(pickle.dumps(body | {"J_regressor": matrix}))
        with pytest.raises(MeshFileError, match=r"'J_regressor' is not a sparse matrix of shape \(5, 30\)"):
            load_smpl(path)
    path.write_bytes(pickle.dumps(body))
    data = tmp_path / "data.pkl"
    data.write_bytes(pickle.dumps({"toys_betas": np.zeros((3, 4)), "cluster_means": [np.zeros(3), np.zeros(4)]}))
    with pytest.raises(MeshFileError, match="the entries of 'cluster_means' differ in shape"):
        load_smal(path, data)
    data.write_bytes(pickle.dumps({"cluster_means": np.zeros((3, 4))}))
    with pytest.raises(MeshFileError, match=r"data.pkl: no 'toys_betas' in it; it has cluster_means"):
        load_smal(path, data)
