"""SetConv and its extractor against literal transcriptions, one sample at a time."""

import literal_setconv
import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from torch import Tensor, nn
from torch.autograd import gradcheck

from meshkit.neighbors import knn
from meshkit.nn import SetConv, SetConvExtractor, _edge_mlp

K = 5


def randomise(module: nn.Module, seed: int = 100) -> nn.Module:
    """Every parameter drawn anew: scales of either sign and shifts away from zero."""
    for i, parameter in enumerate(module.parameters()):
        parameter.data = rand(*parameter.shape, seed=seed + i, dtype=parameter.dtype)
    return module


def setconv_literally(conv: SetConv, x: Tensor, positions: Tensor, nearest: Tensor) -> Tensor:
    """One sample: x (N, C), positions (N, 3), nearest (N, k)."""
    return literal_setconv.setconv_literally(conv, x[None], positions[None], nearest[None])[0]


def argsort_knn(points: Tensor, k: int) -> Tensor:
    return literal_setconv.argsort_knn(points[None], k)[0]


def extractor_literally(extractor: SetConvExtractor, positions: Tensor, descriptors: Tensor | None = None) -> Tensor:
    given = None if descriptors is None else descriptors[None]
    return literal_setconv.extractor_literally(extractor, positions[None], given)[0]


@pytest.fixture(params=[_edge_mlp._CPU_BLOCK, 90, None], ids=["one-block", "many-blocks", "samples-together"])
def block(request, monkeypatch) -> None:
    """How the rows are gone through; samples go together on devices other than the CPU."""
    if request.param is None:
        monkeypatch.setattr(_edge_mlp, "launch_bound", lambda x: True)
    else:
        monkeypatch.setattr(_edge_mlp, "_CPU_BLOCK", request.param)


recompute = pytest.mark.parametrize("recompute", [False, True], ids=["kept", "recomputed"])


def gradients(value: Tensor, inputs: list[Tensor]) -> tuple[Tensor, ...]:
    return torch.autograd.grad(value, inputs, rand(*value.shape, seed=77, dtype=value.dtype), retain_graph=True)


# SetConv


@recompute
@pytest.mark.parametrize("channels", [1, 6])
@pytest.mark.parametrize("k", [1, 5, 12])
def test_setconv_equals_the_equations(k, channels, recompute, block):
    conv = randomise(SetConv(channels, 7, recompute=recompute).double())
    x, positions = rand(2, 12, channels).requires_grad_(), rand(2, 12, 3, seed=1)
    value = conv(x, positions, knn(positions, k))
    expected = torch.stack(
        [setconv_literally(conv, f, p, argsort_knn(p, k)) for f, p in zip(x, positions, strict=True)]
    )
    assert_near(value, expected, 1e-12)
    inputs = [x, *conv.parameters()]
    for gradient, truth in zip(gradients(value, inputs), gradients(expected, inputs), strict=True):
        assert_near(gradient, truth, 1e-10)


def test_setconv_in_float32_and_far_from_the_origin():
    """The split of the first map subtracts W p_i from W p_j: at 10 units from the origin, 4 digits must remain."""
    conv = randomise(SetConv(3, 8))
    points = 0.1 * rand(1, 60, 3, dtype=torch.float32)
    for offset, tol in ((0.0, 2e-5), (10.0, 2e-3)):
        moved = points + offset
        value = conv(moved, moved, knn(moved, K))
        assert value.dtype == torch.float32
        exact = moved[0].double()
        assert_near(value[0], setconv_literally(conv.double(), exact, exact, argsort_knn(exact, K)), tol)
        conv.float()


def test_setconv_slope():
    conv = randomise(SetConv(3, 4, slope=0.3).double())
    p = rand(1, 10, 3)
    assert_near(conv(p, p, knn(p, K))[0], setconv_literally(conv, p[0], p[0], argsort_knn(p[0], K)), 1e-12)
    with pytest.raises(ValueError, match=r"slope must not be negative.* got -0\.1"):
        SetConv(3, 4, slope=-0.1)


@recompute
def test_setconv_gradcheck(recompute):
    conv = randomise(SetConv(2, 3, recompute=recompute).double())
    positions = rand(2, 6, 3, seed=1)
    mask = torch.tensor([[True] * 6, [True, False, True, True, False, True]])
    neighbors = knn(positions, 3, mask=mask)
    assert gradcheck(lambda x: conv(x, positions, neighbors, mask=mask)[mask], rand(2, 6, 2).requires_grad_())


