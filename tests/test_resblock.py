"""The residual block and the pose-transfer stack against literal transcriptions; spectral normalisation."""

import copy
from collections.abc import Sequence

import literal
import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from torch import Tensor, nn
from torch.autograd import gradcheck
from torch.nn.utils.parametrizations import spectral_norm

from meshkit.models import PoseTransferStack
from meshkit.nn import ConditionalResBlock, settle_spectral_norm
from meshkit.norm import SPADE, AdaIN, ElaIN, SoftAdaIN, SPAdaIN

C, D = 5, 4
NORMS = [ElaIN, AdaIN, SoftAdaIN, SPAdaIN, SPADE]


def make_block(spectral: bool = True, **options) -> ConditionalResBlock:
    block = ConditionalResBlock(C, D, spectral=spectral, **options).double()
    for i, parameter in enumerate(block.parameters()):
        parameter.data = 0.4 * rand(*parameter.shape, seed=i)
    settle_spectral_norm(block, steps=50)
    return block.eval()


def block_literally(block: ConditionalResBlock, x: Tensor, cond: Tensor, slope: float = 0.2) -> Tensor:
    """Each norm finds its own statistics; x (N, C), cond (N, D)."""

    def act(h: Tensor) -> Tensor:
        return torch.where(h > 0, h, slope * h)

    x, cond = x[None], cond[None]
    inner = act(block.norm_0(x, cond)) @ block.conv_0.weight.T + block.conv_0.bias
    residual = act(block.norm_1(inner, cond)) @ block.conv_1.weight.T + block.conv_1.bias
    return (act(block.norm_s(x, cond)) @ block.conv_s.weight.T + residual)[0]


def gradients(value: Tensor, inputs: list[Tensor]) -> tuple[Tensor, ...]:
    return torch.autograd.grad(value, inputs, rand(*value.shape, seed=77, dtype=value.dtype), retain_graph=True)


def assert_gradients_near(gradients: Sequence[Tensor], truths: Sequence[Tensor], tol: float) -> None:
    """Each within ``tol`` of its own size, or of 1e-3 of the largest: biases before a norm have a zero gradient."""
    floor = 1e-3 * max(truth.abs().amax().item() for truth in truths)
    for gradient, truth in zip(gradients, truths, strict=True):
        assert_near(gradient, truth.reshape(gradient.shape), tol, scale=max(truth.abs().amax().item(), floor))


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("spectral", [True, False])
def test_block_equals_the_equation_without_shared_statistics(spectral, norm):
    block = make_block(spectral, norm=norm)
    x, cond = rand(2, 9, C).requires_grad_(), rand(2, 9, D, seed=1).requires_grad_()
    value = block(x, cond)
    expected = torch.stack([block_literally(block, a, c) for a, c in zip(x, cond, strict=True)])
    assert_near(value, expected, 1e-12)
    inputs = [x, cond, *block.parameters()]
    assert_gradients_near(gradients(value, inputs), gradients(expected, inputs), 1e-10)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("garbage", GARBAGE)
def test_block_padded_batch_equals_the_loop(garbage, norm):
    block, sizes = make_block(norm=norm), [6, 9, 1]
    xs, cs = ([rand(n, c, seed=i + s).requires_grad_() for i, n in enumerate(sizes)] for c, s in ((C, 0), (D, 9)))
    mask = scattered_mask(sizes, 11)
    x, cond = (scatter(samples, mask, garbage).requires_grad_() for samples in (xs, cs))
    y = block(x, cond, mask=mask, cond_mask=mask)
    assert (y[~mask] == 0).all()
    value, expected = y[mask], torch.cat([block_literally(block, a, c) for a, c in zip(xs, cs, strict=True)])
    assert_near(value, expected, 1e-12)
    parameters = list(block.parameters())
    got, truths = gradients(value, [x, cond, *parameters]), gradients(expected, [*xs, *cs, *parameters])
    for gradient, samples in zip(got[:2], (truths[:3], truths[3:6]), strict=True):
        assert_near(gradient[mask], torch.cat(samples), 1e-10)
        assert (gradient[~mask] == 0).all()
    assert_gradients_near(got[2:], truths[6:], 1e-10)


def test_block_condition_of_other_rows():
    """Under a norm by global statistics, the condition has rows and a mask of its own."""
    block, cond = make_block(norm=AdaIN), rand(2, 7, D, seed=1)
    x, cond_mask = rand(2, 9, C), scattered_mask([7, 3], 7)
    value = block(x, cond, cond_mask=cond_mask)
    assert_near(value[1], block(x[1:], cond[1:][cond_mask[1:]][None])[0], 1e-12)


@pytest.mark.parametrize("then", [None, 3])
def test_block_gradcheck(then):
    block = make_block()
    narrow = None if then is None else nn.Linear(C, then).double()
    mask = torch.tensor([[True] * 4, [True, False, True, True]])
    leaves = [rand(2, 4, C).requires_grad_(), rand(2, 4, D, seed=1).requires_grad_()]
    assert gradcheck(lambda x, cond: block(x, cond, mask=mask, then=narrow)[mask], leaves, fast_mode=True)


