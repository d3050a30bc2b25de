"""The generator against a composition of its parts written out, its symmetries, and checkpoints."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from safetensors.torch import save_file
from torch import Tensor, nn

from meshkit.consistency import DualReconstruction
from meshkit.losses import backward_correspondence_loss
from meshkit.models import (
    NPT,
    GeneratorConfig,
    GeneratorOutput,
    OrderedPoseTransferStack,
    PointwiseExtractor,
    PoseTransferGenerator,
    PoseTransferStack,
    corenet3d,
    export_onnx,
    load_generator,
    npt,
    xdualnet,
)

SIZES = {"extractor_widths": (5, 6), "k": 4, "widths": (8, 7)}


def make(**options) -> PoseTransferGenerator:
    """A small float64 generator in evaluation mode whose output is far from zero."""
    torch.manual_seed(0)
    net = PoseTransferGenerator(**{**SIZES, **options}).double()
    last = net.transfer.narrow[-1]
    last.weight.data = rand(*last.weight.shape)
    return net.eval()


def forward_literally(net: PoseTransferGenerator, identity: Tensor, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One pair (N, 3), (M, 3): match, warp and refine, step by step; returns vertices, warped mesh and plan."""
    f_id, f_pose = net.encode(identity[None])[0], net.encode(pose[None])[0]
    cosine = nn.functional.normalize(f_id, dim=1) @ nn.functional.normalize(f_pose, dim=1).T
    kernel = torch.exp(-(1 - cosine) / 0.03)
    a = torch.full((len(identity),), 1 / len(identity), dtype=kernel.dtype)
    for _ in range(5):
        b = 1 / len(pose) / (kernel.T @ a)
        a = 1 / len(identity) / (kernel @ b)
    plan = a[:, None] * kernel * b
    warped = plan / plan.sum(1, keepdim=True) @ pose
    x = net.transfer.mix(net.transfer.lift(warped[None]))
    for block, narrow in zip(net.transfer.blocks, net.transfer.narrow, strict=True):
        x = narrow(block(x, f_id[None]))
    return 2 * torch.tanh(x[0]), warped, plan


# The forward pass


def test_generator_equals_its_parts():
    net, identity, pose = make(), rand(2, 12, 3), rand(2, 17, 3, seed=1)
    result = net(identity, pose)
    assert isinstance(result, GeneratorOutput)
    assert result.vertices.shape == result.warped.shape == (2, 12, 3) and result.plan.shape == (2, 12, 17)
    for b in range(2):
        for value, expected in zip(
            (result.vertices[b], result.warped[b], result.plan.dense()[b]),
            forward_literally(net, identity[b], pose[b]),
            strict=True,
        ):
            assert_near(value, expected, 1e-10)


def test_eps_and_iterations_reach_the_matching():
    identity, pose = rand(1, 12, 3), rand(1, 17, 3, seed=1)
    plans = [make(**o)(identity, pose).plan.dense() for o in ({}, {"eps": 0.1}, {"n_iters": 1})]
    for plan in plans[1:]:
        assert (plan - plans[0]).abs().amax() > 1e-4


def test_residual_adds_the_warped_mesh():
    plain, residual = make(), make(residual=True)
    residual.load_state_dict(plain.state_dict())
    identity, pose = rand(1, 12, 3), rand(1, 17, 3, seed=1)
    expected, result = plain(identity, pose), residual(identity, pose)
    assert_near(result.vertices, expected.vertices + expected.warped, 1e-12)


def test_raw_plan_shrinks_the_warped_mesh_by_the_number_of_vertices():
    normalised, raw = make(), make(normalize_plan=False)
    raw.load_state_dict(normalised.state_dict())
    identity, pose = rand(1, 12, 3), rand(1, 17, 3, seed=1)
    result = raw(identity, pose)
    assert_near(12 * result.warped, normalised(identity, pose).warped, 1e-12)
    assert_near(result.warped, result.plan.dense() @ pose, 1e-12)


def test_output_stays_within_two_units():
    net = make()
    net.transfer.narrow[-1].bias.data.fill_(100)
    assert_near(net(rand(1, 12, 3), rand(1, 9, 3)).vertices, torch.full((1, 12, 3), 2.0), 1e-6)


def test_stack_lifts_by_one_map():
    """The composed 3 -> w_0 map against the two maps one after the other."""
    stack = PoseTransferStack(4, (6,), spectral=False).double()
    warped, features = rand(2, 9, 3), rand(2, 9, 4, seed=1)
    x = stack.narrow[0](stack.blocks[0](stack.mix(stack.lift(warped)), features))
    assert_near(stack(warped, features), 2 * x.tanh(), 1e-12)


# Symmetries and padding


def test_permuting_the_identity_permutes_the_output():
    net, identity, pose, order = make(), rand(1, 12, 3), rand(1, 17, 3, seed=1), torch.randperm(12)
    expected, result = net(identity, pose), net(identity[:, order], pose)
    assert_near(result.vertices, expected.vertices[:, order], 1e-10)
    assert_near(result.warped, expected.warped[:, order], 1e-10)