def test_relative_positions_carry_no_gradient():
    conv = SetConv(3, 4).double()
    x, positions = rand(1, 10, 3).requires_grad_(), rand(1, 10, 3, seed=1).requires_grad_()
    value = conv(x, positions, knn(positions, K)).sum()
    assert torch.autograd.grad(value, [x, positions], allow_unused=True)[1] is None


@recompute
def test_relative_positions_carry_their_gradient_where_it_is_asked_for(recompute):
    """By finite differences, of both arguments and in a padded batch; values stay as they are."""
    options = {"recompute": recompute, "relative_gradient": True}
    conv, mask = randomise(SetConv(2, 3, **options).double()), scattered_mask([8, 6], 9)
    x, positions = rand(2, 9, 2).requires_grad_(), rand(2, 9, 3, seed=1).requires_grad_()
    neighbors = knn(positions.detach(), K, mask=mask)
    assert torch.autograd.gradcheck(lambda a, b: conv(a, b, neighbors, mask=mask), (x, positions), fast_mode=True)
    (slope,) = torch.autograd.grad(conv(x, positions, neighbors, mask=mask).square().sum(), positions)
    assert slope[mask].abs().sum(1).min() > 0 and not slope[~mask].any()
    extractor = randomise(SetConvExtractor((4, 3), k=K, **options).double())
    plain = SetConvExtractor((4, 3), k=K, recompute=recompute).double()
    plain.load_state_dict(extractor.state_dict())
    verts = rand(1, 9, 3, seed=2).requires_grad_()
    assert torch.autograd.gradcheck(extractor, (verts,), fast_mode=True)
    assert torch.equal(extractor(verts), plain(verts))
    whole, half = (torch.autograd.grad(net(verts).square().sum(), verts)[0] for net in (extractor, plain))
    assert (whole - half).norm() > 0.1 * whole.norm()


@recompute
@pytest.mark.parametrize("garbage", GARBAGE)
def test_setconv_padded_batch_equals_the_loop(garbage, recompute, block):
    conv, sizes = randomise(SetConv(4, 6, recompute=recompute).double()), [8, 12, 5]
    xs = [rand(n, 4, seed=i).requires_grad_() for i, n in enumerate(sizes)]
    ps, mask = [rand(n, 3, seed=i + 9) for i, n in enumerate(sizes)], scattered_mask(sizes, 13)
    x, positions = scatter(xs, mask, garbage).requires_grad_(), scatter(ps, mask, 0.0)
    neighbors = knn(positions, K, mask=mask)
    value = conv(x, scatter(ps, mask, garbage), neighbors, mask=mask)
    expected = torch.cat([setconv_literally(conv, f, p, argsort_knn(p, K)) for f, p in zip(xs, ps, strict=True)])
    assert value.shape == (3, 13, 6)
    assert_near(value[mask], expected, 1e-12)
    parameters = list(conv.parameters())
    got, truths = gradients(value[mask], [x, *parameters]), gradients(expected, [*xs, *parameters])
    assert_near(got[0][mask], torch.cat(truths[:3]), 1e-10)
    assert (got[0][~mask] == 0).all()
    for gradient, truth in zip(got[1:], truths[3:], strict=True):
        assert_near(gradient, truth, 1e-10)


