"""Dual reconstruction around toy generators whose results are written out, and around the real one."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from conftest import GARBAGE, assert_near, rand, scatter, scattered_mask
from torch import Tensor, nn

from meshkit.consistency import (
    CycleOutput,
    CycleReconstruction,
    DualOutput,
    DualReconstruction,
    GeneratorAdapter,
    SelfOutput,
    SelfReconstruction,
)
from meshkit.deform import ARAPDeformer
from meshkit.models import PoseTransferGenerator

A, B = rand(2, 7, 3), rand(2, 9, 3, seed=1)
TETRAHEDRON = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


class Affine(nn.Module):
    """G(identity, pose) = theta identity + mean(pose), and a record of how it was called."""

    def __init__(self, theta: float = 2.0) -> None:
        super().__init__()
        self.theta = nn.Parameter(torch.tensor(theta, dtype=torch.float64))
        self.calls: list[SimpleNamespace] = []

    def forward(self, identity: Tensor, pose: Tensor, **options: Tensor | None) -> Tensor:
        self.calls.append(SimpleNamespace(identity=identity, pose=pose, options=options))
        return self.theta * identity + pose.mean(1, keepdim=True)


class Encoding(Affine):
    """The same with an encoder, whose features are 10 times the vertices; returns an object."""

    def __init__(self, theta: float = 2.0) -> None:
        super().__init__(theta)
        self.encoded: list[SimpleNamespace] = []

    def encode(self, verts: Tensor, *, mask: Tensor | None = None, descriptors: Tensor | None = None) -> Tensor:
        self.encoded.append(SimpleNamespace(verts=verts, mask=mask, descriptors=descriptors))
        return 10 * verts

    def forward(self, identity: Tensor, pose: Tensor, **options: Tensor | None) -> SimpleNamespace:
        vertices = super().forward(identity, pose, **options)
        return SimpleNamespace(vertices=vertices, warped=vertices + 1, plan=("plan", pose))


class Shift:
    """deform(A, O) = A + O, and a record of how it was called."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def __call__(self, rest: Tensor, target: Tensor, faces: Tensor, *, mask: Tensor | None = None) -> Tensor:
        self.calls.append((rest, target, faces, mask))
        return rest + target


def mean(x: Tensor) -> Tensor:
    return x.mean(1, keepdim=True)


# The three passes


@pytest.mark.parametrize("generator", [Affine, Encoding])
@pytest.mark.parametrize("deform", [False, True])
def test_closed_form(generator, deform):
    """O = 2A + mB; D = O or A + O; A' = 2D + mA; B' = 2B + mD."""
    result = DualReconstruction(generator(), Shift() if deform else None)(A, B, identity_faces=TETRAHEDRON)
    output = 2 * A + mean(B)
    deformed = A + output if deform else output
    assert isinstance(result, DualOutput)
    assert_near(result.output, output, 1e-14)
    assert_near(result.deformed, deformed, 1e-14)
    assert_near(result.reconstruction_a, 2 * deformed + mean(A), 1e-14)
    assert_near(result.reconstruction_b, 2 * B + mean(deformed), 1e-14)
    assert torch.equal(result.target_a, A) and torch.equal(result.target_b, B)
    assert result.mask_a is None and result.mask_b is None


def test_a_perfect_generator_reconstructs_both():
    """Meshes are an identity (its shape about the mean) and a pose (the mean): G takes one from each."""

    def generator(identity: Tensor, pose: Tensor, **_) -> Tensor:
        return identity - mean(identity) + mean(pose)

    result = DualReconstruction(generator)(A, B)
    assert_near(result.reconstruction_a, A, 1e-14)
    assert_near(result.reconstruction_b, B, 1e-14)
    assert (result.output - A).abs().amax() > 0.1


def test_warped_and_plan_are_those_of_the_main_pass():
    result = DualReconstruction(Encoding())(A, B)
    assert_near(result.warped, result.output + 1, 1e-14)
    assert result.plan[0] == "plan" and torch.equal(result.plan[1], B)
    plain = DualReconstruction(Affine())(A, B)
    assert plain.warped is None and plain.plan is None


