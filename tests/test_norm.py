"""The norms against their equations written with per-vertex maps; modulation and statistics against plain formulas."""

import io
import math
from functools import partial

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck
from torch.nn.functional import conv1d

from meshkit import norm as norms
from meshkit.nn import ConditionalResBlock
from meshkit.norm import (
    SPADE,
    AdaIN,
    ConditionalNorm,
    ElaIN,
    Modulation,
    SoftAdaIN,
    SPAdaIN,
    _tiles,
    adain,
    elain,
    instance_norm,
    instance_statistics,
    modulate,
    soft_adain,
    spadain,
    spade,
)

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


@pytest.fixture(params=[False, True], ids=["in-tiles", "samples-together"])
def walk(request, monkeypatch) -> None:
    """How the vertices are gone through: the whole batch at once on devices other than the CPU."""
    monkeypatch.setattr(_tiles, "launch_bound", lambda x: request.param)


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
def test_padded_batch_equals_the_loop(garbage, variant, walk):
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
@pytest.mark.parametrize(("gate", "degree"), [(None, 2), ("sigmoid", 1)])
def test_elain_squares_the_scale_of_its_input_unless_gated(variant, gate, degree):
    """Without bound, w grows with the mean, and w sigma and w mu with its square; a block has two ElaINs in a row."""
    torch.manual_seed(0)
    x, cond = rand(1, 8, C) + 1, rand(1, 8, D, seed=1)

    def growth(layer: torch.nn.Module) -> float:
        with torch.no_grad():
            small, large = (layer(scale * x, cond).abs().amax().log10() for scale in (1e6, 1e7))
        return float(large - small)

    norm = partial(ElaIN, variant=variant, gate=gate)
    block = ConditionalResBlock(C, D, norm=norm, spectral=False).double()
    assert growth(norm(C, D).double()) == pytest.approx(degree, abs=0.01)
    assert growth(block) == pytest.approx(degree**2, abs=0.01)


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
    released, paper = (modulate(x, make(variant).modulation(cond, mean, std)) for variant in VARIANTS)
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
    mean, std = small.statistics(x)
    assert_near(small(x, cond), modulate(x, norm.modulation(cond, mean, std)), 1e-12)
    assert (small.statistics(x)[1] < 2e-4).all() and (norm.statistics(x)[1] > 3e-3).all()


@variants
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_autocast(variant, dtype, walk):
    norm = make(variant, dtype=torch.float32)
    x, cond = rand(2, 40, C, dtype=dtype), rand(2, 40, D, seed=1, dtype=dtype)
    with torch.autocast("cpu", torch.bfloat16):
        value = norm(x, cond)
    assert value.dtype == dtype
    assert_near(value, norm(x.float(), cond.float()), 0.03)


@pytest.mark.parametrize(
    ("x", "cond", "message"),
    [
        ((5, C), (1, 5, D), r"x must have shape \(B, N, C\), got \(5, 6\); add the batch dimension with x\[None\]"),
        ((1, 5, C), (5, D), r"cond must have shape \(B, N, D\), got \(5, 4\); add .* with cond\[None\]"),
        ((1, C, 5), (1, 5, D), r"expected x with 6 channels \(B, N, 6\), got \(1, 6, 5\); .* transpose it with x.mT"),
        ((1, 5, C), (1, D, 5), r"expected cond with 4 channels .* transpose it with cond.mT"),
        ((1, 5, C), (1, 4, D), "must agree in B and N"),
        ((2, 5, C), (1, 5, D), "must agree in B and N"),
        ((1, 5, C + 1), (1, 5, D), r"expected x with 6 channels \(B, N, 6\), got \(1, 5, 7\)$"),
        ((1, 5, C), (1, 5, D + 1), r"expected cond with 4 channels \(B, N, 4\), got \(1, 5, 5\)"),
    ],
)
def test_elain_shape_errors(x, cond, message):
    with pytest.raises(ValueError, match=message):
        ElaIN(C, D)(torch.ones(x), torch.ones(cond))


def test_unknown_variant():
    with pytest.raises(ValueError, match='must be "released" or "paper", got \'printed\''):
        ElaIN(C, D, variant="printed")


# Every norm

NORMS = [ElaIN, AdaIN, SoftAdaIN, SPAdaIN, SPADE]
GLOBAL = [AdaIN, SoftAdaIN]
every = pytest.mark.parametrize("kind", NORMS)


def make_any(kind: type[ConditionalNorm], dtype: torch.dtype = torch.float64, **options) -> ConditionalNorm:
    norm = kind(C, D, **options).to(dtype)
    for i, parameter in enumerate(norm.parameters()):
        parameter.data = 0.5 * rand(*parameter.shape, seed=100 + i, dtype=dtype)
    return norm


