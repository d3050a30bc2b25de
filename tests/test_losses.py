"""Losses against literal loops over samples, vertices, faces and matrix entries."""

import importlib
import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from meshkit.batching import pad, pad_faces
from meshkit.losses import (
    BackwardCorrespondenceLoss,
    EdgeLengthLoss,
    EdgeRatioLoss,
    MatchingLoss,
    ReconstructionLoss,
    backward_correspondence_loss,
    edge_length_loss,
    edge_ratio_loss,
    matching_loss,
    reconstruction_loss,
)
from meshkit.ot import sinkhorn

edge_ratio = importlib.import_module("meshkit.losses.edge_ratio")

GARBAGE = [1e20, float("nan")]
TETRAHEDRON = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
STRIP = torch.tensor([[0, 1, 2], [2, 1, 3], [2, 3, 4]])


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def reduce_literally(samples: list[tuple[float, int]], reduction: str) -> list[float] | float:
    """The reduction rule, from each sample's sum and number of elements."""
    if reduction == "sum":
        return sum(total for total, _ in samples) / len(samples)
    means = [total / count for total, count in samples]
    return means if reduction == "none" else sum(means) / len(means)


def assert_close(value: torch.Tensor, expected: list[float] | float) -> None:
    torch.testing.assert_close(value, torch.tensor(expected, dtype=value.dtype), rtol=1e-12, atol=1e-12)


@pytest.fixture
def ragged() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, list[torch.Tensor]]:
    """Vertices, mask and faces of a batch of two meshes of 4 and 5 vertices, 4 and 3 faces; and the meshes."""
    meshes = [rand(4, 3), rand(5, 3, seed=1)]
    return *pad(meshes), pad_faces([TETRAHEDRON, STRIP]), meshes


@pytest.fixture(params=[False, True], ids=["by-edges", "by-faces"])
def walk(request, monkeypatch) -> None:
    """How edge ratios are found; face by face on devices other than the CPU."""
    monkeypatch.setattr(edge_ratio, "launch_bound", lambda x: request.param)


reductions = pytest.mark.parametrize("reduction", ["mean", "sum", "none"])


# Reconstruction


@reductions
@pytest.mark.parametrize("garbage", GARBAGE)
def test_reconstruction_equals_loops(ragged, reduction, garbage):
    verts, mask, _, meshes = ragged
    target = rand(2, 5, 3, seed=2)
    samples = []
    for b, mesh in enumerate(meshes):
        total = 0.0
        for n in range(len(mesh)):
            for c in range(3):
                total += (mesh[n, c].item() - target[b, n, c].item()) ** 2
        samples.append((total, 3 * len(mesh)))
    pred = torch.where(mask[..., None], verts, garbage)
    value = reconstruction_loss(pred, target, mask=mask, reduction=reduction)
    assert_close(value, reduce_literally(samples, reduction))


def test_reconstruction_mean_is_mse():
    pred, target = rand(2, 5, 3), rand(2, 5, 3, seed=1)
    torch.testing.assert_close(reconstruction_loss(pred, target), torch.nn.functional.mse_loss(pred, target))


@reductions
def test_reconstruction_gradient(ragged, reduction):
    verts, mask, _, _ = ragged
    leaves = [verts.requires_grad_(), rand(2, 5, 3, seed=2).requires_grad_()]
    assert gradcheck(lambda p, t: reconstruction_loss(p, t, mask=mask, reduction=reduction), leaves)


def test_half_precision_is_lifted():
    pred = torch.full((1, 2, 3), 300.0, dtype=torch.float16)  # the square, 9e4, is beyond float16
    value = reconstruction_loss(pred, torch.zeros_like(pred))
    assert value.dtype == torch.float32 and value.item() == 9e4


# Edge length


def edge_length_literally(mesh: torch.Tensor, faces: list[list[int]]) -> tuple[float, int]:
    neighbors: list[set[int]] = [set() for _ in mesh]
    for face in faces:
        for v in face:
            neighbors[v] |= set(face) - {v}
    lengths = [math.dist(mesh[v].tolist(), mesh[u].tolist()) ** 2 for v in range(len(mesh)) for u in neighbors[v]]
    return sum(lengths), len(lengths)