def test_arguments_of_a_plain_generator():
    generator = Affine()
    masks = {"identity_mask": scattered_mask([5, 7], 7), "pose_mask": scattered_mask([9, 2], 9)}
    descriptors = {"identity_descriptors": rand(2, 7, 4).requires_grad_(), "pose_descriptors": rand(2, 9, 4)}
    result = DualReconstruction(generator)(A, B, **masks, **descriptors)
    id_mask, pose_mask = masks.values()
    id_d, pose_d = descriptors.values()
    passes = [
        (A, B, id_mask, pose_mask, id_d, pose_d),
        (result.deformed, A, id_mask, id_mask, id_d, id_d),
        (B, result.deformed, pose_mask, id_mask, pose_d, id_d),
    ]
    assert len(generator.calls) == 3
    names = ["identity_mask", "pose_mask", "identity_descriptors", "pose_descriptors"]
    for call, (identity, pose, *options) in zip(generator.calls, passes, strict=True):
        assert torch.equal(call.identity, identity) and torch.equal(call.pose, pose)
        assert sorted(call.options) == sorted(names)
        for name, expected in zip(names, options, strict=True):
            assert torch.equal(call.options[name], expected), name
    # The generated mesh takes the identity's descriptors as constants; A itself keeps its gradient.
    assert not generator.calls[1].options["identity_descriptors"].requires_grad
    assert not generator.calls[2].options["pose_descriptors"].requires_grad
    assert generator.calls[1].options["pose_descriptors"].requires_grad
    assert result.mask_a is id_mask and result.mask_b is pose_mask


def test_each_mesh_is_encoded_once_and_its_features_reused():
    generator = Encoding()
    masks = {"identity_mask": scattered_mask([5, 7], 7), "pose_mask": scattered_mask([9, 2], 9)}
    descriptors = {"identity_descriptors": rand(2, 7, 4).requires_grad_(), "pose_descriptors": rand(2, 9, 4)}
    result = DualReconstruction(generator)(A, B, **masks, **descriptors)
    id_mask, pose_mask = masks.values()
    id_d, pose_d = descriptors.values()
    expected = [(A, id_mask, id_d), (B, pose_mask, pose_d), (result.deformed, id_mask, id_d)]
    assert len(generator.encoded) == 3
    for call, (verts, mask, descriptor) in zip(generator.encoded, expected, strict=True):
        assert torch.equal(call.verts, verts) and call.mask is mask and torch.equal(call.descriptors, descriptor)
    assert not generator.encoded[2].descriptors.requires_grad
    assert len(generator.calls) == 3
    for call in generator.calls:
        assert torch.equal(call.options["identity_features"], 10 * call.identity)
        assert torch.equal(call.options["pose_features"], 10 * call.pose)
    # Masks and descriptors go along: a generator may condition on the identity's descriptors.
    sides = [(id_mask, id_d, pose_mask, pose_d), (id_mask, id_d, id_mask, id_d), (pose_mask, pose_d, id_mask, id_d)]
    names = ["identity_mask", "identity_descriptors", "pose_mask", "pose_descriptors"]
    for call, side in zip(generator.calls, sides, strict=True):
        assert sorted(call.options) == sorted([*names, "identity_features", "pose_features"])
        for name, given in zip(names, side, strict=True):
            assert torch.equal(call.options[name], given), name


# The deformer


@pytest.mark.parametrize("generator", [Affine, Encoding])
def test_deformer_is_called_on_the_output(generator):
    deform, mask = Shift(), scattered_mask([5, 7], 7)
    dual = DualReconstruction(generator(), deform)
    result = dual(A, B, identity_faces=TETRAHEDRON, identity_mask=mask)
    ((rest, target, faces, given),) = deform.calls
    assert torch.equal(rest, A) and target is result.output and faces is TETRAHEDRON and given is mask


