"""Every public module of the package through the same checks.

A new ``nn.Module`` in the public API needs an entry here: how to build a small one, and which of its inputs have one
row per vertex. The checks then know how to pad, permute, cast and compile it.
"""

import copy
import importlib
import inspect
import io
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from conftest import assert_near, rand, scatter, scattered_mask
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized
from update_public_api import public_modules

from meshkit.consistency import CycleReconstruction, DualReconstruction, GeneratorAdapter, SelfReconstruction
from meshkit.data import RiggedModel
from meshkit.deform import ARAPDeformer
from meshkit.losses import (
    ARAPEnergyLoss,
    BackwardCorrespondenceLoss,
    ChamferLoss,
    EdgeLengthLoss,
    EdgeRatioLoss,
    LaplacianLoss,
    MatchingLoss,
    NormalConsistencyLoss,
    ReconstructionLoss,
    SinkhornDivergenceLoss,
)
from meshkit.models import (
    NPT,
    GeneratorConfig,
    OrderedPoseTransferStack,
    PointwiseExtractor,
    PoseTransferGenerator,
    PoseTransferStack,
    PretrainedTransfer,
)
from meshkit.neighbors import knn
from meshkit.nn import ConditionalResBlock, SetConv, SetConvExtractor
from meshkit.norm import SPADE, AdaIN, ConditionalNorm, ElaIN, SoftAdaIN, SPAdaIN
from meshkit.ot import CorrespondenceWarp, SinkhornCorrespondence, sinkhorn

ABSTRACT = {ConditionalNorm}
SIZES = {"a": (8, 11), "b": (9, 7)}  # real vertices of the two samples in each of two vertex sets
Inputs = dict[str, Any]


def strip(n: int) -> Tensor:
    """Faces of a triangle strip over n vertices."""
    return torch.arange(n - 2)[:, None] + torch.arange(3)


@dataclass(frozen=True)
class Entry:
    """How to build a module and how to call it.

    ``rows`` maps an input to its vertex set and its channels; ``index`` an input to the vertex set it points into and
    its values for n vertices; ``masks`` a vertex set to the keywords of its mask. ``prepare`` completes the inputs.
    ``result`` picks the tensor that is compared, whose rows belong to ``out`` (None: no vertices).
    """

    build: Callable[[], nn.Module]
    rows: dict[str, tuple[str, int]] = field(default_factory=dict)
    masks: dict[str, Sequence[str]] = field(default_factory=dict)
    index: dict[str, tuple[str, Callable[[int], Tensor]]] = field(default_factory=dict)
    prepare: Callable[[Inputs], Inputs] = lambda inputs: inputs
    result: Callable[[Any], Tensor] = lambda output: output
    out: str | None = "a"
    equivariant: bool = True
    constants: Sequence[str] = ()  # inputs without gradient, by design
    inert: Sequence[str] = ()  # parameters without effect in this configuration
    # "fullgraph", "forward" (fullgraph, without gradient), "breaks" (with graph breaks) or None (not here)
    compile: str | None = "fullgraph"
    bf16: float = 0.05  # relative deviation allowed under autocast
    device: float = 1e-8  # and between devices


def with_neighbors(inputs: Inputs) -> Inputs:
    return {**inputs, "neighbors": knn(inputs["positions"], 4, mask=inputs.get("mask"))}


def with_plan(inputs: Inputs) -> Inputs:
    inputs = dict(inputs)
    plan = sinkhorn(
        inputs.pop("identity_features"),
        inputs.pop("pose_features"),
        eps=0.3,
        mask_x=inputs.get("identity_mask"),
        mask_y=inputs.get("pose_mask"),
    )
    return {**inputs, "plan": plan.dense()}


def with_matches(inputs: Inputs) -> Inputs:
    plan = with_plan(inputs)["plan"]
    return {"plan": plan, "correspondence": plan.detach().argmax(2)}


def rigged() -> RiggedModel:
    return RiggedModel(
        rand(6, 3).float(),
        strip(6),
        rand(2, 6, 3, seed=1).float(),
        rand(3, 3, seed=2).float(),
        rand(2, 3, 3, seed=3).float(),
        rand(6, 3, seed=4).float().abs(),
        torch.tensor([-1, 0, 1]),
        pose_correctives=rand(18, 6, 3, seed=5).float(),
    )