@reductions
@pytest.mark.parametrize("garbage", GARBAGE)
def test_edge_length_equals_neighbor_loops(ragged, reduction, garbage):
    verts, mask, faces, meshes = ragged
    samples = [edge_length_literally(mesh, f.tolist()) for mesh, f in zip(meshes, (TETRAHEDRON, STRIP), strict=True)]
    poisoned = torch.where(mask[..., None], verts, garbage)
    for m in (None, mask):
        value = edge_length_loss(poisoned, faces, mask=m, reduction=reduction)
        assert_close(value, reduce_literally(samples, reduction))


@reductions
def test_edge_length_shared_faces_equal_repeated_faces(reduction):
    verts = rand(3, 5, 3)
    shared = edge_length_loss(verts, STRIP, reduction=reduction)
    assert_close(shared, reduce_literally([edge_length_literally(v, STRIP.tolist()) for v in verts], reduction))
    torch.testing.assert_close(shared, edge_length_loss(verts, STRIP.expand(3, -1, -1), reduction=reduction))


@pytest.mark.parametrize("garbage", GARBAGE)
def test_edge_length_mask_removes_edges_of_shared_faces(garbage):
    verts = rand(1, 5, 3)
    mask = torch.tensor([[True, True, True, True, False]])
    expected = edge_length_loss(verts[:, :4], STRIP[:2])
    poisoned = torch.where(mask[..., None], verts, garbage).requires_grad_()
    value = edge_length_loss(poisoned, STRIP, mask=mask)
    torch.testing.assert_close(value, expected)
    (grad,) = torch.autograd.grad(value, poisoned)
    assert grad.isfinite().all() and (grad[0, 4] == 0).all()


@reductions
def test_edge_length_gradient(ragged, reduction):
    verts, mask, faces, _ = ragged
    assert gradcheck(lambda v: edge_length_loss(v, faces, mask=mask, reduction=reduction), verts.requires_grad_())


# Edge ratio


def edge_ratio_literally(mesh: torch.Tensor, reference: torch.Tensor, faces: list[list[int]]) -> tuple[float, int]:
    total = 0.0
    for face in faces:
        for k in range(3):
            i, j = face[k], face[(k + 1) % 3]
            length = math.dist(reference[i].tolist(), reference[j].tolist())
            if length > 0:
                total += abs(math.dist(mesh[i].tolist(), mesh[j].tolist()) / length - 1)
    return total, len(faces)


@reductions
@pytest.mark.parametrize("garbage", GARBAGE)
def test_edge_ratio_equals_loops(ragged, reduction, garbage, walk):
    verts, mask, faces, meshes = ragged
    reference = rand(2, 5, 3, seed=3)
    samples = [
        edge_ratio_literally(mesh, ref, f.tolist())
        for mesh, ref, f in zip(meshes, reference, (TETRAHEDRON, STRIP), strict=True)
    ]
    poisoned = [torch.where(mask[..., None], x, garbage) for x in (verts, reference)]
    for m in (None, mask):
        assert_close(
            edge_ratio_loss(*poisoned, faces, mask=m, reduction=reduction), reduce_literally(samples, reduction)
        )


@pytest.mark.parametrize("garbage", GARBAGE)
def test_edge_ratio_mask_removes_faces_of_a_shared_list(garbage):
    verts, reference = rand(1, 5, 3), rand(1, 5, 3, seed=1)
    mask = torch.tensor([[True, True, True, True, False]])
    leaves = [torch.where(mask[..., None], x, garbage).requires_grad_() for x in (verts, reference)]
    value = edge_ratio_loss(*leaves, STRIP, mask=mask)
    torch.testing.assert_close(value, edge_ratio_loss(verts[:, :4], reference[:, :4], STRIP[:2]))
    for grad in torch.autograd.grad(value, leaves):
        assert grad.isfinite().all() and (grad[0, 4] == 0).all()


def test_edge_ratio_is_rigid_invariant_and_linear_in_scale():
    mesh = rand(1, 4, 3)
    rotation = torch.linalg.qr(rand(3, 3, seed=5)).Q
    assert edge_ratio_loss(mesh @ rotation + 7, mesh, TETRAHEDRON).item() < 1e-13
    assert edge_ratio_loss(3 * mesh, mesh, TETRAHEDRON).item() == pytest.approx(3 * 2)