def by_function(norm: ConditionalNorm, x: Tensor, cond: Tensor) -> Tensor:
    """The learned maps one by one, then the functional form."""
    match norm:
        case ElaIN():
            h = norm.shared(cond)
            w = norm.weight(torch.cat([h.mean(1), x.mean(1)], 1))[:, None]
            w = w if norm.gate is None else 1 / (1 + (-w).exp())
            return elain(x, norm.gamma(h), norm.beta(h), weight=w, variant=norm.variant)
        case SoftAdaIN():
            h = norm.shared(cond)
            w = norm.weight(torch.cat([h.mean(1), x.mean(1)], 1))[:, None]
            return soft_adain(x, h, weight=w if norm.gate is None else 1 / (1 + (-w).exp()))
        case AdaIN():
            return adain(x, norm.shared(cond))
        case SPAdaIN():
            return spadain(x, norm.gamma(cond), norm.beta(cond))
        case SPADE():
            h = norm.shared(cond).clamp_min(0)
            flat = x.flatten(0, 1)
            mean, var = flat.mean(0), flat.var(0, correction=0)
            if not norm.training:
                mean, var = norm.running_mean, norm.running_var
            return spade(x, norm.gamma(h), norm.beta(h), mean=mean, var=var)
    raise AssertionError(norm)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        *((kind, {}) for kind in NORMS),
        (ElaIN, {"gate": "sigmoid"}),
        (ElaIN, {"variant": "paper"}),
        (SoftAdaIN, {"gate": None}),
        (SPADE, {"hidden": 3}),
    ],
)
@pytest.mark.parametrize("training", [True, False])
def test_module_equals_its_function(kind, options, training):
    norm = make_any(kind, **options).train(training)
    rows = 7 if kind in GLOBAL else 9
    x, cond = (3 * rand(2, 9, C) + 1).requires_grad_(), rand(2, rows, D, seed=1).requires_grad_()
    value, expected = norm(x, cond), by_function(norm, x, cond)
    assert_near(value, expected, 1e-12)
    names, parameters = zip(*norm.named_parameters(), strict=True)
    upstream, inputs = rand(2, 9, C, seed=2), [x, cond, *parameters]
    gradients, truths = (torch.autograd.grad(v, inputs, upstream) for v in (value, expected))
    for name, gradient, truth in zip(["x", "cond", *names], gradients, truths, strict=True):
        assert truth.abs().amax() > 1e-3, name
        assert_near(gradient, truth, 1e-10)


def functional(name: str, x: Tensor, mask: Tensor | None = None) -> Tensor:
    scale, shift = rand(*x.shape, seed=3), rand(*x.shape, seed=4)
    calls = {
        "adain": lambda: adain(x, shift, mask=mask, style_mask=mask),
        "soft_adain": lambda: soft_adain(x, shift, weight=scale[:, :1], mask=mask, style_mask=mask),
        "elain": lambda: elain(x, scale, shift, weight=scale[:, :1], mask=mask),
        "spadain": lambda: spadain(x, scale, shift, mask=mask),
        "instance_norm": lambda: instance_norm(x, mask=mask),
    }
    return calls[name]()


@pytest.mark.parametrize("name", ["adain", "soft_adain", "elain", "spadain", "instance_norm"])
def test_functional_equals_its_equation(name):
    """One channel at a time, with scalar formulas."""
    x = 3 * rand(2, 9, C) + 1
    value, scale, shift = functional(name, x), rand(2, 9, C, seed=3), rand(2, 9, C, seed=4)
    for b in range(2):
        for c in range(C):
            v, g, t, w = x[b, :, c], scale[b, :, c], shift[b, :, c], scale[b, 0, c]
            mu, unbiased = v.mean(), (v.var() + 1e-5) ** 0.5
            sigma = (((v - mu) ** 2).mean() + 1e-5) ** 0.5
            mu_t, sigma_t = t.mean(), (((t - t.mean()) ** 2).mean() + 1e-5) ** 0.5
            expected = {
                "adain": sigma_t * (v - mu) / sigma + mu_t,
                "soft_adain": (w * sigma_t + (1 - w) * sigma) * (v - mu) / sigma + w * mu_t + (1 - w) * mu,
                "elain": (1 + w * g + (1 - w) * unbiased) * (v - mu) / unbiased + w * t + (1 - w) * mu,
                "spadain": g * (v - mu) / sigma + t,
                "instance_norm": (v - mu) / sigma,
            }
            assert_near(value[b, :, c], expected[name], 1e-12)


