"""Losses on surfaces and point sets against literal loops, closed forms and SciPy; and what is kept of the faces."""

import gc
import inspect
import math
import re
from pathlib import Path

import pytest
import torch
from conftest import GARBAGE, assert_near, rand
from scipy.spatial import cKDTree
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from meshkit import _connectivity, losses, metrics
from meshkit.batching import pad, pad_faces
from meshkit.deform import arap_energy as arap_energy_of_deform
from meshkit.losses import (
    ARAPEnergyLoss,
    ChamferLoss,
    LaplacianLoss,
    NormalConsistencyLoss,
    SinkhornDivergenceLoss,
    arap_energy,
    chamfer_loss,
    edge_length_loss,
    edge_ratio_loss,
    laplacian_loss,
    normal_consistency_loss,
    sinkhorn_divergence,
)
from meshkit.topology import cotangent_laplacian

TETRAHEDRON = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
STRIP = torch.tensor([[0, 1, 2], [2, 1, 3], [2, 3, 4]])
FACES = [TETRAHEDRON, STRIP]
reductions = pytest.mark.parametrize("reduction", ["mean", "sum", "none"])


def reduced(samples: list[tuple[float, int]], reduction: str) -> Tensor:
    """The reduction rule, from each sample's sum and number of elements."""
    values = [total / (1 if reduction == "sum" else count) for total, count in samples]
    values = torch.tensor(values, dtype=torch.float64)
    return values if reduction == "none" else values.mean()


@pytest.fixture
def ragged() -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """Vertices, mask and faces of a batch of two meshes of 4 and 5 vertices, 4 and 3 faces; and the meshes."""
    meshes = [rand(4, 3), rand(5, 3, seed=1)]
    return *pad(meshes), pad_faces(FACES), meshes


# Laplacian


def laplacian_literally(mesh: Tensor, faces: Tensor, weights: str, source: Tensor) -> Tensor:
    """Differential coordinates, vertex by vertex."""
    neighbors: list[set[int]] = [set() for _ in mesh]
    for face in faces.tolist():
        for v in face:
            neighbors[v] |= set(face) - {v}
    stiffness = cotangent_laplacian(source, faces).to_dense()
    delta = torch.zeros_like(mesh)
    for i, around in enumerate(neighbors):
        pairs = [(j, 1.0 if weights == "uniform" else max(0.0, -stiffness[i, j].item())) for j in around]
        total = sum(w for _, w in pairs)
        if total > 0:
            delta[i] = mesh[i] - sum(w * mesh[j] for j, w in pairs) / total
    return delta


@reductions
@pytest.mark.parametrize("weights", ["uniform", "cotangent"])
@pytest.mark.parametrize("with_reference", [False, True])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_laplacian_equals_loops(ragged, reduction, weights, with_reference, garbage):
    verts, mask, faces, meshes = ragged
    reference = rand(2, 5, 3, seed=3) if with_reference else None
    samples = []
    for b, (mesh, own) in enumerate(zip(meshes, FACES, strict=True)):
        rest = mesh if reference is None else reference[b, : len(mesh)]
        delta = laplacian_literally(mesh, own, weights, rest)
        if reference is not None:
            delta = delta - laplacian_literally(rest, own, weights, rest)
        samples.append((delta.square().sum().item(), len(mesh)))
    poisoned = torch.where(mask[..., None], verts, garbage).requires_grad_()
    rest = None if reference is None else torch.where(mask[..., None], reference, garbage)
    value = laplacian_loss(poisoned, faces, reference=rest, weights=weights, mask=mask, reduction=reduction)
    assert_near(value, reduced(samples, reduction), 1e-12)
    (gradient,) = torch.autograd.grad(value.sum(), poisoned)
    assert gradient.isfinite().all() and (gradient[~mask] == 0).all() and (gradient[mask] != 0).any()


@pytest.mark.parametrize("weights", ["uniform", "cotangent"])
@pytest.mark.parametrize("with_reference", [False, True])
def test_laplacian_gradient(ragged, weights, with_reference):
    verts, mask, faces, _ = ragged
    reference = rand(2, 5, 3, seed=3) if with_reference else None

    def loss(v: Tensor) -> Tensor:
        return laplacian_loss(v, faces, reference=reference, weights=weights, mask=mask, reduction="none")

    assert gradcheck(loss, verts.requires_grad_())