@reductions
def test_edge_ratio_gradient(ragged, reduction, walk):
    verts, mask, faces, _ = ragged
    leaves = [verts.requires_grad_(), rand(2, 5, 3, seed=3).requires_grad_()]
    assert gradcheck(lambda v, r: edge_ratio_loss(v, r, faces, mask=mask, reduction=reduction), leaves)


def test_edge_ratio_degenerate_edges():
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]], dtype=torch.float64)
    triangle = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    face = torch.tensor([[0, 1, 2]])
    # Reference edge of zero length: 0; the two others are 1 in both meshes.
    verts, reference = triangle.clone().requires_grad_(), line.clone().requires_grad_()
    value = edge_ratio_loss(verts, reference, face)
    assert value.item() == 0
    # Current edge of zero length: ratio 0 contributes |0 - 1|.
    collapsed = line.clone().requires_grad_()
    other = edge_ratio_loss(collapsed, triangle, face)
    assert other.item() == 1
    for grad in (*torch.autograd.grad(value, [verts, reference]), *torch.autograd.grad(other, [collapsed])):
        assert grad.isfinite().all()


def test_edge_ratio_min_length_decides_what_is_degenerate():
    reference = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 1e-3, 0]]])
    verts = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]])
    face = torch.tensor([[0, 1, 2]])
    assert edge_ratio_loss(verts, reference, face).item() > 900
    assert edge_ratio_loss(verts, reference, face, min_length=1e-2).item() == pytest.approx(math.sqrt(2) - 1, abs=1e-5)


def test_edge_losses_show_nan_in_real_vertices():
    good, bad = rand(1, 4, 3), rand(1, 4, 3)
    bad[0, 2] = float("nan")
    assert edge_length_loss(bad, TETRAHEDRON).isnan()
    assert edge_ratio_loss(bad, good, TETRAHEDRON).isnan() and edge_ratio_loss(good, bad, TETRAHEDRON).isnan()


def test_edge_losses_of_a_sample_without_faces_are_zero(ragged):
    verts, _, faces, _ = ragged
    faces = faces.clone()
    faces[1] = -1
    for value, first in (
        (edge_length_loss(verts, faces, reduction="none"), edge_length_loss(verts[:1], faces[:1])),
        (edge_ratio_loss(2 * verts, verts, faces, reduction="none"), torch.tensor(3.0, dtype=torch.float64)),
    ):
        torch.testing.assert_close(value[0], first)
        assert value[1] == 0


# Backward correspondence


class Factored:
    """A plan diag(a) K diag(b) behind the protocol, each method on its own path."""

    def __init__(self, a: torch.Tensor, kernel: torch.Tensor, b: torch.Tensor) -> None:
        self.a, self.kernel, self.b = a, kernel, b
        self.products = 0

    @property
    def shape(self) -> torch.Size:
        return self.kernel.shape

    def __matmul__(self, other: torch.Tensor, /) -> torch.Tensor:
        self.products += 1
        return self.a[..., None] * (self.kernel @ (self.b[..., None] * other))

    @property
    def T(self) -> "Factored":
        self.products += 1
        return Factored(self.b, self.kernel.mT, self.a)

    def row_sums(self) -> torch.Tensor:
        return self.a * (self.kernel @ self.b[..., None])[..., 0]

    def dense(self) -> torch.Tensor:
        return self.a[..., None] * self.kernel * self.b[:, None]


def test_normalising_both_ways_returns_weighted_means_whatever_the_counts() -> None:
    a, kernel, b = rand(1, 6, seed=1).exp(), rand(1, 6, 4, seed=2).exp(), rand(1, 4, seed=3).exp()
    plan, pose = a[..., None] * kernel * b[:, None], rand(1, 4, 3, seed=4)
    there = (plan / plan.sum(2, keepdim=True)) @ pose
    back = (plan / plan.sum(1, keepdim=True)).mT @ there
    expected = (back - pose).square().mean()
    for given in (plan, Factored(a, kernel, b)):
        torch.testing.assert_close(backward_correspondence_loss(given, pose, normalization="both"), expected)
        # Moving the pose mesh moves its image along, which row normalisation alone does not do for N != M.
        torch.testing.assert_close(backward_correspondence_loss(given, pose + 5, normalization="both"), expected)
    with pytest.raises(ValueError, match='normalization="both" needs form="coordinates"'):
        backward_correspondence_loss(plan, pose, form="matrix", normalization="both")


