"""Rigid moving least squares against a loop over vertices, and the motions it must reproduce."""

import pytest
import torch
from conftest import rand

from meshkit.deform import rigid_moving_least_squares


def rotation(seed: int) -> torch.Tensor:
    q, _ = torch.linalg.qr(rand(3, 3, seed=seed))
    return q * torch.det(q)


def rotation_of(covariance: torch.Tensor) -> torch.Tensor:
    u, _, vh = torch.linalg.svd(covariance)
    return u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vh))], dtype=u.dtype)) @ vh


def literally(v: torch.Tensor, t: torch.Tensor, radius: float, features: torch.Tensor | None) -> torch.Tensor:
    """One sample, vertex by vertex, rotations by SVD."""
    n = len(v)
    q = torch.zeros(n, n, dtype=v.dtype)
    for i in range(n):
        for j in range(n):
            q[i, j] = max(0.0, 1 - float((v[i] - v[j]).square().sum()) / radius**2) ** 2
            if features is not None:
                q[i, j] *= float(torch.exp(-(features[i] - features[j]).square().mean()))
    whole = rotation_of(sum(torch.outer(t[j] - t.mean(0), v[j] - v.mean(0)) for j in range(n)))
    motions = []
    for i in range(n):
        weight = q[i] / q[i].sum()
        mean_v, mean_t = weight @ v, weight @ t
        covariance = sum(weight[j] * torch.outer(t[j] - mean_t, v[j] - mean_v) for j in range(n))
        covariance = covariance + 0.02 * torch.linalg.norm(covariance) * whole
        motions.append((rotation_of(covariance), mean_v, mean_t))
    out = torch.zeros_like(v)
    for j in range(n):
        for i, (turn, mean_v, mean_t) in enumerate(motions):
            out[j] += q[i, j] * (mean_t + turn @ (v[j] - mean_v))
        out[j] /= q[:, j].sum()
    return out


@pytest.mark.parametrize("with_features", [False, True])
def test_equals_the_loop(with_features: bool) -> None:
    v, t = rand(2, 14, 3, seed=1), rand(2, 14, 3, seed=2)
    features = rand(2, 14, 4, seed=3) if with_features else None
    moved = rigid_moving_least_squares(v, t, radius=2.5, features=features)
    for b in range(2):
        expected = literally(v[b], t[b], 2.5, None if features is None else features[b])
        torch.testing.assert_close(moved[b], expected, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("radius", [0.5, 1.5, 50.0])
def test_a_rigid_motion_is_reproduced(radius: float) -> None:
    v, turn = rand(1, 40, 3), rotation(5)
    target = v @ turn.mT + torch.tensor([1.0, -2.0, 3.0], dtype=v.dtype)
    torch.testing.assert_close(rigid_moving_least_squares(v, target, radius=radius), target, atol=1e-8, rtol=0)


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


def test_features_keep_parts_apart_that_pass_close_to_each_other() -> None:
    left, right = rand(30, 3, seed=1) * 0.1, rand(30, 3, seed=2) * 0.1 + torch.tensor([0.2, 0, 0])
    rest = torch.cat([left, right])[None]
    target = rest.clone()
    target[:, 30:] += torch.tensor([0.0, 1.0, 0.0])  # one part leaves, the other stays
    part = torch.cat([torch.full((30, 1), -4.0), torch.full((30, 1), 4.0)])[None]
    apart = rigid_moving_least_squares(rest, target, radius=1.0, features=part)
    torch.testing.assert_close(apart, target, atol=1e-2, rtol=0)  # the prior turns each part by a trace
    assert (rigid_moving_least_squares(rest, target, radius=1.0) - target).abs().max() > 0.1


def test_padding_changes_nothing_wherever_it_stands() -> None:
    v, t, f = rand(1, 12, 3, seed=1), rand(1, 12, 3, seed=2), rand(1, 12, 2, seed=3)
    mask = torch.tensor([[True] * 5 + [False, True] + [True] * 6 + [False, False]])
    padded = []
    for x in (v, t, f):
        wide = torch.full((1, 15, x.shape[2]), torch.nan, dtype=x.dtype)
        wide[mask] = x[0]
        padded.append(wide)
    target = padded[1].requires_grad_()
    moved = rigid_moving_least_squares(padded[0], target, radius=2.0, mask=mask, features=padded[2])
    torch.testing.assert_close(moved[mask], rigid_moving_least_squares(v, t, radius=2.0, features=f)[0])
    assert (moved[~mask] == 0).all()
    moved.sum().backward()
    assert torch.isfinite(target.grad).all() and (target.grad[~mask] == 0).all()


def test_gradients() -> None:
    v, t = rand(1, 10, 3, seed=1), rand(1, 10, 3, seed=2).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: rigid_moving_least_squares(v, t, radius=2.0), (t,))


def test_vertex_order_is_carried_through() -> None:
    v, t, order = rand(1, 20, 3, seed=1), rand(1, 20, 3, seed=2), torch.randperm(20)
    moved = rigid_moving_least_squares(v, t, radius=1.5)
    torch.testing.assert_close(rigid_moving_least_squares(v[:, order], t[:, order], radius=1.5), moved[:, order])


def test_a_vertex_out_of_reach_goes_to_its_target_and_half_precision_stays_finite() -> None:
    v = torch.tensor([[[0.0, 0, 0], [9, 9, 9]]])
    t = torch.tensor([[[1.0, 2, 3], [4, 5, 6]]])
    torch.testing.assert_close(rigid_moving_least_squares(v, t, radius=0.1), t)
    assert rigid_moving_least_squares(v.bfloat16(), t.bfloat16(), radius=0.1).dtype == torch.bfloat16


def test_another_unit_than_the_radius_stays_finite() -> None:
    """In millimetres rounding takes a vertex out of its own reach."""
    v = 1000 * rand(1, 200, 3, seed=1).float()
    t = v + 1000 * rand(1, 200, 3, seed=2).float()
    moved = rigid_moving_least_squares(v, t, radius=0.25)
    torch.testing.assert_close(moved, t, atol=1.0, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(4, 3), torch.zeros(4, 3), 1.0), "must both be"),
        ((torch.zeros(1, 4, 3), torch.zeros(1, 5, 3), 1.0), "must both be"),
        ((torch.zeros(1, 4, 3), torch.zeros(1, 4, 3), 0.0), "radius must be positive, got 0.0"),
    ],
)
def test_errors(arguments: tuple, message: str) -> None:
    rest, target, radius = arguments
    with pytest.raises(ValueError, match=message):
        rigid_moving_least_squares(rest, target, radius=radius)
