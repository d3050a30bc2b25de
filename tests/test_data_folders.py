"""Data sets in folders: the published names, the store of parsed meshes, and pairs drawn from it."""

import pickle
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from literal_data import assert_same, centred, nearest
from torch import Tensor

from meshkit.data import (
    RELEASED_SPLITS,
    MeshEntry,
    MeshPairs,
    MeshStore,
    PairSampler,
    RiggedModel,
    load_animals,
    load_humans,
    pair_loader,
    read_test_list,
    scan_faust,
    scan_mgn,
    scan_pose_transfer,
)
from meshkit.descriptors import intrinsic_descriptors
from meshkit.io import MeshFileError, load_mesh, save_mesh

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def touch(folder: Path, *names: str, text: str = TRIANGLE) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def places(entries: list[MeshEntry]) -> list[tuple[str, int, int]]:
    return [(entry.path.name, entry.identity, entry.pose) for entry in entries]


# Layouts


@pytest.mark.parametrize("form", ["{}_{}.obj", "id{}_{}.obj", "toy_{}_{}.ply"])
def test_pose_transfer_names(form, tmp_path):
    grid = [(0, 200), (0, 1000), (2, 7), (14, 30)]
    touch(tmp_path, *(form.format(*place) for place in grid), "readme.txt", "human_test_list", "id_1.obj", "x1_2.obj")
    entries = scan_pose_transfer(tmp_path)
    assert places(entries) == [(form.format(*place), *place) for place in sorted(grid)]


def test_released_splits(tmp_path):
    """The published numbers, written out: identities of the animals are those of the released list of names."""
    animals = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 21, 23, 24, 26, 27, 28, 29, 30, 31, 34, 35, 38, 39]
    for name, who, how in (
        ("humans-train", range(15), range(200, 600)),
        ("humans-test", range(21, 30), range(200)),
        ("npt-train", range(16), range(200, 600)),
        ("animals-train", animals, range(400)),
        ("animals-test", [16, 17, 18, 19, 20, 22, 25, 32, 33, 36, 37, 40], range(400, 600)),
    ):
        split = RELEASED_SPLITS[name]
        assert list(split.identities) == list(who) and list(split.poses) == list(how)
        grid = [MeshEntry(tmp_path, i, p) for i in range(45) for p in range(0, 800, 25)]
        chosen = [(e.identity, e.pose) for e in split.select(grid)]
        assert chosen == [(i, p) for i in who for p in range(0, 800, 25) if p in how]
    with pytest.raises(TypeError):
        RELEASED_SPLITS["mine"] = RELEASED_SPLITS["npt-train"]


def test_faust_and_mgn_names(tmp_path):
    touch(tmp_path / "faust", "tr_reg_000.ply", "tr_reg_009.ply", "tr_reg_010.ply", "tr_reg_099.ply", "tr_scan_000.ply")
    assert [e[1:] for e in places(scan_faust(tmp_path / "faust"))] == [(0, 0), (0, 9), (1, 0), (9, 9)]
    touch(tmp_path / "mgn", "b/smpl_registered.obj", "a/smpl_registered.obj", "c/pants.obj")
    entries = scan_mgn(tmp_path / "mgn")
    assert [(e.path.parent.name, e.identity, e.pose) for e in entries] == [("a", 0, 0), ("b", 1, 1)]


def test_folders_without_meshes_are_refused(tmp_path):
    for scan in (scan_faust, scan_mgn, scan_pose_transfer):
        with pytest.raises(MeshFileError, match="nowhere: no such folder"):
            scan(tmp_path / "nowhere")
    touch(tmp_path, "notes.txt", "body.obj")
    for scan, example in ((scan_faust, "tr_reg_000"), (scan_mgn, "PERSON"), (scan_pose_transfer, "id1_2.obj")):
        with pytest.raises(MeshFileError, match=f"no mesh named like .*{example}"):
            scan(tmp_path)
    touch(tmp_path, "1_2.obj", "id1_2.obj")
    with pytest.raises(MeshFileError, match=r"id1_2.obj and .*1_2.obj are both identity 1 in pose 2"):
        scan_pose_transfer(tmp_path)