def test_permuting_the_pose_changes_the_columns_of_the_plan_alone():
    net, identity, pose, order = make(), rand(1, 12, 3), rand(1, 17, 3, seed=1), torch.randperm(17)
    expected, result = net(identity, pose), net(identity, pose[:, order])
    assert_near(result.vertices, expected.vertices, 1e-10)
    assert_near(result.warped, expected.warped, 1e-10)
    assert_near(result.plan.dense(), expected.plan.dense()[:, :, order], 1e-10)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"descriptors": 2, "residual": True},
        {"descriptors": 2, "condition": "descriptors"},
        {"normalize_plan": False},
        {"extractor": "pointwise", "extractor_blocks": 2, "eps": 0.3},
        {"extractor": "pointwise", "extractor_blocks": 1, "eps": 0.3, "descriptors": 2},
        {"released": True, "residual": True},
    ],
)
@pytest.mark.parametrize("garbage", GARBAGE)
def test_padded_batch_equals_the_loop(garbage, options):
    net, id_sizes, pose_sizes = make(**options), [8, 11], [9, 6]
    ids, poses = [rand(n, 3, seed=n) for n in id_sizes], [rand(n, 3, seed=n + 50) for n in pose_sizes]
    id_mask, pose_mask = scattered_mask(id_sizes, 13), scattered_mask(pose_sizes, 10, seed=1)
    identity, pose = (scatter(s, m, garbage).requires_grad_() for s, m in ((ids, id_mask), (poses, pose_mask)))
    extras = [{}, {}]
    padded: dict[str, Tensor] = {}
    if "descriptors" in options:
        id_d, pose_d = [rand(n, 2, seed=n) for n in id_sizes], [rand(n, 2, seed=n) for n in pose_sizes]
        extras = [
            {"identity_descriptors": i[None], "pose_descriptors": p[None]} for i, p in zip(id_d, pose_d, strict=True)
        ]
        padded = {
            "identity_descriptors": scatter(id_d, id_mask, garbage),
            "pose_descriptors": scatter(pose_d, pose_mask, garbage),
        }
    result = net(identity, pose, identity_mask=id_mask, pose_mask=pose_mask, **padded)
    leaves = [[m.clone().requires_grad_() for m in meshes] for meshes in (ids, poses)]
    singles = [net(i[None], p[None], **e) for i, p, e in zip(*leaves, extras, strict=True)]
    assert_near(result.vertices[id_mask], torch.cat([s.vertices[0] for s in singles]), 1e-10)
    assert_near(result.warped[id_mask], torch.cat([s.warped[0] for s in singles]), 1e-10)
    assert (result.vertices[~id_mask] == 0).all()
    parameters = list(net.parameters())
    upstream = rand(19, 3, seed=99)
    got = torch.autograd.grad(result.vertices[id_mask], [identity, pose, *parameters], upstream)
    total = torch.cat([s.vertices[0] for s in singles])
    truths = torch.autograd.grad(total, [*leaves[0], *leaves[1], *parameters], upstream)
    for gradient, mask, truth in zip(got[:2], (id_mask, pose_mask), (truths[:2], truths[2:4]), strict=True):
        assert_near(gradient[mask], torch.cat(truth), 1e-8)
        assert (gradient[~mask] == 0).all()
    for gradient, truth in zip(got[2:], truths[4:], strict=True):
        assert_near(gradient, truth, 1e-8, scale=max(1.0, truth.abs().amax().item()))


# Features once, descriptors


@pytest.mark.parametrize("descriptors", [0, 2])
def test_given_features_replace_the_encoder(descriptors, monkeypatch):
    net, identity, pose = make(descriptors=descriptors), rand(1, 12, 3), rand(1, 17, 3, seed=1)
    d_id, d_pose = (rand(1, n, 2, seed=n) if descriptors else None for n in (12, 17))
    expected = net(identity, pose, identity_descriptors=d_id, pose_descriptors=d_pose)
    f_id, f_pose = net.encode(identity, descriptors=d_id), net.encode(pose, descriptors=d_pose)
    for given in ({"identity_features": f_id}, {"pose_features": f_pose}):
        mixed = net(identity, pose, identity_descriptors=d_id, pose_descriptors=d_pose, **given)
        assert torch.equal(mixed.vertices, expected.vertices)
    monkeypatch.setattr(net, "encode", None)
    result = net(identity, pose, identity_features=f_id, pose_features=f_pose)
    assert torch.equal(result.vertices, expected.vertices)


def test_descriptors_are_standardised_and_bounded():
    net, verts, descriptors = make(descriptors=2), rand(1, 12, 3), rand(1, 12, 2, seed=1)
    expected = net.encode(verts, descriptors=descriptors)
    net.descriptor_mean += torch.tensor([5.0, -1.0])
    net.descriptor_std *= torch.tensor([0.1, 30.0])
    raw = descriptors * net.descriptor_std + net.descriptor_mean
    assert_near(net.encode(verts, descriptors=raw), expected, 1e-10)
    assert {"descriptor_mean", "descriptor_std"} <= net.state_dict().keys()
    spiked, bounded = raw.clone(), raw.clone()
    spiked[0, 3] = net.descriptor_mean + 1e6 * net.descriptor_std
    bounded[0, 3] = net.descriptor_mean + 4 * net.descriptor_std
    assert_near(net.encode(verts, descriptors=spiked), net.encode(verts, descriptors=bounded), 1e-12)


# 3D-CoreNet: pointwise extractor, theta and phi


def test_fitted_descriptors_are_those_of_real_vertices():
    net = make(descriptors=3)
    values, mask = rand(2, 5, 3), torch.arange(5).expand(2, 5) < torch.tensor([[5], [3]])
    net.fit_descriptors(values.masked_fill(~mask[..., None], GARBAGE[0]), mask=mask)
    rows = torch.cat([values[0], values[1, :3]])
    assert_near(net.descriptor_mean, rows.mean(0), 1e-6)
    assert_near(net.descriptor_std, rows.std(0), 1e-6)


@pytest.mark.parametrize(
    ("values", "mask", "message"),
    [
        (torch.zeros(1, 3), None, "two vertices or more, got 1"),
        (torch.zeros(2, 4, 3), torch.arange(8).view(2, 4) < 1, "two vertices or more, got 1"),
        (torch.zeros(5, 1), None, r"takes 3 descriptor channels, got \(5, 1\)"),
        (torch.zeros(3), None, r"takes 3 descriptor channels, got \(3,\)"),
        (torch.zeros(2, 4, 3), torch.ones(4, dtype=torch.bool), r"mask must be bool \(2, 4\), got torch.bool \(4,\)"),
    ],
)
def test_descriptors_that_cannot_be_fitted(values, mask, message):
    net = make(descriptors=3)
    with pytest.raises(ValueError, match=message):
        net.fit_descriptors(values, mask=mask)
    assert not net.descriptor_mean.any() and bool((net.descriptor_std == 1).all())