@pytest.mark.parametrize("norm", [ElaIN, SPADE])
def test_block_composes_the_following_map(norm):
    block, then = make_block(norm=norm), nn.Linear(C, 3).double()
    x, cond = rand(2, 9, C), rand(2, 9, D, seed=1)
    value, expected = block(x, cond, then=then), then(block(x, cond))
    assert_near(value, expected, 1e-12)
    inputs = [*block.parameters(), *then.parameters()]
    assert_gradients_near(gradients(value, inputs), gradients(expected, inputs), 1e-11)


def test_block_keeps_two_tensors_of_the_features_size():
    """For the backward pass: its input and what conv_0 gives; all else is computed again."""
    block, num = ConditionalResBlock(16, D), 4000
    x, cond, kept = rand(1, num, 16).float().requires_grad_(), rand(1, num, D).float(), {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        block(x, cond)
    assert sum(size >= x.numel() * 4 for size in kept.values()) == 2


def test_block_slope_and_variant_of_the_norm():
    block = make_block(False, slope=0.05, norm=lambda c, d: ElaIN(c, d, variant="paper"))
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert {norm.variant for norm in (block.norm_0, block.norm_1, block.norm_s)} == {"paper"}
    assert_near(block(x, cond)[0], block_literally(block, x[0], cond[0], slope=0.05), 1e-12)


def test_slope_must_not_be_negative():
    with pytest.raises(ValueError, match=r"slope must not be negative, got -0.1"):
        ConditionalResBlock(C, D, slope=-0.1)


class ShiftByCondition(nn.Module):
    """The plainest conditional norm: it has no statistics to share."""

    def __init__(self, num_features: int, cond_features: int) -> None:
        super().__init__()
        self.map = nn.Linear(cond_features, num_features)

    def forward(self, x: Tensor, cond: Tensor, *, mask: Tensor | None = None, cond_mask: Tensor | None = None):
        return x + self.map(cond)


def test_block_takes_any_norm():
    block = make_block(False, norm=ShiftByCondition)
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert_near(block(x, cond)[0], block_literally(block, x[0], cond[0]), 1e-12)


def test_running_statistics_of_both_norms_of_the_input_are_kept():
    block = make_block(norm=SPADE).train()
    block(rand(2, 9, C), rand(2, 9, D, seed=1))
    assert torch.equal(block.norm_0.running_mean, block.norm_s.running_mean)
    assert block.norm_0.running_mean.abs().amax() > 0


def test_block_permutation_equivariance():
    block, order = make_block(), torch.randperm(9)
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert_near(block(x[:, order], cond[:, order]), block(x, cond)[:, order], 1e-12)


# The stack


@pytest.mark.parametrize("spectral", [True, False])
def test_stack_equals_its_literal_transcription_in_single_precision(spectral):
    torch.manual_seed(0)
    stack = PoseTransferStack(16, (64, 32, 16), spectral=spectral)
    with torch.no_grad():
        stack.narrow[-1].weight /= 30  # away from the ends of tanh, where nothing can differ
    plain = literal.LiteralStack(16, (64, 32, 16), spectral=spectral).load(stack.state_dict())
    warped, cond = (rand(1, 700, c, seed=c, dtype=torch.float32).requires_grad_() for c in (3, 16))
    results = []
    for model in (stack.eval(), plain.eval()):
        value = model(warped, cond)
        inputs = [warped, cond, *model.parameters()]
        results.append((value, gradients(value, inputs)))
    (value, grads), (expected, truths) = results
    assert expected.abs().amax() < 1.9
    assert_near(value, expected, 1e-5)
    assert_gradients_near(grads, truths, 1e-4)


@pytest.mark.parametrize("norm", NORMS)
def test_stack_takes_any_norm(norm):
    stack = PoseTransferStack(D, (8, 6), norm=norm)
    assert isinstance(stack.blocks[1].norm_1, norm)
    assert stack(rand(1, 20, 3).float(), rand(1, 20, D).float()).shape == (1, 20, 3)


def test_stack_compiles_to_one_graph():
    torch._dynamo.reset()
    stack = PoseTransferStack(D, (6,)).double().eval()
    compiled = torch.compile(stack, backend="aot_eager", fullgraph=True)
    warped, cond = rand(2, 9, 3).requires_grad_(), rand(2, 9, D, seed=1).requires_grad_()
    mask, inputs = scattered_mask([9, 5], 9), [warped, cond, *stack.parameters()]
    value, expected = compiled(warped, cond, mask=mask), stack(warped, cond, mask=mask)
    assert_near(value, expected, 1e-12)
    assert_gradients_near(gradients(value, inputs), gradients(expected, inputs), 1e-10)


@pytest.mark.parametrize("norm", NORMS)
def test_padding_changes_nothing_under_autocast(norm):
    torch.manual_seed(0)
    stack = PoseTransferStack(D, (8, 6), norm=norm).eval()
    warped, cond = (rand(1, 40, c, seed=c, dtype=torch.float32) for c in (3, D))
    mask = torch.zeros(1, 60, dtype=torch.bool)
    mask[:, :40] = True
    padded = [torch.cat([t, torch.full((1, 20, t.shape[2]), 1e20)], 1) for t in (warped, cond)]
    with torch.autocast("cpu", torch.bfloat16):
        value, expected = stack(*padded, mask=mask)[:, :40], stack(warped, cond)
    assert_near(value, expected, 5e-3)


# Spectral normalisation


def test_spectral_normalisation():
    plain, normed = make_block(False), make_block(True)
    for name in ("conv_0", "conv_1", "conv_s"):
        weight = getattr(normed, name).parametrizations.weight.original
        assert_near(getattr(normed, name).weight, weight / torch.linalg.matrix_norm(weight, 2), 1e-6)
        assert isinstance(getattr(plain, name).weight, nn.Parameter)
    assert normed.conv_s.bias is None and normed.conv_0.bias is not None
    x, cond = rand(1, 9, C), rand(1, 9, D, seed=1)
    assert torch.equal(normed(x, cond), normed(x, cond))  # no power iteration in evaluation


def spectral_norms(block: ConditionalResBlock) -> list[float]:
    return [torch.linalg.matrix_norm(m.weight, 2).item() for m in (block.conv_0, block.conv_1, block.conv_s)]


@pytest.mark.parametrize("width", [16, 64, 256, 512])
def test_evaluation_before_training(width):
    torch.manual_seed(width)
    block = ConditionalResBlock(width, D).eval()
    assert all(0.999 < s < 1.03 for s in spectral_norms(block)), spectral_norms(block)
    block.reset_parameters()
    assert not block.training and all(0.999 < s < 1.03 for s in spectral_norms(block)), spectral_norms(block)
    other = ConditionalResBlock(width, D).eval()
    other.load_state_dict(block.state_dict())
    assert spectral_norms(other) == spectral_norms(block)


def test_reset_parameters_draws_anew():
    for spectral in (True, False):
        block = make_block(spectral)
        before = block.conv_0.weight.clone()
        block.reset_parameters()
        assert (block.conv_0.weight - before).abs().amax() > 0.05 and (block.conv_0.bias == 0).all()


def test_settling_repairs_weights_written_from_elsewhere():
    layer = spectral_norm(nn.Linear(64, 64)).eval()
    nn.init.normal_(layer.parametrizations.weight.original)
    assert torch.linalg.matrix_norm(layer.weight, 2) > 2
    settle_spectral_norm(layer)
    assert torch.linalg.matrix_norm(layer.weight, 2) < 1.05 and not layer.training


def test_two_forwards_before_one_backward():
    """Each forward in training moves the singular vectors; the first one's graph must keep its own."""
    block = make_block().train()
    x, cond = rand(2, 2, 9, C), rand(2, 2, 9, D, seed=1)
    twin = copy.deepcopy(block)
    sum(block(a, c).square().sum() for a, c in zip(x, cond, strict=True)).backward()
    for a, c in zip(x, cond, strict=True):  # one after the other accumulates the same
        twin(a, c).square().sum().backward()
    assert_gradients_near([p.grad for p in block.parameters()], [p.grad for p in twin.parameters()], 1e-12)


def test_two_forwards_under_distributed_data_parallel(tmp_path):
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        block = make_block().train()
        twin = copy.deepcopy(block)
        parallel = nn.parallel.DistributedDataParallel(block)
        x, cond = rand(2, 2, 9, C), rand(2, 2, 9, D, seed=1)
        for model in (parallel, twin):
            sum(model(a, c).square().sum() for a, c in zip(x, cond, strict=True)).backward()
        assert_gradients_near([p.grad for p in block.parameters()], [p.grad for p in twin.parameters()], 1e-12)
    finally:
        torch.distributed.destroy_process_group()


@pytest.mark.parametrize("norm", ["elain", SPAdaIN(C, D)])
def test_norm_must_be_a_factory(norm):
    with pytest.raises(ValueError, match=r"called as norm\(num_features, cond_features\)"):
        ConditionalResBlock(C, D, norm=norm)


class WithoutCondMask(torch.nn.Module):
    def forward(self, x, cond, *, mask=None):
        return x


@pytest.mark.parametrize(
    ("norm", "message"),
    [
        (
            lambda c, d: WithoutCondMask(),
            r"called as norm\(x, cond, mask=mask, .*, but WithoutCondMask",
        ),
        (lambda c, d: torch.nn.LayerNorm(c), r"LayerNorm has forward\(input"),
        (lambda c, d: c, r"must give a torch.nn.Module, got int"),
    ],
)
def test_a_norm_of_another_signature_is_named_at_construction(norm, message):
    with pytest.raises(TypeError, match=message):
        ConditionalResBlock(3, 4, norm=norm)


def test_a_linear_map_that_does_not_fit_is_named():
    with pytest.raises(ValueError, match="then must take the 3 channels of the block, it takes 5"):
        ConditionalResBlock(3, 4)(torch.ones(1, 5, 3), torch.ones(1, 5, 4), then=torch.nn.Linear(5, 2))