def backward_literally(plan: torch.Tensor, pose: torch.Tensor, form: str, normalization: str) -> tuple[float, int]:
    """One unpadded sample, entry by entry."""
    rows, columns = plan.shape
    T = [[plan[i, j].item() for j in range(columns)] for i in range(rows)]
    if normalization == "rows":
        T = [[t / sum(row) for t in row] if sum(row) else row for row in T]
    gram = [[sum(T[i][j] * T[i][k] for i in range(rows)) for k in range(columns)] for j in range(columns)]
    total = 0.0
    if form == "matrix":
        for j in range(columns):
            for k in range(columns):
                total += (gram[j][k] - (j == k)) ** 2
        return total, columns**2
    for j in range(columns):
        for c in range(3):
            total += (sum(gram[j][k] * pose[k, c].item() for k in range(columns)) - pose[j, c].item()) ** 2
    return total, 3 * columns


ROWS, COLUMNS = (6, 4), (3, 5)


@pytest.fixture
def matching() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, list, list]:
    """Padded plan, pose, pose mask and identity mask of two samples of unequal sizes; and the separate parts."""
    plans = [rand(n, m, seed=n).exp() for n, m in zip(ROWS, COLUMNS, strict=True)]
    plans[0][2] = 0  # an identity vertex without mass
    plan = torch.zeros(2, max(ROWS), max(COLUMNS), dtype=torch.float64)
    for padded, part in zip(plan, plans, strict=True):
        padded[: part.shape[0], : part.shape[1]] = part
    poses = [rand(m, 3, seed=m) for m in COLUMNS]
    pose, mask = pad(poses)
    identity_mask = torch.arange(max(ROWS)) < torch.tensor(ROWS)[:, None]
    return plan, pose, mask, identity_mask, plans, poses


forms = pytest.mark.parametrize("form", ["coordinates", "matrix"])
normalizations = pytest.mark.parametrize("normalization", ["rows", "none"])


@forms
@normalizations
@reductions
def test_backward_equals_loops(matching, form, normalization, reduction):
    plan, pose, mask, identity_mask, plans, poses = matching
    expected = reduce_literally(
        [backward_literally(t, v, form, normalization) for t, v in zip(plans, poses, strict=True)], reduction
    )
    options = {"form": form, "normalization": normalization, "reduction": reduction}
    assert_close(backward_correspondence_loss(plan, pose, pose_mask=mask, **options), expected)
    for garbage in GARBAGE:
        real = identity_mask[:, :, None] & mask[:, None, :]
        poisoned = torch.where(real, plan, garbage), torch.where(mask[..., None], pose, garbage)
        value = backward_correspondence_loss(*poisoned, pose_mask=mask, identity_mask=identity_mask, **options)
        assert_close(value, expected)
    value = backward_correspondence_loss(
        Factored(torch.ones(2, 6).double(), plan, mask.double()), pose, pose_mask=mask, **options
    )
    assert_close(value, expected)


@forms
@normalizations
def test_backward_gradient_ignores_padding(matching, form, normalization):
    plan, pose, mask, identity_mask, _, _ = matching
    real = identity_mask[:, :, None] & mask[:, None, :]
    plan = torch.where(real, plan, float("nan")).requires_grad_()
    pose = torch.where(mask[..., None], pose, float("nan")).requires_grad_()
    value = backward_correspondence_loss(
        plan, pose, pose_mask=mask, identity_mask=identity_mask, form=form, normalization=normalization
    )
    leaves = [plan, pose] if form == "coordinates" else [plan]
    for grad, valid in zip(torch.autograd.grad(value, leaves), (real, mask), strict=False):
        assert grad.isfinite().all() and (grad[~valid] == 0).all() and (grad[valid] != 0).any()


@forms
@normalizations
@reductions
def test_backward_gradient(form, normalization, reduction):
    leaves = [rand(2, 4, 3).exp().requires_grad_(), rand(2, 3, 3, seed=1).requires_grad_(form == "coordinates")]
    options = {"form": form, "normalization": normalization, "reduction": reduction}
    assert gradcheck(lambda t, v: backward_correspondence_loss(t, v, **options), leaves)


