"""Earth mover's distance against permutations tried one by one, SciPy, POT and closed forms."""

import itertools
import sys

import numpy as np
import pytest
import torch
from conftest import GARBAGE, rand, scatter, scattered_mask
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from torch.autograd import gradcheck

from meshkit.metrics import _exact_transport, earth_movers_bounds, earth_movers_distance
from meshkit.metrics._transport_bounds import DistanceTiles


def by_assignment(p: torch.Tensor, q: torch.Tensor, squared: bool) -> float:
    cost = cdist(p.double().numpy(), q.double().numpy(), "sqeuclidean" if squared else "euclidean")
    return float(cost[linear_sum_assignment(cost)].mean())


@pytest.mark.parametrize("squared", [True, False])
def test_equals_all_permutations(squared):
    p, q = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    values = earth_movers_distance(p, q, squared=squared)
    for b in range(2):
        distances = torch.cdist(p[b], q[b]) ** (2 if squared else 1)
        tried = [distances[range(5), list(order)].mean() for order in itertools.permutations(range(5))]
        torch.testing.assert_close(values[b], min(tried))


@pytest.mark.parametrize("squared", [True, False])
def test_equals_scipy_where_potentials_come_first(squared):
    """More points than ``_SMALL``: the assignment is solved on distances less potentials."""
    p = rand(1, 450, 3)
    q = rand(1, 450, 3, seed=1) * torch.tensor([1.0, 0.1, 3.0]) + 2
    value = earth_movers_distance(p, q, squared=squared)
    assert value.item() == pytest.approx(by_assignment(p[0], q[0], squared), rel=1e-12)
    single = earth_movers_distance(p.float(), q.float(), squared=squared)
    assert single.dtype == torch.float32 and single.item() == pytest.approx(value.item(), rel=1e-5)


@pytest.mark.parametrize("sizes", [(7, 4), (300, 260)])
@pytest.mark.parametrize("squared", [True, False])
def test_unequal_sizes_equal_pot(sizes, squared):
    ot = pytest.importorskip("ot")
    p, q = rand(1, sizes[0], 3), rand(1, sizes[1], 3, seed=1)
    cost = torch.cdist(p[0], q[0]).numpy() ** (2 if squared else 1)
    expected = ot.emd2(np.full(sizes[0], 1 / sizes[0]), np.full(sizes[1], 1 / sizes[1]), cost)
    assert earth_movers_distance(p, q, squared=squared).item() == pytest.approx(expected, rel=1e-9)


def test_unequal_sizes_by_hand():
    pytest.importorskip("ot")
    # One point goes to both of the others, half of its mass each.
    p, q = torch.zeros(1, 1, 3), torch.tensor([[[3.0, 4, 0], [0, 0, 1]]])
    assert earth_movers_distance(p, q).item() == pytest.approx(3)
    assert earth_movers_distance(q, p, squared=True).item() == pytest.approx(13)


@pytest.mark.parametrize("garbage", [*GARBAGE, 0.0])
def test_masks_pick_the_real_points(garbage):
    pytest.importorskip("ot")
    preds, targets = [rand(6, 3), rand(9, 3, seed=1)], [rand(6, 3, seed=2), rand(4, 3, seed=3)]
    pred_mask, target_mask = scattered_mask([6, 9], 9), scattered_mask([6, 4], 8, seed=1)
    masks = {"pred_mask": pred_mask, "target_mask": target_mask}
    pred, target = scatter(preds, pred_mask, garbage), scatter(targets, target_mask, garbage)
    alone = torch.cat([earth_movers_distance(p[None], t[None]) for p, t in zip(preds, targets, strict=True)])
    leaf = pred.clone().requires_grad_()
    value = earth_movers_distance(leaf, target, **masks)
    torch.testing.assert_close(value, alone)
    value.sum().backward()
    assert (leaf.grad[~pred_mask] == 0).all() and leaf.grad[pred_mask].isfinite().all()
    bounds = earth_movers_bounds(pred, target, **masks)
    assert (bounds.lower <= alone + 1e-9).all() and (alone - 1e-9 <= bounds.upper).all()


def test_properties():
    p, q = rand(1, 40, 3), rand(1, 40, 3, seed=1)
    value = earth_movers_distance(p, q)
    torch.testing.assert_close(earth_movers_distance(q, p), value)
    torch.testing.assert_close(earth_movers_distance(p.flip(1), q), value)
    assert earth_movers_distance(p, p.flip(1)).item() == 0
    # A common shift of squared distances adds its square, if the means are equal.
    q = q - q.mean(1, keepdim=True) + p.mean(1, keepdim=True)
    shift = torch.tensor([1.0, 2, 2])
    torch.testing.assert_close(
        earth_movers_distance(p, q + shift, squared=True), earth_movers_distance(p, q, squared=True) + 9
    )