def test_laplacian_on_a_regular_grid_is_zero_inside_whatever_the_weights():
    x, y = torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij")
    verts = torch.stack([x, y, 0 * x], 2).view(1, 16, 3)
    quads = torch.tensor([[4 * i + j, 4 * i + j + 4, 4 * i + j + 5, 4 * i + j + 1] for i in range(3) for j in range(3)])
    faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    for weights in ("uniform", "cotangent"):
        leaf = verts.clone().requires_grad_()
        laplacian_loss(leaf, faces, weights=weights).backward()
        flat = laplacian_literally(verts[0], faces, weights, verts[0])
        assert flat[[5, 6, 9, 10]].abs().amax() < 1e-6


def test_laplacian_is_linear_and_blind_to_translation():
    verts, rest = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    base = laplacian_loss(verts, STRIP)
    assert_near(laplacian_loss(3 * verts + 7, STRIP), 9 * base, 1e-12)
    assert laplacian_loss(rest + 7, STRIP, reference=rest, weights="cotangent").item() < 1e-28
    assert laplacian_loss(verts, STRIP, reference=rest).item() > 0.1


def test_laplacian_vertices_without_neighbors_or_weight_count_zero():
    verts = rand(1, 6, 3)  # vertex 5 is in no face
    five = laplacian_loss(verts[:, :5], STRIP)
    assert_near(laplacian_loss(verts, STRIP), five * 5 / 6, 1e-12)
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]).requires_grad_()  # no area, no cotangents
    value = laplacian_loss(line, torch.tensor([[0, 1, 2]]), weights="cotangent")
    assert value.item() == 0 and torch.autograd.grad(value, line)[0].isfinite().all()


# Normal consistency


def normals_literally(mesh: Tensor, faces: list[list[int]]) -> tuple[float, int]:
    total, count = 0.0, 0
    sides: dict[frozenset, list[int]] = {}
    for face in faces:
        for k in range(3):
            sides.setdefault(frozenset((face[k], face[k - 1])), []).append(face[k - 2])
    for edge, opposite in sides.items():
        if len(opposite) != 2:
            continue
        i, j = sorted(edge)
        e, p, q = mesh[j] - mesh[i], mesh[opposite[0]] - mesh[i], mesh[opposite[1]] - mesh[i]
        # The dihedral angle from the parts of p and q orthogonal to the edge: pi where flat.
        p, q = (v - (v @ e) / (e @ e) * e for v in (p, q))
        total += 1 + (p @ q / (p.norm() * q.norm())).item()
        count += 1
    return total, count


@reductions
@pytest.mark.parametrize("garbage", GARBAGE)
def test_normal_consistency_equals_dihedral_angles(ragged, reduction, garbage):
    verts, mask, faces, meshes = ragged
    samples = [normals_literally(mesh, own.tolist()) for mesh, own in zip(meshes, FACES, strict=True)]
    poisoned = torch.where(mask[..., None], verts, garbage).requires_grad_()
    for given in (None, mask):
        value = normal_consistency_loss(poisoned, faces, mask=given, reduction=reduction)
        assert_near(value, reduced(samples, reduction), 1e-12)
    (gradient,) = torch.autograd.grad(value.sum(), poisoned)
    assert gradient.isfinite().all() and (gradient[~mask] == 0).all() and (gradient[mask] != 0).any()


def test_normal_consistency_gradient(ragged):
    verts, mask, faces, _ = ragged
    assert gradcheck(lambda v: normal_consistency_loss(v, faces, mask=mask), verts.requires_grad_())


def test_normal_consistency_known_angles_whatever_the_winding():
    faces = torch.tensor([[0, 1, 2], [0, 1, 3]])
    for angle in (0.0, 0.3, math.pi / 2, math.pi):
        far = [-math.cos(angle), 0.0, math.sin(angle)]
        verts = torch.tensor([[[0.0, 0, 0], [0, 1, 0], [1, 0, 0], far]], dtype=torch.float64)
        for wound in (faces, faces.flip(1), torch.stack([faces[0], faces[1].flip(0)])):
            value = normal_consistency_loss(verts, wound)
            assert value.item() == pytest.approx(1 - math.cos(angle), abs=1e-14)


