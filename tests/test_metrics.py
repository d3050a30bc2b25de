"""Metrics against SciPy, brute force and cases worked out by hand."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.autograd import gradcheck

from meshkit import neighbors
from meshkit.batching import center, pad
from meshkit.metrics import chamfer_distance, correspondence_error, pmd

GARBAGE = [0.0, 1e6, float("nan"), float("inf")]  # 0 is close to the points: a neighbour, if it were real


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture
def ragged() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, list, list]:
    """Two samples of 20 and 50 points against 40 and 30: both batches, both masks, the separate clouds."""
    preds, targets = [rand(20, 3), rand(50, 3, seed=1)], [rand(40, 3, seed=2), rand(30, 3, seed=3)]
    return *pad(preds), *pad(targets), preds, targets


def poison(x: torch.Tensor, mask: torch.Tensor, value: float) -> torch.Tensor:
    return torch.where(mask[..., None], x, value)


# PMD


@pytest.mark.parametrize("garbage", GARBAGE)
@pytest.mark.parametrize("recenter", [True, False])
def test_pmd_equals_numpy(ragged, garbage, recenter):
    pred, mask, _, _, preds, _ = ragged
    target = rand(2, 50, 3, seed=4)
    value = pmd(poison(pred, mask, garbage), poison(target, mask, garbage), mask=mask, recenter=recenter)
    for b, cloud in enumerate(preds):
        p, t = cloud.numpy(), target[b, : len(cloud)].numpy()
        if recenter:
            p = p - (p.min(0) + p.max(0)) / 2
        np.testing.assert_allclose(value[b], np.mean((p - t) ** 2), rtol=1e-12)


def test_pmd_moves_the_prediction_but_not_the_target():
    target = center(rand(1, 10, 3))
    assert pmd(target + 7, target).item() < 1e-28
    assert pmd(target, target + 7).item() == pytest.approx(49)
    assert pmd(target + 7, target, recenter=False).item() == pytest.approx(49)


def test_pmd_by_hand():
    target = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]], [[0.0, -1, 0], [0, 1, 0]]])
    pred = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]], [[0.0, -1, 3], [0, 1, 1]]])
    # Second sample, centred: z = 1 and -1, so 2 of 6 coordinates are off by 1.
    assert pmd(pred, target).tolist() == pytest.approx([0, 1 / 3])


@pytest.mark.parametrize("recenter", [True, False])
def test_pmd_gradient(ragged, recenter):
    pred, mask, _, _, _, _ = ragged
    leaves = [pred[:, ::5].clone().requires_grad_(), rand(2, 10, 3, seed=4).requires_grad_()]
    assert gradcheck(lambda p, t: pmd(p, t, mask=mask[:, ::5], recenter=recenter), leaves)
    leaf = poison(pred, mask, float("nan")).requires_grad_()
    (grad,) = torch.autograd.grad(pmd(leaf, rand(2, 50, 3), mask=mask, recenter=recenter).sum(), leaf)
    assert grad.isfinite().all() and (grad[~mask] == 0).all()


def test_pmd_is_computed_in_float32_at_least():
    pred = (torch.arange(4.0).view(1, 4, 1).expand(-1, -1, 3) * 300).half()
    value = pmd(pred, center(pred.float()))
    assert value.dtype == torch.float32 and value.item() == 0


# Chamfer


@pytest.mark.parametrize("direction", ["both", "forward", "backward"])
@pytest.mark.parametrize("squared", [True, False])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_chamfer_equals_kd_tree(ragged, direction, squared, garbage):
    pred, pred_mask, target, target_mask, preds, targets = ragged
    masks = {"pred_mask": pred_mask, "target_mask": target_mask}
    pred, target = poison(pred, pred_mask, garbage), poison(target, target_mask, garbage)
    mean = chamfer_distance(pred, target, squared=squared, direction=direction, **masks)
    total = chamfer_distance(pred, target, squared=squared, direction=direction, point_reduction="sum", **masks)
    for b, (p, t) in enumerate(zip(preds, targets, strict=True)):
        sides = {"forward": cKDTree(t).query(p)[0], "backward": cKDTree(p).query(t)[0]}
        used = [d**2 if squared else d for name, d in sides.items() if direction in ("both", name)]
        np.testing.assert_allclose(mean[b], sum(d.mean() for d in used), rtol=1e-6)
        np.testing.assert_allclose(total[b], sum(d.sum() for d in used), rtol=1e-6)


def test_chamfer_equals_brute_force_in_tiles(monkeypatch):
    pred, target = rand(2, 300, 3), rand(2, 200, 3, seed=1)
    distances = torch.cdist(pred, target, compute_mode="donot_use_mm_for_euclid_dist").square()
    expected = distances.amin(2).mean(1) + distances.amin(1).mean(1)
    torch.testing.assert_close(chamfer_distance(pred, target), expected)
    monkeypatch.setattr(neighbors, "_knn_tree", neighbors._knn_tiles)
    monkeypatch.setattr(neighbors, "_TILE_ELEMENTS", 7 * 2 * 200)
    torch.testing.assert_close(chamfer_distance(pred, target), expected)


def test_chamfer_by_hand():
    p = torch.tensor([[[0.0, 0, 0]]])
    q = torch.tensor([[[3.0, 4, 0], [0, 0, 12]]])
    assert chamfer_distance(p, q).item() == 25 + (25 + 144) / 2
    assert chamfer_distance(p, q, squared=False).item() == 5 + (5 + 12) / 2
    assert chamfer_distance(p, q, direction="forward").item() == 25
    assert chamfer_distance(p, q, direction="backward", point_reduction="sum").item() == 25 + 144


@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_distances_of_the_points(ragged, squared):
    pred, pred_mask, target, target_mask, preds, targets = ragged
    masks = {"pred_mask": pred_mask, "target_mask": target_mask}
    details = chamfer_distance(pred, target, squared=squared, return_distances=True, **masks)
    assert torch.equal(details.value, chamfer_distance(pred, target, squared=squared, **masks))
    for b, (p, t) in enumerate(zip(preds, targets, strict=True)):
        there, back = cKDTree(t).query(p)[0], cKDTree(p).query(t)[0]
        np.testing.assert_allclose(details.forward[b, : len(p)], there**2 if squared else there, rtol=1e-9)
        np.testing.assert_allclose(details.backward[b, : len(t)], back**2 if squared else back, rtol=1e-9)
    assert (details.forward[~pred_mask] == 0).all() and (details.backward[~target_mask] == 0).all()
    one_sided = chamfer_distance(pred, target, squared=squared, direction="backward", return_distances=True, **masks)
    assert one_sided.forward is None and torch.equal(one_sided.backward, details.backward)


def test_chamfer_is_symmetric_and_ignores_order():
    p, q = rand(1, 30, 3), rand(1, 20, 3, seed=1)
    value = chamfer_distance(p, q)
    torch.testing.assert_close(chamfer_distance(q, p), value)
    torch.testing.assert_close(chamfer_distance(p.flip(1), q), value)
    assert chamfer_distance(p, p.flip(1)).item() == 0
    assert torch.equal(chamfer_distance(p, q, direction="forward"), chamfer_distance(q, p, direction="backward"))


@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_gradient(squared):
    leaves = [rand(2, 6, 3).requires_grad_(), rand(2, 5, 3, seed=1).requires_grad_()]
    masks = {"pred_mask": torch.tensor([[True] * 6, [True] * 4 + [False] * 2]), "target_mask": None}
    assert gradcheck(lambda p, q: chamfer_distance(p, q, squared=squared, **masks), leaves)


@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_gradient_is_finite_at_coincident_points_and_zero_in_padding(ragged, squared):
    pred, pred_mask, _, _, _, _ = ragged
    leaf = poison(pred, pred_mask, float("nan")).requires_grad_()
    other = pred.clone().requires_grad_()
    value = chamfer_distance(leaf, other, pred_mask=pred_mask, target_mask=pred_mask, squared=squared)
    assert (value == 0).all()
    for grad in torch.autograd.grad(value.sum(), [leaf, other]):
        assert (grad == 0).all()


def test_chamfer_of_nan_points():
    p, q = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    p[0, 0] = float("nan")
    assert chamfer_distance(p, q).isnan().tolist() == [True, False]
    without = chamfer_distance(p[:1, 1:], q[:1], direction="backward")
    torch.testing.assert_close(chamfer_distance(p[:1], q[:1], direction="backward"), without)


def test_chamfer_mixes_and_lifts_dtypes():
    p, q = rand(1, 5, 3), rand(1, 4, 3, seed=1)
    assert chamfer_distance(p.float(), q).dtype == torch.float64
    assert chamfer_distance(p.bfloat16(), q.bfloat16()).dtype == torch.float32


# Correspondence error


def test_correspondence_error_equals_loops():
    generator = torch.Generator().manual_seed(0)
    matches, truth = torch.randint(0, 7, (2, 2, 9), generator=generator)
    verts = rand(2, 7, 3)
    mask = torch.rand(2, 9, generator=generator) < 0.6
    expected = []
    for b in range(2):
        distances = [
            math.dist(verts[b, matches[b, n]].tolist(), verts[b, truth[b, n]].tolist()) for n in range(9) if mask[b, n]
        ]
        expected.append(sum(distances) / len(distances))
    ignored = torch.where(mask, matches, -1), torch.where(mask, truth, 10**6)
    assert correspondence_error(ignored[0], verts, ignored[1], mask=mask).tolist() == pytest.approx(expected)
    assert correspondence_error(matches.int(), verts, truth.int()).shape == (2,)


def test_correspondence_error_of_true_matches_is_zero():
    truth = torch.tensor([[2, 0, 1]])
    assert correspondence_error(truth, rand(1, 3, 3), truth).item() == 0
    half = torch.zeros(1, 2, 3, dtype=torch.float16)
    assert correspondence_error(truth.clamp_max(1), half, truth.clamp_max(1)).dtype == torch.float32


X, NONE = torch.zeros(2, 4, 3), torch.tensor([[True] * 4, [False] * 4])
I = torch.zeros(2, 5, dtype=torch.int64)  # noqa: E741


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: pmd(X[0], X), "pred must"),
        (lambda: pmd(X, X[0]), "target must"),
        (lambda: pmd(X, X[:1]), "same shape"),
        (lambda: pmd(X, X, mask=NONE), r"no real vertex in samples \[1\]"),
        (lambda: chamfer_distance(X[0], X), "pred must"),
        (lambda: chamfer_distance(X, X[0]), "target must"),
        (lambda: chamfer_distance(X, X[:, :0]), "at least one sample and one vertex"),
        (lambda: chamfer_distance(X, X[:1]), "same batch size"),
        (lambda: chamfer_distance(X, X, pred_mask=NONE), "pred_mask marks no real vertex"),
        (lambda: chamfer_distance(X, X, target_mask=NONE), "target_mask marks no real vertex"),
        (lambda: chamfer_distance(X, X, direction="up"), "direction must be one of .*'up'"),
        (lambda: chamfer_distance(X, X, point_reduction="max"), "point_reduction must be one of .*'max'"),
        (lambda: correspondence_error(I, X[0], I), "target_verts must"),
        (lambda: correspondence_error(I, X, I[:, :4]), "same shape"),
        (lambda: correspondence_error(I[:1], X, I[:1]), "B = 2"),
        (lambda: correspondence_error(I[:, :0], X, I[:, :0]), "N > 0"),
        (lambda: correspondence_error(I.float(), X, I), "matches must hold integer indices, got torch.float32"),
        (lambda: correspondence_error(I, X, I.bool()), "truth must hold integer"),
        (lambda: correspondence_error(I + 4, X, I), r"matches must lie in \[0, 4\), got a range of \[4, 4\]"),
        (lambda: correspondence_error(I, X, I - 1), "truth must lie"),
        (lambda: correspondence_error(I, X, I, mask=torch.zeros(2, 5, dtype=torch.bool)), "no real vertex"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()