PAIR = {"rows": {"identity": ("a", 3), "pose": ("b", 3)}, "masks": {"a": ["identity_mask"], "b": ["pose_mask"]}}
SMALL = {"extractor_widths": (5, 6), "k": 4, "widths": (8,), "eps": 0.3}


def norm(build: Callable[[], nn.Module], *, condition: str = "a") -> Entry:
    masks = {"a": ["mask"]} if condition == "a" else {"a": ["mask"], "b": ["cond_mask"]}
    return Entry(build, {"x": ("a", 6), "cond": (condition, 4)}, masks)


ENTRIES = {
    "AdaIN": norm(lambda: AdaIN(6, 4), condition="b"),
    "SoftAdaIN": norm(lambda: SoftAdaIN(6, 4), condition="b"),
    "SPAdaIN": norm(lambda: SPAdaIN(6, 4)),
    "SPADE": norm(lambda: SPADE(6, 4, hidden=8)),
    "ElaIN-released": norm(lambda: ElaIN(6, 4)),
    "ElaIN-paper": norm(lambda: ElaIN(6, 4, variant="paper")),
    "ConditionalResBlock": norm(lambda: ConditionalResBlock(6, 4)),
    "ConditionalResBlock-plain": replace(
        norm(lambda: ConditionalResBlock(6, 4, spectral=False, norm=SPAdaIN)), inert=["conv_0.bias"]
    ),
    "SetConv": Entry(
        lambda: SetConv(5, 6),
        {"x": ("a", 5), "positions": ("a", 3)},
        {"a": ["mask"]},
        prepare=with_neighbors,
        constants=["positions"],
    ),
    "SetConvExtractor": Entry(
        lambda: SetConvExtractor((5, 6), k=4), {"positions": ("a", 3)}, {"a": ["mask"]}, compile="breaks"
    ),
    "PointwiseExtractor": Entry(
        lambda: PointwiseExtractor((5, 6), blocks=2, descriptors=2),
        {"positions": ("a", 3), "descriptors": ("a", 2)},
        {"a": ["mask"]},
    ),
    "PoseTransferStack": Entry(
        lambda: PoseTransferStack(4, (8,)), {"warped": ("a", 3), "features": ("a", 4)}, {"a": ["mask"]}
    ),
    "OrderedPoseTransferStack": Entry(
        lambda: OrderedPoseTransferStack(4, (8,)),
        {"warped": ("a", 3), "features": ("a", 4)},
        {"a": ["mask"]},
        equivariant=False,
        compile=None,  # as PoseTransferStack
    ),
    "PoseTransferGenerator-setconv": Entry(
        lambda: PoseTransferGenerator(**SMALL, residual=True),
        **PAIR,
        result=lambda o: o.vertices,
        compile=None,  # its networks are compiled above; for the matching see SinkhornCorrespondence
    ),
    "PoseTransferGenerator-pointwise": Entry(
        lambda: PoseTransferGenerator(**SMALL, extractor="pointwise", residual=True),
        **PAIR,
        result=lambda o: o.vertices,
        compile=None,  # as above
    ),
    "PretrainedTransfer": Entry(
        lambda: PretrainedTransfer(PoseTransferGenerator(**SMALL, residual=True), GeneratorConfig(k=4)),
        **PAIR,
        compile=None,  # as its generator
    ),
    "NPT-maxpool": Entry(
        lambda: NPT(encoder_widths=(4, 9)),
        **PAIR,
        result=lambda o: o.vertices,
        compile="forward",  # ConditionalResBlock-plain stands for the gradient
    ),
    "NPT-original": Entry(
        lambda: NPT("original", encoder_widths=(4, 5, 9)),
        {"identity": ("a", 3), "pose": ("a", 3)},
        {"a": ["identity_mask", "pose_mask"]},
        result=lambda o: o.vertices,
        compile=None,  # as NPT-maxpool
    ),
    "DualReconstruction": Entry(
        lambda: DualReconstruction(PoseTransferGenerator(**SMALL, residual=True)),
        **PAIR,
        result=lambda o: o.reconstruction_a,
        compile=None,  # three times its generator
        bf16=0.2,  # two generators, one after the other
    ),
    "ARAPDeformer": Entry(
        lambda: ARAPDeformer(0.5, max_iter=3, method="local_global"),
        {"rest": ("a", 3), "target": ("a", 3)},
        {"a": ["mask"]},
        {"faces": ("a", strip), "handles": ("a", lambda n: torch.arange(0, n, 2))},
        compile=None,  # equal, but its loops are unrolled, which takes minutes
        device=1e-5,  # rotations are float32 on the CPU, float64 elsewhere
    ),
    "ARAPDeformer-batched": Entry(
        lambda: ARAPDeformer(0.5, max_iter=3, solver="dense"),
        {"rest": ("a", 3), "target": ("a", 3)},
        {"a": ["mask"]},
        {"faces": ("a", strip), "handles": ("a", lambda n: torch.arange(0, n, 2))},
        compile=None,  # as above
    ),
    "RiggedModel": Entry(
        rigged,
        prepare=lambda inputs: {"identity": rand(2, 2).to(DTYPE), "pose": rand(2, 3, 3, seed=1).to(DTYPE)},
        out=None,
    ),
}
ENTRIES |= {
    "SinkhornCorrespondence": Entry(
        lambda: SinkhornCorrespondence(eps=0.3, learn_eps=True),
        {"fx": ("a", 4), "fy": ("b", 4)},
        {"a": ["mask_x"], "b": ["mask_y"]},
        result=lambda plan: plan.topk(3)[0],
        compile=None,  # equal, but each sweep of each iteration is unrolled
    ),
    "CorrespondenceWarp": Entry(
        lambda: CorrespondenceWarp(SinkhornCorrespondence(eps=0.3)),
        {"fx": ("a", 4), "fy": ("b", 4), "values": ("b", 3)},
        {"a": ["mask_x"], "b": ["mask_y"]},
        result=lambda output: output[0],
        compile=None,  # as above
    ),
    "EdgeLengthLoss": Entry(
        EdgeLengthLoss, {"verts": ("a", 3)}, {"a": ["mask"]}, {"faces": ("a", strip)}, out=None, compile="breaks"
    ),
    "EdgeRatioLoss": Entry(
        EdgeRatioLoss,
        {"verts": ("a", 3), "reference": ("a", 3)},
        {"a": ["mask"]},
        {"faces": ("a", strip)},
        out=None,
        constants=["reference"],
        compile="breaks",
    ),
    "ReconstructionLoss": Entry(ReconstructionLoss, {"pred": ("a", 3), "target": ("a", 3)}, {"a": ["mask"]}, out=None),
    "BackwardCorrespondenceLoss": Entry(
        BackwardCorrespondenceLoss,
        {"identity_features": ("a", 4), "pose_features": ("b", 4), "pose_verts": ("b", 3)},
        {"a": ["identity_mask"], "b": ["pose_mask"]},
        prepare=with_plan,
        out=None,
    ),
    "MatchingLoss": Entry(
        MatchingLoss,
        {"identity_features": ("a", 4), "pose_features": ("b", 4)},
        {"a": ["identity_mask"], "b": ["pose_mask"]},
        prepare=with_matches,
        out=None,
    ),
}
SURFACE = {"masks": {"a": ["mask"]}, "index": {"faces": ("a", strip)}, "out": None, "compile": "breaks"}
POINTS = {
    "rows": {"pred": ("a", 3), "target": ("b", 3)},
    "masks": {"a": ["pred_mask"], "b": ["target_mask"]},
    "out": None,
}
ENTRIES |= {
    "LaplacianLoss": Entry(LaplacianLoss, {"verts": ("a", 3), "reference": ("a", 3)}, **SURFACE),
    "LaplacianLoss-cotangent": Entry(lambda: LaplacianLoss(weights="cotangent"), {"verts": ("a", 3)}, **SURFACE),
    "NormalConsistencyLoss": Entry(NormalConsistencyLoss, {"verts": ("a", 3)}, **SURFACE),
    "ChamferLoss": Entry(ChamferLoss, **POINTS, compile="breaks"),
    "SinkhornDivergenceLoss": Entry(
        lambda: SinkhornDivergenceLoss(eps=0.3, n_iters=20, tol=None, anneal=None),
        **POINTS,
        compile=None,  # as SinkhornCorrespondence
    ),
    "ARAPEnergyLoss": Entry(
        ARAPEnergyLoss,
        {"verts": ("a", 3), "reference": ("a", 3)},
        **SURFACE | {"compile": None},  # as ARAPDeformer
        constants=["reference"],
    ),
    "CycleReconstruction": Entry(
        lambda: CycleReconstruction(PoseTransferGenerator(**SMALL, residual=True)),
        **PAIR,
        result=lambda o: o.reconstruction_a,
        compile=None,  # as DualReconstruction
        bf16=0.2,
    ),
    "SelfReconstruction": Entry(
        lambda: SelfReconstruction(PoseTransferGenerator(**SMALL, residual=True)),
        {"verts": ("a", 3)},
        {"a": ["mask"]},
        result=lambda o: o.reconstruction,
        compile=None,  # as its generator
    ),
    "GeneratorAdapter": Entry(
        lambda: GeneratorAdapter(
            PoseTransferGenerator(**SMALL, residual=True),
            keywords={name: name for name in ("identity_mask", "pose_mask")},
            vertices="vertices",
        ),
        **PAIR,
        result=lambda o: o.vertices,
        compile=None,  # as its generator
    ),
}
DTYPE = torch.float64
CASES = pytest.mark.parametrize("name", ENTRIES)


