"""Rigid moving least squares and Poisson deformation against loops over vertices, and what both must reproduce."""

from typing import Any

import pytest
import torch
from conftest import rand

from meshkit.deform import poisson_deform, rigid_moving_least_squares

BOTH = pytest.mark.parametrize("deform", [rigid_moving_least_squares, poisson_deform])


def rotation(seed: int) -> torch.Tensor:
    q, _ = torch.linalg.qr(rand(3, 3, seed=seed))
    return q * torch.det(q)


def rotation_of(covariance: torch.Tensor) -> torch.Tensor:
    u, _, vh = torch.linalg.svd(covariance)
    return u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vh))], dtype=u.dtype)) @ vh


def weights_of(v: torch.Tensor, radius: float, features: torch.Tensor | None) -> torch.Tensor:
    n = len(v)
    q = torch.zeros(n, n, dtype=v.dtype)
    for i in range(n):
        for j in range(n):
            q[i, j] = max(0.0, 1 - float((v[i] - v[j]).square().sum()) / radius**2) ** 2
            if features is not None:
                q[i, j] *= float(torch.exp(-(features[i] - features[j]).square().mean()))
    return q


def motions_of(v: torch.Tensor, t: torch.Tensor, q: torch.Tensor) -> list[tuple[torch.Tensor, ...]]:
    """Rotation and means of each neighbourhood, rotations by SVD."""
    n, motions = len(v), []
    whole = rotation_of(sum(torch.outer(t[j] - t.mean(0), v[j] - v.mean(0)) for j in range(n)))
    for i in range(n):
        weight = q[i] / q[i].sum()
        mean_v, mean_t = weight @ v, weight @ t
        covariance = sum(weight[j] * torch.outer(t[j] - mean_t, v[j] - mean_v) for j in range(n))
        covariance = covariance + 0.02 * torch.linalg.norm(covariance) * whole
        motions.append((rotation_of(covariance), mean_v, mean_t))
    return motions


def literal_mls(v: torch.Tensor, t: torch.Tensor, radius: float, features: torch.Tensor | None) -> torch.Tensor:
    q = weights_of(v, radius, features)
    out = torch.zeros_like(v)
    for j in range(len(v)):
        for i, (turn, mean_v, mean_t) in enumerate(motions_of(v, t, q)):
            out[j] += q[i, j] * (mean_t + turn @ (v[j] - mean_v))
        out[j] /= q[:, j].sum()
    return out


def literal_poisson(v: torch.Tensor, t: torch.Tensor, radius: float, features: torch.Tensor | None) -> torch.Tensor:
    """The least-squares problem, one row for each pair of vertices and each target."""
    n, q, weight = len(v), weights_of(v, radius, features), 0.2
    turns = [motion[0] for motion in motions_of(v, t, q)]
    rows, values = [], []
    unit = torch.eye(n, dtype=v.dtype)
    for i in range(n):
        for j in range(i):
            rows.append(q[i, j].sqrt() * (unit[i] - unit[j]))
            values.append(q[i, j].sqrt() * (turns[i] + turns[j]) @ (v[i] - v[j]) / 2)
    mean_degree = (q.sum() - q.diagonal().sum()) / n
    for i in range(n):
        rows.append((weight * mean_degree).sqrt() * unit[i])
        values.append((weight * mean_degree).sqrt() * t[i])
    return torch.linalg.lstsq(torch.stack(rows), torch.stack(values)).solution


@pytest.mark.parametrize("with_features", [False, True])
@pytest.mark.parametrize(
    ("deform", "literally"), [(rigid_moving_least_squares, literal_mls), (poisson_deform, literal_poisson)]
)
def test_equals_the_loop(deform: Any, literally: Any, with_features: bool) -> None:
    v, t = rand(2, 14, 3, seed=1), rand(2, 14, 3, seed=2)
    features = rand(2, 14, 4, seed=3) if with_features else None
    moved = deform(v, t, radius=2.5, features=features)
    for b in range(2):
        expected = literally(v[b], t[b], 2.5, None if features is None else features[b])
        torch.testing.assert_close(moved[b], expected, atol=1e-9, rtol=1e-9)