@recompute
@pytest.mark.parametrize("relative_gradient", [False, True])
def test_a_sample_without_real_vertices_is_zero_and_leaves_the_others_alone(recompute, relative_gradient):
    conv = randomise(SetConv(4, 6, recompute=recompute, relative_gradient=relative_gradient).double())
    x, p = rand(2, 12, 4).requires_grad_(), rand(2, 12, 3, seed=1).requires_grad_()
    neighbors, mask = knn(p, K), torch.tensor([[True], [False]]).expand(2, 12)
    value = conv(x, p, neighbors, mask=mask)
    alone = conv(x[:1], p[:1], neighbors[:1])
    assert_near(value[:1], alone, 1e-13)
    assert (value[1] == 0).all()
    wanted, upstream = [x, *conv.parameters(), *[p] * relative_gradient], rand(*value.shape, seed=2)
    truths = torch.autograd.grad(alone, wanted, upstream[:1])
    for gradient, truth in zip(torch.autograd.grad(value, wanted, upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-11)


def test_no_samples():
    extractor = SetConvExtractor((5, 6), k=K)
    empty = torch.zeros(0, 9, 3, requires_grad=True)
    for mask in (None, torch.ones(0, 9, dtype=torch.bool)):
        value = extractor(empty, mask=mask)
        assert value.shape == (0, 9, 6)
        assert all((gradient == 0).all() for gradient in gradients(value, [empty, *extractor.parameters()]))


def test_setconv_is_the_same_in_training_and_evaluation():
    """Statistics are those of the sample, never running ones, and do not mix the samples of a batch."""
    conv = randomise(SetConv(3, 4).double())
    p = rand(3, 10, 3)
    value = conv(p, p, knn(p, K))
    assert torch.equal(conv.eval()(p, p, knn(p, K)), value)
    assert_near(conv(p[:1], p[:1], knn(p[:1], K)), value[:1], 1e-13)


@recompute
def test_what_is_kept_for_the_backward(recompute):
    """One tensor of N k rows, or none."""
    conv, p, k = SetConv(3, 16, recompute=recompute), rand(2, 40, 3, dtype=torch.float32), 12
    kept: dict[int, int] = {}
    with torch.autograd.graph.saved_tensors_hooks(
        lambda t: kept.setdefault(t.data_ptr(), t.numel()) and t, lambda t: t
    ):
        conv(p, p, knn(p, k))
    rows = 2 * 40 * k
    assert [size for size in kept.values() if size >= rows * 3] == ([] if recompute else [rows * 16])


def test_statistics_far_from_zero():
    """Numbers near 100 with deviations near 1: the sum of their squares would lose the variance in float32."""
    conv, p = randomise(SetConv(3, 8)), rand(1, 60, 3, dtype=torch.float32)
    for shift in list(conv.shifts)[:2]:
        shift.data += 100
    value = conv(p, p, knn(p, K))
    exact = p[0].double()
    assert_near(value[0], setconv_literally(conv.double(), exact, exact, argsort_knn(exact, K)), 2e-3)


def test_coincident_vertices_share_the_gradient():
    conv = randomise(SetConv(3, 8).double())
    p = rand(1, 10, 3).repeat(1, 2, 1)
    x = p.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(conv(x, p, knn(p, 4)).square().sum(), x)
    assert_near(gradient[:, :10], gradient[:, 10:], 1e-10)
    assert gradient.abs().amax() > 1e-3


def test_channels_of_scale_zero_are_their_shift():
    conv, p = randomise(SetConv(3, 4).double()), rand(1, 10, 3)
    conv.scales[2].data.zero_()
    expected = nn.functional.leaky_relu(conv.shifts[2], 0.1).expand(1, 10, 4)
    assert_near(conv(p, p, knn(p, K)), expected, 1e-12)


def test_second_derivatives_are_refused():
    conv, p = SetConv(3, 4).double(), rand(1, 10, 3)
    x = p.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(conv(x, p, knn(p, K)).square().sum(), x, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_gradients_of_torch_func():
    conv, p = randomise(SetConv(3, 4).double()), rand(1, 10, 3)
    neighbors, parameters = knn(p, K), dict(conv.named_parameters())

    def loss(parameters: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(conv, parameters, (p, p, neighbors)).square().sum()

    got = torch.func.grad(loss)({name: value.detach() for name, value in parameters.items()})
    for name, truth in zip(parameters, torch.autograd.grad(loss(parameters), list(parameters.values())), strict=True):
        assert_near(got[name], truth, 1e-12)


def test_setconv_compiles_into_one_graph():
    conv, p = randomise(SetConv(3, 6).double()), rand(2, 12, 3)
    mask = scattered_mask([12, 8], 12)
    neighbors, inputs = knn(p, K, mask=mask), [p.clone().requires_grad_(), *conv.parameters()]
    compiled = torch.compile(conv, fullgraph=True, backend="aot_eager")
    results = [f(inputs[0], p, neighbors, mask=mask) for f in (compiled, conv)]
    assert_near(*results, 1e-13)
    for gradient, truth in zip(*(gradients(y, inputs) for y in results), strict=True):
        assert_near(gradient, truth, 1e-12)


def test_setconv_in_bfloat16():
    conv, p = SetConv(3, 8), rand(2, 60, 3, dtype=torch.float32)
    neighbors, exact = knn(p, 8), conv(p, p, knn(p, 8))
    low = conv.bfloat16()(p.bfloat16(), p.bfloat16(), neighbors)
    assert low.dtype == torch.bfloat16
    assert_near(low.float(), exact, 0.1)


# The extractor


@pytest.mark.parametrize("descriptors", [0, 2])
def test_extractor_equals_the_stack(descriptors):
    extractor = randomise(SetConvExtractor((5, 7, 9), k=K, descriptors=descriptors).double())
    positions = rand(2, 15, 3).requires_grad_()
    extra = rand(2, 15, descriptors, seed=1).requires_grad_() if descriptors else None
    value = extractor(positions, descriptors=extra)
    expected = torch.stack(
        [extractor_literally(extractor, positions[b], None if extra is None else extra[b]) for b in range(2)]
    )
    assert value.shape == (2, 15, 9)
    assert_near(value, expected, 1e-11)
    inputs = [positions, *([] if extra is None else [extra]), *extractor.parameters()]
    for gradient, truth in zip(gradients(value, inputs), gradients(expected, inputs), strict=True):
        assert_near(gradient, truth, 1e-9)


@pytest.mark.parametrize("descriptors", [0, 2])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_extractor_padded_batch_equals_the_loop(garbage, descriptors):
    extractor, sizes = randomise(SetConvExtractor((5, 6), k=K, descriptors=descriptors).double()), [9, 14, 5]
    meshes = [rand(n, 3, seed=i).requires_grad_() for i, n in enumerate(sizes)]
    extras = [rand(n, 2, seed=i + 9) for i, n in enumerate(sizes)] if descriptors else [None] * 3
    mask = scattered_mask(sizes, 16)
    positions = scatter(meshes, mask, garbage).requires_grad_()
    extra = scatter(extras, mask, garbage) if descriptors else None
    value = extractor(positions, descriptors=extra, mask=mask)[mask]
    expected = torch.cat([extractor_literally(extractor, m, e) for m, e in zip(meshes, extras, strict=True)])
    assert_near(value, expected, 1e-11)
    parameters = list(extractor.parameters())
    got, truths = gradients(value, [positions, *parameters]), gradients(expected, [*meshes, *parameters])
    assert_near(got[0][mask], torch.cat(truths[:3]), 1e-9)
    assert (got[0][~mask] == 0).all()
    for gradient, truth in zip(got[1:], truths[3:], strict=True):
        assert_near(gradient, truth, 1e-9)


def test_extractor_permutation_equivariance():
    extractor = randomise(SetConvExtractor((5, 6), k=K, descriptors=2).double())
    p, d, order = rand(1, 20, 3), rand(1, 20, 2, seed=1), torch.randperm(20)
    assert_near(extractor(p[:, order], descriptors=d[:, order]), extractor(p, descriptors=d)[:, order], 1e-11)


def test_extractor_does_not_see_translations():
    """The first instance norm removes the constant that a translation adds to W x."""
    extractor = randomise(SetConvExtractor((5, 6), k=K).double())
    p = rand(1, 20, 3)
    assert_near(extractor(p + torch.tensor([0.3, -2.0, 5.0])), extractor(p), 1e-11)


def test_extractor_takes_descriptors_of_another_dtype():
    extractor = randomise(SetConvExtractor((5,), k=K, descriptors=2))
    p, d = rand(1, 20, 3, dtype=torch.float32), rand(1, 20, 2, seed=1)
    assert torch.equal(extractor(p, descriptors=d), extractor(p, descriptors=d.float()))


def test_extractor_under_autocast():
    torch.manual_seed(0)
    extractor = SetConvExtractor((8, 8), k=K)
    p, mask = rand(2, 30, 3, dtype=torch.float32), scattered_mask([30, 20], 30)
    exact = extractor(p, mask=mask)
    with torch.autocast("cpu", torch.bfloat16):
        value = extractor(p, mask=mask)
    assert_near(value.float(), exact, 0.1)
    inputs = list(extractor.parameters())
    got, truths = (torch.autograd.grad(y.float().square().mean(), inputs) for y in (value, exact))
    difference = sum(((a - b) ** 2).sum() for a, b in zip(got, truths, strict=True))
    assert difference < 0.2**2 * sum((b**2).sum() for b in truths)


@pytest.mark.parametrize(
    ("options", "num", "given", "message"),
    [
        ({"k": 6}, 5, None, "k=6 neighbours .* smallest mesh of the batch has 5 vertices"),
        (
            {"k": 3, "descriptors": 2},
            5,
            None,
            "takes 2 descriptor channels, got 0: compute them with .*intrinsic",
        ),
        ({"k": 3, "descriptors": 2}, 5, (1, 5, 3), "takes 2 descriptor channels, got 3$"),
        ({"k": 3}, 5, (1, 5, 1), "takes 0 descriptor channels, got 1$"),
    ],
)
def test_extractor_errors(options, num, given, message):
    extractor = SetConvExtractor((4,), **options)
    with pytest.raises(ValueError, match=message):
        extractor(rand(1, num, 3, dtype=torch.float32), descriptors=None if given is None else torch.ones(given))


def test_extractor_error_counts_real_vertices():
    mask = torch.tensor([[True] * 6, [True] * 3 + [False] * 3])
    with pytest.raises(ValueError, match="has 3 vertices"):
        SetConvExtractor((4,), k=4)(rand(2, 6, 3, dtype=torch.float32), mask=mask)


def test_extractor_wants_coordinates():
    with pytest.raises(ValueError, match=r"positions must have shape \(B, N, 3\), got \(1, 20, 6\)"):
        SetConvExtractor((4,), k=4)(torch.randn(1, 20, 6))


def test_moments_of_the_graph_stay_in_float32_under_autocast():
    """In float16 the covariance of positions in centimetres would overflow."""
    positions = 50 * rand(1, 60, 3).float()
    conv = SetConv(3, 4)
    neighbors = knn(positions, 6)
    with torch.autocast("cpu", torch.float16):
        value = conv(positions, positions, neighbors)
    assert_near(value.float(), conv(positions, positions, neighbors), 2e-2)


POINTS = torch.linspace(-1, 1, 2 * 12 * 3).view(2, 12, 3)
NEAR = knn(POINTS, 4)


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda e, c: e(POINTS.numpy()), TypeError, r"positions must be a tensor \(B, N, 3\), got ndarray; convert it"),
        (lambda e, c: e(POINTS[0]), ValueError, r"got \(12, 3\); add the batch dimension with positions\[None\]"),
        (lambda e, c: e(POINTS.mT), ValueError, r"got \(2, 3, 12\); transpose them with positions.mT"),
        (
            lambda e, c: e(POINTS.double()),
            TypeError,
            r"positions is torch.float64, but the parameters",
        ),
        (lambda e, c: e(POINTS, mask=torch.ones(2, 11).bool()), ValueError, r"mask must have shape \(2, 12\)"),
        (lambda e, c: e(POINTS, descriptors=torch.ones(2, 11, 2)), ValueError, "must agree in B and N"),
        (lambda e, c: c(None, POINTS, NEAR), TypeError, r"x must be a tensor \(B, N, C\), got None"),
        (lambda e, c: c(POINTS.half(), POINTS, NEAR), TypeError, "x is torch.float16, but"),
        (lambda e, c: c(POINTS[..., :2], POINTS, NEAR), ValueError, "expected x with 3 channels"),
        (lambda e, c: c(POINTS, POINTS, NEAR.int()), TypeError, "neighbors must be int64 indices, .* got torch.int32"),
        (lambda e, c: c(POINTS, POINTS, NEAR[0]), ValueError, r"neighbors must have shape \(B, N, k\), got \(12, 4\)"),
        (lambda e, c: c(POINTS, POINTS[:1], NEAR), ValueError, "x, positions and neighbors must agree in B and N"),
        (lambda e, c: SetConvExtractor(()), ValueError, r"widths must be at least one positive .*got \(\)"),
        (lambda e, c: SetConv(0, 3), ValueError, "in_features must be a whole number, at least 1, got 0"),
    ],
)
def test_set_convolutions_name_what_does_not_fit(call, kind, message):
    with pytest.raises(kind, match=message):
        call(SetConvExtractor((4,), k=4), SetConv(3, 4))