def test_use_deform_false_leaves_it_out():
    deform, generator = Shift(), Affine()
    result = DualReconstruction(generator, deform)(A, B, use_deform=False)  # no faces needed
    assert not deform.calls and result.deformed is result.output
    plain = DualReconstruction(generator)(A, B)
    assert torch.equal(result.reconstruction_a, plain.reconstruction_a)
    assert torch.equal(result.reconstruction_b, plain.reconstruction_b)


@pytest.mark.parametrize("generator", [Affine, Encoding])
@pytest.mark.parametrize("deform", [None, Shift()])
@pytest.mark.parametrize("stop_gradient", ["none", "deformed"])
def test_gradient_of_the_generator(generator, deform, stop_gradient):
    """d/dtheta of O = theta A + mB, D = O (+ A), A' = theta D + mA, B' = theta B + mD, with D a constant or not."""
    net = generator(1.5)
    result = DualReconstruction(net, deform, stop_gradient=stop_gradient)(A, B, identity_faces=TETRAHEDRON)
    through = 1.0 if stop_gradient == "none" else 0.0
    for value, expected in [
        (result.output, A),
        (result.reconstruction_a, result.deformed + through * 1.5 * A),
        (result.reconstruction_b, B + through * mean(A)),
    ]:
        upstream = rand(*value.shape, seed=5)
        (gradient,) = torch.autograd.grad(value, net.theta, upstream, retain_graph=True)
        assert gradient.item() == pytest.approx((expected * upstream).sum().item(), rel=1e-12)
    assert result.deformed.requires_grad == (stop_gradient == "none")
    assert result.output.requires_grad


@pytest.mark.parametrize("deform", [None, Shift()])
def test_released_policy_stops_the_gradient_only_where_the_deformer_ran(deform):
    def gradients(stop_gradient: str) -> list[Tensor]:
        net = Encoding(1.5)
        result = DualReconstruction(net, deform, stop_gradient=stop_gradient)(A, B, identity_faces=TETRAHEDRON)
        values = (result.output, result.reconstruction_a, result.reconstruction_b)
        return [torch.autograd.grad(v.square().sum(), net.theta, retain_graph=True)[0] for v in values]

    same, other = ("none", "deformed") if deform is None else ("deformed", "none")
    assert gradients("released") == gradients(same) != gradients(other)


def test_a_deformer_without_gradient_is_run_without_gradient():
    modes = []

    def deform(rest: Tensor, target: Tensor, faces: Tensor, *, mask: Tensor | None) -> Tensor:
        modes.append(torch.is_grad_enabled())
        return rest + target

    for policy in ("none", "deformed", "released"):
        DualReconstruction(Affine(), deform, stop_gradient=policy)(A, B, identity_faces=TETRAHEDRON)
    with torch.no_grad():
        DualReconstruction(Affine(), deform)(A, B, identity_faces=TETRAHEDRON)
    assert modes == [True, False, False, False]


# Cycle and self reconstruction


@pytest.mark.parametrize("generator", [Affine, Encoding])
def test_cycle_closed_form(generator):
    """AB = 2A + mB; BA = 2B + mA; A' = 2 AB + mBA; B' = 2 BA + mAB; A'' = 2A + mA."""
    result = CycleReconstruction(generator())(A, B)
    ab, ba = 2 * A + mean(B), 2 * B + mean(A)
    assert isinstance(result, CycleOutput)
    expected = {
        "output": ab,
        "output_b": ba,
        "reconstruction_a": 2 * ab + mean(ba),
        "reconstruction_b": 2 * ba + mean(ab),
    }
    for name, value in (expected | {"self_reconstruction": 2 * A + mean(A)}).items():
        assert_near(getattr(result, name), value, 1e-14)
    assert result.target_a is A and result.target_b is B and result.mask_a is None and result.mask_b is None
    if generator is Encoding:
        assert_near(result.warped, ab + 1, 1e-14)
        assert torch.equal(result.plan[1], B)
    else:
        assert result.warped is None and result.plan is None