@BOTH
@pytest.mark.parametrize("radius", [0.5, 1.5, 50.0])
def test_a_rigid_motion_is_reproduced(deform: Any, radius: float) -> None:
    v, turn = rand(1, 40, 3), rotation(5)
    target = v @ turn.mT + torch.tensor([1.0, -2.0, 3.0], dtype=v.dtype)
    torch.testing.assert_close(deform(v, target, radius=radius), target, atol=1e-8, rtol=0)


def test_a_target_shrunk_to_the_axis_regains_its_thickness() -> None:
    """A tube whose rings were averaged away: the target says where the axis runs, the rest shape how thick it is."""
    angle = torch.linspace(0, 2 * torch.pi, 17, dtype=torch.float64)[:-1]
    ring = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1) * 0.1
    rest = torch.cat([ring + torch.tensor([0.0, 0.0, z]) for z in torch.linspace(0, 2, 41).tolist()])[None]
    axis = rest * torch.tensor([0.0, 0.0, 1.0])
    moved = rigid_moving_least_squares(rest, axis, radius=0.5)
    distance = moved[0, :, :2].norm(dim=1)
    assert axis[0, :, :2].norm(dim=1).max() == 0
    torch.testing.assert_close(distance, torch.full_like(distance, 0.1), atol=2e-3, rtol=0)


@BOTH
def test_far_from_the_origin(deform: Any) -> None:
    v = rand(1, 40, 3).float()
    target = v @ rotation(5).float().mT
    moved = deform(v + 1000, target - 1000, radius=1.5)
    torch.testing.assert_close(moved, target - 1000, atol=2e-3, rtol=0)


@BOTH
def test_features_keep_parts_apart_that_pass_close_to_each_other(deform: Any) -> None:
    left, right = rand(30, 3, seed=1) * 0.1, rand(30, 3, seed=2) * 0.1 + torch.tensor([0.2, 0, 0])
    rest = torch.cat([left, right])[None]
    target = rest.clone()
    target[:, 30:] += torch.tensor([0.0, 1.0, 0.0])  # one part leaves, the other stays
    part = torch.cat([torch.full((30, 1), -4.0), torch.full((30, 1), 4.0)])[None]
    apart = deform(rest, target, radius=1.0, features=part)
    torch.testing.assert_close(apart, target, atol=1e-2, rtol=0)  # the prior turns each part by a trace
    assert (deform(rest, target, radius=1.0) - target).abs().max() > 0.1


@BOTH
def test_padding_changes_nothing_wherever_it_stands(deform: Any) -> None:
    v, t, f = rand(1, 12, 3, seed=1), rand(1, 12, 3, seed=2), rand(1, 12, 2, seed=3)
    mask = torch.tensor([[True] * 5 + [False, True] + [True] * 6 + [False, False]])
    padded = []
    for x in (v, t, f):
        wide = torch.full((1, 15, x.shape[2]), torch.nan, dtype=x.dtype)
        wide[mask] = x[0]
        padded.append(wide)
    target = padded[1].requires_grad_()
    moved = deform(padded[0], target, radius=2.0, mask=mask, features=padded[2])
    torch.testing.assert_close(moved[mask], deform(v, t, radius=2.0, features=f)[0])
    assert (moved[~mask] == 0).all()
    moved.sum().backward()
    assert torch.isfinite(target.grad).all() and (target.grad[~mask] == 0).all()


@BOTH
def test_gradients(deform: Any) -> None:
    v, t = rand(1, 10, 3, seed=1), rand(1, 10, 3, seed=2).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: deform(v, t, radius=2.0), (t,))


@BOTH
def test_vertex_order_is_carried_through(deform: Any) -> None:
    v, t, order = rand(1, 20, 3, seed=1), rand(1, 20, 3, seed=2), torch.randperm(20)
    moved = deform(v, t, radius=1.5)
    torch.testing.assert_close(deform(v[:, order], t[:, order], radius=1.5), moved[:, order])