@pytest.mark.parametrize("name", ["adain", "soft_adain", "elain", "spadain", "instance_norm"])
def test_functional_padding(name):
    x, mask = rand(2, 9, C), torch.ones(2, 9, dtype=torch.bool)
    mask[:, 6:] = False
    padded = x.masked_fill(~mask[..., None], math.nan)
    value = functional(name, padded, mask)
    assert (value[~mask] == 0).all()
    cut = [t[:, :6] for t in (x, rand(2, 9, C, seed=3), rand(2, 9, C, seed=4))]
    expected = {
        "adain": lambda x, s, t: adain(x, t),
        "soft_adain": lambda x, s, t: soft_adain(x, t, weight=s[:, :1]),
        "elain": lambda x, s, t: elain(x, s, t, weight=s[:, :1]),
        "spadain": lambda x, s, t: spadain(x, s, t),
        "instance_norm": lambda x, s, t: instance_norm(x),
    }
    assert_near(value[:, :6], expected[name](*cut), 1e-12)


def test_spade_equals_batch_norm():
    x, batch_norm = rand(3, 9, C), torch.nn.BatchNorm1d(C).double()
    norm = make_any(SPADE)
    for p in (*norm.gamma.parameters(), *norm.beta.parameters()):
        p.data.zero_()
    cond = rand(3, 9, D)
    for training in (True, True, False):
        norm.train(training), batch_norm.train(training)
        assert_near(norm(x, cond), batch_norm(x.mT).mT, 1e-12)
        assert_near(norm.running_mean, batch_norm.running_mean, 1e-12)
        assert_near(norm.running_var, batch_norm.running_var, 1e-12)
    assert norm.num_batches_tracked == 2


def test_adain_of_equal_widths_starts_without_parameters_of_its_own():
    x, cond = rand(2, 9, C), 2 * rand(2, 7, C, seed=1) + 1
    assert_near(AdaIN(C, C).double()(x, cond), adain(x, cond), 1e-12)


@every
@pytest.mark.parametrize("garbage", GARBAGE)
def test_every_norm_ignores_padding(garbage, kind):
    """A padded batch equals one sample at a time; SPADE, whose statistics are the batch's, in evaluation."""
    norm, sizes = make_any(kind).eval(), [5, 9, 1]
    rows = [4, 3, 6] if kind in GLOBAL else sizes
    xs = [rand(n, C, seed=i).requires_grad_() for i, n in enumerate(sizes)]
    conds = [rand(n, D, seed=9 + i).requires_grad_() for i, n in enumerate(rows)]
    mask = scattered_mask(sizes, 12)
    cond_mask = scattered_mask(rows, 8) if kind in GLOBAL else mask
    x, cond = scatter(xs, mask, garbage).requires_grad_(), scatter(conds, cond_mask, garbage).requires_grad_()
    y = norm(x, cond, mask=mask, cond_mask=cond_mask)
    assert (y[~mask] == 0).all()
    if kind not in GLOBAL:
        assert torch.equal(y, norm(x, cond, mask=mask))  # the condition's mask is that of x
    expected = torch.cat([norm(a[None], c[None])[0] for a, c in zip(xs, conds, strict=True)])
    assert_near(y[mask], expected, 1e-12)
    upstream, parameters = rand(*expected.shape, seed=20), list(norm.parameters())
    gradients = torch.autograd.grad(y[mask], [x, cond, *parameters], upstream)
    truths = torch.autograd.grad(expected, [*xs, *conds, *parameters], upstream)
    for padded, samples, real in zip(gradients[:2], (truths[:3], truths[3:6]), (mask, cond_mask), strict=True):
        assert_near(padded[real], torch.cat(samples), 1e-11, scale=1.0)
        assert (padded[~real] == 0).all()
    for gradient, truth in zip(gradients[2:], truths[6:], strict=True):
        assert_near(gradient, truth, 1e-11)


def test_spade_statistics_are_those_of_the_real_vertices_of_the_batch():
    norm, sizes = make_any(SPADE), [5, 9, 1]
    xs, conds = ([rand(n, c, seed=i + s) for i, n in enumerate(sizes)] for c, s in ((C, 0), (D, 9)))
    mask = scattered_mask(sizes, 12)
    value = norm(scatter(xs, mask, 1e20), scatter(conds, mask, 1e20), mask=mask)[mask]
    kept = norm.running_var.clone()
    norm.running_var.fill_(1)
    assert_near(value, norm(torch.cat(xs)[None], torch.cat(conds)[None])[0], 1e-12)
    assert_near(norm.running_var, kept, 1e-12)