# Building and calling


def make(entry: Entry, seed: int = 0, dtype: torch.dtype = DTYPE) -> nn.Module:
    """The module in evaluation mode, with parameters away from the values they are initialised with."""
    torch.manual_seed(seed)
    module = entry.build()
    for parameter in module.parameters():
        if parameter.dim() < 2:
            parameter.data += 0.2 * torch.randn_like(parameter)
    return module.to(dtype).eval()


def samples(entry: Entry, which: int) -> dict[str, Tensor]:
    """Rows ``(n, C)`` of one sample, of every input."""
    return {
        name: 0.5 * rand(SIZES[group][which], channels, seed=100 * which + i)
        for i, (name, (group, channels)) in enumerate(entry.rows.items())
    }


def single(entry: Entry, which: int) -> Inputs:
    """A batch of one sample, unpadded."""
    indices = {name: of(SIZES[group][which])[None] for name, (group, of) in entry.index.items()}
    return {name: rows[None] for name, rows in samples(entry, which).items()} | indices


def pair(entry: Entry, dtype: torch.dtype = DTYPE) -> Inputs:
    """A batch of two different samples of one size."""
    sample = single(entry, 1)
    return {
        name: torch.cat([v, 0.5 * rand(*v.shape, seed=7 + i)]).to(dtype) if v.is_floating_point() else torch.cat([v, v])
        for i, (name, v) in enumerate(sample.items())
    }


