"""Padding, masks and masked statistics against loops over the separate meshes."""

import numpy as np
import pytest
import torch
import trimesh
from torch.autograd import gradcheck

from meshkit.batching import bounding_box_center, center, check_mask, check_verts, masked_mean, pad, pad_faces, unpad

LENGTHS = (5, 1, 3)


@pytest.fixture
def meshes() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(n, 3, generator=generator, dtype=torch.float64) + 4 for n in LENGTHS]


def poison(padded: torch.Tensor, mask: torch.Tensor, value: float) -> torch.Tensor:
    return torch.where(mask[..., None], padded, value)


def test_pad_places_every_vertex_and_zeroes_the_rest(meshes):
    padded, mask = pad(meshes)
    assert padded.shape == (3, 5, 3) and mask.dtype == torch.bool
    for b, mesh in enumerate(meshes):
        for n in range(5):
            assert bool(mask[b, n]) == (n < len(mesh))
            expected = mesh[n] if n < len(mesh) else torch.zeros(3, dtype=torch.float64)
            assert torch.equal(padded[b, n], expected)


def test_unpad_inverts_pad_and_passes_gradients(meshes):
    leaves = [mesh.clone().requires_grad_() for mesh in meshes]
    parts = unpad(*pad(leaves))
    assert all(torch.equal(part, mesh) for part, mesh in zip(parts, meshes, strict=True))
    sum((i + 1) * part.sum() for i, part in enumerate(parts)).backward()
    for i, leaf in enumerate(leaves):
        assert torch.equal(leaf.grad, torch.full_like(leaf, i + 1))


def test_unpad_takes_scattered_masks_and_none():
    x = torch.arange(4.0).view(1, 4)
    assert unpad(x, torch.tensor([[True, False, False, True]]))[0].tolist() == [0, 3]
    assert [part.tolist() for part in unpad(x)] == [[0, 1, 2, 3]]


def test_pad_faces():
    faces = [torch.tensor([[0, 1, 2], [1, 2, 3]]), torch.tensor([[4, 5, 6]])]
    assert pad_faces(faces).tolist() == [[[0, 1, 2], [1, 2, 3]], [[4, 5, 6], [-1, -1, -1]]]


@pytest.mark.parametrize("garbage", [1e30, float("nan"), float("inf")])
def test_masked_statistics_equal_separate_meshes(meshes, garbage):
    padded, mask = pad(meshes)
    padded = poison(padded, mask, garbage)
    moved = center(padded, mask)
    for b, mesh in enumerate(meshes):
        np.testing.assert_allclose(masked_mean(padded, mask)[b], mesh.numpy().mean(0), rtol=1e-14)
        middle = trimesh.PointCloud(mesh.numpy()).bounds.mean(0)
        np.testing.assert_allclose(bounding_box_center(padded, mask)[b, 0], middle, rtol=1e-14)
        np.testing.assert_allclose(moved[b, : len(mesh)], mesh.numpy() - middle, atol=1e-14)
        assert (moved[b, len(mesh) :] == 0).all()


def test_none_mask_equals_all_true(meshes):
    x = meshes[0][None]
    everything = torch.ones(1, 5, dtype=torch.bool)
    for function in (masked_mean, bounding_box_center, center):
        assert torch.equal(function(x), function(x, everything))


@pytest.mark.parametrize("dim", [2, -1])
def test_masked_mean_other_dimension(meshes, dim):
    padded, mask = pad(meshes)
    channels_first = padded.transpose(1, 2)
    assert torch.allclose(masked_mean(channels_first, mask, dim), masked_mean(padded, mask))
    assert torch.allclose(masked_mean(channels_first, None, dim), padded.mean(1))


def test_masked_mean_accumulates_half_precision_in_float32():
    x = torch.full((1, 4000, 1), 100.0, dtype=torch.float16)  # the sum, 4e5, is beyond float16
    mask = torch.ones(1, 4000, dtype=torch.bool)
    assert masked_mean(x, mask).dtype == torch.float16
    assert masked_mean(x, mask).item() == masked_mean(x).item() == 100


def test_gradients(meshes):
    padded, mask = pad(meshes)
    leaf = padded.clone().requires_grad_()
    for function in (masked_mean, bounding_box_center, center):
        assert gradcheck(lambda x, f=function: f(x, mask), leaf)


