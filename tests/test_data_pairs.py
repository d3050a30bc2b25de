"""Pairs, pools, samplers and loaders: reproducible, with ground truth checked through geometry."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import rand
from literal_data import (
    assert_same,
    centred,
    nearest,
    parts,
    stack,
    synthetic_rig,
)
from scipy.spatial import cKDTree
from torch import Tensor

from meshkit.batching import bounding_box_center, center
from meshkit.data import (
    MeshPairs,
    MeshPool,
    PairBatch,
    PairSampler,
    PosePairs,
    RiggedModel,
    human_split,
    load_humans,
    load_shipped,
    pair_loader,
)
from meshkit.descriptors import wave_kernel_signature
from meshkit.neighbors import gather_vertices


@pytest.fixture(scope="module")
def humans() -> RiggedModel:
    return load_humans(1000)


# Pairs


@pytest.fixture(scope="module")
def pool(humans) -> MeshPool:
    return MeshPool.build(humans, torch.tensor([4, 90]), torch.tensor([12, 500, 901]), 5, num_signatures=6)


@pytest.fixture(params=["drawn", "pool"])
def pairs(request, humans) -> PosePairs:
    """Pairs of few identities in few poses."""
    return PosePairs(
        humans,
        torch.tensor([4, 90]),
        torch.tensor([12, 500, 901]),
        length=50,
        seed=3,
        pool=request.getfixturevalue("pool") if request.param == "pool" else None,
    )


def test_pairs_are_what_they_say(pairs, humans):
    """Everything is recovered from geometry: which body in which pose, and which vertex of the template is where."""
    batch = pairs[[(0, i) for i in range(4)]]
    assert len(batch) == 4
    for b in range(4):
        who_a, how_b = batch.identity_index[[b]], batch.pose_index[[b]]
        assert who_a in pairs.identities
        assert how_b in pairs.poses
        truth = centred(humans(who_a, how_b)[0])
        order_a = nearest(batch.ground_truth[b], truth)
        assert torch.equal(order_a.sort()[0], torch.arange(1000))
        # The identity mesh is that body in one of the poses, the pose mesh one of the bodies in that pose.
        bodies = [centred(humans(who_a, how[None])[0])[order_a] for how in pairs.poses]
        assert min((batch.identity[b] - body).abs().max() for body in bodies) < 1e-6
        order_b = None
        for who in pairs.identities:
            body = centred(humans(who[None], how_b)[0])
            if cKDTree(body.numpy()).query(batch.pose[b].numpy())[0].max() < 1e-6:
                order_b = nearest(batch.pose[b], body)
        assert order_b is not None
        assert torch.equal(order_b.sort()[0], torch.arange(1000))
        assert torch.equal(order_b[batch.correspondence[b]], order_a)
        assert torch.equal(order_a[batch.identity_faces[b]], humans.faces)
        assert torch.equal(order_b[batch.pose_faces[b]], humans.faces)
        assert (order_a != order_b).sum() > 900
        assert (order_a != torch.arange(1000)).sum() > 900


def test_reindexed_faces_keep_the_surface(pairs, humans):
    pairs.shuffle = False
    still = pairs[(0, 1)]
    pairs.shuffle = True
    moved = pairs[(0, 1)]
    for mesh, faces in (("identity", "identity_faces"), ("pose", "pose_faces"), ("ground_truth", "identity_faces")):
        corners = [getattr(batch, mesh)[0][getattr(batch, faces)[0]] for batch in (still, moved)]
        for quantity in (
            lambda c: torch.linalg.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]),
            lambda c: (c - c.roll(1, 1)).norm(dim=2),
        ):
            torch.testing.assert_close(quantity(corners[1]), quantity(corners[0]), rtol=0, atol=1e-6)


def test_meshes_are_centred_by_their_bounding_box(pairs):
    batch = pairs[[(2, i) for i in range(3)]]
    for verts in (batch.identity, batch.pose, batch.ground_truth):
        torch.testing.assert_close(bounding_box_center(verts), torch.zeros(3, 1, 3), rtol=0, atol=1e-6)


def test_an_item_depends_on_its_address_alone(pairs):
    addresses = [(0, 3), (5, 49), (0, 0), (5, 3)]
    together = pairs[addresses]
    assert_same(stack([pairs[address] for address in addresses]), together)
    assert_same(stack([pairs[addresses[:3]], pairs[addresses[3:]]]), together)
    fresh = PosePairs(pairs.model, pairs.identities, pairs.poses, length=50, seed=3, pool=pairs.pool)
    assert_same(fresh[addresses], together)
    other = PosePairs(pairs.model, pairs.identities, pairs.poses, length=50, seed=4, pool=pairs.pool)
    assert not torch.equal(other[addresses].correspondence, together.correspondence)


def test_single_addresses_make_batches_of_one(pairs):
    assert len(pairs[(0, 7)]) == 1
    assert len(pairs) == 50


@pytest.mark.parametrize("resample", [True, False])
def test_resampling(pairs, resample):
    pairs.resample = resample
    batches = [pairs[[(epoch, i) for i in range(12)]] for epoch in (0, 1)]
    kept = [torch.equal(getattr(batches[0], n), getattr(batches[1], n)) for n in ("identity_index", "pose_index")]
    assert kept == [not resample] * 2
    orders_change = ~(batches[0].correspondence == batches[1].correspondence).all(1)
    assert orders_change.all()
    if not resample:  # the same two meshes up to the order of their vertices
        for name in ("identity", "pose", "ground_truth"):
            for a, b in zip(getattr(batches[0], name), getattr(batches[1], name), strict=True):
                assert not torch.equal(a, b)
                nearest(a, b)


def test_without_shuffling_vertices_keep_the_template_order(pairs, humans):
    pairs.shuffle = False
    batch = pairs[[(1, 0), (1, 1)]]
    assert torch.equal(batch.correspondence, torch.arange(1000).expand(2, -1))
    assert torch.equal(batch.identity_faces, humans.faces.expand(2, -1, -1))
    assert torch.equal(batch.pose_faces, humans.faces.expand(2, -1, -1))
    for b in range(2):
        truth = centred(humans(batch.identity_index[[b]], batch.pose_index[[b]])[0])
        torch.testing.assert_close(batch.ground_truth[b], truth, rtol=0, atol=1e-6)


def test_draws_cover_the_lists_evenly(humans):
    """Over many epochs every identity and pose comes up about equally often, and streams do not repeat."""
    model = synthetic_rig().float()
    pairs = PosePairs(model, torch.arange(4), torch.arange(5), length=100)
    batch = pairs[[(epoch, i) for epoch in range(20) for i in range(100)]]
    for index, count in ((batch.identity_index, 4), (batch.pose_index, 5)):
        expected = 2000 / count
        chi_squared = ((torch.bincount(index, minlength=count) - expected) ** 2 / expected).sum()
        assert chi_squared < 25  # the 0.9999 quantile for 4 degrees of freedom is 23.5
    combined = batch.identity_index * 5 + batch.pose_index
    assert ((torch.bincount(combined, minlength=20) - 100).square() / 100).sum() < 55
    assert len(batch.correspondence.unique(dim=0)) > 1990


def test_gradients_stop_at_the_data(pairs):
    assert not pairs[(0, 0)].ground_truth.requires_grad


def test_moving_a_batch(pairs):
    batch = pairs[(0, 0)]
    moved = batch.to("meta")
    for name in PairBatch.__dataclass_fields__:
        value, there = getattr(batch, name), getattr(moved, name)
        assert (value is None) == (there is None)
        if there is not None:
            assert there.device.type == "meta"
            assert there.shape == value.shape
    assert_same(batch.to("cpu"), batch)


@pytest.mark.parametrize(
    ("identities", "poses", "length", "numbers"),
    [(0, 3, 5, "0, 3 and 5"), (2, 0, 5, "2, 0 and 5"), (2, 3, 0, "2, 3 and 0")],
)
def test_pairs_of_nothing_are_refused(humans, identities, poses, length, numbers):
    with pytest.raises(ValueError, match=f"need identities, poses and a positive length, got {numbers}"):
        PosePairs(humans, torch.arange(identities), torch.arange(poses), length=length)


def test_train_and_test_pairs_share_nobody_and_no_pose(humans):
    split = human_split()
    addresses = [(0, i) for i in range(100)]
    train = PosePairs(humans, split.train_identities, split.train_poses)[addresses]
    test = PosePairs(humans, split.test_identities, split.test_poses)[addresses]
    assert not set(train.identity_index.tolist()) & set(test.identity_index.tolist())
    assert not set(train.pose_index.tolist()) & set(test.pose_index.tolist())
    assert set(test.identity_index.tolist()) <= set(split.test_identities.tolist())
    assert set(train.pose_index.tolist()) <= set(split.train_poses.tolist())


# Pool


def describe(verts: Tensor, faces: Tensor, **options: int) -> Tensor:
    """Wave-kernel signatures of one mesh, then the logarithm of the root of its area."""
    a, b, c = verts[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2
    waves = wave_kernel_signature(verts, faces, width=7.0, method="fast", **options)
    return torch.cat([waves, area.sqrt().log().expand(len(verts), 1)], 1)


def test_pool_holds_the_meshes_it_names(pool, humans):
    assert len(pool) == 5
    assert set(pool.identity.tolist()) <= {4, 90}
    assert set(pool.pose.tolist()) <= {12, 500, 901}
    torch.testing.assert_close(pool.verts, humans(pool.identity, pool.pose), rtol=0, atol=1e-6)
    assert pool.descriptors.shape == (5, 1000, 7)
    for verts, descriptors in zip(pool.verts, pool.descriptors, strict=True):
        expected = describe(verts, humans.faces, num_signatures=6)
        torch.testing.assert_close(descriptors, expected, rtol=1e-4, atol=1e-5)
    # Descriptors of the posed surface, which are not those of the body at rest.
    rest = describe(humans.shape(pool.identity[:1])[0][0], humans.faces, num_signatures=6)
    assert (pool.descriptors[0] - rest).abs().mean() > 0.01


def test_pool_is_reproducible_with_any_number_of_workers(pool, humans):
    arguments = (humans, torch.tensor([4, 90]), torch.tensor([12, 500, 901]), 5)
    again = MeshPool.build(*arguments, num_signatures=6, workers=2)
    for name, value in pool.state_dict().items():
        exact = 0 if name != "descriptors" else 1e-5
        torch.testing.assert_close(again.state_dict()[name], value, rtol=exact, atol=exact, msg=name)
    once = MeshPool.build(*arguments, num_signatures=6)
    assert all(torch.equal(once.state_dict()[name], value) for name, value in pool.state_dict().items())


def test_a_pool_made_here_keeps_to_one_thread(humans, monkeypatch):
    """Two such processes on two cores would fight for them."""
    from meshkit.data import _signatures as module

    seen = []

    original = module.intrinsic_descriptors

    def describe_and_look(*arguments, **options):
        seen.append(torch.get_num_threads())
        return original(*arguments, **options)

    monkeypatch.setattr(module, "intrinsic_descriptors", describe_and_look)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        MeshPool.build(humans, torch.arange(3), torch.arange(3), 2, num_signatures=2, num_eigenpairs=4)
        after = torch.get_num_threads()
    finally:
        torch.set_num_threads(threads)
    assert seen == [1, 1]
    assert after == 2


def test_pool_seed_and_arguments(humans, capsys):
    few, many = torch.arange(50), torch.arange(60)
    first = MeshPool.build(humans, few, many, 8, num_signatures=4, num_eigenpairs=8, progress=True)
    assert "8/8" in capsys.readouterr().err
    second = MeshPool.build(humans, few, many, 8, num_signatures=4, num_eigenpairs=8, seed=1)
    assert capsys.readouterr().err == ""
    assert not torch.equal(first.identity, second.identity)
    assert not torch.equal(first.pose, second.pose)
    expected = describe(first.verts[0], humans.faces, num_signatures=4, num_eigenpairs=8)
    torch.testing.assert_close(first.descriptors[0], expected, rtol=1e-4, atol=1e-5)


def test_pool_round_trip(pool, tmp_path):
    from safetensors.torch import load_file, save_file

    save_file(pool.state_dict(), tmp_path / "pool.safetensors")
    loaded = MeshPool(**load_file(tmp_path / "pool.safetensors"))
    assert all(torch.equal(getattr(loaded, name), value) for name, value in pool.state_dict().items())
    assert len(loaded) == 5


def test_a_pool_of_one_is_refused(humans):
    with pytest.raises(ValueError, match="at least 2 meshes to make a pair, got 1"):
        MeshPool.build(humans, torch.arange(3), torch.arange(3), 1)


def test_pool_pairs_come_with_the_descriptors_of_their_meshes(humans, pool):
    """Descriptors are invariant to order and place: computed afresh from what the network gets, they are the same."""
    pairs = PosePairs(humans, torch.tensor([0]), torch.tensor([0]), length=9, pool=pool)
    batch = pairs[[(0, 0), (3, 8)]]
    for side in ("identity", "pose"):
        verts, faces = getattr(batch, side), getattr(batch, f"{side}_faces")
        for b, descriptors in enumerate(getattr(batch, f"{side}_descriptors")):
            torch.testing.assert_close(
                descriptors, describe(verts[b], faces[b], num_signatures=6), rtol=1e-3, atol=1e-3
            )
    assert set(batch.identity_index.tolist()) <= {4, 90}


def test_pairs_without_pool_have_no_descriptors(humans):
    batch = PosePairs(humans, torch.arange(2), torch.arange(2))[(0, 0)]
    assert batch.identity_descriptors is None
    assert batch.pose_descriptors is None


# Devices, noise, no ground truth


@pytest.mark.parametrize("name", ["humans", "animals"])
@pytest.mark.parametrize("pooled", [False, True])
def test_pairs_without_ground_truth_are_the_same_otherwise(name, pooled):
    model, split = load_shipped(name)
    who, how = split.test_identities, split.test_poses
    pool = MeshPool.build(model, who, how, 3, num_signatures=2, num_eigenpairs=4) if pooled else None
    full = PosePairs(model, who, how, pool=pool)[[(0, 0), (2, 5)]]
    bare = PosePairs(model, who, how, pool=pool, ground_truth=False)[[(0, 0), (2, 5)]]
    assert bare.ground_truth.shape == (2, 0, 3)
    assert full.ground_truth.shape == full.identity.shape
    assert_same(replace(full, ground_truth=bare.ground_truth), bare)


def test_pool_pairs_are_two_different_meshes():
    model = synthetic_rig().float()
    pool = MeshPool(torch.arange(5) % 4, torch.arange(5), rand(5, 12, 3).float(), torch.zeros(5, 12, 1))
    pairs = PosePairs(model, torch.arange(4), torch.arange(5), pool=pool, shuffle=False)
    batch = pairs[[(0, i) for i in range(400)]]
    first = (batch.identity[:, None] - center(pool.verts)).abs().amax((2, 3)).argmin(1)
    second = (batch.pose[:, None] - center(pool.verts)).abs().amax((2, 3)).argmin(1)
    assert (first != second).all()
    counts = torch.bincount(5 * first + second, minlength=25).view(5, 5)
    expected = 20 * (1 - torch.eye(5))  # 400 draws over 20 ordered pairs
    chi_squared = ((counts - expected).square() / expected)[expected > 0].sum()
    assert chi_squared < 57  # the 0.99999 quantile for 19 degrees of freedom


def test_pose_noise_is_of_the_stated_size_and_on_the_pose_mesh_alone(humans):
    arguments = (humans, torch.arange(5), torch.arange(5))
    clean = PosePairs(*arguments)[[(0, 0), (1, 3)]]
    noisy = PosePairs(*arguments, pose_noise=0.02)[[(0, 0), (1, 3)]]
    assert_same(replace(noisy, pose=clean.pose), clean)
    difference = noisy.pose - clean.pose
    difference = difference - difference.mean(1, keepdim=True)  # the noise moves the bounding box
    assert abs(difference.std() - 0.02) < 5e-4
    assert difference[0].sub(difference[1]).abs().max() > 0.05  # drawn per item
    assert bounding_box_center(noisy.pose).abs().max() < 1e-6
    again = PosePairs(*arguments, pose_noise=0.02)[(1, 3)]
    torch.testing.assert_close(again.pose[0], noisy.pose[1], rtol=0, atol=1e-6)


def test_pairs_move_to_a_device_and_leave_the_original(humans, pool):
    for chosen in (None, pool):
        pairs = PosePairs(humans, torch.arange(5), torch.arange(5), pool=chosen)
        there = pairs.to("meta")
        assert there.device.type == "meta" and pairs.device.type == "cpu" and humans.template.device.type == "cpu"
        batch, here = there[[(0, 0), (0, 1)]], pairs[[(0, 0), (0, 1)]]
        for name in PairBatch.__dataclass_fields__:
            value, twin = getattr(batch, name), getattr(here, name)
            assert (value is None) == (twin is None)
            if value is not None:
                assert value.device.type == "meta" and value.shape == twin.shape and value.dtype == twin.dtype, name
        with pytest.raises(ValueError, match="pairs on meta are made by this process: use workers=0, got 2"):
            pair_loader(there, PairSampler(10, 2, stop=1), workers=2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("name", ["humans", "animals"])
def test_batches_are_the_same_on_the_gpu(name):
    model, split = load_shipped(name)
    pool = MeshPool.build(model, split.test_identities, split.test_poses, 3, num_signatures=2, num_eigenpairs=4)
    for chosen in (None, pool):
        pairs = PosePairs(model, split.test_identities, split.test_poses, pool=chosen, length=20)
        there = pairs.to("cuda")
        for addresses in PairSampler(20, 4, stop=5):
            batch = there[addresses]
            assert batch.identity.is_cuda
            assert_same(batch.to("cpu"), pairs[addresses])
        assert next(iter(pair_loader(there, PairSampler(20, 4, stop=5)))).identity.is_cuda
    pinned = next(iter(pair_loader(pairs, PairSampler(20, 4, stop=5), pin_memory=True)))
    assert pinned.identity.is_pinned()


def test_what_pairs_refuse(humans, pool):
    few = torch.arange(3)
    with pytest.raises(ValueError, match=r"identities must be in \[0, 200\), got 0 to 200"):
        PosePairs(humans, torch.tensor([0, 200]), few)
    with pytest.raises(ValueError, match=r"poses must be in \[0, 1000\), got -1 to 2"):
        PosePairs(humans, few, torch.tensor([-1, 2]))
    with pytest.raises(ValueError, match=r"identities must be in \[0, 200\), got 0 to 300"):
        PosePairs(humans, few, few, listed=torch.tensor([[0, 1, 300, 2]]))
    with pytest.raises(ValueError, match=r"got -0.1"):
        PosePairs(humans, few, few, pose_noise=-0.1)
    with pytest.raises(ValueError, match=r"0 with a pool, whose descriptors are of clean meshes; got 0.1"):
        PosePairs(humans, few, few, pose_noise=0.1, pool=pool)
    with pytest.raises(ValueError, match="no tables of identities and poses to draw from"):
        PosePairs(RiggedModel(**parts(synthetic_rig())), few, few)


# Sampler and loader


def test_sampler_visits_each_pair_once_per_epoch():
    sampler = PairSampler(12, 3, stop=12, seed=5)
    batches = list(sampler)
    assert len(sampler) == len(batches) == 12
    for epoch in range(3):
        addresses = [address for batch in batches[4 * epoch : 4 * epoch + 4] for address in batch]
        assert {e for e, _ in addresses} == {epoch}
        assert sorted(i for _, i in addresses) == list(range(12))
    orders = [[i for batch in batches[4 * e : 4 * e + 4] for _, i in batch] for e in range(3)]
    assert orders[0] != orders[1] != orders[2] != orders[0]
    assert batches == list(sampler)
    assert batches != list(PairSampler(12, 3, stop=12, seed=6))


def test_sampler_drops_the_incomplete_batch():
    batches = list(PairSampler(11, 3, stop=7))
    assert all(len(batch) == 3 for batch in batches)
    assert [batch[0][0] for batch in batches] == [0, 0, 0, 1, 1, 1, 2]
    assert len({i for batch in batches[:3] for _, i in batch}) == 9


@pytest.mark.parametrize("start", [0, 1, 4, 7, 11, 12, 15])
def test_sampler_resumes(start):
    every = list(PairSampler(12, 3, stop=12, seed=5))
    rest = PairSampler(12, 3, start=start, stop=12, seed=5)
    assert list(rest) == every[start:]
    assert len(rest) == len(every[start:])


@pytest.mark.parametrize("world_size", [2, 3])
def test_ranks_share_out_the_single_process_order(world_size):
    ranks = [list(PairSampler(26, 2, stop=9, seed=1, rank=r, world_size=world_size)) for r in range(world_size)]
    together = [[address for rank in ranks for address in rank[step]] for step in range(9)]
    assert together == list(PairSampler(26, 2 * world_size, stop=9, seed=1))
    assert all(len(set(batch)) == 2 * world_size for batch in together)
    resumed = PairSampler(26, 2, start=5, stop=9, seed=1, rank=1, world_size=world_size)
    assert list(resumed) == ranks[1][5:]


def test_sampler_refuses_epochs_below_a_batch():
    with pytest.raises(ValueError, match="an epoch of 7 pairs is less than one batch of 4 for each of 2 processes"):
        PairSampler(7, 4, stop=1, world_size=2)


def test_loader_gives_the_same_batches_with_and_without_workers(pairs):
    sampler = PairSampler(50, 5, start=8, stop=12, seed=2)
    here, there = (list(pair_loader(pairs, sampler, workers=workers)) for workers in (0, 2))
    assert len(here) == len(there) == 4
    for mine, theirs, addresses in zip(here, there, sampler, strict=True):
        assert_same(mine, theirs)
        assert_same(mine, pairs[addresses])


def test_a_pool_of_other_meshes_than_listed_is_refused(humans: RiggedModel) -> None:
    listed = torch.tensor([[0, 1, 2, 3], [4, 5, 6, 7]])
    who, how = listed.view(-1, 2).unbind(1)
    few = torch.arange(2)

    def pool(who: Tensor, how: Tensor) -> MeshPool:
        return MeshPool(who, how, torch.zeros(len(who), 1000, 3), torch.zeros(len(who), 1000, 2))

    PosePairs(humans, few, few, listed=listed, pool=pool(who, how))
    for other in (pool(who.flip(0), how.flip(0)), pool(who, who), pool(who[:2], how[:2])):
        with pytest.raises(ValueError, match=r"must hold the 4 listed meshes in their order"):
            PosePairs(humans, few, few, listed=listed, pool=other)


@pytest.mark.parametrize("key", [5, [0, 1], [], torch.tensor([[0, 1]]), (0, 1, 2), (0.5, 1), slice(2)])
def test_pairs_are_addressed_by_epoch_and_number(key: Any, humans: RiggedModel) -> None:
    pairs = PosePairs(humans, torch.arange(2), torch.arange(2))
    meshes = MeshPairs.__new__(MeshPairs)  # the key is looked at before the store
    said = r"address pairs by \(epoch, i\).*pair_loader\(pairs, PairSampler\(\.\.\.\)\)"
    for dataset in (pairs, meshes):
        with pytest.raises(TypeError, match=said):
            dataset[key]
    assert pairs[[[0, 1]]].identity.equal(pairs[(0, 1)].identity)


def test_a_sampler_begins_at_a_step_from_0_on() -> None:
    with pytest.raises(ValueError, match="start must be a whole number, at least 0, got -3"):
        PairSampler(10, 2, start=-3, stop=4)


def test_listed_pairs_are_the_rows_of_the_list_with_and_without_a_pool() -> None:
    body, split = load_humans(1000), human_split()
    assert split.test_pairs.shape == (400, 4)
    assert set(split.test_pairs[:, [0, 2]].flatten().tolist()) <= set(split.test_identities.tolist())
    assert set(split.test_pairs[:, [1, 3]].flatten().tolist()) <= set(split.test_poses.tolist())
    assert (split.test_pairs[:, 0] != split.test_pairs[:, 2]).all()
    listed = split.test_pairs[:3]
    who, how = listed.view(-1, 2).unbind(1)
    pool = MeshPool.of(body, who, how, num_signatures=3, num_eigenpairs=5)
    assert torch.equal(pool.verts, body(who, how))
    for source in (None, pool):
        pairs = PosePairs(body, split.test_identities, split.test_poses, listed=listed, pool=source)
        assert len(pairs) == 3
        batch = pairs[[(0, 2), (0, 0)]]
        assert batch.identity_index.tolist() == listed[[2, 0], 0].tolist()
        assert batch.pose_index.tolist() == listed[[2, 0], 3].tolist()
        truth = center(body(listed[[2, 0], 0], listed[[2, 0], 3]))
        ordered = gather_vertices(batch.pose, batch.correspondence)
        back = gather_vertices(center(body(listed[[2, 0], 2], listed[[2, 0], 3])), _template_order(batch, truth))
        torch.testing.assert_close(ordered, back, atol=1e-6, rtol=0)


def _template_order(batch: PairBatch, truth: torch.Tensor) -> torch.Tensor:
    """Template vertex of each row of the ground truth, found by position."""
    return torch.cdist(batch.ground_truth, truth, compute_mode="donot_use_mm_for_euclid_dist").argmin(2)


def test_tables_are_indexed_by_batches(humans):
    with pytest.raises(ValueError, match=r"identity must be a batch, a tensor such as torch.tensor\(\[3\]\), got 3"):
        humans(3, torch.tensor([10]))
    with pytest.raises(ValueError, match=r"pose must be a batch.*got list"):
        humans(torch.tensor([3]), [10])


def test_tables_are_indexed_by_whole_numbers(humans):
    rows = torch.tensor([1, 2])
    with pytest.raises(ValueError, match=r"identities must be whole numbers, rows of .* got torch\.float32"):
        PosePairs(humans, rows.float(), rows)
    with pytest.raises(ValueError, match=r"listed must be a pair or more \(L, 4\), got \(0, 4\)"):
        PosePairs(humans, rows, rows, listed=torch.zeros(0, 4, dtype=torch.long))