@normalizations
def test_backward_takes_a_known_warp(matching, normalization):
    plan, pose, mask, identity_mask, _, _ = matching
    scale = plan.sum(2, keepdim=True).where(plan.sum(2, keepdim=True) > 0, 1) if normalization == "rows" else 1
    factored = Factored(torch.ones(2, 6).double(), plan, mask.double())
    options = {"pose_mask": mask, "identity_mask": identity_mask, "normalization": normalization}
    expected = backward_correspondence_loss(plan, pose, **options)
    warped = torch.where(identity_mask[..., None], plan @ pose / scale, float("nan"))
    torch.testing.assert_close(backward_correspondence_loss(factored, pose, warped=warped, **options), expected)
    assert factored.products == 1
    other = backward_correspondence_loss(factored, pose, warped=2 * warped, **options)
    assert not torch.isclose(other, expected)


def test_backward_known_warp_of_a_row_without_mass_is_ignored(matching):
    plan, pose, mask, _, _, _ = matching
    warped = plan @ pose / plan.sum(2, keepdim=True)  # 0 / 0 in the rows without mass
    assert warped.isnan().any()
    value = backward_correspondence_loss(plan, pose, pose_mask=mask, warped=warped)
    torch.testing.assert_close(value, backward_correspondence_loss(plan, pose, pose_mask=mask))


@forms
def test_backward_of_a_permutation_is_zero(form):
    plan = torch.eye(5, dtype=torch.float64)[torch.randperm(5, generator=torch.Generator().manual_seed(0))][None] / 5
    pose = rand(1, 5, 3)
    assert backward_correspondence_loss(plan, pose, form=form).item() < 1e-30
    assert backward_correspondence_loss(plan, pose, form=form, normalization="none").item() > 1e-2


def test_backward_constant_vector_is_scaled_as_documented():
    """Uniform marginals: the rows variant maps a constant mesh to N/M times itself, the raw plan to 1/(NM) times."""
    rows, columns = 6, 4
    plan = torch.full((1, rows, columns), 1 / (rows * columns), dtype=torch.float64)
    constant = torch.ones(1, columns, 3, dtype=torch.float64)
    normalized = backward_correspondence_loss(plan, constant)
    assert normalized.item() == pytest.approx((rows / columns - 1) ** 2)
    raw = backward_correspondence_loss(plan, constant, normalization="none")
    assert raw.item() == pytest.approx((1 / (rows * columns) - 1) ** 2)


def test_backward_forms_are_not_equivalent():
    """A plan with uniform marginals that fixes the coordinates of two distinct vertices and is not orthonormal."""
    plan = torch.tensor([[[1.0, 0], [0, 1], [0.5, 0.5], [0.5, 0.5]]]) / 4
    assert plan.sum(2).unique().tolist() == [0.25] and plan.sum(1).unique().tolist() == [0.5]
    pose = torch.tensor([[[1.0, 0, 0], [-1, 0, 0]]])
    assert backward_correspondence_loss(plan, pose, reduction="sum").item() == 0
    assert backward_correspondence_loss(plan, pose, form="matrix", reduction="sum").item() == 1


def test_backward_runs_in_full_precision_under_autocast():
    plan, pose = rand(1, 8, 6).exp(), rand(1, 6, 3)
    for form in ("coordinates", "matrix"):
        expected = backward_correspondence_loss(plan, pose, form=form).float()
        with torch.autocast("cpu", torch.bfloat16):
            value = backward_correspondence_loss(plan.float(), pose.float(), form=form)
            lifted = backward_correspondence_loss(plan.bfloat16(), pose.float(), form=form)
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=0)
        assert lifted.dtype == torch.float32


def test_matrix_form_goes_back_in_full_precision_from_within_autocast():
    plan, pose = rand(1, 8, 6).exp().float().requires_grad_(), rand(1, 6, 3).float()
    with torch.autocast("cpu", torch.bfloat16):
        value = backward_correspondence_loss(plan, pose, form="matrix", normalization="none")
        (within,) = torch.autograd.grad(value, plan, retain_graph=True)
    assert torch.equal(within, torch.autograd.grad(value, plan)[0])


