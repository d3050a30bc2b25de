"""Geodesic correspondence error and mesh quality against closed forms, brute force and Dijkstra's bounds."""

import math

import igl
import numpy as np
import pytest
import torch
from conftest import GARBAGE, rand, scatter, scattered_mask
from torch.autograd import gradcheck

from meshkit.batching import pad_faces
from meshkit.data import load_humans
from meshkit.metrics import (
    correspondence_auc,
    correspondence_curve,
    correspondence_error,
    edge_ratio,
    self_intersection_rate,
    volume_change,
)

CUBE = torch.tensor([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)], dtype=torch.float64)
CUBE_FACES = torch.tensor(
    [0, 1, 3, 0, 3, 2, 4, 6, 7, 4, 7, 5, 0, 4, 5, 0, 5, 1, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 5, 7, 1, 7, 3]
).view(12, 3)


def grid(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Flat square of side 1 with (n + 1)² vertices."""
    verts = torch.cartesian_prod(*[torch.linspace(0, 1, n + 1, dtype=torch.float64)] * 2)
    corner = torch.arange(n * (n + 1)).view(n, n + 1)[:, :n].flatten()
    faces = torch.cat(
        [
            torch.stack([corner, corner + n + 1, corner + 1], 1),
            torch.stack([corner + n + 1, corner + n + 2, corner + 1], 1),
        ]
    )
    return torch.cat([verts, torch.zeros(len(verts), 1)], 1), faces


# Correspondence


@pytest.mark.parametrize("normalize", [True, False])
def test_geodesics_of_a_flat_square_are_straight(normalize):
    verts, faces = grid(8)
    verts = 3 * verts
    generator = torch.Generator().manual_seed(0)
    matches, truth = torch.randint(0, len(verts), (2, 1, 60), generator=generator)
    options = {"faces": faces, "normalize": normalize, "point_reduction": "none"}
    straight = (verts[matches] - verts[truth]).norm(dim=2) / (3 if normalize else 1)
    exact = correspondence_error(matches, verts[None], truth, distance="geodesic", **options)
    torch.testing.assert_close(exact, straight)
    torch.testing.assert_close(correspondence_error(matches, verts[None], truth, **options), straight)
    heat = correspondence_error(matches, verts[None], truth, distance="heat", **options)
    assert ((heat - straight).abs().mean() / straight.mean()).item() < 0.1


def test_geodesics_of_a_cube():
    """Opposite corners: over two unfolded sides, sqrt(1 + 2²)."""
    truth, matches = torch.tensor([[0, 0, 0, 0]]), torch.tensor([[0, 4, 6, 7]])
    expected = torch.tensor([[0, 1, math.sqrt(2), math.sqrt(5)]], dtype=torch.float64)
    options = {"faces": CUBE_FACES, "distance": "geodesic"}
    error = correspondence_error(matches, CUBE[None], truth, point_reduction="none", **options)
    torch.testing.assert_close(error, expected)
    normalised = correspondence_error(matches, CUBE[None], truth, normalize=True, **options)
    assert normalised.item() == pytest.approx(expected.mean().item() / math.sqrt(6))


def test_patches_do_not_change_the_exact_distance():
    body = load_humans(1000)
    verts = body(torch.tensor([3]), torch.tensor([40])).double()
    generator = torch.Generator().manual_seed(0)
    truth = torch.arange(0, 1000, 50)[None].repeat(1, 2)
    matches = torch.randint(0, 1000, truth.shape, generator=generator)
    matches[:, 20:] = body.faces[:20, 0]  # some anywhere, some of them perhaps near
    error = correspondence_error(matches, verts, truth, faces=body.faces, distance="geodesic", point_reduction="none")
    v, f, nothing = verts[0].numpy(), body.faces.numpy(), np.empty(0, dtype=np.int64)
    for n in range(0, truth.shape[1], 3):
        ends = truth[0, n : n + 1].numpy(), matches[0, n : n + 1].numpy()
        assert error[0, n].item() == pytest.approx(igl.exact_geodesic(v, f, ends[0], nothing, ends[1], nothing)[0])
    assert (error >= (verts[0, matches] - verts[0, truth]).norm(dim=2) - 1e-9).all()
    heat = correspondence_error(matches, verts, truth, faces=body.faces, distance="heat", point_reduction="none")
    assert ((heat - error).abs().mean() / error.mean()).item() < 0.05


@pytest.mark.parametrize("distance", ["geodesic", "heat"])
def test_geodesics_between_parts_and_to_loose_vertices(distance):
    verts = torch.cat([CUBE, CUBE + 5, CUBE[:1] - 1])
    faces = torch.cat([CUBE_FACES, CUBE_FACES + 8, torch.tensor([[0, 0, 1], [-1, -1, -1]])])
    truth, matches = torch.tensor([[0, 1, 16, 16, 9]]), torch.tensor([[0, 9, 16, 0, 8]])
    error = correspondence_error(matches, verts[None], truth, faces=faces, distance=distance, point_reduction="none")
    assert error[0, [0, 2]].tolist() == [0, 0] and error[0, [1, 3]].isinf().all()
    assert error[0, 4].item() == pytest.approx(1, rel=1e-9 if distance == "geodesic" else 0.5)
    same = correspondence_error(truth, verts[None], truth, faces=faces, distance=distance)
    assert same.item() == 0


@pytest.mark.parametrize("distance", ["geodesic", "heat"])
@pytest.mark.parametrize("garbage", [0.0, 1e20])
def test_geodesics_of_ragged_batches(distance, garbage):
    verts, faces = grid(4)
    both = torch.full((2, 25, 3), garbage, dtype=torch.float64)
    both[0], both[1, :8] = verts, CUBE
    truth, matches = torch.tensor([[0, 1, 2, 3], [0, 1, -1, -1]]), torch.tensor([[7, 20, 4, 3], [7, 7, -1, -1]])
    mask = truth >= 0
    options = {"distance": distance, "normalize": True}
    error = correspondence_error(matches, both, truth, faces=pad_faces([faces, CUBE_FACES]), mask=mask, **options)
    first = correspondence_error(matches[:1], verts[None], truth[:1], faces=faces, **options)
    second = correspondence_error(matches[1:, :2], CUBE[None], truth[1:, :2], faces=CUBE_FACES, **options)
    torch.testing.assert_close(error, torch.cat([first, second]))
    per_point = correspondence_error(
        matches, both, truth, faces=pad_faces([faces, CUBE_FACES]), mask=mask, point_reduction="none", **options
    )
    assert (per_point[~mask] == 0).all()


def test_correspondence_error_of_broken_vertices():
    verts = torch.stack([CUBE, CUBE])
    verts[1, 7] = float("nan")
    truth, matches = torch.zeros(2, 1, dtype=torch.int64), torch.ones(2, 1, dtype=torch.int64)
    for distance in ("geodesic", "heat"):
        error = correspondence_error(matches, verts, truth, faces=CUBE_FACES, distance=distance)
        assert error.isnan().tolist() == [False, True]


def test_curve_and_area_by_hand():
    errors = torch.tensor([[0.0, 0.1, 0.2, 0.9], [0.3, 0.0, 5.0, 5.0]], dtype=torch.float64)
    mask = torch.tensor([[True] * 4, [True, True, False, False]])
    curve = correspondence_curve(errors, torch.tensor([0.0, 0.1, 0.25, 1.0], dtype=torch.float64), mask=mask)
    assert curve.tolist() == [[0.25, 0.5, 0.75, 1], [0.5, 0.5, 0.5, 1]]
    area = correspondence_auc(errors, max_error=0.4, mask=mask)
    assert area.tolist() == pytest.approx([(1 + 0.75 + 0.5) / 4, (0.25 + 1) / 2])


def test_area_is_the_integral_of_the_curve():
    errors = rand(3, 50).abs()
    errors[0, 0] = float("nan")
    thresholds = torch.linspace(0, 0.7, 20001, dtype=torch.float64)
    curve = correspondence_curve(errors, thresholds)
    area = correspondence_auc(errors[1:], max_error=0.7)
    torch.testing.assert_close(torch.trapezoid(curve, thresholds)[1:] / 0.7, area, atol=1e-4, rtol=0)
    assert curve[0, -1] <= 49 / 50


# Quality


@pytest.mark.parametrize("shared", [True, False])
def test_edge_ratio_equals_loops(shared):
    verts, reference = rand(2, 8, 3), rand(2, 8, 3, seed=1)
    lists = [CUBE_FACES, CUBE_FACES if shared else CUBE_FACES[:5]]
    mask = torch.ones(2, 8, dtype=torch.bool)
    mask[1, 3] = False
    value = edge_ratio(verts, reference, CUBE_FACES if shared else pad_faces(lists), mask=mask)
    for b, faces in enumerate(lists):
        edges = {tuple(sorted((f[k], f[k - 1]))) for f in faces.tolist() for k in range(3)}
        edges = [e for e in edges if mask[b, list(e)].all()]
        ratios = [
            math.dist(verts[b, i].tolist(), verts[b, j].tolist())
            / math.dist(reference[b, i].tolist(), reference[b, j].tolist())
            for i, j in edges
        ]
        assert value[b].item() == pytest.approx(sum(abs(r - 1) for r in ratios) / len(ratios))


def test_edge_ratio_of_degenerate_edges():
    reference = torch.tensor([[[0.0, 0, 0], [0, 0, 0], [1, 0, 0]]])
    pred = torch.tensor([[[0.0, 0, 0], [7, 0, 0], [0, 0, 0]]])  # edges 7 of 0 (left out), 7 of 1, 0 of 1
    pred.requires_grad_()
    value = edge_ratio(pred, reference, torch.tensor([[0, 1, 2]]))
    assert value.item() == pytest.approx((6 + 1) / 2)
    value.sum().backward()
    assert pred.grad.isfinite().all()
    assert edge_ratio(pred, reference, torch.tensor([[0, 1, 2]]), min_length=2).isnan().all()


def test_volume_change_by_hand_and_by_igl():
    cube = CUBE[None]
    stretched = cube * torch.tensor([1.0, 2, 3]) + 100
    assert volume_change(stretched, cube, CUBE_FACES).item() == pytest.approx(5)
    assert volume_change(cube, stretched, CUBE_FACES).item() == pytest.approx(-5 / 6)
    assert volume_change(cube, stretched, CUBE_FACES.flip(1)).item() == pytest.approx(5 / 6)  # inside out: -1 of -6
    flat = cube * torch.tensor([1.0, 1, 0])
    assert volume_change(cube, flat, CUBE_FACES).isinf().all()
    body = load_humans(1000)
    verts = body(torch.tensor([3, 7]), torch.tensor([40, 60])).double()
    volumes = []
    for v in verts.numpy():
        tets = np.concatenate([body.faces.numpy(), np.full((len(body.faces), 1), 1000)], 1)
        volumes.append(-igl.volume(np.concatenate([v, v.mean(0, keepdims=True)]), tets).sum())
    change = volume_change(verts[:1], verts[1:], body.faces).item()
    assert change == pytest.approx((abs(volumes[0]) - abs(volumes[1])) / abs(volumes[1]), rel=1e-6)


CROSSING = torch.tensor(
    [[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, -1], [0.5, 0.5, 1], [1, 0.5, 1], [9, 9, 9], [9, 8, 9], [8, 9, 9]]
)
CROSSING_FACES = torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 8]])


def test_self_intersections_by_hand():
    assert self_intersection_rate(CROSSING[None], CROSSING_FACES).item() == pytest.approx(2 / 3)
    assert self_intersection_rate(CUBE[None], CUBE_FACES).item() == 0
    inside = torch.stack([CUBE, CUBE])
    inside[1, 0] = torch.tensor([0.5, 0.5, 1.5])  # a corner pushed out through the top
    rates = self_intersection_rate(inside, CUBE_FACES)
    assert rates[0].item() == 0 and rates[1].item() > 0
    assert rates.dtype == torch.float64 and self_intersection_rate(inside.half(), CUBE_FACES).dtype == torch.float32


def test_self_intersections_equal_all_pairs():
    """Every pair of faces without a common vertex, by libigl's own test of two triangles."""
    verts, faces = rand(30, 3).numpy(), np.arange(30).reshape(10, 3)
    hit = np.zeros(10, dtype=bool)
    for i in range(10):
        for j in range(i):
            corners = [np.ascontiguousarray(verts[v]) for v in (*faces[i], *faces[j])]
            if igl.predicates.triangle_triangle_intersect(*corners)[0]:
                hit[[i, j]] = True
    rate = self_intersection_rate(torch.from_numpy(verts)[None], torch.from_numpy(faces))
    assert 0 < rate.item() == pytest.approx(hit.mean())


def test_self_intersections_of_nothing_and_of_nan():
    nothing = torch.full((1, 3), -1)
    assert self_intersection_rate(CROSSING[None], nothing).item() == 0
    broken = CROSSING[None].clone()
    broken[0, 0] = float("nan")
    assert self_intersection_rate(broken, CROSSING_FACES).isnan().all()
    assert self_intersection_rate(broken, CROSSING_FACES[1:]).item() == 0


@pytest.mark.parametrize("function", [edge_ratio, volume_change])
def test_gradient(function):
    leaves = [rand(2, 8, 3).requires_grad_(), (CUBE + 0.1 * rand(2, 8, 3, seed=1)).requires_grad_()]
    assert gradcheck(lambda p, t: function(p, t, CUBE_FACES), leaves)


@pytest.mark.parametrize("garbage", GARBAGE)
def test_padding_changes_nothing(garbage):
    clouds = [[rand(8, 3), rand(5, 3, seed=1)], [rand(8, 3, seed=2), rand(5, 3, seed=3)]]
    lists = [CUBE_FACES, torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2], [0, 1, 4], [2, 3, 4]])]
    mask = scattered_mask([8, 5], 12)
    moved = pad_faces([mask[b].nonzero()[:, 0][faces] for b, faces in enumerate(lists)])
    pred, target = (scatter(cloud, mask, garbage) for cloud in clouds)
    for function in (edge_ratio, volume_change):
        leaf = pred.clone().requires_grad_()
        value = function(leaf, target, moved, mask=mask)
        alone = [function(p[None], t[None], f) for p, t, f in zip(*clouds, lists, strict=True)]
        torch.testing.assert_close(value, torch.cat(alone))
        value.sum().backward()
        assert (leaf.grad[~mask] == 0).all() and leaf.grad.isfinite().all()
    alone = [self_intersection_rate(p[None], f) for p, f in zip(clouds[0], lists, strict=True)]
    torch.testing.assert_close(self_intersection_rate(pred, moved, mask=mask), torch.cat(alone))


