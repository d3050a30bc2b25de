"""SetConv, its extractor and the residual block against literal transcriptions, one sample at a time."""

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from torch import Tensor, nn
from torch.autograd import gradcheck

from meshkit.neighbors import knn
from meshkit.nn import ConditionalResBlock, SetConv, SetConvExtractor
from meshkit.norm import ElaIN

K = 5


def randomise(module: nn.Module, seed: int = 100) -> nn.Module:
    """Every parameter drawn anew: scales of either sign and shifts away from zero."""
    for i, parameter in enumerate(module.parameters()):
        parameter.data = rand(*parameter.shape, seed=seed + i, dtype=parameter.dtype)
    return module


def setconv_literally(conv: SetConv, x: Tensor, positions: Tensor, nearest: Tensor, slope: float = 0.1) -> Tensor:
    """x (N, C), positions (N, 3), nearest (N, k): concatenate, then three times linear, norm over (N, k), LeakyReLU."""
    relative = (positions[nearest] - positions[:, None]).detach()
    h = torch.cat([x[nearest], relative], 2)
    for linear, scale, shift in zip(conv.linears, conv.scales, conv.shifts, strict=True):
        h = torch.einsum("oc,nkc->nko", linear.weight, h)
        mean = h.mean((0, 1))
        variance = ((h - mean) ** 2).mean((0, 1))  # biased, over vertices and neighbours
        h = scale * (h - mean) / (variance + 1e-5) ** 0.5 + shift
        h = torch.where(h > 0, h, slope * h)
    return h.max(1).values


def argsort_knn(points: Tensor, k: int) -> Tensor:
    return torch.cdist(points, points).argsort(1)[:, :k]


def extractor_literally(extractor: SetConvExtractor, positions: Tensor, descriptors: Tensor | None = None) -> Tensor:
    nearest = argsort_knn(positions.detach(), extractor.k)
    x = positions if descriptors is None else torch.cat([positions, descriptors], 1)
    for conv in extractor.convs:
        x = setconv_literally(conv, x, positions, nearest)
    return x


def gradients(value: Tensor, inputs: list[Tensor]) -> tuple[Tensor, ...]:
    return torch.autograd.grad(value, inputs, rand(*value.shape, seed=77, dtype=value.dtype), retain_graph=True)


# SetConv


@pytest.mark.parametrize("channels", [1, 3, 6])
@pytest.mark.parametrize("k", [1, 5, 12])
def test_setconv_equals_the_equations(k, channels):
    conv = randomise(SetConv(channels, 7).double())
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
    assert_near(conv(p, p, knn(p, K))[0], setconv_literally(conv, p[0], p[0], argsort_knn(p[0], K), slope=0.3), 1e-12)


def test_setconv_gradcheck():
    conv = randomise(SetConv(2, 3).double())
    positions = rand(2, 6, 3, seed=1)
    mask = torch.tensor([[True] * 6, [True, False, True, True, False, True]])
    neighbors = knn(positions, 3, mask=mask)
    assert gradcheck(lambda x: conv(x, positions, neighbors, mask=mask)[mask], rand(2, 6, 2).requires_grad_())


def test_relative_positions_carry_no_gradient():
    conv = SetConv(3, 4).double()
    x, positions = rand(1, 10, 3).requires_grad_(), rand(1, 10, 3, seed=1).requires_grad_()
    value = conv(x, positions, knn(positions, K)).sum()
    assert torch.autograd.grad(value, [x, positions], allow_unused=True)[1] is None


@pytest.mark.parametrize("garbage", GARBAGE)
def test_setconv_padded_batch_equals_the_loop(garbage):
    conv, sizes = randomise(SetConv(4, 6).double()), [8, 12, 5]
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


def test_setconv_is_the_same_in_training_and_evaluation():
    """Statistics are those of the sample, never running ones, and do not mix the samples of a batch."""
    conv = randomise(SetConv(3, 4).double())
    p = rand(3, 10, 3)
    value = conv(p, p, knn(p, K))
    assert torch.equal(conv.eval()(p, p, knn(p, K)), value)
    assert_near(conv(p[:1], p[:1], knn(p[:1], K)), value[:1], 1e-13)


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
    extractor = SetConvExtractor((8, 8), k=K)
    p, mask = rand(2, 30, 3, dtype=torch.float32), scattered_mask([30, 20], 30)
    exact = extractor(p, mask=mask)
    with torch.autocast("cpu", torch.bfloat16):
        value = extractor(p, mask=mask)
    assert_near(value.float(), exact, 0.1)