def test_pointwise_extractor_equals_its_equation():
    torch.manual_seed(0)
    net = PointwiseExtractor((4, 6), blocks=2, descriptors=1).double()
    for block in net.blocks:
        block.prelu.weight.data.uniform_(-0.5, 0.5)
    verts, descriptors = rand(2, 11, 3), rand(2, 11, 1, seed=1)

    def norm(x: Tensor) -> Tensor:
        return nn.functional.instance_norm(x.mT, eps=1e-5).mT

    x = torch.cat([verts, descriptors], 2)
    x = norm(net.linears[1](nn.functional.leaky_relu(norm(net.linears[0](x)), 0.2)))
    x = x / x.norm(dim=2, keepdim=True)
    for block in net.blocks:
        h = norm(block.conv_1(block.prelu(norm(block.conv_0(x)))))
        x = block.prelu(x + h)
    assert_near(net(verts, descriptors=descriptors), x, 1e-10)


def test_pointwise_errors():
    net = PointwiseExtractor((4,), blocks=0, descriptors=1)
    with pytest.raises(ValueError, match="takes 1 descriptor channels, got 0"):
        net(torch.zeros(1, 5, 3))
    with pytest.raises(ValueError, match=r"positions must have shape \(B, N, 3\)"):
        net(torch.zeros(5, 3))
    with pytest.raises(ValueError, match="mask must have shape"):
        net(torch.zeros(1, 5, 3), descriptors=torch.zeros(1, 5, 1), mask=torch.ones(1, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"must agree in B and N, got \(1, 4, 1\) and \(1, 5, 3\)"):
        net(torch.zeros(1, 5, 3), descriptors=torch.zeros(1, 4, 1))
    with pytest.raises(ValueError, match=r"descriptors must have shape \(B, N, D\), got \(5, 1\)"):
        net(torch.zeros(1, 5, 3), descriptors=torch.zeros(5, 1))
    with pytest.raises(TypeError, match=r"positions is torch.float64, but the parameters .* are torch.float32"):
        net(torch.zeros(1, 5, 3).double(), descriptors=torch.zeros(1, 5, 1))
    for widths in ((), (4, 0)):
        with pytest.raises(ValueError, match="widths must be at least one positive whole number"):
            PointwiseExtractor(widths)
    with pytest.raises(ValueError, match="blocks must be a whole number, at least 0, got -1"):
        PointwiseExtractor((4,), blocks=-1)
    with pytest.raises(ValueError, match='extractor must be "setconv" or "pointwise", got \'dgcnn\''):
        PoseTransferGenerator(extractor="dgcnn")


def test_spadain_replaces_elain_in_the_blocks():
    """The stack by its equations, with scale and shift from the condition and statistics over the vertices."""
    net, warped = make(norm="spadain", spectral=False), rand(1, 12, 3)
    cond = rand(1, 12, net.transfer.blocks[0].norm_0.cond_features, seed=1)

    def branch(block, which, x):
        norm, conv = getattr(block, f"norm_{which}"), getattr(block, f"conv_{which}")
        standard = (x - x.mean(1)) / (x.var(1, unbiased=False) + 1e-5).sqrt()
        return conv(nn.functional.leaky_relu(norm.gamma(cond) * standard + norm.beta(cond), 0.2))

    x = net.transfer.mix(net.transfer.lift(warped))
    for block, narrow in zip(net.transfer.blocks, net.transfer.narrow, strict=True):
        x = narrow(branch(block, "s", x) + branch(block, "1", branch(block, "0", x)))
    assert_near(net.transfer(warped, cond), 2 * torch.tanh(x), 1e-9)
    with pytest.raises(ValueError, match='norm must be "elain" or "spadain", got \'batch\''):
        PoseTransferGenerator(norm="batch")


def test_theta_and_phi_stand_before_the_matching():
    net, identity, pose = make(extractor="pointwise", eps=0.3), rand(1, 12, 3), rand(1, 17, 3, seed=1)
    f_id, f_pose = net.encode(identity), net.encode(pose)
    cosine = nn.functional.cosine_similarity(net.theta(f_id)[:, :, None], net.phi(f_pose)[:, None], dim=3)
    plan = net(identity, pose).plan.dense()
    # Scalings apart, the logarithm of the plan is the cosine over eps: its mixed differences are free of them.
    for value, scale in ((plan.log(), 0.3), (cosine, 1.0)):
        mixed = scale * (value - value[:, :1] - value[:, :, :1] + value[:, :1, :1])
        expected = mixed if scale == 0.3 else expected  # noqa: F821
    assert_near(mixed, expected, 1e-8)


# NPT


def make_npt(variant: str = "maxpool") -> NPT:
    """A small float64 NPT whose output is far from zero."""
    torch.manual_seed(0)
    net = NPT(variant, encoder_widths=(4, 5, 9)).double()
    for name, parameter in net.named_parameters():
        if parameter.dim() == 1 or name.startswith("decoder.narrow"):
            parameter.data = rand(*parameter.shape)
    return net.eval()


def test_npt_is_a_generator_without_correspondence():
    result = make_npt()(rand(2, 12, 3), rand(2, 17, 3, seed=1))
    assert isinstance(result, GeneratorOutput) and result.vertices.shape == (2, 12, 3)
    assert result.warped is None and result.plan is None


def test_npt_takes_given_features():
    net, identity, pose = make_npt(), rand(2, 12, 3), rand(2, 17, 3, seed=1)
    features = net.encode(pose)
    assert features.shape == (2, 17, 9)
    given = net(identity, pose, identity_features=net.encode(identity), pose_features=features)
    assert torch.equal(given.vertices, net(identity, pose).vertices)


def test_npt_maxpool_ignores_the_order_of_the_pose_and_follows_that_of_the_identity():
    net, identity, pose, order = make_npt(), rand(2, 12, 3), rand(2, 17, 3, seed=1), torch.randperm(12)
    expected = net(identity, pose).vertices
    assert_near(net(identity, pose[:, torch.randperm(17)]).vertices, expected, 1e-12)
    assert_near(net(identity[:, order], pose).vertices, expected[:, order], 1e-12)


@pytest.mark.parametrize("garbage", GARBAGE)
@pytest.mark.parametrize("variant", ["maxpool", "original"])
def test_npt_padded_batch_equals_the_loop(variant, garbage):
    net, sizes = make_npt(variant), [8, 11]
    pose_sizes = sizes if variant == "original" else [9, 6]
    ids, poses = [rand(n, 3, seed=n) for n in sizes], [rand(n, 3, seed=n + 50) for n in pose_sizes]
    id_mask = scattered_mask(sizes, 13)
    pose_mask = id_mask if variant == "original" else scattered_mask(pose_sizes, 10, seed=1)
    identity, pose = (scatter(s, m, garbage).requires_grad_() for s, m in ((ids, id_mask), (poses, pose_mask)))
    vertices = net(identity, pose, identity_mask=id_mask, pose_mask=pose_mask).vertices
    total = torch.cat([net(i[None], p[None]).vertices[0] for i, p in zip(ids, poses, strict=True)])
    assert_near(vertices[id_mask], total, 1e-10)
    assert (vertices[~id_mask] == 0).all()
    upstream, parameters = rand(19, 3, seed=99), list(net.parameters())
    got = torch.autograd.grad(vertices[id_mask], [identity, pose, *parameters], upstream)
    truths = torch.autograd.grad(total, parameters, upstream)
    for gradient, mask in zip(got[:2], (id_mask, pose_mask), strict=True):
        assert gradient.isfinite().all() and (gradient[~mask] == 0).all()
    for gradient, truth in zip(got[2:], truths, strict=True):
        assert_near(gradient, truth, 1e-8, scale=max(1.0, truth.abs().amax().item()))


@pytest.mark.parametrize("variant", ["maxpool", "original"])
def test_npt_inert_parameters_are_those_without_gradient(variant):
    net = make_npt(variant)
    net(rand(2, 12, 3), rand(2, 12, 3, seed=1)).vertices.square().sum().backward()
    sizes = {n: p.grad.abs().amax().item() for n, p in net.named_parameters()}
    assert {name for name, size in sizes.items() if size < 1e-10} == set(net.inert_parameters())


@pytest.mark.parametrize("variant", ["maxpool", "original"])
@pytest.mark.parametrize("points", [None, 7])
def test_npt_in_dual_reconstruction(variant, points):
    net, a, b = make_npt(variant), rand(2, 12, 3), rand(2, 12, 3, seed=1)
    dual = DualReconstruction(net, points=points)
    if variant == "original" and points is not None:
        with pytest.raises(ValueError, match="needs equal vertex counts, got 12 and 7"):
            dual(a, b)
        return
    result = dual(a, b)
    assert_near(result.output, net(a, b).vertices, 1e-12)
    assert result.plan is None and result.warped is None
    if points is None:
        assert_near(result.reconstruction_a, net(result.output, a).vertices, 1e-12)
    assert result.reconstruction_b.shape == (2, points or 12, 3)


def test_npt_errors():
    net, mesh = make_npt("original"), rand(2, 9, 3)
    with pytest.raises(ValueError, match='variant must be "maxpool" or "original", got \'mean\''):
        NPT("mean")
    with pytest.raises(ValueError, match=r"encoder_widths must be .* positive whole number.*, got \(3, 0\)"):
        NPT(encoder_widths=(3, 0))
    with pytest.raises(ValueError, match="identity and pose batches differ"):
        net(mesh, mesh[:1])
    with pytest.raises(ValueError, match=r'equal vertex counts, got 9 and 8: use variant="maxpool"'):
        net(mesh, mesh[:, :8])
    few, most = torch.arange(9).expand(2, 9) < 6, torch.arange(9).expand(2, 9) < 8
    for masks in ({"identity_mask": few, "pose_mask": most}, {"pose_mask": few}, {"identity_mask": most}):
        with pytest.raises(ValueError, match='variant="original" pairs vertices by their index and needs equal masks'):
            net(mesh, mesh, **masks)
    net(mesh, mesh, identity_mask=few, pose_mask=few.clone())
    net(mesh, mesh, identity_mask=torch.ones(2, 9, dtype=torch.bool))
    with pytest.raises(ValueError, match="NPT takes no descriptors"):
        net(mesh, mesh, pose_descriptors=mesh)
    with pytest.raises(ValueError, match="NPT takes no descriptors"):
        net.encode(mesh, descriptors=mesh)
    with pytest.raises(ValueError, match="NPT takes no descriptors"):
        net.fit_descriptors(mesh)
    with pytest.raises(ValueError, match=r"verts must have shape \(B, N, 3\)"):
        net.encode(mesh[..., :2])


# The released layout's first convolution


def test_ordered_stack_begins_with_a_convolution_along_the_order():
    """The lift against ``conv1d`` of kernel 3, for a batch whose padding stands anywhere."""
    torch.manual_seed(0)
    stack, plain = (s(4, (6,), spectral=False).double() for s in (OrderedPoseTransferStack, PoseTransferStack))
    plain.load_state_dict({**stack.state_dict(), "lift.weight": torch.zeros(6, 3)})
    sizes = [7, 9]
    mask = scattered_mask(sizes, 11)
    samples = [rand(n, 3, seed=n) for n in sizes]
    features = [rand(n, 4, seed=n + 9) for n in sizes]
    result = stack(scatter(samples, mask, 0.0), scatter(features, mask, 0.0), mask=mask)
    kernel = stack.lift.weight.unflatten(1, (3, 3)).mT  # taps last
    for b, (sample, feature) in enumerate(zip(samples, features, strict=True)):
        x = nn.functional.conv1d(sample.mT[None], kernel, stack.lift.bias, padding=1).mT
        x = stack.narrow[0](stack.blocks[0](stack.mix(x), feature[None]))
        assert_near(result[b][mask[b]], 2 * x[0].tanh(), 1e-10)
        assert_near(stack(sample[None], feature[None])[0], 2 * x[0].tanh(), 1e-10)


def test_ordered_stack_depends_on_the_order():
    net, plain = make(released=True), make()
    identity, pose, order = rand(1, 12, 3), rand(1, 17, 3, seed=1), torch.randperm(12)
    for model, equivariant in ((net, False), (plain, True)):
        change = model(identity[:, order], pose).vertices - model(identity, pose).vertices[:, order]
        assert (change.norm() < 1e-8) == equivariant


def test_released_matching_reads_like_a_plan():
    """Where features are alike, the constant in the denominators is lost in rounding: the two plans agree."""
    net, identity, pose = make(released=True), rand(2, 12, 3), rand(2, 17, 3, seed=1)
    plain = make()
    plain.extractor.load_state_dict(net.extractor.state_dict())
    plan, expected = net(identity, pose).plan, plain(identity, pose).plan
    assert plan.shape == (2, 12, 17) and plan.T.shape == (2, 17, 12) and plan.dtype == torch.float64
    values, back = rand(2, 17, 4), rand(2, 12, 4)
    for read in (
        lambda p: p.dense(),
        lambda p: p @ values,
        lambda p: p.T @ back,
        lambda p: p.barycentric(values),
        lambda p: p.row_sums(),
        lambda p: p.marginals()[1],
        lambda p: p.log_at(torch.arange(12).expand(2, -1)),
        lambda p: p.log_at(torch.full((2, 12), -1)).exp(),
    ):
        assert_near(read(plan), read(expected), 1e-5)
    assert torch.equal(plan.argmax(), expected.argmax()) and torch.equal(plan.argmax(1), expected.argmax(1))
    assert plan.device == expected.device
    assert_near(plan.entropy(), expected.entropy(), 1e-5)
    for ours, theirs in zip(plan.mutual(), expected.mutual(), strict=True):
        assert torch.equal(ours, theirs)
    for dim in (1, 2):
        (ours, at), (theirs, index) = plan.topk(3, dim=dim), expected.topk(3, dim=dim)
        assert_near(ours, theirs, 1e-5)
        assert torch.equal(at, index)
    for k, dim, message in ((18, 2, "between 1 and 17"), (13, 1, "between 1 and 12"), (1, 0, "dim must be 1")):
        with pytest.raises(ValueError, match=message):
            plan.topk(k, dim=dim)
    mask_a, mask_b = scattered_mask([7, 12], 12), scattered_mask([9, 17], 17)
    options = {"identity_mask": mask_a, "pose_mask": mask_b}
    plan, expected = (n(identity, pose, **options).plan for n in (net, plain))
    assert_near(plan.entropy(), expected.entropy(), 1e-5)
    for read in (lambda p: p.mutual()[1], lambda p: torch.where(p.mutual()[1], p.mutual()[0], 0)):
        assert torch.equal(read(plan), read(expected))
    masses, index = plan.topk(17)
    assert not masses[0, :, 9:].any() and not index[0, :, 9:].any() and not masses[~mask_a].any()
    plan, expected = net(identity, pose).plan, plain(identity, pose).plan
    assert_near(backward_correspondence_loss(plan, pose), backward_correspondence_loss(plan.dense(), pose), 1e-10)


# Every default preset


@pytest.mark.parametrize(
    "build",
    [
        *(
            pytest.param(lambda f=f, s=s: f(s), id=f"{f.__name__}-{s}")
            for f in (xdualnet, corenet3d)
            for s in ("paper", "tiny")
        ),
        *(
            pytest.param(lambda v=v, s=s: npt(v, preset=s), id=f"npt-{v}-{s}")
            for v in ("maxpool", "original")
            for s in ("paper", "tiny")
        ),
    ],
)
def test_presets_are_permutation_equivariant(build):
    torch.manual_seed(0)
    net = build().double().eval()
    last = (net.decoder if isinstance(net, NPT) else net.transfer).narrow[-1]
    last.weight.data = rand(*last.weight.shape) / last.in_features**0.5
    identity, pose, order, other = 0.4 * rand(1, 40, 3), 0.4 * rand(1, 40, 3, seed=1), *map(torch.randperm, (40, 40))
    extra, moved = {}, {}
    if getattr(net, "match_size", False):
        extra = {f"{n}_descriptors": rand(1, 40, 17, seed=s) for s, n in enumerate(("identity", "pose"))}
    if isinstance(net, NPT) and net.variant == "original":
        other = order  # it pairs vertices by their index
    if extra:
        moved = {n: d[:, order if n.startswith("identity") else other] for n, d in extra.items()}
    expected = net(identity, pose, **extra).vertices
    assert expected.abs().amax() > 0.1
    assert_near(net(identity[:, order], pose[:, other], **moved).vertices, expected[:, order], 1e-9)


# ONNX


@pytest.mark.filterwarnings("ignore")
def test_onnx_export_equals_the_stack(tmp_path):
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    pytest.importorskip("onnxscript", reason="onnxscript is not installed")
    torch.manual_seed(0)
    net = PoseTransferStack(5, (16,), residual=True).eval()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    export_onnx(net, tmp_path / "stack.onnx")
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    session = runtime.InferenceSession(str(tmp_path / "stack.onnx"), providers=["CPUExecutionProvider"])
    for batch, vertices in ((1, 30), (3, 17)):
        warped, features = (rand(batch, vertices, c, seed=c, dtype=torch.float32) for c in (3, 5))
        (result,) = session.run(None, {"warped": warped.numpy(), "features": features.numpy()})
        assert_near(torch.from_numpy(result), net(warped, features).detach(), 1e-5)


def test_onnx_export_names_the_missing_extra(monkeypatch, tmp_path):
    monkeypatch.setattr("meshkit.models.export.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r'pip install "meshkit-torch\[onnx\]"'):
        export_onnx(PoseTransferStack(5, (4,)), tmp_path / "stack.onnx")


# Conditioning on descriptors alone


def test_condition_on_descriptors():
    """The blocks see the standardised descriptors of the identity; the matching still sees features."""
    net = make(descriptors=2, condition="descriptors")
    net.descriptor_mean += 0.5
    identity, pose = rand(1, 12, 3), rand(1, 17, 3, seed=1)
    extra = {"identity_descriptors": rand(1, 12, 2), "pose_descriptors": rand(1, 17, 2, seed=1)}
    result = net(identity, pose, **extra)
    condition = (extra["identity_descriptors"] - net.descriptor_mean) / net.descriptor_std
    assert_near(result.vertices, net.transfer(result.warped, condition), 1e-12)
    features = {
        f"{n}_features": net.encode(m, descriptors=extra[f"{n}_descriptors"])
        for n, m in (("identity", identity), ("pose", pose))
    }
    assert torch.equal(net(identity, pose, **extra, **features).vertices, result.vertices)
    with pytest.raises(ValueError, match='condition="descriptors" needs identity_descriptors, also beside'):
        net(identity, pose, **features)


def test_condition_errors():
    with pytest.raises(ValueError, match='condition must be "features" or "descriptors", got \'pose\''):
        PoseTransferGenerator(condition="pose")
    with pytest.raises(ValueError, match='condition="descriptors" and match_size need descriptors'):
        PoseTransferGenerator(condition="descriptors")
    assert replace(SMALL, condition="descriptors").build().condition == "descriptors"


# Training


def inert_names(net: nn.Module) -> set[str]:
    """Full names of what the modules in ``net`` declare as without effect."""
    return {
        f"{prefix}.{name}".lstrip(".")
        for prefix, module in net.named_modules()
        if hasattr(module, "inert_parameters")
        for name in module.inert_parameters()
    }


@pytest.mark.parametrize(
    "options", [{}, {"spectral": False, "residual": True}, {"descriptors": 2}, {"extractor": "pointwise"}]
)
def test_gradients_reach_every_parameter(options):
    net = make(**options).train()
    extra = {f"{n}_descriptors": rand(2, 12, 2) for n in ("identity", "pose")} if "descriptors" in options else {}
    net(rand(2, 12, 3), rand(2, 12, 3, seed=1), **extra).vertices.square().sum().backward()
    inert = inert_names(net)
    assert len(inert) == (2 + 4 * 2 if "extractor" in options else 0)
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert (parameter.grad.abs().amax() > 1e-9) == (name not in inert), name


@pytest.mark.parametrize("residual", [False, True])
def test_training_starts_near_the_centre(residual):
    """The stack gives decimetres at most, where Xavier's gain on the last layer gives metres."""
    torch.manual_seed(0)
    net = replace(GeneratorConfig(), residual=residual).build()
    identity, pose = (rand(1, 50, 3, seed=s, dtype=torch.float32) for s in (0, 1))
    sizes = []
    with torch.no_grad():
        for gain in (None, 1.0):
            if gain is not None:
                nn.init.xavier_normal_(net.transfer.narrow[-1].weight, gain)
            result = net(identity, pose)
            stack = result.vertices - result.warped if residual else result.vertices
            sizes.append(stack.square().mean().sqrt().item())
    assert sizes[0] < 0.2 and sizes[1] > 1


def test_half_precision_autocast_gives_float32_vertices():
    net = make().float()
    identity, pose = rand(1, 30, 3, dtype=torch.float32), rand(1, 40, 3, seed=1, dtype=torch.float32)
    exact = net(identity, pose)
    with torch.autocast("cpu", torch.bfloat16):
        result = net(identity, pose)
    assert result.vertices.dtype == torch.float32 and result.vertices.isfinite().all()
    assert result.plan.dtype == torch.float32
    assert (result.vertices - exact.vertices).square().mean().sqrt() < 0.2


# Sizes


def elements(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameter_counts_of_the_paper_by_hand():
    net = xdualnet("paper")
    # SetConv: (3 + C) x w, w x w, w x w without bias, and three pairs of scale and shift.
    first = (3 + 3) * 32 + 2 * 32 * 32 + 6 * 32
    second = (32 + 3) * 64 + 2 * 64 * 64 + 6 * 64
    third = (64 + 3) * 128 + 2 * 128 * 128 + 6 * 128
    assert [elements(conv) for conv in net.extractor.convs] == [first, second, third] == [2432, 10816, 42112]
    # ElaIN: 128 -> w, w -> w twice, 2w -> w, with biases; a block has three, and three maps of which one is unbiased.
    for block, w in zip(net.transfer.blocks, (1024, 512, 256), strict=True):
        norm = (128 * w + w) + 2 * (w * w + w) + (2 * w * w + w)
        assert elements(block) == 3 * norm + 3 * w * w + 2 * w
    ends = (3 * 1024 + 1024) + (1024 * 1024 + 1024)
    ends += (1024 * 512 + 512) + (512 * 256 + 256) + (256 * 3 + 3)
    assert elements(net) == first + second + third + ends + sum(elements(block) for block in net.transfer.blocks)


def test_presets():
    paper, tiny = xdualnet(), xdualnet("tiny")
    assert (paper.extractor.k, paper.eps, paper.n_iters, paper.normalize_plan) == (32, 0.03, 5, True)
    assert paper.extractor.descriptors == 0 and paper.condition == "features" and not paper.transfer.residual
    assert tiny.extractor.descriptors == GeneratorConfig().num_signatures + 1 and tiny.condition == "descriptors"
    assert elements(tiny) < elements(paper) / 10
    corenet = corenet3d()
    assert [m.out_features for m in corenet.extractor.linears] == [64, 128, 256] and len(corenet.extractor.blocks) == 4
    assert corenet.theta.weight.shape == corenet.phi.weight.shape == (256, 256)
    assert elements(corenet3d("tiny")) < elements(corenet) / 10
    assert [b.conv_0.in_features for b in npt().decoder.blocks] == [1027, 513, 256]
    assert [b.conv_0.in_features for b in npt(preset="tiny").decoder.blocks] == [256, 128, 64]
    for build in (xdualnet, corenet3d, lambda size: npt(preset=size)):
        with pytest.raises(ValueError, match=r"preset must be one of \['paper', 'small', 'tiny'\], got 'huge'"):
            build("huge")
    with pytest.raises(ValueError, match='variant must be "maxpool" or "original"'):
        npt("huge")


@pytest.mark.parametrize("spectral", [True, False])
def test_spectral_normalisation_sits_on_the_blocks_alone(spectral):
    net = make(spectral=spectral)
    normed = {name for name, module in net.named_modules() if hasattr(module, "parametrizations")}
    expected = {f"transfer.blocks.{b}.conv_{c}" for b in range(2) for c in "01s"} if spectral else set()
    assert normed == expected


# Errors of the forward pass


@pytest.mark.parametrize("option", [{"n_iters": 1.5}, {"k": 4.5}, {"n_iters": 5.0}, {"k": 8.0}])
def test_counts_are_whole_numbers(option):
    """Also those that the functions called in the forward pass would refuse."""
    with pytest.raises(ValueError, match="n_iters and k must be whole numbers, got"):
        make(**option)


def test_there_is_no_reset_of_a_part():
    """``reset_parameters`` means all of a module in torch; norms and spectral originals would keep what they have."""
    assert not hasattr(PoseTransferGenerator, "reset_parameters") and not hasattr(NPT, "reset_parameters")


def test_generator_errors():
    net, mesh = make(), rand(2, 9, 3)
    with pytest.raises(ValueError, match=r"identity and pose batches differ: \(2, 9, 3\) and \(1, 9, 3\)"):
        net(mesh, mesh[:1])
    for bad in (mesh[0], mesh[..., :2]):
        with pytest.raises(ValueError, match=r"must have shape \(B, V, 3\), got"):
            net(bad, bad)
    with pytest.raises(ValueError, match="k=4 neighbours"):
        net(mesh[:, :3], mesh)
    with pytest.raises(ValueError, match="takes 2 descriptor channels, got 0"):
        make(descriptors=2)(mesh, mesh)
    with pytest.raises(ValueError, match=r"takes 2 descriptor channels, got \(2, 9, 3\)"):
        make(descriptors=2)(mesh, mesh, identity_descriptors=mesh, pose_descriptors=mesh)


# Configurations and checkpoints

SMALL = GeneratorConfig(**SIZES, descriptors="wks", num_signatures=2, eps=0.1, n_iters=3, spectral=False)


@pytest.mark.parametrize(
    "config",
    [
        GeneratorConfig(),
        SMALL,
        replace(SMALL, residual=True, normalize_plan=False),
        replace(SMALL, extractor="pointwise", extractor_blocks=1, released=True),
        GeneratorConfig(architecture="npt_original", extractor_widths=(4, 5)),
    ],
)
def test_configuration_survives_json(config):
    assert GeneratorConfig.from_json(json.dumps(asdict(config))) == config


def test_configuration_reaches_the_generator():
    net = replace(SMALL, residual=True, normalize_plan=False).build()
    assert (net.eps, net.n_iters, net.normalize_plan, net.transfer.residual) == (0.1, 3, False, True)
    assert net.extractor.descriptors == 3 and net.extractor.k == 4  # two signatures and the size
    assert [conv.out_features for conv in net.extractor.convs] == [5, 6]
    assert replace(SMALL, descriptors="none").build().extractor.descriptors == 0
    assert GeneratorConfig.from_json('{"k": 7}') == GeneratorConfig(k=7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "the model configuration is not JSON"),
        ("", "the model configuration is not JSON"),
        ('{"kk": 3, "k": 3}', r"unknown fields \['kk'\] .* known: \['architecture', 'extractor', 'extractor_w"),
        ("3", "model configuration"),
        ("[]", "model configuration"),
        ("null", "model configuration"),
    ],
)
def test_configuration_errors(text, message):
    with pytest.raises(ValueError, match=message):
        GeneratorConfig.from_json(text)


def test_configuration_names_the_architecture():
    corenet = replace(SMALL, extractor="pointwise", extractor_blocks=1, released=True).build()
    assert isinstance(corenet.extractor, PointwiseExtractor) and len(corenet.extractor.blocks) == 1
    assert isinstance(corenet.transfer, OrderedPoseTransferStack) and corenet.extractor.descriptors == 3
    for variant in ("maxpool", "original"):
        net = GeneratorConfig(architecture=f"npt_{variant}", extractor_widths=(4, 5)).build()
        assert isinstance(net, NPT) and net.variant == variant
        assert [m.out_features for m in net.encoder.linears] == [4, 5]


def test_configuration_build_errors():
    with pytest.raises(ValueError, match='must be "none" or "wks", got \'hks\''):
        GeneratorConfig(descriptors="hks").build()
    with pytest.raises(ValueError, match=r'architecture must be "matching", "npt_maxpool" or .*, got \'unet\''):
        GeneratorConfig(architecture="unet").build()
    with pytest.raises(ValueError, match='NPT takes no descriptors: set descriptors="none"'):
        replace(SMALL, architecture="npt_maxpool").build()


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, PoseTransferGenerator]:
    """The folder of a run, and the generator saved there."""
    torch.manual_seed(1)
    net = replace(SMALL, spectral=True).build()
    net.descriptor_mean += 0.5
    save_file(net.state_dict(), tmp_path / "model.safetensors")
    (tmp_path / "model.json").write_text(json.dumps(asdict(replace(SMALL, spectral=True))))
    return tmp_path, net