def test_faces_of_masked_vertices_are_left_out():
    verts = torch.stack([CUBE, CUBE])
    mask = torch.ones(2, 8, dtype=torch.bool)
    mask[1, 7] = False
    kept = CUBE_FACES[(CUBE_FACES != 7).all(1)]
    for function in (edge_ratio, volume_change):
        value = function(2 * verts, verts * torch.tensor([1.0, 2, 1]), CUBE_FACES, mask=mask)
        alone = function(2 * CUBE[None, :7], CUBE[None, :7] * torch.tensor([1.0, 2, 1]), kept)
        torch.testing.assert_close(value[1:], alone)
    crossing_mask = torch.arange(9)[None] != 4
    assert self_intersection_rate(CROSSING[None], CROSSING_FACES, mask=crossing_mask).item() == 0


X, NONE = torch.zeros(2, 4, 3), torch.tensor([[True] * 4, [False] * 4])
F = torch.tensor([[0, 1, 2]])
I = torch.zeros(2, 5, dtype=torch.int64)  # noqa: E741
E = torch.zeros(2, 5)
BOOK = torch.tensor([[0, 1, 2], [0, 1, 3], [1, 0, 2]])


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: correspondence_error(I, X, I, distance="geodesic"), "need the faces of the target: pass faces="),
        (lambda: correspondence_error(I, X, I, normalize=True), "need the faces of the target: pass faces="),
        (lambda: correspondence_error(I, X, I, distance="graph"), "distance must be one of .*'graph'"),
        (lambda: correspondence_error(I, X, I, point_reduction="sum"), "point_reduction must be one of .*'sum'"),
        (lambda: correspondence_error(I, X, I, faces=F + 9), "face indices must lie in"),
        (lambda: correspondence_error(I, X, I, faces=F[None]), "batch size of the vertices"),
        (
            lambda: correspondence_error(I, X, I, faces=BOOK, distance="geodesic"),
            "sample 0 has 1 edges of more than two",
        ),
        (lambda: correspondence_curve(E[0], E[0]), r"errors must be \(B, N\)"),
        (lambda: correspondence_curve(E.long(), E[0]), "floating point"),
        (lambda: correspondence_curve(E, E), r"thresholds must be \(K,\)"),
        (lambda: correspondence_curve(E, E[0].long()), "thresholds must be"),
        (lambda: correspondence_auc(E[:0]), "not empty"),
        (lambda: correspondence_auc(E, max_error=0), "max_error must be positive, got 0"),
        (lambda: correspondence_auc(X[..., 0], mask=NONE), r"no real vertex in samples \[1\]"),
        (lambda: edge_ratio(X, X[:1], F), "same shape"),
        (lambda: edge_ratio(X, X, F + 9), "face indices must lie in"),
        (lambda: edge_ratio(X, X, F[None]), "batch size of the vertices"),
        (lambda: edge_ratio(X, X, F, min_length=-1), "min_length must be a length >= 0, got -1"),
        (lambda: edge_ratio(X, X, F, mask=NONE), "no real vertex"),
        (lambda: volume_change(X, X[0], F), "target must"),
        (lambda: volume_change(X, X, F.float()), "faces must be an integer tensor"),
        (lambda: volume_change(X, X, F, mask=NONE), "no real vertex"),
        (lambda: self_intersection_rate(X[0], F), "verts must have shape"),
        (lambda: self_intersection_rate(X, F[None]), "batch size of the vertices"),
        (lambda: self_intersection_rate(X, F, mask=NONE), "no real vertex"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()