@every
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_padding_under_autocast(kind, dtype):
    norm = make_any(kind, dtype=torch.float32).eval()
    x, cond = (3 * rand(2, 40, C)).to(dtype), rand(2, 40, D, seed=1).to(dtype)
    mask = torch.zeros(2, 70, dtype=torch.bool)
    mask[:, :40] = True
    wide_x, wide_cond = (torch.cat([t, t.new_full((2, 30, t.shape[2]), 1e20)], 1) for t in (x, cond))
    with torch.autocast("cpu", torch.bfloat16):
        value = norm(wide_x, wide_cond, mask=mask, cond_mask=mask)[:, :40]
        expected = norm(x, cond)
    assert value.dtype == expected.dtype == dtype
    assert_near(value, expected, 8e-3)
    assert_near(expected, norm.double()(x.double(), cond.double()), 0.03)


@every
def test_every_norm_compiles_to_one_graph(kind):
    torch._dynamo.reset()
    norm = make_any(kind).eval()
    compiled = torch.compile(norm, backend="aot_eager", fullgraph=True)
    x, cond, mask = rand(2, 9, C).requires_grad_(), rand(2, 9, D, seed=1).requires_grad_(), scattered_mask([9, 5], 9)
    inputs, upstream = [x, cond, *norm.parameters()], rand(2, 9, C, seed=2)
    value, expected = (f(x, cond, mask=mask, cond_mask=mask) for f in (compiled, norm))
    assert_near(value, expected, 1e-12)
    for gradient, truth in zip(*(torch.autograd.grad(v, inputs, upstream) for v in (value, expected)), strict=True):
        assert_near(gradient, truth, 1e-10)


@every
def test_function_transforms(kind):
    """torch.func: a vmap over samples and per-sample gradients equal the batch and the loop."""
    norm = make_any(kind).eval()
    x, cond, parameters = rand(3, 5, C), rand(3, 5, D, seed=1), dict(norm.named_parameters())

    def loss(parameters: dict[str, Tensor], x: Tensor, cond: Tensor) -> Tensor:
        return torch.func.functional_call(norm, parameters, (x[None], cond[None])).square().sum()

    losses = torch.func.vmap(loss, (None, 0, 0))(parameters, x, cond)
    assert_near(losses, norm(x, cond).square().sum((1, 2)), 1e-12)
    gradients = torch.func.vmap(torch.func.grad(loss), (None, 0, 0))(parameters, x, cond)
    for b in range(3):
        truths = torch.autograd.grad(norm(x[b : b + 1], cond[b : b + 1]).square().sum(), list(parameters.values()))
        for gradient, truth in zip(gradients.values(), truths, strict=True):
            assert_near(gradient[b], truth, 1e-11)


@every
def test_state_dict_names(kind):
    names = {
        ElaIN: {"shared", "gamma", "beta", "weight"},
        AdaIN: {"shared"},
        SoftAdaIN: {"shared", "weight"},
        SPAdaIN: {"gamma", "beta"},
        SPADE: {"shared", "gamma", "beta"},
    }
    found = {name.split(".")[0] for name, _ in make_any(kind).named_parameters()}
    assert found == names[kind]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ElaIN(0, 3), "must be positive whole numbers, got 0, 3"),
        (lambda: ElaIN(64.0, 3), "must be positive whole numbers, got 64.0, 3"),
        (lambda: ElaIN(4, 3, eps=-1.0), "cannot be negative, got -1.0"),
        (lambda: ElaIN(3, 3, gate="tanh"), "gate must be \"sigmoid\" or None, got 'tanh'"),
        (lambda: SoftAdaIN(3, 3, gate="tanh"), "gate must be \"sigmoid\" or None, got 'tanh'"),
        (lambda: elain(torch.ones(1, 2, 3), 0, 0, weight=0, variant="x"), 'must be "released" or "paper"'),
        (lambda: AdaIN(3, 2)(torch.ones(2, 4, 3), torch.ones(1, 4, 2)), r"\(B, M, D\) must agree in B, got"),
        (lambda: AdaIN(3, 2)(torch.ones(1, 4, 3), torch.ones(1, 4, 3)), "expected cond with 2 channels"),
        (
            lambda: AdaIN(3, 2)(torch.ones(1, 4, 3), torch.ones(1, 5, 2), cond_mask=torch.ones(1, 4) > 0),
            r"cond_mask must have shape \(1, 5\)",
        ),
        (lambda: adain(torch.ones(1, 4, 3), torch.ones(1, 4, 2)), "must agree in B and C"),
        (lambda: soft_adain(torch.ones(4, 3), torch.ones(1, 4, 3), weight=torch.ones(1)), r"x\[None\]"),
        (lambda: adain(torch.ones(1, 4, 3), torch.ones(4, 3)), r"style must have shape \(B, M, C\), got \(4, 3\)"),
        (lambda: modulate(torch.ones(4, 3), Modulation(*torch.ones(3, 1, 1, 3))), r"x must have shape .* x\[None\]"),
    ],
)
def test_norm_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