@normalizations
@reductions
@pytest.mark.parametrize("shape", [(7, 4), (4, 7), (5, 5)])
def test_matrix_form_in_blocks_equals_the_whole_gram_matrix(shape, normalization, reduction, monkeypatch):
    """Tall, wide and square plans; stored, with a gradient, and read by products; blocks that do not divide it."""
    rows, columns = shape
    a, kernel, b = rand(2, rows, seed=1).exp(), rand(2, rows, columns, seed=2).exp(), rand(2, columns, seed=3).exp()
    mask = torch.arange(columns) < torch.tensor([[columns], [columns - 1]])
    identity_mask = torch.arange(rows) < torch.tensor([[rows - 2], [rows]])
    a, b = a * identity_mask, b * mask
    dense = (a[..., None] * kernel * b[:, None]).requires_grad_()
    sums = dense.sum(2, keepdim=True)
    used = dense / torch.where(sums > 0, sums, 1) if normalization == "rows" else dense
    squares = (used.mT @ used - torch.diag_embed(mask.double())).square().sum((1, 2))
    expected = {"sum": squares.mean(), "none": squares / mask.sum(1) ** 2, "mean": (squares / mask.sum(1) ** 2).mean()}
    (gradient,) = torch.autograd.grad(expected[reduction].sum(), dense)
    pose = torch.zeros(2, columns, 3, dtype=torch.float64)
    options = {"form": "matrix", "normalization": normalization, "reduction": reduction}
    options |= {"pose_mask": mask, "identity_mask": identity_mask}
    real = identity_mask[:, :, None] & mask[:, None]
    for block in (3, 512):
        monkeypatch.setattr("meshkit.losses.backward_correspondence._BLOCK", block)
        value = backward_correspondence_loss(dense, pose, **options)
        torch.testing.assert_close(value, expected[reduction], rtol=1e-12, atol=1e-12)
        (own,) = torch.autograd.grad(value.sum(), dense)
        torch.testing.assert_close(own[real], gradient[real], rtol=1e-11, atol=1e-11)
        for given in (Factored(a, kernel, b), Factored(a.clone().requires_grad_(), kernel, b)):
            value = backward_correspondence_loss(given, pose, **options)
            torch.testing.assert_close(value, expected[reduction], rtol=1e-12, atol=1e-12)


def test_matrix_form_of_a_sinkhorn_plan_has_the_gradient_of_the_stored_plan():
    x, y = rand(1, 6, 4).requires_grad_(), rand(1, 9, 4, seed=1).requires_grad_()
    pose = torch.zeros(1, 9, 3, dtype=torch.float64)
    plan = sinkhorn(x, y, eps=0.3)
    T = plan.dense()
    T = T / T.sum(2, keepdim=True)
    expected = (T.mT @ T - torch.eye(9)).square().mean()
    value = backward_correspondence_loss(plan, pose, form="matrix")
    torch.testing.assert_close(value, expected)
    for own, wanted in zip(
        *(torch.autograd.grad(v, [x, y], retain_graph=True) for v in (value, expected)), strict=True
    ):
        torch.testing.assert_close(own, wanted)
    with torch.no_grad():
        torch.testing.assert_close(backward_correspondence_loss(plan, pose, form="matrix"), expected.detach())


def test_second_derivative_of_the_matrix_form():
    leaf = rand(1, 4, 3).exp().requires_grad_()
    pose = torch.zeros(1, 3, 3, dtype=torch.float64)
    assert gradgradcheck(lambda t: backward_correspondence_loss(t, pose, form="matrix"), leaf)


# Modules and errors


def test_modules_equal_functions():
    verts, reference, plan = rand(2, 5, 3), rand(2, 5, 3, seed=1), rand(2, 4, 5).exp()
    mask = torch.tensor([[True] * 5, [True] * 4 + [False]])
    assert torch.equal(
        ReconstructionLoss(reduction="sum")(verts, reference, mask=mask),
        reconstruction_loss(verts, reference, mask=mask, reduction="sum"),
    )
    assert torch.equal(
        EdgeLengthLoss(reduction="none")(verts, STRIP, mask=mask),
        edge_length_loss(verts, STRIP, mask=mask, reduction="none"),
    )
    assert torch.equal(
        EdgeRatioLoss(min_length=1.5, reduction="none")(verts, reference, STRIP, mask=mask),
        edge_ratio_loss(verts, reference, STRIP, mask=mask, min_length=1.5, reduction="none"),
    )
    keywords = {"pose_mask": mask, "identity_mask": torch.ones(2, 4, dtype=torch.bool), "warped": rand(2, 4, 3)}
    assert torch.equal(
        BackwardCorrespondenceLoss(normalization="none", reduction="sum")(plan, verts, **keywords),
        backward_correspondence_loss(plan, verts, normalization="none", reduction="sum", **keywords),
    )
    assert torch.equal(
        BackwardCorrespondenceLoss(form="matrix")(plan, verts), backward_correspondence_loss(plan, verts, form="matrix")
    )