@pytest.mark.parametrize(
    ("options", "num", "given", "message"),
    [
        ({"k": 6}, 5, None, "k=6 neighbours .* smallest mesh of the batch has 5 vertices"),
        ({"k": 3, "descriptors": 2}, 5, None, "takes 2 descriptor channels, got 0: compute them with .*wave_kernel"),
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


# The residual block

C, D = 5, 4


def make_block(spectral: bool, **options) -> ConditionalResBlock:
    block = ConditionalResBlock(C, D, spectral=spectral, **options).double()
    for i, parameter in enumerate(block.parameters()):
        parameter.data = 0.4 * rand(*parameter.shape, seed=i)
    for _ in range(50):  # settle the power iterations on the new weights
        block(rand(1, 3, C), rand(1, 3, D))
    return block.eval()


def block_literally(block: ConditionalResBlock, x: Tensor, cond: Tensor, slope: float = 0.2) -> Tensor:
    """Each norm finds its own statistics; x (N, C), cond (N, D)."""

    def act(h: Tensor) -> Tensor:
        return torch.where(h > 0, h, slope * h)

    x, cond = x[None], cond[None]
    inner = act(block.norm_0(x, cond)) @ block.conv_0.weight.T + block.conv_0.bias
    residual = act(block.norm_1(inner, cond)) @ block.conv_1.weight.T + block.conv_1.bias
    return (act(block.norm_s(x, cond)) @ block.conv_s.weight.T + residual)[0]


@pytest.mark.parametrize("spectral", [True, False])
def test_block_equals_the_equation_without_shared_statistics(spectral):
    block = make_block(spectral)
    x, cond = rand(2, 9, C).requires_grad_(), rand(2, 9, D, seed=1).requires_grad_()
    value = block(x, cond)
    expected = torch.stack([block_literally(block, a, c) for a, c in zip(x, cond, strict=True)])
    assert_near(value, expected, 1e-12)
    inputs = [x, cond, *block.parameters()]
    for gradient, truth in zip(gradients(value, inputs), gradients(expected, inputs), strict=True):
        assert_near(gradient, truth, 1e-10)


@pytest.mark.parametrize("garbage", GARBAGE)
def test_block_padded_batch_equals_the_loop(garbage):
    block, sizes = make_block(True), [6, 9, 1]
    xs, cs = ([rand(n, c, seed=i + s).requires_grad_() for i, n in enumerate(sizes)] for c, s in ((C, 0), (D, 9)))
    mask = scattered_mask(sizes, 11)
    x, cond = (scatter(samples, mask, garbage).requires_grad_() for samples in (xs, cs))
    value = block(x, cond, mask=mask)[mask]
    expected = torch.cat([block_literally(block, a, c) for a, c in zip(xs, cs, strict=True)])
    assert_near(value, expected, 1e-12)
    parameters = list(block.parameters())
    got, truths = gradients(value, [x, cond, *parameters]), gradients(expected, [*xs, *cs, *parameters])
    for gradient, samples in zip(got[:2], (truths[:3], truths[3:6]), strict=True):
        assert_near(gradient[mask], torch.cat(samples), 1e-10)
        assert (gradient[~mask] == 0).all()
    for gradient, truth in zip(got[2:], truths[6:], strict=True):
        assert_near(gradient, truth, 1e-10)


def test_block_gradcheck():
    block = make_block(True)
    mask = torch.tensor([[True] * 4, [True, False, True, True]])
    leaves = [rand(2, 4, C).requires_grad_(), rand(2, 4, D, seed=1).requires_grad_()]
    assert gradcheck(lambda x, cond: block(x, cond, mask=mask)[mask], leaves)


def test_block_slope_and_variant_of_the_norm():
    block = make_block(False, slope=0.05, norm=lambda c, d: ElaIN(c, d, variant="paper"))
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert {norm.variant for norm in (block.norm_0, block.norm_1, block.norm_s)} == {"paper"}
    assert_near(block(x, cond)[0], block_literally(block, x[0], cond[0], slope=0.05), 1e-12)


class ShiftByCondition(nn.Module):
    """The plainest conditional norm: it has no statistics to share."""

    def __init__(self, num_features: int, cond_features: int) -> None:
        super().__init__()
        self.map = nn.Linear(cond_features, num_features)

    def forward(self, x: Tensor, cond: Tensor, *, mask: Tensor | None = None) -> Tensor:
        return x + self.map(cond)


def test_block_takes_any_norm():
    block = make_block(False, norm=ShiftByCondition)
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert_near(block(x, cond)[0], block_literally(block, x[0], cond[0]), 1e-12)


def test_spectral_normalisation():
    plain, normed = make_block(False), make_block(True)
    for name in ("conv_0", "conv_1", "conv_s"):
        weight = getattr(normed, name).parametrizations.weight.original
        assert_near(getattr(normed, name).weight, weight / torch.linalg.matrix_norm(weight, 2), 1e-6)
        assert isinstance(getattr(plain, name).weight, nn.Parameter)
    assert normed.conv_s.bias is None and normed.conv_0.bias is not None
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert torch.equal(normed(x, cond), normed(x, cond))  # no power iteration in evaluation


def test_block_permutation_equivariance():
    block, order = make_block(True), torch.randperm(9)
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert_near(block(x[:, order], cond[:, order]), block(x, cond)[:, order], 1e-12)