def test_cycle_passes_and_encodings():
    generator = Encoding()
    id_mask, pose_mask = scattered_mask([5, 7], 7), scattered_mask([9, 2], 9)
    id_d, pose_d = rand(2, 7, 4).requires_grad_(), rand(2, 9, 4).requires_grad_()
    masks = {"identity_mask": id_mask, "pose_mask": pose_mask}
    result = CycleReconstruction(generator)(A, B, **masks, identity_descriptors=id_d, pose_descriptors=pose_d)
    meshes = {"a": (A, id_mask, id_d, True), "b": (B, pose_mask, pose_d, True)}
    meshes |= {"ab": (result.output, id_mask, id_d, False), "ba": (result.output_b, pose_mask, pose_d, False)}
    assert len(generator.encoded) == 4
    for call, (verts, mask, descriptors, passes_gradient) in zip(generator.encoded, meshes.values(), strict=True):
        assert torch.equal(call.verts, verts) and call.mask is mask and torch.equal(call.descriptors, descriptors)
        assert call.descriptors.requires_grad == passes_gradient
    order = [("a", "b"), ("b", "a"), ("ab", "ba"), ("ba", "ab"), ("a", "a")]
    assert len(generator.calls) == 5
    for call, names in zip(generator.calls, order, strict=True):
        for side, verts, name in zip(("identity", "pose"), (call.identity, call.pose), names, strict=True):
            assert torch.equal(verts, meshes[name][0])
            assert torch.equal(call.options[f"{side}_features"], 10 * verts)
            assert call.options[f"{side}_mask"] is meshes[name][1]
            assert torch.equal(call.options[f"{side}_descriptors"], meshes[name][2])
    assert result.mask_a is id_mask and result.mask_b is pose_mask


@pytest.mark.parametrize("stop_gradient", ["none", "generated"])
def test_cycle_gradient(stop_gradient):
    """d/dtheta of A' = theta AB + mBA with AB = theta A + mB, BA = theta B + mA, constants or not."""
    net = Encoding(1.5)
    result = CycleReconstruction(net, stop_gradient=stop_gradient)(A, B)
    through = 1.0 if stop_gradient == "none" else 0.0
    for value, expected in [
        (result.output, A),
        (result.output_b, B),
        (result.reconstruction_a, result.output + through * (1.5 * A + mean(B))),
        (result.reconstruction_b, result.output_b + through * (1.5 * B + mean(A))),
        (result.self_reconstruction, A),
    ]:
        upstream = rand(*value.shape, seed=5)
        (gradient,) = torch.autograd.grad(value, net.theta, upstream, retain_graph=True)
        assert gradient.item() == pytest.approx((expected * upstream).sum().item(), rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_generators_of_half_precision(dtype):
    """They give float32, and take what they gave all the same."""
    net = PoseTransferGenerator(extractor_widths=(4, 6), k=4, widths=(12, 8)).to(dtype)
    a, b = rand(2, 9, 3, dtype=dtype), rand(2, 7, 3, seed=1, dtype=dtype)
    for wrapper in (DualReconstruction(net), CycleReconstruction(net)):
        result = wrapper(a, b)
        loss = result.reconstruction_a.square().mean() + result.reconstruction_b.square().mean()
        gradients = torch.autograd.grad(loss, list(net.transfer.parameters()))
        assert loss.isfinite() and all(gradient.isfinite().all() for gradient in gradients)


def test_self_reconstruction():
    generator, mask, descriptors = Encoding(), scattered_mask([5, 7], 7), rand(2, 7, 4)
    result = SelfReconstruction(generator)(A, mask=mask, descriptors=descriptors)
    assert isinstance(result, SelfOutput)
    assert_near(result.reconstruction, 2 * A + mean(A), 1e-14)
    assert result.target is A and result.mask is mask and torch.equal(result.plan[1], A)
    assert_near(result.warped, result.reconstruction + 1, 1e-14)
    assert len(generator.encoded) == len(generator.calls) == 1
    options = generator.calls[0].options
    assert options["identity_mask"] is options["pose_mask"] is mask
    assert options["identity_descriptors"] is options["pose_descriptors"] is descriptors
    plain = SelfReconstruction(Affine())(A)
    assert plain.warped is None and plain.plan is None


# Other generators


class Foreign(nn.Module):
    """Takes (source, template) as (B, 3, N), knows its own names, returns a dictionary and an extra loss."""

    def __init__(self) -> None:
        super().__init__()
        self.theta = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))

    def forward(self, source: Tensor, template: Tensor, *, valid: Tensor | None = None) -> tuple[dict, Tensor]:
        weight = source.new_ones(len(source), source.shape[2]) if valid is None else valid.to(source.dtype)
        pose = (source * weight[:, None]).sum(2, keepdim=True) / weight.sum(1)[:, None, None]
        mesh = self.theta * template + pose
        return {"mesh": mesh, "warp": mesh + 1, "match": "plan"}, self.theta.square()


