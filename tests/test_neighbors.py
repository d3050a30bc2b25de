"""Nearest neighbours against brute force, and gathering against a loop."""

import math

import pytest
import torch
from conftest import rand, scatter, scattered_mask
from torch import Tensor
from torch.autograd import gradcheck

from meshkit import neighbors
from meshkit.neighbors import gather_vertices, knn

methods = pytest.mark.parametrize("method", ["tree", "tiles", "auto"])


def brute_force(points: Tensor, query: Tensor, k: int) -> Tensor:
    """Full argsort of the distances of one sample."""
    return ((query[:, None] - points[None]) ** 2).sum(2).argsort(1)[:, :k]


@pytest.fixture(params=[1 << 22, 200], ids=["one-tile", "many-tiles"])
def tile_elements(request, monkeypatch) -> int:
    monkeypatch.setattr(neighbors, "_TILE_ELEMENTS", request.param)
    return request.param


@methods
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("coordinates", [1, 3, 8])
@pytest.mark.parametrize("k", [1, 7, 60])
def test_knn_equals_argsort(k, coordinates, dtype, method, tile_elements):
    points = rand(2, 60, coordinates, dtype=dtype)
    index = knn(points, k, method=method)
    assert index.dtype == torch.int64 and index.shape == (2, 60, k)
    for b in range(2):
        assert torch.equal(index[b], brute_force(points[b].double(), points[b].double(), k))
    assert torch.equal(index[..., 0], torch.arange(60).expand(2, -1))  # itself first


def test_small_samples_are_searched_in_tiles(monkeypatch):
    """Setting up a tree per sample takes longer there, whatever the number of samples."""
    chosen = []
    for name in ("_knn_tree", "_knn_tiles"):
        search = getattr(neighbors, name)
        monkeypatch.setattr(neighbors, name, lambda *a, search=search, name=name: chosen.append(name) or search(*a))
    for batch, num, queries in ((9, 128, 128), (1, 64, 256), (1, 129, 128)):
        knn(rand(batch, num, 3), 1, query=rand(batch, queries, 3, seed=1))
    assert chosen == ["_knn_tiles", "_knn_tiles", "_knn_tree"]


@methods
def test_query_points(method, tile_elements):
    points, query = rand(2, 40, 3), rand(2, 25, 3, seed=1)
    index = knn(points, 6, query=query, method=method)
    for b in range(2):
        assert torch.equal(index[b], brute_force(points[b], query[b], 6))


@methods
def test_others_only(method, tile_elements):
    samples, mask = [rand(n, 3, seed=n) for n in (20, 31, 7)], scattered_mask([20, 31, 7], 33)
    index = knn(scatter(samples, mask, 0.0), 6, mask=mask, include_self=False, method=method)
    for b, sample in enumerate(samples):
        places = mask[b].nonzero()[:, 0]
        assert torch.equal(index[b, mask[b]], places[brute_force(sample, sample, 7)[:, 1:]])
    assert mask.gather(1, index.flatten(1)).all()


@methods
def test_others_among_coincident_points(method):
    index = knn(torch.ones(1, 20, 3), 4, include_self=False, method=method)[0]
    assert not (index == torch.arange(20)[:, None]).any()
    assert all(len(set(row)) == 4 for row in index.tolist())


@methods
@pytest.mark.parametrize("garbage", [0.0, 1e20, math.nan, math.inf])
def test_padded_batch_equals_the_loop(garbage, method, tile_elements):
    """Padding at 0 lies amid the points: it would be a neighbour if it were real."""
    samples, mask = [rand(n, 3, seed=n) for n in (20, 31, 5)], scattered_mask([20, 31, 5], 33)
    points = scatter(samples, mask, garbage)
    index = knn(points, 5, mask=mask, method=method)
    for b, sample in enumerate(samples):
        places = mask[b].nonzero()[:, 0]
        assert torch.equal(index[b, mask[b]], places[brute_force(sample, sample, 5)])
    assert mask.gather(1, index.flatten(1)).all()  # rows of padded queries are valid too
    query = rand(3, 9, 3, seed=8)
    index = knn(points, 5, query=query, mask=mask, method=method)
    for b, sample in enumerate(samples):
        assert torch.equal(index[b], mask[b].nonzero()[:, 0][brute_force(sample, query[b], 5)])


@methods
@pytest.mark.parametrize("layout", ["pairs", "all-equal", "grid"])
def test_ties_give_distinct_points_at_the_right_distances(layout, method, tile_elements):
    grid = torch.cartesian_prod(*[torch.arange(3.0)] * 3)
    points = {"pairs": rand(15, 3).repeat(2, 1), "all-equal": torch.ones(20, 3), "grid": grid}[layout][None]
    index = knn(points, 6, method=method)[0]
    assert all(len(set(row)) == 6 for row in index.tolist())
    distances = torch.cdist(points[0], points[0], compute_mode="donot_use_mm_for_euclid_dist")
    assert torch.equal(distances.gather(1, index), distances.sort(1).values[:, :6])