V, P = torch.zeros(2, 5, 3), torch.ones(2, 4, 5)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: reconstruction_loss(V, V, reduction="avg"), "reduction must be one of .*'avg'"),
        (lambda: reconstruction_loss(V, V[:, :4]), "same shape"),
        (lambda: reconstruction_loss(V[0], V), r"pred must have shape \(B, N, 3\)"),
        (lambda: reconstruction_loss(V, V[0]), "target must"),
        (lambda: reconstruction_loss(V, V, mask=torch.ones(2, 4, dtype=torch.bool)), r"\(2, 5\)"),
        (lambda: ReconstructionLoss(reduction="avg"), "reduction"),
        (lambda: edge_length_loss(V, STRIP, reduction="avg"), "reduction"),
        (lambda: edge_length_loss(V[0], STRIP), "verts must"),
        (lambda: edge_length_loss(V[:, :4], STRIP), r"\[0, 4\)"),
        (lambda: edge_length_loss(V, STRIP.expand(3, -1, -1)), "batch size of the vertices"),
        (lambda: edge_length_loss(V, STRIP, mask=torch.ones(2, 5)), "must be bool"),
        (lambda: EdgeLengthLoss(reduction="avg"), "reduction"),
        (lambda: edge_ratio_loss(V, V, STRIP, reduction="avg"), "reduction"),
        (lambda: edge_ratio_loss(V, V, STRIP, min_length=-1.0), "min_length must be a length >= 0, got -1.0"),
        (lambda: edge_ratio_loss(V, V, STRIP, min_length=float("nan")), "min_length"),
        (lambda: edge_ratio_loss(V[0], V, STRIP), "verts must"),
        (lambda: edge_ratio_loss(V, V[0], STRIP), "reference must"),
        (lambda: edge_ratio_loss(V, V[:1], STRIP), "same shape"),
        (lambda: edge_ratio_loss(V, V, STRIP.expand(3, -1, -1)), "batch size of the vertices"),
        (lambda: edge_ratio_loss(V, V, STRIP, mask=torch.ones(2, 5)), "must be bool"),
        (lambda: EdgeRatioLoss(min_length=-1.0), "min_length"),
        (lambda: EdgeRatioLoss(reduction="avg"), "reduction"),
        (lambda: backward_correspondence_loss(P, V, reduction="avg"), "reduction"),
        (lambda: backward_correspondence_loss(P, V, form="dense"), "form must be one of .*'dense'"),
        (lambda: backward_correspondence_loss(P, V, normalization="cols"), "normalization must be one of .*'cols'"),
        (lambda: backward_correspondence_loss(P, V, form="matrix", warped=V[:, :4]), "warped is of no use"),
        (lambda: backward_correspondence_loss(P, V[0]), "pose_verts must"),
        (lambda: backward_correspondence_loss(P.mT, V), r"= \(2, N, 5\) to match pose_verts, got \(2, 5, 4\)"),
        (lambda: backward_correspondence_loss(P[0], V), "plan must have shape"),
        (lambda: backward_correspondence_loss(P[:, :0], V), "plan must have shape"),
        (
            lambda: backward_correspondence_loss(P, V, pose_mask=torch.ones(2, 4, dtype=torch.bool)),
            r"pose_mask must have .*5\)",
        ),
        (lambda: backward_correspondence_loss(P, V, identity_mask=torch.ones(2, 5).bool()), "identity_mask must"),
        (lambda: backward_correspondence_loss(P, V, warped=V), r"warped must have shape \(2, 4, 3\)"),
        (lambda: BackwardCorrespondenceLoss(form="dense"), "form must"),
        (lambda: BackwardCorrespondenceLoss(normalization="cols"), "normalization must"),
        (lambda: BackwardCorrespondenceLoss(reduction="avg"), "reduction"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()


# Likelihood of known matches

KNOWN = torch.tensor([[2, 0, 1, -1, 0, 2], [4, -1, 0, 3, -1, -1]])  # of the rows of `matching`; its third has no mass


@reductions
def test_matching_equals_loops(matching, reduction):
    plan, *_, plans, _ = matching
    samples = []
    for part, columns in zip(plans, KNOWN.tolist(), strict=True):
        terms = [
            -math.log(row[c] / sum(row)) for row, c in zip(part.tolist(), columns, strict=False) if c >= 0 < sum(row)
        ]
        samples.append((sum(terms), len(terms)))
    assert samples[0][1] == 4 and samples[1][1] == 3
    assert_close(matching_loss(plan, KNOWN, reduction=reduction), reduce_literally(samples, reduction))
    assert_close(MatchingLoss(reduction=reduction)(plan, KNOWN), reduce_literally(samples, reduction))


@pytest.mark.parametrize("reach", [None, 0.5], ids=["balanced", "unbalanced"])
def test_matching_of_a_factored_plan_is_that_of_the_stored_one(reach):
    x, y = (rand(2, n, 4, seed=n).requires_grad_() for n in (9, 7))
    masks = {"mask_x": torch.arange(9) < torch.tensor([[9], [6]]), "mask_y": torch.arange(7) < torch.tensor([[5], [7]])}
    known = torch.randint(-1, 5, (2, 9), generator=torch.Generator().manual_seed(0))
    plan = sinkhorn(x, y, eps=0.1, reach=reach, **masks)
    factored, stored = matching_loss(plan, known), matching_loss(plan.dense(), known)
    torch.testing.assert_close(factored, stored, rtol=1e-12, atol=0)
    for a, b in zip(
        *(torch.autograd.grad(value, (x, y), retain_graph=True) for value in (factored, stored)), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)
        assert bool(a.isfinite().all()) and float(a.abs().max()) > 1e-3


def test_matching_reaches_what_is_matched_to_the_wrong_place():
    """Where the true entry underflows in the stored plan, its logarithm and gradient are still right."""
    y = torch.tensor([[[1.0, 0.0], [-1.0, 1e-2]]])
    x = y.clone().requires_grad_()
    plan = sinkhorn(x, y, eps=0.005)
    assert float(plan.dense()[0, 0, 1].detach()) == 0
    loss = matching_loss(plan, torch.tensor([[1, -1]]))
    assert loss.item() == pytest.approx(2 / 0.005, rel=1e-3)
    assert float(torch.autograd.grad(loss, x)[0].abs().max()) > 0.1


def test_matching_of_what_has_no_mass_has_finite_gradients():
    """A row of nothing, an entry of nothing, and padding, in a stored plan."""
    plan = torch.tensor([[[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.0]]], requires_grad=True)
    loss = matching_loss(plan, torch.tensor([[0, 1, 0, -1]]))
    assert loss.item() == pytest.approx((math.log(2) + math.log(0.5 / torch.finfo(torch.float32).tiny)) / 2, rel=1e-5)
    (gradient,) = torch.autograd.grad(loss, plan)
    assert gradient.tolist() == [[[0, 0], [1, 1], [-0.5, 0.5], [0, 0]]]


def test_matching_bounds():
    uniform = torch.full((1, 3, 8), 0.2)
    assert matching_loss(uniform, torch.tensor([[0, 3, 7]])).item() == pytest.approx(math.log(8))
    assert matching_loss(torch.eye(3)[None], torch.tensor([[0, 1, 2]])).item() == 0
    assert matching_loss(uniform, torch.full((1, 3), -1)).item() == 0
    assert matching_loss(uniform.bfloat16(), torch.tensor([[0, 3, 7]])).dtype == torch.float32


def test_matching_errors():
    plan = torch.ones(2, 3, 4)
    with pytest.raises(
        ValueError, match=r"correspondence must be integers of shape \(B, N\) = \(2, 3\), got torch.int64"
    ):
        matching_loss(plan, torch.zeros(2, 4, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"got torch.float32 of \(2, 3\)"):
        matching_loss(plan, torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"got torch.bool of \(2, 3\)"):
        matching_loss(plan, torch.zeros(2, 3, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"a plan must have shape \(B, N, M\), got \(3, 4\)"):
        matching_loss(plan[0], torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match="reduction must be one of"):
        MatchingLoss(reduction="max")