X, COND = torch.ones(1, 5, C), torch.ones(1, 5, D)


@pytest.mark.parametrize("kind", [ElaIN, SPAdaIN, AdaIN, SoftAdaIN, SPADE])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((X, None), r"cond must be a tensor \(B, [NM], D\), got None"),
        ((X.numpy(), COND), r"x must be a tensor \(B, N, C\), got ndarray; convert it with torch.from_numpy"),
        ((X, COND.tolist()), r"cond must be a tensor .* got list"),
        (
            (X.double(), COND),
            r"x is torch.float64, but the parameters of \w+ are torch.float32: .* x.to\(torch.f",
        ),
        ((X.half(), COND.half()), r"x is torch.float16, but the parameters of"),
        ((X.long(), COND), r"x is torch.int64, but"),
    ],
)
@pytest.mark.parametrize("block", [False, True])
def test_what_is_no_features_is_named(kind, arguments, message, block):
    module = ConditionalResBlock(C, D, norm=kind) if block else kind(C, D)
    with pytest.raises(TypeError, match=message):
        module(*arguments)


def test_a_mask_that_is_no_tensor_is_named():
    with pytest.raises(TypeError, match=r"mask must be a bool tensor \(1, 5\) or None, got ndarray"):
        ElaIN(C, D)(X, COND, mask=torch.ones(1, 5).bool().numpy())


def test_one_dtype_is_not_asked_for_under_autocast():
    norm = SPAdaIN(C, D)
    with torch.autocast("cpu", torch.bfloat16):
        assert norm(X.bfloat16(), COND).shape == X.shape


@pytest.mark.parametrize("with_module", [False, True])
def test_a_norm_without_the_constructor_of_its_base_says_so(with_module):
    class Own(ConditionalNorm):
        def __init__(self, num_features, cond_features):
            self.width = num_features
            if with_module:
                self.map = torch.nn.Linear(cond_features, num_features)

        def modulation(self, cond, mean, std, *, cond_mask=None):
            raise AssertionError

    with pytest.raises(TypeError, match=r"Own.__init__ must begin with super\(\).__init__\(num_f"):
        Own(C, D)


def test_the_constructor_that_left_out_its_base_is_the_one_blamed():
    class Wrong(ConditionalNorm):
        def __init__(self, num_features, cond_features):
            self.width = num_features

    class Right(Wrong):
        def __init__(self, num_features, cond_features):
            super().__init__(num_features, cond_features)

    with pytest.raises(TypeError, match=r"Wrong.__init__ must begin with"):
        Right(C, D)

    class Typo(ConditionalNorm):
        def __init__(self, num_features, cond_features):
            super().__init__(num_features.width, cond_features)

    with pytest.raises(AttributeError, match="width"):
        Typo(C, D)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("kind", [ElaIN, SPAdaIN, AdaIN, SoftAdaIN, SPADE])
def test_half_precision_throughout(kind, dtype):
    norm = make_any(kind, dtype=torch.float32)
    x, cond = rand(2, 40, C, dtype=torch.float32), rand(2, 40, D, seed=1, dtype=torch.float32)
    expected = norm(x, cond)
    value = norm.to(dtype)(x.to(dtype), cond.to(dtype))
    assert value.dtype == dtype
    assert (value.float() - expected).abs().max() < 0.1 * expected.abs().max()


def test_other_errors_of_a_constructor_stay_as_they_are():
    class Own(ConditionalNorm):
        def __init__(self, num_features, cond_features):
            super().__init__(num_features, cond_features)
            self.missing  # noqa: B018

    with pytest.raises(AttributeError, match="missing"):
        Own(C, D)


def test_a_norm_whose_modulation_takes_no_cond_mask_says_so():
    with pytest.raises(TypeError, match=r"Own.modulation must take cond_mask: modulation\(self, cond, mean, std, \*, "):

        class Own(ConditionalNorm):
            def modulation(self, cond, mean, std):
                raise AssertionError


def test_a_part_of_a_modulation_that_is_no_tensor_is_named():
    with pytest.raises(TypeError, match="shift_bias of the modulation must be a tensor, got float"):
        modulate(X, Modulation(torch.zeros(1, 1, C), torch.zeros(1, 1, C), 1.0))


def test_a_norm_without_modulation_says_so():
    with pytest.raises(NotImplementedError):
        ConditionalNorm(2, 2)(torch.ones(1, 3, 2), torch.ones(1, 3, 2))