def test_padding_receives_no_gradient(meshes):
    padded, mask = pad(meshes)
    for function in (masked_mean, bounding_box_center, center):
        leaf = poison(padded, mask, float("nan")).requires_grad_()
        (grad,) = torch.autograd.grad(function(leaf, mask).square().sum(), leaf)
        assert (grad[~mask] == 0).all() and grad.isfinite().all() and (grad[mask] != 0).any()


def test_sample_without_real_vertices_is_zero_and_leaves_the_others_alone(meshes):
    padded, mask = pad(meshes)
    mask[1] = False
    leaf = padded.clone().requires_grad_()
    for function in (masked_mean, bounding_box_center, center):
        value = function(leaf, mask)
        assert (value[1] == 0).all() and torch.allclose(value[0], function(padded[:1])[0])
        (grad,) = torch.autograd.grad(value.sum(), leaf)
        assert grad.isfinite().all() and (grad[1] == 0).all()


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: pad([]), "empty list"),
        (lambda: pad([torch.zeros(2, 3), torch.zeros(0, 3)]), "number 1 is empty"),
        (lambda: pad([torch.zeros(2)]), r"shape \(N_i, C\)"),
        (lambda: pad([torch.zeros(2, 3), torch.zeros(2, 4)]), "agree in columns"),
        (lambda: pad([torch.zeros(2, 3), torch.zeros(2, 3).double()]), "torch.float64"),
        (lambda: unpad(torch.zeros(3)), r"\(B, N, C\)"),
        (lambda: unpad(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.bool)), r"samples \[0\]"),
        (lambda: pad_faces([]), "empty list"),
        (lambda: pad_faces([torch.zeros(0, 3, dtype=torch.int64)]), "is empty"),
        (lambda: pad_faces([torch.zeros(2, 4, dtype=torch.int64)]), "triangulate"),
        (lambda: pad_faces([torch.zeros(2, 3, dtype=torch.int32)]), "int32"),
        (lambda: pad_faces([torch.tensor([[0, 1, -1]])]), r"faces\[0\] has a negative"),
        (lambda: masked_mean(torch.zeros(1, 2, 3).long()), "floating point"),
        (lambda: masked_mean(torch.zeros(1, 2, 3), None, 0), "other than the batch"),
        (lambda: masked_mean(torch.zeros(1, 2, 3), None, -3), "other than the batch"),
        (lambda: masked_mean(torch.zeros(1, 2, 3), None, 3), "other than the batch"),
        (lambda: masked_mean(torch.zeros(1, 0, 3)), "at least one vertex"),
        (lambda: masked_mean(torch.zeros(1, 2, 3), torch.ones(1, 3, dtype=torch.bool)), r"shape \(1, 2\)"),
        (lambda: check_verts(torch.zeros(2, 3)), r"\(B, N, 3\)"),
        (lambda: check_verts(torch.zeros(1, 3, 5), name="pose_verts"), "pose_verts must"),
        (lambda: check_verts(torch.zeros(1, 0, 3)), "at least one sample and one vertex"),
        (lambda: check_verts(torch.zeros(1, 2, 3).long()), "floating point"),
        (lambda: bounding_box_center(torch.zeros(1, 0, 3)), "at least one sample"),
        (lambda: center(torch.zeros(1, 2, 3), torch.ones(2, 2, dtype=torch.bool)), "match the vertices"),
        (lambda: check_mask(torch.ones(1, 2), 1, 2), r"must be bool .* torch.float32"),
        (lambda: check_mask(torch.ones(2, 2, dtype=torch.bool), 1, 2, name="pose_mask"), "pose_mask must"),
    ],
)
def test_errors(call, match):
    with pytest.raises(ValueError, match=match):
        call()


def test_check_mask_reads_values_only_when_asked():
    nothing = torch.zeros(2, 3, dtype=torch.bool)
    check_mask(nothing, 2, 3)
    check_mask(None, 2, 3, nonempty=True)
    with pytest.raises(ValueError, match=r"samples \[0, 1\]"):
        check_mask(nothing, 2, 3, nonempty=True)