def test_normal_consistency_small_angles_in_single_precision():
    angle = 1e-4  # whose cosine is 1 in single precision
    verts = torch.tensor([[[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [-math.cos(angle), 0, math.sin(angle)]]])
    value = normal_consistency_loss(verts, torch.tensor([[0, 1, 2], [0, 3, 1]]))
    assert value.item() == pytest.approx(angle**2 / 2, rel=1e-3)


def test_normal_consistency_of_boundary_nonmanifold_and_degenerate_edges():
    verts = rand(1, 5, 3)
    assert normal_consistency_loss(verts, torch.tensor([[0, 1, 2]])).item() == 0
    fan = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4]])  # three sheets at one edge
    assert normal_consistency_loss(verts, fan).item() == 0
    flat = verts.clone()
    flat[0, 3] = flat[0, 0]  # the second face has no area
    flat.requires_grad_()
    value = normal_consistency_loss(flat, fan[:2])
    assert value.item() == 0 and (torch.autograd.grad(value, flat)[0] == 0).all()
    broken = verts.clone()
    broken[0, 2] = math.nan
    assert normal_consistency_loss(broken, fan[:2]).isnan()


@pytest.mark.parametrize("loss", [laplacian_loss, normal_consistency_loss])
def test_shared_faces_equal_repeated_faces_and_masks_remove_faces(loss):
    verts = rand(3, 5, 3)
    for reduction in ("mean", "none"):
        shared = loss(verts, STRIP, reduction=reduction)
        assert_near(shared, loss(verts, STRIP.expand(3, -1, -1), reduction=reduction), 1e-12)
    mask = torch.tensor([[True, True, True, True, False]])
    poisoned = torch.where(mask[..., None], verts[:1], math.nan)
    assert_near(loss(poisoned, STRIP, mask=mask), loss(verts[:1, :4], STRIP[:2]), 1e-12)


# Chamfer


@reductions
@pytest.mark.parametrize("direction", ["both", "forward", "backward"])
@pytest.mark.parametrize("squared", [True, False])
@pytest.mark.parametrize("garbage", GARBAGE)
def test_chamfer_equals_trees(reduction, direction, squared, garbage):
    preds, targets = [rand(4, 3), rand(7, 3, seed=1)], [rand(6, 3, seed=2), rand(3, 3, seed=3)]
    expected = 0.0
    for name, start, to in (("forward", preds, targets), ("backward", targets, preds)):
        if direction in (name, "both"):
            near = [cKDTree(q.numpy()).query(p.numpy())[0] ** (2 if squared else 1) for p, q in zip(start, to)]  # noqa: B905
            expected = expected + reduced([(d.sum(), len(d)) for d in near], reduction)
    (pred, mask), (target, target_mask) = pad(preds), pad(targets)
    leaves = [torch.where(m[..., None], x, garbage).requires_grad_() for x, m in ((pred, mask), (target, target_mask))]
    options = {"pred_mask": mask, "target_mask": target_mask, "squared": squared, "direction": direction}
    value = chamfer_loss(*leaves, **options, reduction=reduction)
    assert_near(value, expected, 1e-12)
    for gradient, m in zip(torch.autograd.grad(value.sum(), leaves), (mask, target_mask), strict=True):
        assert gradient.isfinite().all() and (gradient[~m] == 0).all() and (gradient[m] != 0).any()


@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_gradient(squared):
    leaves = [rand(2, 4, 3).requires_grad_(), rand(2, 6, 3, seed=1).requires_grad_()]
    assert gradcheck(lambda p, q: chamfer_loss(p, q, squared=squared), leaves)


def test_chamfer_of_equal_sets_is_zero_with_zero_gradient():
    points = rand(1, 6, 3).requires_grad_()
    value = chamfer_loss(points, points.detach().flip(1), squared=False)
    assert value.item() == 0 and (torch.autograd.grad(value, points)[0] == 0).all()


# Measures of other components