def of_linear(linear, std):
    """A per-vertex modulation as a norm of one's own gives it, to be spoiled."""
    weight = linear.weight.mT.expand(len(std), -1, -1)
    return Modulation(
        torch.zeros_like(std), 1 / std, linear.bias, features=None, scale_weight=weight, shift_weight=weight
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda m, cond: m._replace(features=cond, scale_weight=m.scale_weight[0]),
            r"scale_weight .* x \(2, 5, 3\) must be \(2, 4, 3\), of each sample the transposed weight .* got \(4, 3\)",
        ),
        (
            lambda m, cond: m._replace(features=cond, shift_weight=m.shift_weight.mT),
            r"shift_weight .* must be \(2, 4, 3\).* got \(2, 3, 4\)",
        ),
        (lambda m, cond: m._replace(features=cond[:, :4]), r"features .* must be \(2, 5, 4\), got \(2, 4, 4\)"),
        (lambda m, cond: m, "come together: features left out"),
        (
            lambda m, cond: Modulation(m.mean, m.scale_bias, m.shift_bias, features=cond),
            "scale_weight and shift_weight left out",
        ),
        (
            lambda m, cond: Modulation(m.mean, torch.ones(2, 5, 3), m.shift_bias),
            r"scale_bias .* \(2, 1, 3\) or broadcast to it, got \(2, 5, 3\); what differs .* goes through features",
        ),
        (lambda m, cond: Modulation(m.mean, m.scale_bias, torch.ones(2, 3)), r"shift_bias .* got \(2, 3\)$"),
        (lambda m, cond: Modulation(torch.ones(2, 1, 4), m.scale_bias, m.shift_bias), r"mean .* got \(2, 1, 4\)$"),
        (lambda m, cond: (m.scale_bias, m.shift_bias), "must return a Modulation, got tuple"),
    ],
)
@pytest.mark.parametrize("block", [False, True])
def test_a_modulation_of_other_shapes_is_named(spoil, message, block):
    class Own(ConditionalNorm):
        def __init__(self, num_features, cond_features):
            super().__init__(num_features, cond_features)
            self.map = torch.nn.Linear(cond_features, num_features)

        def modulation(self, cond, mean, std, *, cond_mask=None):
            return spoil(of_linear(self.map, std), cond)

    module = ConditionalResBlock(3, 4, norm=Own) if block else Own(3, 4)
    with pytest.raises(ValueError, match=message):
        module(torch.randn(2, 5, 3), torch.randn(2, 5, 4))


def test_what_broadcasts_to_scale_and_shift_is_taken():
    x, mean, vector = rand(2, 5, 3), rand(2, 1, 3, seed=1), rand(3, seed=2)
    expected = vector * (x - mean) + vector
    for bias in (vector, vector[None], vector[None, None]):
        assert_near(modulate(x, Modulation(mean, bias, bias)), expected, 1e-12)


@pytest.mark.parametrize(
    ("norm", "said"),
    [
        (SPAdaIN(3, 4, eps=1e-3), "SPAdaIN(3, 4, eps=0.001"),
        (ElaIN(3, 4, variant="paper", gate="sigmoid"), "ElaIN(3, 4, eps=1e-05, variant='paper', gate='sigmoid'"),
        (SoftAdaIN(3, 4, gate=None), "SoftAdaIN(3, 4, eps=1e-05, gate=None"),
        (SPADE(3, 4, momentum=0.2), "SPADE(3, 4, eps=1e-05, momentum=0.2"),
    ],
)
def test_a_printed_norm_shows_its_options(norm, said):
    assert "".join(repr(norm).split()).startswith(said.replace(" ", ""))


# Modulation


def modulation_inputs(features: bool, linear: bool, *, num: int = 11) -> list[Tensor | None]:
    """x, mean, scale and shift bias, features, scale and shift weight, weight, bias."""
    b, c, d, o = 3, 4, 3, 5
    shapes: list[tuple[int, ...] | None] = [(b, num, c), (b, 1, c), (b, 1, c), (b, 1, c)]
    shapes += [(b, num, d), (b, d, c), (b, d, c)] if features else [None] * 3
    shapes += [(o, c), (o,)] if linear else [None] * 2
    return [None if s is None else rand(*s, seed=i).requires_grad_() for i, s in enumerate(shapes)]


def call_modulate(slope: float | None, *inputs: Tensor | None) -> Tensor:
    x, *modulation, weight, bias = inputs
    return modulate(x, Modulation(*modulation), slope=slope, weight=weight, bias=bias)