def call(entry: Entry, module: Callable[..., Any], inputs: Inputs) -> Tensor:
    return entry.result(module(**entry.prepare(inputs)))


def upstream(result: Tensor) -> Tensor:
    return rand(result.numel(), seed=3).reshape(result.shape)


def inert(module: nn.Module) -> set[str]:
    """Parameters that a module itself declares to be without effect."""
    return {
        f"{prefix}.{name}".lstrip(".")
        for prefix, child in module.named_modules()
        for name in getattr(child, "inert_parameters", list)()
    }


# Completeness


def test_every_public_module_has_an_entry():
    public = {
        value
        for module in map(importlib.import_module, public_modules())
        for value in (getattr(module, name) for name in getattr(module, "__all__", ()))
        if isinstance(value, type) and issubclass(value, nn.Module)
    }
    covered = {type(entry.build()) for entry in ENTRIES.values()}
    assert public - covered - ABSTRACT == set(), "new modules: give each an entry in ENTRIES"
    assert covered <= public


# Checks

# Options that the printed parts show: classes, numbers of modules, widths of linear maps. Tables are buffers.
SHOWN_BY_PARTS = {"norm", "spectral", "extractor", "extractor_blocks", "blocks", "hidden", "card"}
SHOWN_BY_PARTS |= {"pose_correctives", "identities", "poses"}


@CASES
def test_a_printed_module_shows_its_options(name):
    module = ENTRIES[name].build()
    options = {
        option.name
        for option in inspect.signature(type(module).__init__).parameters.values()
        if option.kind is option.KEYWORD_ONLY and isinstance(option.default, bool | int | float | str | None)
    }
    if name == "PoseTransferGenerator-pointwise":
        options -= {"k"}  # without effect
    assert {option for option in options - SHOWN_BY_PARTS if f"{option}=" not in repr(module)} == set()


@CASES
def test_state_dict_round_trip(name):
    entry = ENTRIES[name]
    module, other = make(entry), make(entry, seed=1)
    inputs = pair(entry)
    expected = call(entry, module, inputs)
    if list(module.parameters()):
        assert not torch.equal(call(entry, other, inputs), expected)
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(call(entry, other, inputs), expected)