def test_measures_of_other_components_are_the_same_objects():
    assert arap_energy is arap_energy_of_deform
    verts, rest = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    mask = torch.tensor([[True] * 5, [True] * 4 + [False]])
    energies = arap_energy(rest, STRIP[:2], verts, energy="spokes", mask=mask)
    for reduction, expected in (("none", energies), ("mean", energies.mean())):
        assert torch.equal(
            ARAPEnergyLoss(energy="spokes", reduction=reduction)(verts, rest, STRIP[:2], mask=mask), expected
        )
    options = {"eps": 0.5, "n_iters": 7, "tol": None, "anneal": None, "debias": False}
    values = sinkhorn_divergence(verts, rest, mask_x=mask, **options)
    for reduction, expected in (("none", values), ("mean", values.mean())):
        assert torch.equal(
            SinkhornDivergenceLoss(**options, reduction=reduction)(verts, rest, pred_mask=mask), expected
        )


def test_sinkhorn_divergence_of_a_translation_is_its_squared_length():
    points = rand(1, 6, 3)
    moved = points + torch.tensor([0.3, 0.0, 0.4])
    assert SinkhornDivergenceLoss()(moved, points).item() == pytest.approx(0.25, rel=1e-2)
    near = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(SinkhornDivergenceLoss(tol=1e-9, n_iters=500)(near, moved), near)
    assert_near(gradient, -2 / 6 * (moved - points), 0.05)


# Modules, what is kept of the faces, errors


def test_modules_equal_functions():
    verts, rest = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    mask = torch.tensor([[True] * 5, [True] * 4 + [False]])
    assert torch.equal(
        LaplacianLoss(weights="cotangent", reduction="sum")(verts, STRIP, reference=rest, mask=mask),
        laplacian_loss(verts, STRIP, reference=rest, weights="cotangent", mask=mask, reduction="sum"),
    )
    assert torch.equal(
        NormalConsistencyLoss(reduction="none")(verts, STRIP, mask=mask),
        normal_consistency_loss(verts, STRIP, mask=mask, reduction="none"),
    )
    options = {"squared": False, "direction": "forward", "reduction": "sum"}
    assert torch.equal(
        ChamferLoss(**options)(verts, rest, pred_mask=mask, target_mask=mask.flip(0)),
        chamfer_loss(verts, rest, pred_mask=mask, target_mask=mask.flip(0), **options),
    )


def test_edges_are_found_once_for_a_tensor_of_faces_and_anew_when_it_changes(monkeypatch):
    calls = []
    connect = _connectivity._connect
    monkeypatch.setattr(_connectivity, "_connect", lambda *a: calls.append(a) or connect(*a))
    verts, faces = rand(2, 5, 3), STRIP.clone()
    first = edge_length_loss(verts, faces)
    edge_ratio_loss(verts, verts, faces)
    laplacian_loss(verts[:1], faces)  # shared faces serve any batch
    assert len(calls) == 1
    faces[2] = faces[1]
    assert edge_length_loss(verts, faces) != first and len(calls) == 2
    with pytest.raises(ValueError, match=r"\[0, 3\)"):  # the check is not skipped for fewer vertices
        edge_length_loss(verts[:, :3], faces)
    each = STRIP.expand(2, -1, -1).clone()
    edge_length_loss(verts, each)
    with pytest.raises(ValueError, match="batch size of the vertices"):
        edge_length_loss(verts[:1], each)


def test_edges_are_forgotten_with_their_faces():
    faces = STRIP.clone()
    edge_length_loss(rand(1, 5, 3), faces)
    gc.collect()
    before = len(_connectivity._known)
    del faces
    gc.collect()
    assert len(_connectivity._known) == before - 1


def test_edges_kept_from_inference_serve_training():
    faces, verts = STRIP.clone(), rand(1, 5, 3)
    with torch.inference_mode():
        expected = edge_length_loss(verts, faces).item()
        edge_length_loss(verts, faces.clone())  # an inference tensor
    leaf = verts.requires_grad_()
    value = edge_length_loss(leaf, faces)
    value.backward()
    assert value.item() == expected and leaf.grad is not None