@BOTH
def test_a_vertex_out_of_reach_goes_to_its_target_and_half_precision_stays_finite(deform: Any) -> None:
    v = torch.tensor([[[0.0, 0, 0], [9, 9, 9]]])
    t = torch.tensor([[[1.0, 2, 3], [4, 5, 6]]])
    torch.testing.assert_close(deform(v, t, radius=0.1), t)
    assert deform(v.bfloat16(), t.bfloat16(), radius=0.1).dtype == torch.bfloat16


@BOTH
def test_another_unit_than_the_radius_stays_finite(deform: Any) -> None:
    """In millimetres rounding takes a vertex out of its own reach."""
    v = 1000 * rand(1, 200, 3, seed=1).float()
    t = v + 1000 * rand(1, 200, 3, seed=2).float()
    moved = deform(v, t, radius=0.25)
    torch.testing.assert_close(moved, t, atol=1.0, rtol=0)


def test_poisson_deformation_keeps_lengths_where_moving_least_squares_takes_those_of_the_target() -> None:
    """An arm bent at a right angle, whose target is half again as long."""
    along = torch.linspace(0, 1, 101, dtype=torch.float64)
    ring = 0.05 * torch.tensor([[1.0, 0], [-0.5, 0.9], [-0.5, -0.9]], dtype=torch.float64)
    rest = torch.cat([along.repeat_interleave(3)[:, None], ring.repeat(101, 1)], 1)[None]
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    elbow = torch.tensor([0.5, 0, 0], dtype=torch.float64)
    bent = torch.where(rest[..., :1] > 0.5, (rest - elbow) @ turn.mT + elbow, rest)

    def length(x: torch.Tensor) -> float:
        middle = x.view(101, 3, 3).mean(1)
        return float((middle[45] - middle[0]).norm() + (middle[100] - middle[55]).norm())

    moving = length(rigid_moving_least_squares(rest, 1.5 * bent, radius=0.15))
    poisson = length(poisson_deform(rest, 1.5 * bent, radius=0.15, weight=1e-3))
    assert moving > 1.4 * length(rest)
    assert 0.97 * length(rest) < poisson < 1.08 * length(rest)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(4, 3), torch.zeros(4, 3), 1.0), "must both be"),
        ((torch.zeros(1, 4, 3), torch.zeros(1, 5, 3), 1.0), "must both be"),
        ((torch.zeros(1, 4, 3), torch.zeros(1, 4, 3), 0.0), "radius must be positive, got 0.0"),
    ],
)
@BOTH
def test_errors(arguments: tuple, message: str, deform: Any) -> None:
    rest, target, radius = arguments
    with pytest.raises(ValueError, match=message):
        deform(rest, target, radius=radius)


@pytest.mark.parametrize("shape", [(2, 1, 5), (1, 4, 5), (2, 5, 5), (4, 5), (2, 4, 0)])
@BOTH
def test_features_belong_to_the_vertices(shape: tuple[int, ...], deform: Any) -> None:
    rest = rand(2, 4, 3)
    with pytest.raises(ValueError, match=r"features must be \(2, 4, D\) beside rest, got"):
        deform(rest, rest, radius=1.0, features=torch.zeros(shape))


def test_a_weight_must_be_positive() -> None:
    for weight in (0.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match=f"weight must be positive and finite, got {weight}"):
            poisson_deform(torch.zeros(1, 4, 3), torch.zeros(1, 4, 3), radius=1.0, weight=weight)


@BOTH
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("which", ["rest", "target", "features"])
def test_a_number_that_is_not_finite_spoils_its_own_sample_alone(which: str, bad: float, deform: Any) -> None:
    inputs = {"rest": rand(2, 12, 3), "target": rand(2, 12, 3, seed=1), "features": rand(2, 12, 4, seed=2)}
    truth = deform(**inputs, radius=1.0)
    inputs[which] = inputs[which].clone()
    inputs[which][0, 5, 1] = bad
    spoilt = deform(**inputs, radius=1.0)
    assert spoilt[0].isnan().all()
    torch.testing.assert_close(spoilt[1], truth[1])