NAMES = {"identity": "template", "pose": "source", "pose_mask": "valid"}


def adapted() -> GeneratorAdapter:
    options = {f: (lambda r, k=k: r[0][k]) for f, k in (("vertices", "mesh"), ("warped", "warp"), ("plan", "match"))}
    return GeneratorAdapter(Foreign(), keywords=NAMES, channels_first=True, **options)


@pytest.mark.parametrize("wrapper", [DualReconstruction, CycleReconstruction])
def test_an_adapted_generator_equals_the_plain_one(wrapper):
    mask = scattered_mask([9, 4], 9)
    pose = torch.stack([b[m].mean(0) for b, m in zip(B, mask, strict=True)])[:, None]
    system = wrapper(adapted())
    result = system(A, B, pose_mask=mask)
    assert_near(result.output, 2 * A + pose, 1e-14)
    assert_near(result.warped, result.output + 1, 1e-14)
    assert result.plan == "plan"
    assert_near(wrapper(adapted())(A, B).reconstruction_a, wrapper(Affine())(A, B).reconstruction_a, 1e-14)
    result.reconstruction_b.square().sum().backward()
    assert system.generator.generator.theta.grad is not None


def test_adapter_reads_attributes_keys_indices_and_bare_tensors():
    tensor = A + 1
    for returned, where in [
        (tensor, None),
        ({"mesh": tensor}, "mesh"),
        (SimpleNamespace(mesh=tensor), "mesh"),
        ((0, tensor), 1),
        ([[tensor]], lambda r: r[0][0]),
    ]:
        result = GeneratorAdapter(lambda i, p, r=returned: r, vertices=where)(A, B)
        assert result.vertices is tensor and result.warped is None and result.plan is None
    # Masks go only to models that name them.
    assert GeneratorAdapter(lambda i, p: i)(A, B, identity_mask=scattered_mask([5, 7], 7)).vertices is A
    # A mesh that is named is not passed by position as well.
    assert GeneratorAdapter(lambda p, *, shape: shape, keywords={"identity": "shape"})(A, B).vertices is A


# Subsets of vertices


def test_points_choose_vertices_of_each_mesh():
    generator, deform = Encoding(), Shift()
    torch.manual_seed(0)
    # Descriptors equal to the vertices show which vertex each of them belongs to.
    result = DualReconstruction(generator, deform, points=4)(
        A, B, identity_faces=TETRAHEDRON, identity_descriptors=A, pose_descriptors=B
    )
    assert result.output.shape == result.deformed.shape == A.shape
    for target, mesh in ((result.target_a, A), (result.target_b, B)):
        assert target.shape == (2, 4, 3)
        chosen = (target[:, :, None] == mesh[:, None]).all(3)
        assert (chosen.sum(2) == 1).all() and (chosen.sum(1) <= 1).all()  # distinct vertices of the mesh
    assert result.reconstruction_a.shape == result.reconstruction_b.shape == (2, 4, 3)
    # The output needs all of A but only the chosen vertices of B; the deformer and the encoder see whole meshes.
    assert_near(result.output, 2 * A + mean(result.target_b), 1e-14)
    assert [call.verts.shape[1] for call in generator.encoded] == [7, 9, 7]
    assert torch.equal(deform.calls[0][0], A) and deform.calls[0][1] is result.output
    # The deformed mesh is read at the vertices of target_a.
    index = (result.target_a[:, :, None] == A[:, None]).all(3).long().argmax(2)
    deformed = torch.stack([d[i] for d, i in zip(result.deformed, index, strict=True)])
    assert_near(result.reconstruction_a, 2 * deformed + mean(result.target_a), 1e-14)
    assert_near(result.reconstruction_b, 2 * result.target_b + mean(deformed), 1e-14)
    for call in generator.calls:
        assert torch.equal(call.options["identity_features"], 10 * call.identity)
        assert torch.equal(call.options["pose_features"], 10 * call.pose)
    described = [(A, result.target_b), (result.target_a, result.target_a), (result.target_b, result.target_a)]
    for call, (identity, pose) in zip(generator.calls, described, strict=True):
        assert torch.equal(call.options["identity_descriptors"], identity)
        assert torch.equal(call.options["pose_descriptors"], pose)