@pytest.mark.parametrize("per_mesh", [False, True])
def test_second_derivatives_of_edge_losses(per_mesh):
    faces = STRIP.expand(2, -1, -1).contiguous() if per_mesh else STRIP
    mask = torch.tensor([[True] * 5, [True] * 4 + [False]])
    rest = rand(2, 5, 3, seed=1)
    assert gradgradcheck(lambda v: edge_length_loss(v, faces, mask=mask), rand(2, 5, 3).requires_grad_())
    assert gradgradcheck(lambda v: edge_ratio_loss(v, rest, faces), rand(2, 5, 3).requires_grad_())


def test_documented_blocks_run():
    blocks = re.findall(r"```python\n(.*?)```", (Path(__file__).parents[1] / "docs" / "losses.md").read_text(), re.S)
    assert blocks
    for block in blocks:
        exec(compile(block, "docs/losses.md", "exec"), {})


V = torch.zeros(2, 5, 3)
NONE = torch.zeros(2, 5, dtype=torch.bool)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: laplacian_loss(V, STRIP, reduction="avg"), "reduction must be one of .*'avg'"),
        (lambda: laplacian_loss(V, STRIP, weights="mean"), "weights must be one of .*'mean'"),
        (lambda: laplacian_loss(V[0], STRIP), "verts must"),
        (lambda: laplacian_loss(V, STRIP, reference=V[0]), "reference must"),
        (lambda: laplacian_loss(V, STRIP, reference=V[:1]), "same shape"),
        (lambda: laplacian_loss(V[:, :4], STRIP), r"\[0, 4\)"),
        (lambda: laplacian_loss(V, STRIP.tolist()), "faces must be a torch.Tensor"),
        (lambda: laplacian_loss(V, STRIP, mask=NONE.float()), "must be bool"),
        (lambda: LaplacianLoss(weights="mean"), "weights"),
        (lambda: LaplacianLoss(reduction="avg"), "reduction"),
        (lambda: normal_consistency_loss(V, STRIP, reduction="avg"), "reduction"),
        (lambda: normal_consistency_loss(V[0], STRIP), "verts must"),
        (lambda: normal_consistency_loss(V, STRIP.expand(3, -1, -1)), "batch size of the vertices"),
        (lambda: normal_consistency_loss(V, STRIP, mask=NONE[:, :4]), r"mask must have shape \(2, 5\)"),
        (lambda: NormalConsistencyLoss(reduction="avg"), "reduction"),
        (lambda: chamfer_loss(V, V, reduction="avg"), "reduction"),
        (lambda: chamfer_loss(V, V, direction="there"), "direction must be one of .*'there'"),
        (lambda: chamfer_loss(V[0], V), "pred must"),
        (lambda: chamfer_loss(V, V[0]), "target must"),
        (lambda: chamfer_loss(V, V[:1]), "one batch size"),
        (lambda: chamfer_loss(V, V, pred_mask=NONE), r"pred_mask marks no real vertex in samples \[0, 1\]"),
        (lambda: chamfer_loss(V, V, target_mask=NONE), "target_mask marks no real vertex"),
        (lambda: ChamferLoss(direction="there"), "direction"),
        (lambda: ChamferLoss(reduction="avg"), "reduction"),
        (lambda: SinkhornDivergenceLoss(reduction="sum"), r"reduction must be one of \('mean', 'none'\).*'sum'"),
        (lambda: ARAPEnergyLoss(reduction="sum"), "reduction must be one of"),
        (lambda: ARAPEnergyLoss(energy="springs"), "energy must be one of .* got 'springs'"),
        (lambda: SinkhornDivergenceLoss(eps=0.0), "eps must be positive"),
        (lambda: SinkhornDivergenceLoss(n_iters=0), "n_iters must be an integer of at least 1"),
        (lambda: SinkhornDivergenceLoss(anneal=1.0), "anneal must be between 0 and 1"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()


@pytest.mark.parametrize("module", [losses, metrics])
def test_meshes_that_need_not_correspond_have_masks_named_after_them(module):
    """One convention: a lone mask is ``mask``; of two masks each says whose it is."""
    for name in module.__all__:
        call = getattr(getattr(module, name), "forward", getattr(module, name))
        if not callable(call) or name[0] == "_":
            continue
        named = [key for key in inspect.signature(call).parameters if key == "mask" or key.endswith("_mask")]
        assert "mask" not in named or named == ["mask"], (name, named)