def test_published_test_lists(tmp_path):
    touch(tmp_path, *(f"id{i}_{p}.obj" for i in (1, 3) for p in (2, 4)))
    entries = scan_pose_transfer(tmp_path)
    listing = tmp_path / "human_test_list"
    listing.write_text("id1_2.obj id3_4.obj id1_4.obj\n\nid3_4.obj id1_2.obj id3_2.obj \n")
    rows = read_test_list(listing, entries)
    assert [[entries[k].path.name for k in row] for row in rows] == [
        ["id1_2.obj", "id3_4.obj", "id1_4.obj"],
        ["id3_4.obj", "id1_2.obj", "id3_2.obj"],
    ]
    for text, message in {
        "id1_2.obj id3_4.obj\n": "line 1 has 2 names; identity, pose and ground truth are 3",
        "id1_2.obj id3_4.obj id1_9.obj\n": "line 1 names 'id1_9.obj', which none of 4 meshes is",
        "\n": "no pairs in it",
    }.items():
        listing.write_text(text)
        with pytest.raises(MeshFileError, match=message):
            read_test_list(listing, entries)
    with pytest.raises(MeshFileError, match="gone: no such file"):
        read_test_list(tmp_path / "gone", entries)


# Store


@pytest.fixture(scope="module")
def bodies() -> dict[int, RiggedModel]:
    """Identities of different vertex counts: two humans and an animal have their own topologies."""
    small, large, animal = load_humans(1000), load_humans(2000), load_animals()
    return {0: small, 1: small, 2: large, 3: animal}


def mesh(bodies: dict[int, RiggedModel], who: int, how: int) -> Tensor:
    return bodies[who](torch.tensor([who]), torch.tensor([10 * how]))[0]


@pytest.fixture(scope="module")
def grid(bodies, tmp_path_factory) -> Path:
    """Four identities in three poses as PLY files, one combination missing."""
    folder = tmp_path_factory.mktemp("grid")
    for who in bodies:
        for how in range(3):
            if (who, how) != (3, 2):
                save_mesh(folder / f"{who}_{how}.ply", mesh(bodies, who, how), bodies[who].faces)
    return folder


@pytest.fixture(scope="module")
def store(grid) -> MeshStore:
    return MeshStore.build(scan_pose_transfer(grid), grid / "cache", progress=False, shard_bytes=60_000)


def test_store_holds_the_files_bit_for_bit(store, bodies):
    assert len(store) == 11 and store.skipped == []
    assert store.num_verts.tolist() == [1000] * 6 + [2000] * 3 + [1962] * 2
    assert store.topology.tolist() == [0] * 6 + [1] * 3 + [2] * 2
    assert store.shard.max() > 2  # several shards
    assert store.shard.unique().tolist() == list(range(int(store.shard.max()) + 1))
    for k, entry in enumerate(store.entries):
        assert (entry.identity, entry.pose) == (int(store.identity[k]), int(store.pose[k]))
        assert torch.equal(store.verts(k), mesh(bodies, entry.identity, entry.pose))
        assert torch.equal(store.faces(k), bodies[entry.identity].faces)
        store.verts(k).zero_()  # a copy: the file cannot be written through it
    assert store.verts(0).abs().sum() > 0


def test_files_are_parsed_once(grid, store, monkeypatch, capsys, tmp_path):
    entries = scan_pose_transfer(grid)
    monkeypatch.setattr("meshkit.data.store.load_mesh", lambda path: pytest.fail("parsed again"))
    again = MeshStore.build(entries, store.cache, shard_bytes=60_000)
    assert torch.equal(again.verts(10), store.verts(10)) and capsys.readouterr().err == ""
    monkeypatch.undo()
    copy = touch(tmp_path, "0_0.obj", "0_1.obj")
    first = MeshStore.build(scan_pose_transfer(copy), copy / "cache")
    assert "2/2" in capsys.readouterr().err
    touch(copy, "0_1.obj", text=TRIANGLE.replace("v 1 0 0", "v 2 0 00"))  # another size or time: parsed again
    second = MeshStore.build(scan_pose_transfer(copy), copy / "cache", progress=False)
    assert not torch.equal(first.verts(0), second.verts(1)) and len(second) == 2
    assert capsys.readouterr().err == ""


def test_store_travels_to_workers_without_its_content(store):
    store.verts(0)
    data = pickle.dumps(store)
    assert len(data) < 20_000
    assert torch.equal(pickle.loads(data).verts(7), store.verts(7))