@methods
def test_close_points_far_from_the_origin_are_told_apart(method):
    """|a|^2 - 2ab + |b|^2 in float32 would see distances of zero here."""
    points = rand(1, 50, 3, dtype=torch.float32) * 0.05 + 100
    assert torch.equal(knn(points, 4, method=method)[0], brute_force(points[0].double(), points[0].double(), 4))


@methods
def test_a_nan_point_is_nobodys_neighbour(method):
    points = rand(1, 10, 3)
    points[0, 3] = math.nan
    index = knn(points, 9, method=method)[0]
    others = torch.arange(10) != 3
    assert not (index[others] == 3).any()


@methods
def test_no_gradient_and_leaves_accepted(method):
    points, query = rand(1, 10, 3).requires_grad_(), rand(1, 4, 3, seed=1).requires_grad_()
    assert not knn(points, 3, query=query, method=method).requires_grad


@pytest.mark.parametrize(
    ("points", "k", "options", "message"),
    [
        ((5, 3), 2, {}, r"points must have shape \(B, N, C\), got \(5, 3\)"),
        ((1, 5, 3), 0, {}, "k=0 neighbours"),
        ((1, 5, 3), 6, {}, "k=6 neighbours were asked for, but the smallest mesh of the batch has 5 vertices"),
        ((2, 5, 3), 4, {"mask": torch.tensor([[True] * 5, [True] * 3 + [False] * 2])}, "has 3 vertices"),
        ((1, 5, 3), 1, {"mask": torch.zeros(1, 5, dtype=torch.bool)}, "has 0 vertices"),
        ((1, 5, 3), 2, {"query": torch.ones(4, 3)}, r"query must have shape \(B, Q, C\)"),
        ((1, 5, 3), 2, {"query": torch.ones(2, 4, 3)}, "like points"),
        ((1, 5, 3), 2, {"query": torch.ones(1, 4, 2)}, r"got \(1, 4, 2\)"),
        ((1, 5, 3), 2, {"mask": torch.ones(1, 4, dtype=torch.bool)}, "mask"),
        ((2, 5, 3), 2, {"mask": torch.ones(1, 5, dtype=torch.bool)}, "mask"),
        ((1, 5, 3), 5, {"include_self": False}, "k=5 .* has 5 vertices, itself included"),
        ((1, 5, 3), 2, {"include_self": False, "query": torch.ones(1, 4, 3)}, "leave query out"),
        ((1, 5, 3), 2, {"method": "ball"}, "method must be .* got 'ball'"),
    ],
)
def test_knn_errors(points, k, options, message):
    with pytest.raises(ValueError, match=message):
        knn(torch.ones(points), k, **options)


@pytest.mark.parametrize("method", ["auto", "tree", "tiles"])
def test_no_samples(method):
    points, mask = torch.zeros(0, 5, 3), torch.ones(0, 5, dtype=torch.bool)
    assert knn(points, 2, method=method).shape == knn(points, 2, mask=mask, method=method).shape == (0, 5, 2)
    assert knn(points, 2, query=torch.zeros(0, 7, 3), method=method).shape == (0, 7, 2)
    with pytest.raises(ValueError, match="k=6"):
        knn(points, 6, mask=mask, method=method)


# Gathering


@pytest.mark.parametrize("shape", [(), (4,), (4, 3), (2, 3, 2)])
def test_gather_equals_a_loop(shape):
    x = rand(3, 7, 5)
    index = torch.randint(7, (3, *shape), generator=torch.Generator().manual_seed(0))
    value = gather_vertices(x, index)
    assert value.shape == (3, *shape, 5)
    for b in range(3):
        expected = [x[b, i] for i in index[b].flatten().tolist()]
        assert torch.equal(value[b].reshape(-1, 5), torch.stack(expected))


def test_gather_gradient_adds_up_at_repeated_indices():
    x, index = rand(2, 4, 3).requires_grad_(), torch.tensor([[[0, 0], [3, 0]], [[1, 2], [2, 2]]])
    assert gradcheck(lambda x: gather_vertices(x, index), x)
    (gradient,) = torch.autograd.grad(gather_vertices(x, index).sum(), x)
    assert gradient[..., 0].tolist() == [[3, 0, 0, 1], [0, 1, 3, 0]]


def test_gather_takes_views():
    x, index = rand(2, 5, 4).mT, torch.tensor([[1, 3], [2, 0]])
    assert torch.equal(gather_vertices(x, index), torch.stack([x[0, [1, 3]], x[1, [2, 0]]]))


@pytest.mark.parametrize(("x", "index"), [((4, 3), (4, 2)), ((2, 4, 3), (1, 2))])
def test_gather_errors(x, index):
    with pytest.raises(ValueError, match=r"x must be \(B, N, C\) and index \(B, ...\)"):
        gather_vertices(torch.ones(x), torch.zeros(index, dtype=torch.int64))