def test_load_generator_returns_the_saved_one_in_evaluation_mode(run):
    folder, net = run
    for given in (folder, str(folder)):
        loaded, config = load_generator(given)
        assert config == replace(SMALL, spectral=True) and not loaded.training
    meshes = [rand(1, 9, 3, dtype=torch.float32), rand(1, 8, 3, seed=1, dtype=torch.float32)]
    extra = {f"{n}_descriptors": rand(1, v, 3).float() for n, v in (("identity", 9), ("pose", 8))}
    assert torch.equal(loaded(*meshes, **extra).vertices, net.eval()(*meshes, **extra).vertices)


def test_load_generator_of_npt(tmp_path):
    config = GeneratorConfig(architecture="npt_maxpool", extractor_widths=(4, 5))
    net = config.build()
    save_file(net.state_dict(), tmp_path / "model.safetensors")
    (tmp_path / "model.json").write_text(json.dumps(asdict(config)))
    loaded, read = load_generator(tmp_path)
    meshes = [rand(1, 9, 3, dtype=torch.float32), rand(1, 8, 3, seed=1, dtype=torch.float32)]
    assert read == config and torch.equal(loaded(*meshes).vertices, net(*meshes).vertices)


def test_load_generator_without_descriptors(tmp_path):
    """The empty statistics of the descriptors survive the file."""
    config = replace(SMALL, descriptors="none")
    save_file(config.build().state_dict(), tmp_path / "model.safetensors")
    (tmp_path / "model.json").write_text(json.dumps(asdict(config)))
    assert load_generator(tmp_path)[0].descriptor_mean.shape == (0,)