@pytest.mark.parametrize("sizes", [(6, 6), (4, 6)])
@pytest.mark.parametrize("squared", [True, False])
def test_gradient(sizes, squared):
    if sizes[0] != sizes[1]:
        pytest.importorskip("ot")
    leaves = [rand(2, sizes[0], 3).requires_grad_(), rand(2, sizes[1], 3, seed=1).requires_grad_()]
    assert gradcheck(lambda p, q: earth_movers_distance(p, q, squared=squared), leaves)
    p = rand(1, 5, 3).requires_grad_()
    earth_movers_distance(p, p.detach().clone(), squared=squared).sum().backward()
    assert (p.grad == 0).all()


@pytest.mark.parametrize("sizes", [(300, 300), (300, 200)])
@pytest.mark.parametrize("squared", [True, False])
def test_bounds_enclose_the_exact_value(sizes, squared):
    if sizes[0] != sizes[1]:
        pytest.importorskip("ot")
    p, q = rand(1, sizes[0], 3), rand(1, sizes[1], 3, seed=1) + 0.3
    exact = earth_movers_distance(p, q, squared=squared)
    gaps = []
    for n_iters in (1, 100):
        lower, upper = earth_movers_bounds(p, q, squared=squared, n_iters=n_iters, tol=0)
        assert lower <= exact * (1 + 1e-9) and exact * (1 - 1e-9) <= upper
        gaps.append(float((upper - lower) / exact))
    assert gaps[1] < min(gaps[0] / 2, 0.15)
    middle = earth_movers_distance(p, q, squared=squared, method="sinkhorn")
    bounds = earth_movers_bounds(p, q, squared=squared)
    torch.testing.assert_close(middle, (bounds.lower + bounds.upper) / 2)


def test_bounds_at_extremes():
    p = rand(1, 30, 3)
    lower, upper = earth_movers_bounds(p, p)
    assert abs(lower.item()) < 1e-2 and 0 <= upper.item() < 0.1
    point = torch.ones(1, 4, 3)
    assert earth_movers_bounds(point, point).upper.item() == 0
    # From one point to many there is only one plan.
    lower, upper = earth_movers_bounds(p[:, :1], p)
    expected = (p - p[:, :1]).norm(dim=2).mean().item()
    assert lower.item() == pytest.approx(expected) and upper.item() == pytest.approx(expected)


@pytest.mark.parametrize("method", ["exact", "sinkhorn"])
def test_points_that_are_not_finite(method):
    p, q = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    p[0, 0, 0] = float("nan")
    assert earth_movers_distance(p, q, method=method).isnan().tolist() == [True, False]


def test_without_pot(monkeypatch):
    monkeypatch.setitem(sys.modules, "ot", None)
    assert earth_movers_distance(torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)).item() == 0
    with pytest.raises(ImportError, match='needs POT: pip install POT; or use method="sinkhorn"'):
        earth_movers_distance(torch.zeros(1, 3, 3), torch.zeros(1, 2, 3))


def test_pot_that_gives_up(monkeypatch):
    ot = pytest.importorskip("ot")
    monkeypatch.setattr(ot, "emd", lambda *args, **kwargs: (np.ones((3, 2)), {"warning": "numItermax reached"}))
    with pytest.raises(RuntimeError, match="did not solve a transport problem of 3 x 2: numItermax reached"):
        _exact_transport.exact_plan(torch.zeros(3, 3), torch.zeros(2, 3), False)


def test_the_kernel_of_distances():
    """Logits as meshkit.ot wants them, rows and columns exchanged on request, and no silent zero gradient."""
    p, q = rand(70, 3), rand(50, 3, seed=1)
    tiles = DistanceTiles(p, q, True, 0.5)
    expected = -torch.cdist(p, q).square() / 0.5 / np.log(2)
    torch.testing.assert_close(torch.cat([tiles.logits(rows) for rows in tiles.blocks]), expected)
    transposed = tiles.transposed()
    torch.testing.assert_close(torch.cat([transposed.logits(rows) for rows in transposed.blocks]), expected.mT)
    with pytest.raises(NotImplementedError):
        tiles.pullback([])


X, NONE = torch.zeros(2, 4, 3), torch.tensor([[True] * 4, [False] * 4])


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: earth_movers_distance(X[0], X), "pred must"),
        (lambda: earth_movers_distance(X, X[0]), "target must"),
        (lambda: earth_movers_distance(X, X[:1]), "same batch size"),
        (lambda: earth_movers_distance(X, X, pred_mask=NONE), "pred_mask marks no real vertex"),
        (lambda: earth_movers_distance(X, X, target_mask=NONE), "target_mask marks no real vertex"),
        (lambda: earth_movers_distance(X, X, method="auction"), "method must be one of .*'auction'"),
        (lambda: earth_movers_bounds(X, X[:1]), "same batch size"),
        (lambda: earth_movers_bounds(X, X, eps=0.0), "eps must be None, or positive and finite, got 0.0"),
        (lambda: earth_movers_bounds(X, X, n_iters=0), "n_iters must be at least 1, got 0"),
        (lambda: earth_movers_bounds(X, X, tol=-1.0), "tol must be None or at least 0, got -1.0"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()