def test_many_shards_keep_few_maps_open(tmp_path, monkeypatch):
    monkeypatch.setattr("meshkit.data.store._OPEN_MAPS", 3)
    touch(tmp_path, *(f"0_{p}.obj" for p in range(10)))
    store = MeshStore.build(scan_pose_transfer(tmp_path), tmp_path / "cache", progress=False, shard_bytes=1)
    assert sorted(store.shard.tolist()) == list(range(10))
    assert all(len(store.verts(k)) == 3 and len(store.faces(k)) == 1 for k in range(10))
    assert len(store._maps) == 3


BAD = {
    "0_10.obj": "",
    "0_11.obj": "v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n",
    "0_12.obj": TRIANGLE.replace("f 1 2 3", "f 1 2 4"),
    "0_13.ply": "solid wrong magic",
    "0_14.ply": "ply\nformat ascii 1.0\nelement vertex 900000\nproperty float x\nend_header\n0\n",
    "0_15.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n",
    "0_16.obj": "# " + "x" * 9000,
    "0_17.stl": "",
    "0_18.glb": "glTF truncated",
}


# Descriptors

FEW = {"num_signatures": 4, "num_eigenpairs": 12, "progress": False}


def described(grid: Path, cache: Path, **options) -> MeshStore:
    store = MeshStore.build(scan_pose_transfer(grid), cache, progress=False, shard_bytes=60_000)
    assert store.descriptor_width == 0
    store.describe(**FEW | options)
    return store


@pytest.mark.parametrize("workers", [1, 2])
def test_descriptors_are_those_of_each_mesh(grid, tmp_path, workers):
    store = described(grid, tmp_path, workers=workers)
    assert store.descriptor_width == 5
    for k in range(len(store)):
        alone = intrinsic_descriptors(
            store.verts(k), store.faces(k), num_signatures=4, num_eigenpairs=12, method="fast"
        )
        assert torch.allclose(store.view("descriptors", k), alone, atol=1e-5), store.entries[k].path


def test_descriptors_are_computed_once_and_go_on_where_they_stopped(grid, tmp_path, monkeypatch):
    store = described(grid, tmp_path)
    before = [store.view("descriptors", k).clone() for k in range(len(store))]
    files = sorted(tmp_path.glob("descriptors-*.npy"))
    assert len(files) == len(store.shard.unique()) > 2
    asked: list[int] = []
    module = "meshkit.data.store.signatures"
    count = MeshStore.describe.__globals__["signatures"]
    monkeypatch.setattr(module, lambda verts, *rest, **options: count(seen(verts, asked), *rest, **options))

    def again(**options) -> list[Tensor]:
        asked.clear()
        opened = described(grid, tmp_path, **options)
        return [opened.view("descriptors", k) for k in range(len(opened))]

    assert all(map(torch.equal, again(), before)) and asked == []
    files[1].unlink()  # as if it had been stopped there
    files[2].write_bytes(files[2].read_bytes()[:200])
    lost = int(torch.isin(store.shard, torch.tensor([1, 2])).sum())
    assert all(map(torch.equal, again(), before)) and len(asked) == lost > 0
    (tmp_path / "descriptors.json").write_bytes(b"\xff")  # no text
    assert all(map(torch.equal, again(), before)) and len(asked) == len(store)
    assert again(num_signatures=3)[0].shape == (1000, 4) and len(asked) == len(store)
    assert again(num_signatures=3, num_eigenpairs=8)[0].shape == (1000, 4) and len(asked) == len(store)


def seen(meshes, counts: list[int]):
    for verts in meshes:
        counts.append(len(verts))
        yield verts


def test_other_files_have_descriptors_of_their_own(bodies, tmp_path):
    for how in (0, 1):
        save_mesh(tmp_path / f"0_{how}.ply", mesh(bodies, 0, how), bodies[0].faces)
    first = described(tmp_path, tmp_path / "cache").view("descriptors", 0).clone()
    save_mesh(tmp_path / "0_0.ply", 1.5 * mesh(bodies, 0, 0), bodies[0].faces)
    second = described(tmp_path, tmp_path / "cache").view("descriptors", 0)
    assert torch.allclose(second[:, -1] - first[:, -1], torch.tensor(1.5).log())  # the logarithm of the size