@CASES
def test_dtype_follows_the_input(name, monkeypatch):
    entry, results = ENTRIES[name], {}
    for dtype in (torch.float64, torch.float32):
        monkeypatch.setitem(globals(), "DTYPE", dtype)
        results[dtype] = call(entry, make(entry, dtype=dtype), pair(entry, dtype))
        assert results[dtype].dtype == dtype
    assert_near(results[torch.float32].double(), results[torch.float64], 1e-4)


@CASES
def test_autocast(name, monkeypatch):
    entry = ENTRIES[name]
    monkeypatch.setitem(globals(), "DTYPE", torch.float32)
    module, inputs = make(entry, dtype=torch.float32), pair(entry, torch.float32)
    exact = call(entry, module, inputs)
    with torch.autocast("cpu", torch.bfloat16):
        result = call(entry, module, inputs)
    assert result.isfinite().all()
    assert (result.float() - exact).norm() < entry.bf16 * exact.norm()


@CASES
@pytest.mark.filterwarnings("ignore")
def test_backward_started_within_autocast(name, monkeypatch):
    """Where the block of the forward pass has not been left yet, as in many training loops."""
    entry = ENTRIES[name]
    monkeypatch.setitem(globals(), "DTYPE", torch.float32)
    module, inputs = make(entry, dtype=torch.float32), entry.prepare(pair(entry, torch.float32))
    wanted = {k: x.detach().requires_grad_() for k, x in inputs.items() if x is not None and x.is_floating_point()}
    with torch.autocast("cpu", torch.bfloat16):
        result = entry.result(module(**inputs | wanted)).float()
        given = [result.square().sum(), [*wanted.values(), *module.parameters()]]
        within = torch.autograd.grad(*given, allow_unused=True, retain_graph=True)
    for gradient, expected in zip(within, torch.autograd.grad(*given, allow_unused=True), strict=True):
        if expected is not None:
            assert (gradient - expected).norm() <= entry.bf16 * expected.norm() + 1e-6


@CASES
@pytest.mark.filterwarnings("ignore")
def test_compile(name):
    """Captured and run by the autograd-aware eager backend: same result and same gradients as without."""
    entry = ENTRIES[name]
    if entry.compile is None:
        pytest.skip("too slow to compile here: see the entry")
    module, inputs = make(entry), entry.prepare(pair(entry))
    torch._dynamo.reset()
    compiled = torch.compile(module, backend="aot_eager", fullgraph=entry.compile != "breaks")
    with torch.set_grad_enabled(entry.compile != "forward"):
        outputs = [entry.result(run(**inputs)) for run in (module, compiled)]
    assert_near(outputs[1], outputs[0], 1e-10)
    parameters = [] if entry.compile == "forward" else list(module.parameters())
    if parameters:
        gradients = [torch.autograd.grad(o, parameters, upstream(o), materialize_grads=True) for o in outputs]
        for value, expected in zip(*reversed(gradients), strict=True):
            assert_near(value, expected, 1e-8, scale=max(1.0, expected.abs().amax().item()))


@CASES
def test_copy_and_pickle(name):
    entry = ENTRIES[name]
    module, inputs = make(entry), pair(entry)
    expected = call(entry, module, inputs)
    assert torch.equal(call(entry, copy.deepcopy(module), inputs), expected)
    if any(is_parametrized(child) for child in module.modules()):
        with pytest.raises(RuntimeError, match="only supported through state_dict"):
            pickle.dumps(module)
    else:
        assert torch.equal(call(entry, pickle.loads(pickle.dumps(module)), inputs), expected)


@CASES
def test_train_and_eval(name):
    """Modes reach every child; evaluation repeats exactly and changes nothing; training changes no parameter."""
    entry = ENTRIES[name]
    module, inputs = make(entry), pair(entry)
    before = {n: v.clone() for n, v in module.state_dict().items()}
    first = call(entry, module, inputs)
    assert torch.equal(call(entry, module, inputs), first)
    assert all(torch.equal(v, before[n]) for n, v in module.state_dict().items())
    module.train()
    assert all(child.training for child in module.modules())
    assert call(entry, module, inputs).isfinite().all()
    assert all(torch.equal(p, before[n]) for n, p in module.named_parameters())
    assert not any(child.training for child in module.eval().modules())