def test_points_are_drawn_anew_and_differ_within_the_batch():
    dual = DualReconstruction(Encoding(), points=4)
    torch.manual_seed(0)
    first, second = dual(A, A), dual(A, A)
    assert not torch.equal(first.target_a, second.target_a) and not torch.equal(first.target_b, second.target_b)
    same = rand(1, 40, 3).expand(2, -1, -1)
    target = dual(same, same).target_a
    assert not torch.equal(target[0], target[1])
    torch.manual_seed(0)
    assert torch.equal(dual(A, A).target_a, first.target_a)


@pytest.mark.parametrize("points", [9, 100])
def test_points_not_below_the_vertex_count_are_all(points):
    result, expected = DualReconstruction(Encoding(), points=points)(A, B), DualReconstruction(Encoding())(A, B)
    for name in ("output", "deformed", "reconstruction_a", "reconstruction_b", "target_a", "target_b"):
        assert torch.equal(getattr(result, name), getattr(expected, name)), name


def test_points_between_the_two_vertex_counts():
    result = DualReconstruction(Encoding(), points=8)(A, B)
    assert torch.equal(result.target_a, A) and result.target_b.shape == (2, 8, 3)


# Around the real generator


@pytest.fixture(scope="module")
def network() -> PoseTransferGenerator:
    torch.manual_seed(0)
    net = PoseTransferGenerator(extractor_widths=(5, 6), k=4, widths=(8, 7)).double().eval()
    net.transfer.narrow[-1].weight.data = rand(3, 7)
    return net


@pytest.mark.parametrize("garbage", GARBAGE)
def test_padded_batch_equals_the_loop(network, garbage):
    id_sizes, pose_sizes = [6, 8], [9, 5]
    ids, poses = [rand(n, 3, seed=n) for n in id_sizes], [rand(n, 3, seed=n + 50) for n in pose_sizes]
    id_mask, pose_mask = scattered_mask(id_sizes, 10), scattered_mask(pose_sizes, 11, seed=1)
    dual = DualReconstruction(network)
    result = dual(
        scatter(ids, id_mask, garbage),
        scatter(poses, pose_mask, garbage),
        identity_mask=id_mask,
        pose_mask=pose_mask,
    )
    singles = [dual(i[None], p[None]) for i, p in zip(ids, poses, strict=True)]
    for name, mask in [
        ("output", id_mask),
        ("deformed", id_mask),
        ("warped", id_mask),
        ("reconstruction_a", id_mask),
        ("target_a", id_mask),
        ("reconstruction_b", pose_mask),
        ("target_b", pose_mask),
    ]:
        expected = torch.cat([getattr(single, name)[0] for single in singles])
        assert_near(getattr(result, name)[mask], expected, 1e-9)
    assert torch.equal(result.mask_a, id_mask) and torch.equal(result.mask_b, pose_mask)


