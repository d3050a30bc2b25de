"""ElaIN against the paper's equations written with per-vertex convolutions; instance statistics against torch."""

import io

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn.functional import conv1d

from meshkit.norm import ElaIN, instance_statistics

VARIANTS = ["released", "paper"]
variants = pytest.mark.parametrize("variant", VARIANTS)
C, D = 6, 4


def make(variant: str, *, dtype: torch.dtype = torch.float64, c: int = C, d: int = D) -> ElaIN:
    norm = ElaIN(c, d, variant=variant).to(dtype)
    for i, parameter in enumerate(norm.parameters()):
        parameter.data = 0.5 * rand(*parameter.shape, seed=100 + i, dtype=dtype)
    return norm


def elain_literally(p: dict[str, Tensor], x: Tensor, cond: Tensor, variant: str) -> Tensor:
    """One sample, x (N, C) and cond (N, D), in the channels-first layout and the order of the paper's section."""

    def convolution(h: Tensor, name: str) -> Tensor:
        return conv1d(h, p[f"{name}.weight"][:, :, None], p[f"{name}.bias"])

    h_warp, count = x.T[None], len(x)
    mu = h_warp.sum(2, keepdim=True) / count
    squares = ((h_warp - mu) ** 2).sum(2, keepdim=True)
    sigma = (squares / (count if variant == "paper" else max(count - 1, 1)) + 1e-5) ** 0.5
    h_id = convolution(cond.T[None], "shared")
    w = convolution(torch.cat([h_id.mean(2, keepdim=True), h_warp.mean(2, keepdim=True)], 1), "weight")
    gamma, beta = convolution(h_id, "gamma"), convolution(h_id, "beta")
    gamma = w * gamma + (1 - w) * sigma
    beta = w * beta + (1 - w) * mu
    offset = {"paper": 0, "released": 1}[variant]
    return ((offset + gamma) * ((h_warp - mu) / sigma) + beta)[0].T


# ElaIN