@CASES
@pytest.mark.parametrize("garbage", [1e20, float("nan")])
def test_padding_changes_nothing(name, garbage):
    entry = ENTRIES[name]
    if not entry.masks:
        pytest.skip("no vertices to pad")
    module, total = make(entry), {"a": 13, "b": 10}
    masks = {group: scattered_mask(SIZES[group], total[group], seed=ord(group)) for group in SIZES}
    rows = [samples(entry, which) for which in (0, 1)]
    inputs: Inputs = {
        key: scatter([r[key] for r in rows], masks[group], garbage).requires_grad_()
        for key, (group, _) in entry.rows.items()
    }
    for key, (group, values) in entry.index.items():
        places = [m.nonzero()[:, 0][values(n)] for m, n in zip(masks[group], SIZES[group], strict=True)]
        padded = torch.full((2, max(map(len, places)), *places[0].shape[1:]), -1)
        for b, place in enumerate(places):
            padded[b, : len(place)] = place
        inputs[key] = padded
    leaves = [inputs[key] for key in entry.rows]
    inputs |= {keyword: masks[group] for group, keywords in entry.masks.items() for keyword in keywords}
    result = call(entry, module, inputs)
    singles = [call(entry, module, single(entry, which)) for which in (0, 1)]
    if entry.out is None:
        assert_near(result, torch.stack(singles).mean(), 1e-10)
    else:
        result = result[masks[entry.out]]
        assert_near(result, torch.cat([s[0] for s in singles]), 1e-10)
    gradients = torch.autograd.grad(result, leaves, upstream(result), allow_unused=True)
    for gradient, (key, (group, _)) in zip(gradients, entry.rows.items(), strict=True):
        assert (gradient is None) <= (key in entry.constants), f"no gradient reaches {key}"
        if gradient is not None:
            assert gradient.isfinite().all() and (gradient[~masks[group]] == 0).all(), key


@CASES
def test_permutation_equivariance(name):
    entry = ENTRIES[name]
    if not entry.rows:
        pytest.skip("no vertices to permute")
    module, inputs = make(entry), pair(entry)
    expected = call(entry, module, inputs)
    generator = torch.Generator().manual_seed(1)
    orders = {group: torch.randperm(n[1], generator=generator) for group, n in SIZES.items()}
    moved = {key: inputs[key][:, orders[group]] for key, (group, _) in entry.rows.items()}
    moved |= {key: orders[group].argsort()[inputs[key]] for key, (group, _) in entry.index.items()}
    result = call(entry, module, moved)
    wanted = expected if entry.out is None else expected[:, orders[entry.out]]
    if entry.equivariant:
        assert_near(result, wanted, 1e-10)
    else:
        assert (result - wanted).norm() > 1e-3 * wanted.norm()


@CASES
def test_gradient_reaches_every_parameter(name):
    entry = ENTRIES[name]
    module = make(entry).train()
    if not list(module.parameters()):
        pytest.skip("no parameters")
    result = call(entry, module, pair(entry))
    (result * upstream(result)).sum().backward()
    without = inert(module) | set(entry.inert)
    for key, parameter in module.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), key
        assert (parameter.grad.abs().amax() > 1e-9) == (key not in without), key


# Devices


@CASES
@pytest.mark.filterwarnings("ignore")
def test_no_tensor_is_made_on_the_default_device(name):
    """With another default device, everything still happens where the inputs are."""
    entry = ENTRIES[name]
    module, inputs = make(entry), entry.prepare(pair(entry))
    wanted = {
        k: x.detach().clone().requires_grad_() for k, x in inputs.items() if x is not None and x.is_floating_point()
    }

    def run() -> list[Tensor | None]:
        result = entry.result(module(**inputs | wanted))
        return [result, *torch.autograd.grad(result.square().sum(), [*wanted.values()], allow_unused=True)]

    with torch.device("meta"):  # first: what is kept between calls must be right as well
        results = run()
    expected = run()
    for result, value in zip(results, expected, strict=True):
        assert value is None or (result.device.type == "cpu" and torch.equal(result, value))


@CASES
def test_cuda(name):
    if not torch.cuda.is_available():
        pytest.skip("CUDA is not available")
    entry = ENTRIES[name]
    module, inputs = make(entry), entry.prepare(pair(entry))
    expected = entry.result(module(**inputs))
    on_device = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in inputs.items()}
    result = entry.result(module.cuda()(**on_device))
    assert result.is_cuda
    assert_near(result.cpu(), expected, entry.device)