@pytest.mark.parametrize("name", ["model.json", "model.safetensors"])
def test_load_generator_names_the_missing_file(run, name):
    (run[0] / name).unlink()
    with pytest.raises(ValueError, match=f"holds no {name}: give the folder"):
        load_generator(run[0])


@pytest.mark.parametrize("kept", [0, 5, 400, -4])
def test_load_generator_refuses_damaged_weights(run, kept):
    file = run[0] / "model.safetensors"
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(ValueError, match="cannot be read into this model"):
        load_generator(run[0])


@pytest.mark.parametrize("change", [{"widths": (8, 6)}, {"widths": (8,)}, {"spectral": False}, {"num_signatures": 3}])
def test_load_generator_refuses_weights_of_another_configuration(run, change):
    (run[0] / "model.json").write_text(json.dumps(asdict(replace(SMALL, **{"spectral": True, **change}))))
    with pytest.raises(ValueError, match="cannot be read into this model"):
        load_generator(run[0])


def test_load_generator_refuses_a_damaged_configuration(run):
    (run[0] / "model.json").write_text('{"k": 3')
    with pytest.raises(ValueError, match="not JSON"):
        load_generator(run[0])


def test_initialisation_of_the_linear_maps():
    """Xavier normal, deviation sqrt(2 / (in + out)), on every map but the last."""
    torch.manual_seed(0)
    net = PoseTransferGenerator(extractor_widths=(64, 64), k=4, widths=(128, 128), spectral=False)
    for name, parameter in net.named_parameters():
        if parameter.dim() == 2 and "narrow.1" not in name and parameter.numel() > 2000:
            expected = math.sqrt(2 / sum(parameter.shape))
            assert parameter.std().item() == pytest.approx(expected, rel=0.1), name
            # A normal deviate, not a uniform one, which ends at 1.7 deviations.
            assert parameter.abs().amax().item() > 2.5 * expected, name
    assert net.transfer.narrow[-1].weight.std().item() == pytest.approx(1e-3, rel=0.2)