def modulate_literally(slope: float | None, *inputs: Tensor | None) -> Tensor:
    x, mean, scale, shift, features, scale_weight, shift_weight, weight, bias = inputs
    if features is not None:
        scale = scale + torch.einsum("bnd,bdc->bnc", features, scale_weight)
        shift = shift + torch.einsum("bnd,bdc->bnc", features, shift_weight)
    y = scale * (x - mean) + shift
    y = y if slope is None else torch.where(y > 0, y, slope * y)
    y = y if weight is None else torch.einsum("oc,bnc->bno", weight, y)
    return y if bias is None else y + bias


forms = pytest.mark.parametrize(
    ("features", "linear", "slope"), [(True, True, 0.2), (True, False, None), (False, True, 0.0), (False, False, 0.2)]
)


@forms
@pytest.mark.parametrize("rows", [4, 11, 23, 512, None])
def test_modulate_in_tiles_of_any_size(features, linear, slope, rows, monkeypatch):
    monkeypatch.setattr(_tiles, "launch_bound", lambda x: rows is None)
    monkeypatch.setattr(_tiles, "ROWS", rows)
    inputs = modulation_inputs(features, linear)
    value, expected = call_modulate(slope, *inputs), modulate_literally(slope, *inputs)
    assert_near(value, expected, 1e-13)
    given, upstream = [t for t in inputs if t is not None], rand(*value.shape, seed=20)
    for gradient, truth in zip(*(torch.autograd.grad(v, given, upstream) for v in (value, expected)), strict=True):
        assert_near(gradient, truth, 1e-12)


def test_tiles_on_a_cpu_span_small_samples():
    walks = {shape: [t for t in _tiles.tiles(torch.empty(shape))] for shape in ((5, 200, 2), (2, 600, 2), (1, 9, 2))}
    everything = slice(None)
    assert walks[5, 200, 2] == [(slice(0, 2), everything), (slice(2, 4), everything), (slice(4, 5), everything)]
    assert walks[2, 600, 2] == [(b, rows) for b in range(2) for rows in (slice(0, 512), slice(512, 600))]
    assert walks[1, 9, 2] == [(0, slice(0, 9))]
    assert len(_tiles.tile_buffer(torch.empty(5, 200, 2), torch.float32)) == 2


@forms
def test_modulate_second_derivatives(features, linear, slope):
    inputs = modulation_inputs(features, linear, num=3)
    given = [t for t in inputs if t is not None]

    def function(*tensors: Tensor) -> Tensor:
        source = iter(tensors)
        return call_modulate(slope, *(None if t is None else next(source) for t in inputs))

    assert gradcheck(function, given)
    assert gradgradcheck(function, given, fast_mode=True)


@pytest.mark.parametrize("wanted", range(9))
def test_modulate_gradient_of_one_input_alone(wanted):
    inputs = [t.detach() for t in modulation_inputs(True, True)]
    inputs[wanted].requires_grad_()
    gradients = [
        torch.autograd.grad(f(0.2, *inputs).sin().sum(), inputs[wanted])[0] for f in (call_modulate, modulate_literally)
    ]
    assert_near(*gradients, 1e-12)


def test_modulate_without_bias():
    inputs = [*modulation_inputs(True, True)[:-1], None]
    assert_near(call_modulate(0.2, *inputs), modulate_literally(0.2, *inputs), 1e-13)


def test_modulate_in_half_precision(walk):
    inputs = [t.detach().requires_grad_() for t in modulation_inputs(True, True, num=40)]
    x, mean, scale, shift, *others = inputs
    low = [t.detach().bfloat16() for t in (x,)] + [t.detach().float() for t in (mean, scale, shift)]
    low = [t.requires_grad_() for t in (*low, *(t.detach().bfloat16() for t in others))]
    # A slope near 1: where half precision turns a sign, little changes.
    value, expected = call_modulate(0.9, *low), call_modulate(0.9, *inputs)
    assert value.dtype == torch.bfloat16
    assert_near(value, expected, 0.03)
    upstream = rand(*value.shape, seed=20)
    gradients = torch.autograd.grad(value, low, upstream.bfloat16())
    for gradient, truth, tensor in zip(gradients, torch.autograd.grad(expected, inputs, upstream), low, strict=True):
        assert gradient.dtype == tensor.dtype
        assert_near(gradient, truth, 0.05)


@pytest.mark.parametrize(
    ("options", "message"), [({"bias": torch.ones(2)}, "bias needs a weight"), ({"slope": -1.0}, "not be negative")]
)
def test_modulate_errors(options, message):
    one = torch.ones(1, 1, 2)
    with pytest.raises(ValueError, match=message):
        modulate(torch.ones(1, 3, 2), Modulation(one, one, one), **options)


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
def test_masked_statistics_equal_the_loop(garbage, unbiased, walk):
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