def test_passes_equal_three_plain_calls(network):
    result = DualReconstruction(network)(A, B)
    output = network(A, B).vertices
    assert_near(result.output, output, 1e-12)
    assert_near(result.reconstruction_a, network(output, A).vertices, 1e-10)
    assert_near(result.reconstruction_b, network(B, output).vertices, 1e-10)


@pytest.mark.parametrize("options", [{}, {"descriptors": 2, "condition": "descriptors"}])
@pytest.mark.parametrize("points", [None, 4])
def test_training_step_with_the_arap_deformer(points, options):
    torch.manual_seed(0)
    net = PoseTransferGenerator(extractor_widths=(4,), k=3, widths=(6,), **options).double()
    extra = {f"{n}_descriptors": rand(2, 6, 2) for n in ("identity", "pose")} if options else {}
    octahedron = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    identity, pose = octahedron + 0.1 * rand(2, 6, 3), octahedron + 0.1 * rand(2, 6, 3, seed=1)
    dual = DualReconstruction(net, ARAPDeformer(0.5, max_iter=5), points=points)
    result = dual(identity, pose, identity_faces=faces, **extra)
    loss = (result.reconstruction_a - result.target_a).square().mean()
    loss = loss + (result.reconstruction_b - result.target_b).square().mean()
    loss.backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in dual.parameters())
    assert set(dual.state_dict()) == {f"generator.{name}" for name in net.state_dict()}


def test_documented_blocks_run():
    blocks = re.findall(
        r"```python\n(.*?)```", (Path(__file__).parents[1] / "docs" / "consistency.md").read_text(), re.S
    )
    assert blocks
    for block in blocks:
        exec(compile(block, "docs/consistency.md", "exec"), {})


# Errors


def test_errors():
    for wrapper in (DualReconstruction, CycleReconstruction):
        with pytest.raises(ValueError, match=r"stop_gradient must be one of \('none', .*\), got 'all'"):
            wrapper(Affine(), stop_gradient="all")
    with pytest.raises(ValueError, match=r"keywords may name .*, got \['target'\]"):
        GeneratorAdapter(Affine(), keywords={"target": "x"})
    for wrong in ((A[0], B), (A, B[0])):
        with pytest.raises(ValueError, match=r"must have shape \(B, N, 3\)"):
            CycleReconstruction(Affine())(*wrong)
    with pytest.raises(ValueError, match=r"must have shape \(B, N, 3\)"):
        SelfReconstruction(Affine())(A[0])
    with pytest.raises(ValueError, match="points needs a generator with an encode method"):
        DualReconstruction(Affine(), points=4)
    with pytest.raises(ValueError, match="the deformer needs identity_faces"):
        DualReconstruction(Affine(), Shift())(A, B)
    dual = DualReconstruction(Encoding(), points=4)
    for mask in (
        {"identity_mask": torch.ones(2, 7, dtype=torch.bool)},
        {"pose_mask": torch.ones(2, 9, dtype=torch.bool)},
    ):
        with pytest.raises(ValueError, match="points works on unpadded batches"):
            dual(A, B, **mask)


def test_a_plain_generator_gets_no_keywords_and_a_wrong_one_is_told() -> None:
    a, b = torch.zeros(1, 4, 3), torch.zeros(1, 5, 3)
    assert DualReconstruction(lambda identity, pose: identity)(a, b).output.shape == a.shape
    for wrong in (lambda identity, pose: pose, lambda identity, pose: {"vertices": identity}):
        with pytest.raises(ValueError, match=r"identity's shape.*expected \(1, 4, 3\)"):
            DualReconstruction(wrong)(a, b)
    with pytest.raises(ValueError, match="identity must"):
        DualReconstruction(lambda identity, pose: identity)(a[0], b)
    with pytest.raises(ValueError, match="points must be at least 1"):
        DualReconstruction(lambda identity, pose: identity, points=0)


@pytest.mark.parametrize("padded", [False, True])
def test_the_step_that_the_cuda_tests_compare_runs_here(padded):
    from test_cuda import step

    loss, gradients = step("cpu", torch.float32, padded=padded)
    assert loss.isfinite() and all(bool(g.isfinite().all()) for g in gradients)