def test_match_size_warps_the_scaled_pose_mesh():
    generator = PoseTransferGenerator(**SIZES, descriptors=2, match_size=True)
    plain = PoseTransferGenerator(**SIZES, descriptors=2)
    plain.load_state_dict(generator.state_dict())
    a, b = rand(2, 20, 3, seed=1, dtype=torch.float32), rand(2, 25, 3, seed=2, dtype=torch.float32)
    da, db = rand(2, 20, 2, seed=3, dtype=torch.float32), rand(2, 25, 2, seed=4, dtype=torch.float32)
    da[..., 1], db[..., 1] = torch.tensor([[0.4], [0.1]]), torch.tensor([[0.1], [0.3]])  # log sizes of the two pairs
    features = {"identity_features": plain.encode(a, descriptors=da), "pose_features": plain.encode(b, descriptors=db)}
    descriptors = {"identity_descriptors": da, "pose_descriptors": db}
    ratio = torch.tensor([0.3, -0.2]).exp()[:, None, None]
    expected = plain(a, b * ratio, **features, **descriptors)
    result = generator(a, b, **descriptors)
    torch.testing.assert_close(result.warped, expected.warped)
    torch.testing.assert_close(result.vertices, expected.vertices)
    with pytest.raises(ValueError, match="match_size needs identity_descriptors and pose_descriptors"):
        generator(a, b, **features)
    with pytest.raises(ValueError, match="match_size need descriptors"):
        PoseTransferGenerator(**SIZES, match_size=True)


def test_a_preset_in_place_of_a_variant_is_named():
    with pytest.raises(ValueError, match=r'npt\(preset="tiny"\)'):
        npt("tiny")