@pytest.mark.parametrize("kind", NORMS)
@pytest.mark.parametrize("fill", [0.0, math.nan])
def test_a_batch_without_a_real_vertex_moves_nothing(kind, fill):
    norm = make_any(kind).train()
    norm(rand(2, 5, C), rand(2, 5, D, seed=1), mask=scattered_mask([3, 5], 5))  # running statistics other than 0 and 1
    before = {name: value.clone() for name, value in norm.named_buffers()}
    x, cond = (torch.full((2, 5, c), fill, dtype=torch.float64, requires_grad=True) for c in (C, D))
    y = norm(x, cond, mask=torch.zeros(2, 5, dtype=torch.bool))
    y.sum().backward()
    assert not y.any() and not x.grad.any() and not cond.grad.any()
    assert all(p.grad is None or not p.grad.any() for p in norm.parameters())
    assert all(torch.equal(value, before[name]) for name, value in norm.named_buffers())


@pytest.mark.parametrize(("dtype", "gate"), [(torch.float16, "sigmoid"), (torch.bfloat16, None)], ids=str)
def test_elain_bears_large_features_in_half_precision(dtype, gate):
    """Ungated, the result grows with the square of the features: too large for float16 is what float32 gives."""
    norm = ElaIN(C, D, gate=gate)
    x, cond = 1000 * (rand(2, 40, C) + 1), rand(2, 40, D, seed=1)
    results = []
    for kind in (torch.float32, dtype):
        norm = norm.to(kind)
        leaves = [t.to(dtype).to(kind).requires_grad_() for t in (x, cond)]
        norm.zero_grad()
        y = norm(*leaves)
        y.backward(torch.full_like(y, 1e-3))
        results.append([y, *(leaf.grad for leaf in leaves), *(p.grad for p in norm.parameters())])
    assert (results[0][0].abs().amax() > 65504) == (gate is None)
    assert all(value.isfinite().all() for value in results[1])
    assert_near(results[1][0].float(), results[0][0], 0.02)


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
        ((4, 3), None, r"x must have shape \(B, N, C\), got \(4, 3\); add the batch"),
        ((1, 0, 3), None, "at least one vertex"),
        ((1, 4, 3), (1, 3), r"mask must have shape \(1, 4\) .* got \(1, 3\)"),
    ],
)
def test_statistics_errors(shape, mask, message):
    with pytest.raises(ValueError, match=message):
        instance_statistics(torch.ones(shape), mask=None if mask is None else torch.ones(mask, dtype=torch.bool))


def test_statistics_in_tiles_and_second_derivatives(monkeypatch):
    mask = torch.tensor([[True] * 5, [True, False, True, True, False]])
    for rows in (2, 5):
        monkeypatch.setattr(_tiles, "ROWS", rows)
        x = rand(2, 5, 2).requires_grad_()
        for given in (None, mask):
            assert gradcheck(lambda x, given=given: instance_statistics(x, mask=given), x)
            assert gradgradcheck(lambda x, given=given: instance_statistics(x, mask=given), x)


def test_statistics_under_vmap():
    x = rand(3, 2, 5, 2)
    mean, std = torch.vmap(instance_statistics)(x)
    for b in range(3):
        for value, expected in zip((mean[b], std[b]), instance_statistics(x[b]), strict=True):
            assert_near(value, expected, 1e-14)


@pytest.mark.parametrize("name", ["instance_norm", "adain", "spadain", "elain"])
def test_padding_of_functional_forms_reaches_no_gradient(name):
    x = rand(2, 6, 3)
    x[1, 4:] = float("nan")
    x.requires_grad_()
    mask = torch.tensor([[True] * 6, [True] * 4 + [False] * 2])
    beside = rand(2, 6, 3, seed=1)
    calls = {
        "instance_norm": lambda: norms.instance_norm(x, mask=mask),
        "adain": lambda: norms.adain(x, beside, mask=mask),
        "spadain": lambda: norms.spadain(x, beside, beside, mask=mask),
        "elain": lambda: norms.elain(x, beside, beside, weight=torch.full((1, 1, 3), 0.3).double(), mask=mask),
    }
    (gradient,) = torch.autograd.grad(calls[name]().square().sum(), x)
    assert gradient[mask].isfinite().all() and not gradient[~mask].any()


def test_condition_in_another_dtype_is_converted():
    for make in (ElaIN, SPAdaIN, AdaIN, SoftAdaIN, SPADE):
        norm = make(4, 5).eval()
        x, cond = rand(1, 7, 4).float(), rand(1, 7, 5, seed=1)
        assert_near(norm(x, cond), norm(x, cond.float()), 1e-6)