def test_a_mesh_without_descriptors_is_named(bodies, tmp_path):
    save_mesh(tmp_path / "0_0.ply", mesh(bodies, 0, 0), bodies[0].faces)
    save_mesh(tmp_path / "0_1.ply", mesh(bodies, 0, 1), bodies[0].faces[:-700])  # vertices of no face
    with pytest.raises(MeshFileError, match=r"0_1\.ply: no descriptors: "):
        described(tmp_path, tmp_path / "cache")
    store = MeshStore(tmp_path / "cache")
    with pytest.raises(ValueError, match=r"no descriptors yet: call describe\(\) first"):
        store.view("descriptors", 0)
    with pytest.raises(ValueError, match="num_signatures must be a whole number, at least 1, got 0"):
        store.describe(num_signatures=0)


def test_a_store_that_could_not_be_described_is_as_before(bodies, tmp_path):
    for how in (0, 1):
        save_mesh(tmp_path / f"0_{how}.ply", mesh(bodies, 0, how), bodies[0].faces[: -700 if how else None])
    store = MeshStore.build(scan_pose_transfer(tmp_path), tmp_path / "cache", progress=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(MeshFileError) as caught:  # kept, as an interactive session keeps its last error
            store.describe(**FEW)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert caught.value.__traceback__ is not None and store.descriptor_width == 0
    batch = MeshPairs(store, ground_truth=False)[(0, 0)]
    assert batch.identity_descriptors is None and batch.identity.shape == (1, 1000, 3)


def test_pairs_hand_out_descriptors_in_the_order_of_the_vertices(grid, tmp_path):
    store = described(grid, tmp_path)
    pairs = MeshPairs(store, length=20)
    batch = pairs[[(0, i) for i in range(20)]]
    assert batch.identity_mask is not None and batch.identity_descriptors.shape == (*batch.identity.shape[:2], 5)
    for role in ("identity", "pose"):
        verts, known, mask = (getattr(batch, name) for name in (role, f"{role}_descriptors", f"{role}_mask"))
        assert bool((known[~mask] == 0).all())
        for b in range(20):
            rows = verts[b, mask[b]]
            k = next(k for k in range(len(store)) if is_mesh(store, k, rows))
            place = distances(store.verts(k) - store.center[k], rows).argmin(0)
            assert torch.equal(known[b, mask[b]], store.view("descriptors", k)[place])
    with pytest.raises(ValueError, match="descriptors are of clean meshes: pose_noise must be 0"):
        MeshPairs(store, pose_noise=0.1)


def is_mesh(store: MeshStore, k: int, rows: Tensor) -> bool:
    """Whether the rows are the centred vertices of mesh k in another order."""
    own = store.verts(k) - store.center[k]
    return own.shape == rows.shape and bool((distances(own, rows).min(0)[0] < 1e-5).all())


def distances(a: Tensor, b: Tensor) -> Tensor:
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")  # exact


def test_bad_files_are_named_and_skipped_on_request(tmp_path):
    """Empty, NaN, out of range, wrong magic, truncated, too large: each is named; on request left out and counted."""
    for name, text in BAD.items():
        touch(tmp_path, name, text=text)
        with pytest.raises(MeshFileError, match=name):
            MeshStore.build([MeshEntry(tmp_path / name, 0, 0)], tmp_path / "one", progress=False, max_file_bytes=5000)
        assert not (tmp_path / "one" / "index.json").exists()
    touch(tmp_path, *(f"0_{p}.obj" for p in range(4)))
    entries = scan_pose_transfer(tmp_path)
    arguments = {"progress": False, "skip_bad": True, "max_file_bytes": 5000}
    with pytest.warns(UserWarning, match=r"9 of 13 mesh files were left out, the first: .*0_10.obj"):
        store = MeshStore.build(entries, tmp_path / "cache", **arguments)
    assert [e.path.name for e in store.entries] == [f"0_{p}.obj" for p in range(4)]
    assert [Path(name).name for name, _ in store.skipped] == list(BAD)
    assert "more than the 5,000 allowed (max_file_bytes)" in dict(store.skipped)[str(tmp_path / "0_16.obj")]
    with warnings.catch_warnings():  # opened again: nothing is read, nothing to report
        warnings.simplefilter("error")
        assert MeshStore.build(entries, tmp_path / "cache", **arguments).skipped == store.skipped
    with pytest.raises(MeshFileError, match=r"none of the 9 files could be read, the first: .*0_10.obj"):
        MeshStore.build([e for e in entries if e.path.name in BAD], tmp_path / "bad", **arguments)
    with pytest.raises(MeshFileError, match="no meshes to store"):
        MeshStore.build([], tmp_path / "none")
    with pytest.raises(MeshFileError, match=r"9_9.obj: no such file"):
        MeshStore.build([MeshEntry(tmp_path / "9_9.obj", 9, 9)], tmp_path / "none", progress=False)


def test_damaged_stores_say_so_and_are_built_again(tmp_path):
    touch(tmp_path, "0_0.obj", "0_1.obj")
    cache, entries = tmp_path / "cache", scan_pose_transfer(tmp_path)
    with pytest.raises(MeshFileError, match="cache: no store of meshes in it"):
        MeshStore(cache)
    MeshStore.build(entries, cache, progress=False)
    (cache / "verts-00000.npy").rename(tmp_path / "away")
    with pytest.raises(MeshFileError, match=r"verts-00000.npy: shard is missing; delete"):
        MeshStore(cache)
    for text in ("{", "[]", '{"format": 99}'):
        (cache / "index.json").write_text(text)
        with pytest.raises(MeshFileError, match="cache: no store of meshes in it"):
            MeshStore(cache)
        assert len(MeshStore.build(entries, cache, progress=False)) == 2
    for kind in ("verts", "faces"):
        shard = cache / f"{kind}-00000.npy"
        whole = shard.read_bytes()
        shard.write_bytes(whole[:70])
        with pytest.raises(MeshFileError, match=rf"{kind}-00000.npy: shard is cut short; delete .*cache and build"):
            MeshStore(cache)
        assert len(MeshStore.build(entries, cache, progress=False)) == 2
        assert shard.read_bytes() == whole
        for garbage, said in ((b"garbage" * 100, r"\("), (whole.replace(b"4'", b"8'"), r"\(.*rows of 3")):
            shard.write_bytes(garbage + bytes(1000))
            with pytest.raises(MeshFileError, match=f"{kind}-00000.npy: shard is damaged {said}"):
                getattr(MeshStore(cache), kind)(0)
        shard.write_bytes(whole)


def test_what_is_no_folder_or_no_list_is_said(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(MeshFileError, match="file: a file, not a folder"):
        scan_pose_transfer(tmp_path / "file")
    with pytest.raises(MeshFileError, match="a folder, not a list"):
        read_test_list(tmp_path, [])

    def refuse(folder):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("os.listdir", refuse)
    with pytest.raises(MeshFileError, match=r"it cannot be listed \(Permission denied\)"):
        scan_pose_transfer(tmp_path)


# Pairs


def every(pairs: MeshPairs, count: int, epoch: int = 0) -> list:
    return [pairs[(epoch, i)] for i in range(count)]


def test_mesh_pairs_against_the_bodies(store, bodies):
    """Each mesh, un-shuffled by position, is the centred body it names; faces, truth and correspondence follow."""
    seen = set()
    for batch in every(MeshPairs(store, seed=3), 60):
        who, how = int(batch.identity_index), int(batch.pose_index)
        truth = centred(mesh(bodies, who, how))
        order = nearest(batch.ground_truth[0], truth)
        assert sorted(order.tolist()) == list(range(len(truth)))
        assert torch.equal(order[batch.identity_faces[0]], bodies[who].faces)
        options = [(w, h) for w in bodies for h in range(3) if (w, h) != (3, 2)]
        first = [
            h for w, h in options if w == who and torch.equal(centred(mesh(bodies, w, h))[order], batch.identity[0])
        ]
        assert len(first) == 1
        second = []
        for w in (w for w, h in options if h == how):
            body = centred(mesh(bodies, w, how))
            if len(body) == batch.pose.shape[1] and (batch.pose[0, 0] - body).norm(dim=1).min() < 1e-5:
                rank = nearest(batch.pose[0], body)
                assert torch.equal(rank[batch.pose_faces[0]], bodies[w].faces)
                second.append((w, rank))
        assert len(second) == 1
        w, rank = second[0]
        match = batch.correspondence[0]
        if bodies[w] is bodies[who]:
            assert torch.equal(rank[match], order)
        else:
            assert (match == -1).all()
        assert batch.identity_mask is None and batch.pose_mask is None
        seen.add((who, first[0], w, how))
    assert len(seen) > 30 and not {s for s in seen if (s[0], s[3]) == (3, 2)}


def test_ragged_batches_are_the_single_ones_padded(store):
    pairs = MeshPairs(store, seed=1, pose_noise=0.01)
    addresses = [(e, i) for e in range(2) for i in range(6)]
    batch, singles = pairs[addresses], [pairs[address] for address in addresses]
    assert batch.identity.shape[1] == 2000 and batch.identity_mask.shape == (12, 2000)
    for b, one in enumerate(singles):
        num, count = one.identity.shape[1], one.identity_faces.shape[1]
        assert torch.equal(batch.identity_mask[b], torch.arange(2000) < num)
        for name in ("identity", "ground_truth", "correspondence"):
            assert torch.equal(getattr(batch, name)[b, :num], getattr(one, name)[0])
        assert (batch.identity[b, num:] == 0).all() and (batch.correspondence[b, num:] == -1).all()
        assert torch.equal(batch.identity_faces[b, :count], one.identity_faces[0])
        assert (batch.identity_faces[b, count:] == -1).all()
        num = one.pose.shape[1]
        assert torch.equal(batch.pose[b, :num], one.pose[0]) and int(batch.pose_mask[b].sum()) == num
    assert torch.equal(batch.identity_index, torch.cat([one.identity_index for one in singles]))


def test_mesh_pairs_resample_shuffle_and_noise(store):
    plain = MeshPairs(store, shuffle=False)
    for k, batch in enumerate(every(plain, 5)):
        assert int(batch.identity_index) in range(4), k
        where = (store.identity == batch.identity_index).nonzero()[:, 0].tolist()
        assert any(torch.equal(batch.identity[0], centred(store.verts(a))) for a in where)
    fixed = MeshPairs(store, resample=False)
    for i in range(5):
        one, two = fixed[(0, i)], fixed[(7, i)]
        assert torch.equal(one.identity_index, two.identity_index) and torch.equal(one.pose_index, two.pose_index)
        assert not torch.equal(one.identity, two.identity)
        assert torch.equal(one.identity[0].sort(0)[0], two.identity[0].sort(0)[0])
    noisy = MeshPairs(store, pose_noise=0.02)
    clean = MeshPairs(store)
    one, two = noisy[(3, 4)], clean[(3, 4)]
    assert_same(replace(one, pose=two.pose), two)
    difference = one.pose - two.pose
    assert abs((difference - difference.mean(1, keepdim=True)).std() - 0.02) < 1e-3
    assert MeshPairs(store, seed=1)[(3, 4)].identity_index.numel() == 1


def test_mesh_pairs_without_ground_truth_are_any_two_meshes(store):
    pairs = MeshPairs(store, ground_truth=False, shuffle=False, length=500)
    draws = [pairs._draw(torch.Generator(), 0, i)[:2] for i in range(2200)]
    counts = torch.zeros(11, 11)
    for a, b in draws:
        counts[a, b] += 1
    assert (counts.diagonal() == 0).all()
    expected = 20 * (1 - torch.eye(11))
    chi_squared = ((counts - expected).square() / expected)[expected > 0].sum()
    assert chi_squared < 180  # the 0.99999 quantile for 109 degrees of freedom is 179
    assert pairs[(0, 0)].ground_truth.shape[1:] == (0, 3)


def test_draws_with_ground_truth_are_even_over_a_complete_grid(store, bodies):
    """Over the pairs whose identity mesh is not in the pose yet, and whose pose mesh is not the ground truth."""
    some = [k for k in range(len(store)) if int(store.identity[k]) < 3]
    sub = replace_members(store, some)
    pairs = MeshPairs(sub)
    counts = torch.zeros(9, 9)
    for i in range(4050):
        a, b, c = pairs._draw(torch.Generator(), 0, i)
        counts[a, b] += 1
        assert sub.identity[c] == sub.identity[a] and sub.pose[c] == sub.pose[b]
    allowed = (sub.identity[:, None] != sub.identity) & (sub.pose[:, None] != sub.pose)
    assert allowed.sum() == 36 and (counts[~allowed] == 0).all()
    expected = 4050 / 36
    assert ((counts[allowed] - expected).square() / expected).sum() < 88  # the 0.99999 quantile for 35 degrees is 87


def test_a_lone_pose_or_identity_is_its_own_ground_truth(store):
    """Two identities in one pose: nothing else can be drawn."""
    alone = [int((store.identity == who).nonzero()[0]) for who in (0, 1)]
    pairs = MeshPairs(replace_members(store, alone))
    draws = {pairs._draw(torch.Generator(), 0, i) for i in range(100)}
    assert draws == {(0, 1, 0), (1, 0, 1)}


def replace_members(store: MeshStore, members: list[int]) -> MeshStore:
    """The store with only some of its meshes."""
    sub = pickle.loads(pickle.dumps(store))
    for name in ("identity", "pose", "topology", "shard", "num_verts"):
        setattr(sub, name, getattr(store, name)[members])
    sub._spans, sub.entries = store._spans[members], [store.entries[k] for k in members]
    return sub


def test_listed_mesh_pairs(store, grid, tmp_path):
    listing = tmp_path / "list"
    listing.write_text("0_1.ply 2_2.ply 0_2.ply\n3_0.ply 1_1.ply 3_1.ply\n")
    rows = read_test_list(listing, store.entries)
    pairs = MeshPairs(store, listed=rows, shuffle=False)
    assert len(pairs) == 2
    batch = pairs[[(0, 1), (0, 0)]]
    assert batch.identity_index.tolist() == [3, 0] and batch.pose_index.tolist() == [1, 2]
    assert torch.equal(batch.ground_truth[0, :1962], centred(store.verts(rows[1][2])))
    assert torch.equal(batch.pose[1], centred(store.verts(rows[0][1])))
    listing.write_text("3_0.ply 0_2.ply 3_2.ply\n")  # the missing one
    with pytest.raises(MeshFileError, match=r"line 1 names '3_2.ply', which none of 11 meshes is"):
        read_test_list(listing, store.entries)


def test_streaming_stays_within_a_window_of_shards_and_covers_all(store):
    pairs = MeshPairs(store, window=2, length=400, ground_truth=False)
    parts = -(-pairs.num_shards // 2)
    orders = []
    for epoch in range(2):
        used = [{int(store.shard[k]) for k in pairs._draw(torch.Generator(), epoch, i)[:2]} for i in range(400)]
        shards = [set().union(*used[p * 400 // parts + 1 : (p + 1) * 400 // parts - 1]) for p in range(parts)]
        assert all(len(s) <= 2 for s in shards)
        assert set().union(*shards) == set(range(pairs.num_shards))
        assert sum(map(len, shards)) == pairs.num_shards
        orders.append(shards)
    assert orders[0] != orders[1]
    assert [pairs._draw(torch.Generator(), 1, i) for i in (390, 5)] == [
        MeshPairs(store, window=2, length=400, ground_truth=False)._draw(torch.Generator(), 1, i) for i in (390, 5)
    ]
    sampler = PairSampler(400, 8, stop=100, shuffle=False, rank=1, world_size=2)
    steps = list(sampler)
    assert steps[0] == [(0, i) for i in range(8, 16)] and steps[25] == [(1, i) for i in range(8, 16)]
    with_truth = MeshPairs(store, window=3, length=40)
    for i in range(40):
        a, b, c = with_truth._draw(torch.Generator(), 0, i)
        assert store.identity[a] == store.identity[c] and store.pose[b] == store.pose[c]


def test_a_window_of_few_shards_holds_several_identities(tmp_path):
    entries = []
    for who in range(4):
        for how in range(8):
            entries.append(MeshEntry(tmp_path / f"{who}_{how}.ply", who, how))
            save_mesh(entries[-1].path, torch.rand(30, 3), torch.arange(30).view(10, 3))
    store = MeshStore.build(entries, tmp_path / "cache", progress=False, shard_bytes=8 * 30 * 12)
    assert [e.path for e in store.entries] == [e.path for e in entries] and int(store.shard.max()) >= 3
    for shard in range(int(store.shard.max())):
        assert len(store.identity[store.shard == shard].unique()) > 1
    for k in (0, 17, 31):
        assert torch.equal(store.verts(k), load_mesh(entries[k].path)[0])
    pairs = MeshPairs(store, window=1, length=64)
    assert any(b != c for _, b, c in (pairs._draw(torch.Generator(), 0, i) for i in range(64)))


def test_a_window_without_shared_poses_is_warned_about(tmp_path):
    entries = [MeshEntry(tmp_path / f"{who}_{how}.ply", who, how) for who in range(2) for how in range(2)]
    for entry in entries:
        save_mesh(entry.path, torch.rand(30, 3), torch.arange(30).view(10, 3))
    store = MeshStore.build(entries, tmp_path / "cache", progress=False, shard_bytes=1)
    with pytest.warns(UserWarning, match="no pose is shared by two meshes in 1 shards of 4"):
        MeshPairs(store, window=1, length=8)._draw(torch.Generator(), 0, 0)


def test_the_stores_limit_is_the_readers(tmp_path, monkeypatch):
    save_mesh(tmp_path / "a.ply", torch.eye(3), torch.tensor([[0, 1, 2]]))
    limits = []

    def read(path, *, max_bytes):
        limits.append(max_bytes)
        return load_mesh(path)

    monkeypatch.setattr("meshkit.data.store.load_mesh", read)
    MeshStore.build([MeshEntry(tmp_path / "a.ply", 0, 0)], tmp_path / "c", progress=False, max_file_bytes=1 << 30)
    assert limits == [1 << 30]


def test_names_that_several_meshes_have_are_no_places(tmp_path):
    entries = [MeshEntry(tmp_path / folder / "a.ply", k, 0) for k, folder in enumerate("xy")]
    entries.append(MeshEntry(tmp_path / "b.ply", 2, 0))
    (tmp_path / "list").write_text("b.ply b.ply b.ply\nb.ply a.ply b.ply\n")
    with pytest.raises(MeshFileError, match=r"line 2 names 'a\.ply', and several meshes are called that"):
        read_test_list(tmp_path / "list", entries)


def test_mesh_pairs_load_the_same_with_workers_and_share_out_ranks(store):
    pairs = MeshPairs(store, length=24)
    sampler = PairSampler(24, 4, stop=6)
    here, there = (list(pair_loader(pairs, sampler, workers=workers)) for workers in (0, 2))
    for mine, theirs in zip(here, there, strict=True):
        assert_same(mine, theirs)
    ranks = [list(PairSampler(24, 4, stop=3, rank=r, world_size=2)) for r in range(2)]
    both = [address for step in zip(*ranks, strict=True) for rank in step for address in rank]
    assert sorted(both) == [(0, i) for i in range(24)]


def test_what_mesh_pairs_refuse(store, tmp_path):
    for arguments, numbers in (
        ({"length": 0}, "0, 0.0 and None"),
        ({"pose_noise": -1.0}, "6400, -1.0 and None"),
        ({"window": 0}, "6400, 0.0 and 0"),
    ):
        with pytest.raises(ValueError, match=f"window >= 1, got {numbers}"):
            MeshPairs(store, **arguments)
    with pytest.raises(ValueError, match="at least 2 meshes, the store has 1"):
        MeshPairs(replace_members(store, [0]))
    with pytest.raises(ValueError, match="no pose in the store is shared by two identities"):
        MeshPairs(replace_members(store, [0, 4, 8]))
    mixed = replace_members(store, [0, 1, 6])
    mixed.identity = torch.tensor([5, 5, 5])
    mixed.pose = torch.tensor([0, 1, 1])
    with pytest.raises(ValueError, match=r"0_0.ply and .*2_0.ply are one identity but differ in vertex count"):
        MeshPairs(mixed)
    with pytest.raises(ValueError, match=r"listed row 1 must be 3 places in \[0, 11\), got \(0, 1, 11\)"):
        MeshPairs(store, listed=[(0, 1, 2), (0, 1, 11)])
    with pytest.raises(ValueError, match=r"0_0.ply and its ground truth .*2_0.ply differ in vertex count"):
        MeshPairs(store, listed=[(0, 1, 6)])
    assert MeshPairs(store, listed=[(0, 1, 6)], ground_truth=False)[(0, 0)].identity.shape == (1, 1000, 3)
    assert np.isfinite(store.verts(0).numpy()).all()