@variants
@pytest.mark.parametrize(("dtype", "tol"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
@pytest.mark.parametrize(("num", "c", "d"), [(50, 6, 4), (7, 3, 9), (2, 5, 5), (1, 4, 3)])
def test_value_equals_the_equations(num, c, d, dtype, tol, variant):
    norm = make(variant, dtype=dtype, c=c, d=d)
    x, cond = 2 * rand(3, num, c, dtype=dtype) + 1, rand(3, num, d, seed=1, dtype=dtype)
    exact = {name: p.double() for name, p in norm.named_parameters()}
    expected = torch.stack(
        [elain_literally(exact, a.double(), c.double(), variant) for a, c in zip(x, cond, strict=True)]
    )
    value = norm(x, cond)
    assert value.dtype == dtype
    assert_near(value, expected, tol)


@variants
def test_gradients_equal_autograd_through_the_equations(variant):
    norm = make(variant)
    x, cond = rand(2, 9, C).requires_grad_(), rand(2, 9, D, seed=1).requires_grad_()
    names, parameters = zip(*norm.named_parameters(), strict=True)
    literal = dict(zip(names, parameters, strict=True))
    expected = torch.stack([elain_literally(literal, a, c, variant) for a, c in zip(x, cond, strict=True)])
    upstream, inputs = rand(2, 9, C, seed=2), [x, cond, *parameters]
    gradients = torch.autograd.grad(norm(x, cond), inputs, upstream)
    truths = torch.autograd.grad(expected, inputs, upstream)
    for name, gradient, truth in zip(["x", "cond", *names], gradients, truths, strict=True):
        assert truth.abs().amax() > 1e-3, name
        assert_near(gradient, truth, 1e-12)


@variants
def test_gradcheck(variant):
    norm = make(variant, c=3, d=2)
    mask = torch.tensor([[True] * 4, [True, False, True, False]])
    leaves = [rand(2, 4, 3).requires_grad_(), rand(2, 4, 2, seed=1).requires_grad_()]
    assert gradcheck(lambda x, cond: norm(x, cond, mask=mask)[mask], leaves)


@variants
@pytest.mark.parametrize("garbage", GARBAGE)
def test_padded_batch_equals_the_loop(garbage, variant):
    norm, sizes = make(variant), [5, 9, 1]
    xs, conds = ([rand(n, c, seed=i + s).requires_grad_() for i, n in enumerate(sizes)] for c, s in ((C, 0), (D, 9)))
    mask = scattered_mask(sizes, 12)
    x, cond = (scatter(samples, mask, garbage).requires_grad_() for samples in (xs, conds))
    value = norm(x, cond, mask=mask)[mask]
    expected = torch.cat([norm(a[None], c[None])[0] for a, c in zip(xs, conds, strict=True)])
    assert_near(value, expected, 1e-12)
    upstream, parameters = rand(*expected.shape, seed=20), list(norm.parameters())
    gradients = torch.autograd.grad(value, [x, cond, *parameters], upstream)
    truths = torch.autograd.grad(expected, [*xs, *conds, *parameters], upstream)
    for padded, samples in zip(gradients[:2], (truths[:3], truths[3:6]), strict=True):
        assert_near(padded[mask], torch.cat(samples), 1e-11)
        assert (padded[~mask] == 0).all()
    for gradient, truth in zip(gradients[2:], truths[6:], strict=True):
        assert_near(gradient, truth, 1e-11)


@variants
def test_given_statistics_replace_its_own(variant):
    norm = make(variant)
    x, cond, mask = rand(2, 8, C), rand(2, 8, D, seed=1), scattered_mask([5, 8], 8)
    torch.testing.assert_close(
        norm(x, cond, mask=mask, statistics=norm.statistics(x, mask=mask)), norm(x, cond, mask=mask)
    )
    mean, std = norm.statistics(x, mask=mask)
    assert torch.equal(std, instance_statistics(x, mask=mask, unbiased=variant == "released")[1])
    assert (norm(x, cond, statistics=(mean, 2 * std)) - norm(x, cond, statistics=(mean, std))).abs().amax() > 0.1


@variants
def test_constant_channel_gives_the_shift_alone(variant):
    """xhat is 0 there, so y = w beta + (1 - w) mu; the gradient stays finite."""
    norm = make(variant)
    x, cond = rand(1, 8, C), rand(1, 8, D, seed=1)
    x[..., 2] = 7
    x.requires_grad_()
    value = norm(x, cond)
    h = norm.shared(cond)
    w = norm.weight(torch.cat([h.mean(1), x.mean(1)], 1))[:, None]
    expected = w * norm.beta(h) + (1 - w) * 7
    assert_near(value[..., 2], expected[..., 2], 1e-12)
    (gradient,) = torch.autograd.grad(value.square().sum(), x)
    assert gradient.isfinite().all()


def test_paper_and_released_differ_by_the_normalised_features_up_to_the_variance():
    """With sigma shared, the offset alone is left: released - paper = xhat."""
    x, cond = rand(1, 10, C), rand(1, 10, D, seed=1)
    mean, std = instance_statistics(x)
    released, paper = (make(variant)(x, cond, statistics=(mean, std)) for variant in VARIANTS)
    assert_near(released - paper, (x - mean) / std, 1e-12)


@variants
def test_permutation_equivariance(variant):
    norm, x, cond, order = make(variant), rand(2, 9, C), rand(2, 9, D, seed=1), torch.randperm(9)
    assert_near(norm(x[:, order], cond[:, order]), norm(x, cond)[:, order], 1e-13)


@variants
def test_state_dict_round_trip(variant):
    norm, other = make(variant), ElaIN(C, D, variant=variant).double()
    stream = io.BytesIO()
    torch.save(norm.state_dict(), stream)
    stream.seek(0)
    other.load_state_dict(torch.load(stream))
    x, cond = rand(1, 5, C), rand(1, 5, D, seed=1)
    assert torch.equal(norm(x, cond), other(x, cond))
    # The parameters of the equations: no composed matrix is stored.
    shapes = {name: tuple(p.shape) for name, p in norm.state_dict().items()}
    assert shapes == {
        "shared.weight": (C, D),
        "shared.bias": (C,),
        "gamma.weight": (C, C),
        "gamma.bias": (C,),
        "beta.weight": (C, C),
        "beta.bias": (C,),
        "weight.weight": (C, 2 * C),
        "weight.bias": (C,),
    }


@variants
def test_eps_is_added_to_the_variance(variant):
    x, cond = 1e-4 * rand(1, 8, C), rand(1, 8, D, seed=1)
    norm = make(variant)
    small = ElaIN(C, D, variant=variant, eps=1e-12).double()
    small.load_state_dict(norm.state_dict())
    assert_near(small(x, cond), norm(x, cond, statistics=(x.mean(1, keepdim=True), small.statistics(x)[1])), 1e-12)
    assert (small.statistics(x)[1] < 2e-4).all() and (norm.statistics(x)[1] > 3e-3).all()


@variants
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_autocast(variant, dtype):
    norm = make(variant, dtype=torch.float32)
    x, cond = rand(2, 40, C, dtype=dtype), rand(2, 40, D, seed=1, dtype=dtype)
    with torch.autocast("cpu", torch.bfloat16):
        value = norm(x, cond)
    assert value.dtype == dtype
    assert_near(value, norm(x.float(), cond.float()), 0.03)


@pytest.mark.parametrize(
    ("x", "cond", "message"),
    [
        ((5, C), (1, 5, D), r"must agree in B and N, got \(5, 6\)"),
        ((1, 5, C), (1, 4, D), "must agree in B and N"),
        ((2, 5, C), (1, 5, D), "must agree in B and N"),
        ((1, 5, C + 1), (1, 5, D), "expected x with 6 and cond with 4 channels, got 7 and 4"),
        ((1, 5, C), (1, 5, D + 1), "got 6 and 5"),
    ],
)
def test_elain_shape_errors(x, cond, message):
    with pytest.raises(ValueError, match=message):
        ElaIN(C, D)(torch.ones(x), torch.ones(cond))


def test_unknown_variant():
    with pytest.raises(ValueError, match='must be "released" or "paper", got \'printed\''):
        ElaIN(C, D, variant="printed")


# Statistics


@pytest.mark.parametrize("unbiased", [False, True])
@pytest.mark.parametrize("eps", [0.0, 1e-5, 0.1])
def test_statistics_equal_torch(unbiased, eps):
    x = 3 * rand(2, 11, 4) + 1
    mean, std = instance_statistics(x, unbiased=unbiased, eps=eps)
    variance, expected = torch.var_mean(x, 1, keepdim=True, correction=int(unbiased))
    assert_near(mean, expected, 1e-14)
    assert_near(std, (variance + eps).sqrt(), 1e-14)


def test_statistics_are_those_of_instance_norm():
    x = rand(2, 11, 4)
    mean, std = instance_statistics(x)
    assert_near((x - mean) / std, torch.nn.functional.instance_norm(x.mT).mT, 1e-12)


@pytest.mark.parametrize("unbiased", [False, True])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_masked_statistics_equal_the_loop(garbage, unbiased):
    samples, mask = [rand(n, 3, seed=n) for n in (4, 7, 1)], scattered_mask([4, 7, 1], 9)
    x = scatter(samples, mask, garbage).requires_grad_()
    result = instance_statistics(x, mask=mask, unbiased=unbiased)
    for b, sample in enumerate(samples):
        for value, expected in zip(result, instance_statistics(sample[None], unbiased=unbiased), strict=True):
            assert_near(value[b], expected[0], 1e-14)
    (gradient,) = torch.autograd.grad(sum(r.sum() for r in result), x)
    assert gradient.isfinite().all() and (gradient[~mask] == 0).all()


@pytest.mark.parametrize("unbiased", [False, True])
def test_single_vertex_and_constant_channel_have_deviation_sqrt_eps(unbiased):
    for x in (rand(1, 1, 2), torch.full((1, 6, 2), 5.0, dtype=torch.float64)):
        mean, std = instance_statistics(x, unbiased=unbiased, eps=1e-4)
        assert torch.equal(mean, x[:, :1])
        assert_near(std, torch.full_like(std, 1e-2), 1e-14)


def test_nothing_is_lost_to_cancellation():
    x = rand(1, 1000, 2, dtype=torch.float32) + 1000
    assert_near(instance_statistics(x)[1], instance_statistics(x.double())[1], 1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_statistics_of_half_precision_are_float32(dtype):
    x = (300 * rand(1, 500, 2)).to(dtype)  # squares are beyond float16
    for value, expected in zip(instance_statistics(x), instance_statistics(x.double()), strict=True):
        assert value.dtype == torch.float32
        assert_near(value, expected, 1e-5)


def test_statistics_gradcheck():
    mask = torch.tensor([[True] * 4, [True, False, True, True]])
    for unbiased in (False, True):
        assert gradcheck(
            lambda x, unbiased=unbiased: instance_statistics(x, mask=mask, unbiased=unbiased),
            rand(2, 4, 2).requires_grad_(),
        )


@pytest.mark.parametrize(
    ("shape", "mask", "message"),
    [
        ((4, 3), None, r"x must have shape \(B, N, C\) .* got \(4, 3\)"),
        ((1, 0, 3), None, "at least one vertex"),
        ((1, 4, 3), (1, 3), r"mask must have shape \(1, 4\), got \(1, 3\)"),
    ],
)
def test_statistics_errors(shape, mask, message):
    with pytest.raises(ValueError, match=message):
        instance_statistics(torch.ones(shape), mask=None if mask is None else torch.ones(mask, dtype=torch.bool))
