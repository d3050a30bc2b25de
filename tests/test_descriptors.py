"""Laplacian spectra against a dense solver and the sphere; signatures against their definition."""

import math
import sys
from functools import cache

import numpy as np
import pytest
import scipy.linalg
import torch
from conftest import assert_near, rand, scatter, scattered_mask
from torch import Tensor

from meshkit.data import load_humans
from meshkit.descriptors import (
    _solvers,
    heat_kernel_signature,
    intrinsic_descriptors,
    laplacian_eigenpairs,
    wave_kernel_signature,
)
from meshkit.topology import cotangent_laplacian, mass_matrix

Mesh = tuple[Tensor, Tensor]


@cache
def sphere(level: int = 2, noise: float = 0.0) -> Mesh:
    """Subdivided octahedron on the unit sphere: 4^(level + 1) + 2 vertices, optionally bumpy."""
    verts = [tuple(v) for v in torch.cat([torch.eye(3), -torch.eye(3)]).double().tolist()]
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    for _ in range(level):
        middle: dict[frozenset[int], int] = {}
        finer = []
        for face in faces:
            halves = []
            for i, j in zip(face, face[1:] + face[:1], strict=True):
                if frozenset((i, j)) not in middle:
                    middle[frozenset((i, j))] = len(verts)
                    point = np.add(verts[i], verts[j])
                    verts.append(tuple(point / np.linalg.norm(point)))
                halves.append(middle[frozenset((i, j))])
            (a, b, c), (ab, bc, ca) = face, halves
            finer += [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        faces = finer
    points = torch.tensor(verts, dtype=torch.float64)
    return points * (1 + noise * rand(len(points), 1)), torch.tensor(faces)


@cache
def body() -> Mesh:
    human = load_humans(1000)
    return human.template.double(), human.faces


def grid(rows: int, columns: int) -> Mesh:
    """Flat sheet, its vertices moved within the columns so that no two triangles are alike."""
    verts = torch.cartesian_prod(torch.arange(float(rows)), torch.arange(float(columns))).double()
    verts[:, 1] += 0.1 * rand(len(verts))
    corner = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).flatten()
    lower = torch.stack([corner, corner + columns, corner + 1], 1)
    upper = torch.stack([corner + 1, corner + columns, corner + columns + 1], 1)
    return torch.cat([verts, torch.zeros(len(verts), 1)], 1), torch.cat([lower, upper])


@cache
def dense_eigenpairs(name: str) -> tuple[np.ndarray, np.ndarray]:
    verts, faces = MESHES[name]()
    mass = mass_matrix(verts, faces).numpy()
    return scipy.linalg.eigh(cotangent_laplacian(verts, faces).to_dense().numpy(), np.diag(mass / mass.sum()))


MESHES = {"sphere": lambda: sphere(2, 0.05), "body": body, "sheet": lambda: grid(9, 7)}
meshes = pytest.mark.parametrize("name", list(MESHES))


def wks_literally(eigenvalues: np.ndarray, vectors: np.ndarray, count: int, width: float) -> np.ndarray:
    """Loops over vertices and energies of the definition; the first (constant) pair is left out."""
    lam, phi = eigenvalues[1:], vectors[:, 1:]
    low, high = math.log(lam[0]), 0.98 * math.log(lam[-1])
    energies = [low + i * (high - low) / (count - 1) for i in range(count)]
    sigma = width * (energies[1] - energies[0])
    out = np.empty((len(phi), count))
    for e, energy in enumerate(energies):
        bands = [math.exp(-((energy - math.log(value)) ** 2) / (2 * sigma**2)) for value in lam]
        for v in range(len(phi)):
            out[v, e] = sum(phi[v, k] ** 2 * bands[k] for k in range(len(lam))) / sum(bands)
    return out


# Eigenpairs


@meshes
def test_eigenpairs_equal_the_dense_solver(name):
    verts, faces = MESHES[name]()
    k = 20
    eigenvalues, vectors = laplacian_eigenpairs(verts, faces, k)
    expected, dense = dense_eigenpairs(name)
    assert eigenvalues.shape == (k,) and vectors.shape == (len(verts), k)
    assert (eigenvalues.diff() >= 0).all() and eigenvalues[0] < 1e-8
    np.testing.assert_allclose(eigenvalues[1:], expected[1:k], rtol=1e-8)
    mass = mass_matrix(verts, faces)
    mass = mass / mass.sum()
    assert_near(vectors.T @ (mass[:, None] * vectors), torch.eye(k, dtype=torch.float64), 1e-8)
    # Simple eigenvalues here: the vectors agree up to sign.
    overlap = (vectors * mass[:, None] * torch.from_numpy(dense[:, :k])).sum(0).abs()
    assert_near(overlap, torch.ones_like(overlap), 1e-6)


@pytest.mark.parametrize("k", [1, 5, 17])
def test_any_number_of_pairs(k):
    verts, faces = sphere(1, 0.1)  # 18 vertices: 17 is the most
    expected = scipy.linalg.eigh(
        cotangent_laplacian(verts, faces).to_dense().numpy(),
        np.diag((mass_matrix(verts, faces) / mass_matrix(verts, faces).sum()).numpy()),
        eigvals_only=True,
    )
    np.testing.assert_allclose(laplacian_eigenpairs(verts, faces, k)[0], expected[:k], rtol=1e-8, atol=1e-8)


def test_spectrum_of_the_sphere():
    """Area normalised to 1: l (l + 1) times 4 pi, each 2 l + 1 times."""
    eigenvalues, vectors = laplacian_eigenpairs(*sphere(4), 16)
    expected = [degree * (degree + 1) * 4 * math.pi for degree in range(4) for _ in range(2 * degree + 1)]
    np.testing.assert_allclose(eigenvalues, expected, rtol=0.02, atol=1e-8)
    assert_near(vectors[:, 0].abs(), torch.ones(len(vectors), dtype=torch.float64), 1e-6)
    # By the addition theorem the squares of one degree sum to 2 l + 1 at every point.
    for degree in (1, 2, 3):
        total = vectors[:, degree**2 : (degree + 1) ** 2].square().sum(1)
        assert_near(total, torch.full_like(total, 2 * degree + 1), 0.03)


@pytest.mark.parametrize(("level", "k"), [(2, 16), (2, 40), (3, 32), (3, 50)])
def test_repeated_eigenvalues_are_all_found(level, k):
    """A subdivided octahedron has eigenvalues of multiplicity exactly 2 and 3; the vertex order must not matter."""
    verts, faces = sphere(level)
    mass = mass_matrix(verts, faces)
    stiffness = cotangent_laplacian(verts, faces).to_dense().numpy()
    expected = scipy.linalg.eigh(stiffness, np.diag((mass / mass.sum()).numpy()), eigvals_only=True)[:k]
    for seed in range(3):
        order = torch.randperm(len(verts), generator=torch.Generator().manual_seed(seed))
        eigenvalues, _ = laplacian_eigenpairs(verts[order], order.argsort()[faces], k)
        np.testing.assert_allclose(eigenvalues, expected, rtol=1e-8, atol=1e-8)


def test_components_give_as_many_zero_eigenvalues():
    verts, faces = sphere(1, 0.1)
    eigenvalues, _ = laplacian_eigenpairs(torch.cat([verts, verts + 5]), torch.cat([faces, faces + 18]), 4)
    assert (eigenvalues[:2] < 1e-8).all() and (eigenvalues[2:] > 1).all()


def test_eigenpairs_follow_the_dtype_and_repeat():
    verts, faces = sphere(2, 0.05)
    single = laplacian_eigenpairs(verts.float(), faces, 10)
    assert {t.dtype for t in single} == {torch.float32}
    np.testing.assert_allclose(single[0][1:], laplacian_eigenpairs(verts, faces, 10)[0][1:], rtol=1e-4)
    for first, again in zip(single, laplacian_eigenpairs(verts.float(), faces, 10), strict=True):
        assert torch.equal(first, again)
    assert not laplacian_eigenpairs(verts.clone().requires_grad_(), faces, 3)[1].requires_grad


# Wave-kernel signature


@meshes
@pytest.mark.parametrize(("count", "pairs", "width"), [(16, 20, 7.0), (5, 12, 2.0)])
def test_signature_equals_its_definition(name, count, pairs, width):
    verts, faces = MESHES[name]()
    value = wave_kernel_signature(verts, faces, num_signatures=count, num_eigenpairs=pairs, width=width)
    expected, vectors = dense_eigenpairs(name)
    literal = wks_literally(expected[:pairs], vectors[:, :pairs], count, width)
    assert_near(value, torch.from_numpy(literal), 1e-6)


def test_defaults():
    verts, faces = sphere(2, 0.05)
    value = wave_kernel_signature(verts, faces)
    expected, vectors = dense_eigenpairs("sphere")
    assert_near(value, torch.from_numpy(wks_literally(expected[:64], vectors[:, :64], 16, 1.0)), 1e-6)


def test_mean_over_the_surface_is_one():
    """Every phi_k has unit norm, hence so has every average of their squares."""
    for make in MESHES.values():
        verts, faces = make()
        mass = mass_matrix(verts, faces)
        mean = (mass / mass.sum()) @ wave_kernel_signature(verts, faces, num_eigenpairs=20)
        assert_near(mean, torch.ones(16, dtype=torch.float64), 1e-8)


def rotation() -> Tensor:
    return torch.linalg.qr(rand(3, 3))[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v @ rotation().T,
        lambda v: v * torch.tensor([-1.0, 1.0, 1.0]),
        lambda v: v + torch.tensor([30.0, -4.0, 7.0]),
        lambda v: v * 1000,
        lambda v: v * 1e-3,
    ],
    ids=["rotation", "reflection", "translation", "metres-to-millimetres", "smaller"],
)
@pytest.mark.parametrize("name", ["sphere", "body"])
def test_invariance_under_similarities(name, change):
    verts, faces = MESHES[name]()
    value = wave_kernel_signature(change(verts), faces, num_eigenpairs=20)
    assert_near(value, wave_kernel_signature(verts, faces, num_eigenpairs=20), 1e-6)


@pytest.mark.parametrize("name", ["sphere", "body"])
def test_vertex_and_face_order_do_not_matter(name):
    verts, faces = MESHES[name]()
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(verts), generator=generator)
    shuffled = order.argsort()[faces][torch.randperm(len(faces), generator=generator)].roll(1, 1)
    value = wave_kernel_signature(verts[order], shuffled, num_eigenpairs=20)
    assert_near(value, wave_kernel_signature(verts, faces, num_eigenpairs=20)[order], 1e-6)


def test_invariance_under_bending_that_keeps_lengths():
    """Rolling a sheet up along its rows folds it at edges only: every triangle keeps its shape."""
    flat, faces = grid(9, 7)
    angle = 0.5 * flat[:, 0]
    radius = 0.5 / math.sin(0.25)  # chords of 1 between neighbouring rows
    rolled = torch.stack([radius * angle.sin(), flat[:, 1], radius * angle.cos()], 1)
    lengths = [(v[faces] - v[faces.roll(1, 1)]).norm(dim=2) for v in (flat, rolled)]
    assert_near(lengths[1], lengths[0], 1e-12)
    assert_near(
        wave_kernel_signature(rolled, faces, num_eigenpairs=20),
        wave_kernel_signature(flat, faces, num_eigenpairs=20),
        1e-6,
    )


def test_signature_tells_parts_of_a_body_apart():
    """Not a constant: deviations over the body exceed a tenth of the mean in every band."""
    value = wave_kernel_signature(*body(), num_eigenpairs=20)
    assert (value.std(0) > 0.1).all() and (value > 0).all()


# Batches


def ragged(fill: float) -> tuple[Tensor, Tensor, Tensor, list[Mesh]]:
    """Padding anywhere, faces numbered in the padded batch and padded with -1; and the separate meshes."""
    singles = [sphere(1, 0.1), sphere(2, 0.05), grid(5, 4)]
    mask = scattered_mask([len(v) for v, _ in singles], 70)
    verts = scatter([v for v, _ in singles], mask, fill)
    faces = torch.full((3, max(len(f) for _, f in singles), 3), -1)
    for b, (_, f) in enumerate(singles):
        faces[b, : len(f)] = mask[b].nonzero()[:, 0][f]
    return verts, faces, mask, singles


@pytest.mark.parametrize("fill", [0.0, 1e20, math.nan])
def test_padded_batch_equals_the_loop(fill):
    verts, faces, mask, singles = ragged(fill)
    value = wave_kernel_signature(verts, faces, num_signatures=6, num_eigenpairs=12, mask=mask)
    assert value.shape == (3, 70, 6)
    assert (value[~mask] == 0).all()
    for b, (v, f) in enumerate(singles):
        assert_near(value[b, mask[b]], wave_kernel_signature(v, f, num_signatures=6, num_eigenpairs=12), 1e-6)


def test_batch_of_one_topology():
    verts, faces = sphere(1, 0.1)
    batch = torch.stack([verts, verts * torch.tensor([1.0, 2.0, 3.0])])
    value = wave_kernel_signature(batch, faces, num_eigenpairs=10)
    for b in range(2):
        assert_near(value[b], wave_kernel_signature(batch[b], faces, num_eigenpairs=10), 1e-8)


def test_padding_of_shared_faces_is_no_face():
    verts, faces = sphere(1, 0.1)
    padded = torch.cat([faces, torch.full((2, 3), -1)])
    expected = wave_kernel_signature(verts, faces, num_eigenpairs=10)
    for given in (padded, padded[None]):
        assert_near(wave_kernel_signature(verts[None], given, num_eigenpairs=10)[0], expected, 1e-8)
    everything = torch.ones(1, len(verts), dtype=torch.bool)
    for given in (padded, padded[None]):
        value = wave_kernel_signature(verts[None], given, num_eigenpairs=10, mask=everything)
        assert_near(value[0], expected, 1e-8)


def test_fewer_pairs_are_taken_on_small_meshes():
    verts, faces = sphere(1, 0.1)
    assert_near(
        wave_kernel_signature(verts, faces, num_eigenpairs=500),
        wave_kernel_signature(verts, faces, num_eigenpairs=17),
        1e-8,
    )


def test_signature_dtype_and_gradient():
    verts, faces = sphere(1, 0.1)
    value = wave_kernel_signature(verts.float().requires_grad_(), faces, num_eigenpairs=10)
    assert value.dtype == torch.float32 and not value.requires_grad
    assert_near(value, wave_kernel_signature(verts, faces, num_eigenpairs=10), 1e-4)


# Intrinsic descriptors


def area_literally(verts: Tensor, faces: Tensor) -> float:
    a, b, c = verts[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a).norm(dim=1).sum().item() / 2


@meshes
def test_intrinsic_descriptors_add_the_size(name):
    verts, faces = MESHES[name]()
    for scale in (1.0, 3.0):
        value = intrinsic_descriptors(scale * verts, faces, num_signatures=5, num_eigenpairs=20)
        assert value.shape == (len(verts), 6)
        signature = wave_kernel_signature(verts, faces, num_signatures=5, num_eigenpairs=20, width=7.0)
        assert_near(value[:, :5], signature, 1e-6)
        size = torch.full((len(verts),), math.log(scale * math.sqrt(area_literally(verts, faces))), dtype=torch.float64)
        assert_near(value[:, 5], size, 1e-12)


@pytest.mark.parametrize("fill", [0.0, 1e20, math.nan])
def test_intrinsic_descriptors_of_a_padded_batch_equal_the_loop(fill):
    verts, faces, mask, singles = ragged(fill)
    value = intrinsic_descriptors(verts, faces, num_signatures=6, num_eigenpairs=12, mask=mask)
    assert value.shape == (3, 70, 7)
    assert (value[~mask] == 0).all()
    for b, (v, f) in enumerate(singles):
        assert_near(value[b, mask[b]], intrinsic_descriptors(v, f, num_signatures=6, num_eigenpairs=12), 1e-6)
    shared = torch.stack([singles[0][0], 2 * singles[0][0]])
    value = intrinsic_descriptors(shared, singles[0][1], num_eigenpairs=10)
    assert_near(value[1, :, -1] - value[0, :, -1], torch.full((18,), math.log(2), dtype=torch.float64), 1e-12)


def test_intrinsic_descriptors_take_wide_bands_and_have_no_gradient():
    verts, faces = sphere(2, 0.05)
    value = intrinsic_descriptors(verts.float().requires_grad_(), faces)
    assert value.dtype == torch.float32 and not value.requires_grad
    assert_near(value[:, :-1], wave_kernel_signature(verts.float(), faces, width=7.0), 1e-6)


# Errors


def spoil(kind: str) -> Mesh:
    verts, faces = sphere(1)
    verts = verts.clone()
    if kind == "nan":
        verts[3, 1] = math.nan
    elif kind == "infinite":
        verts[2:4] = math.inf
    elif kind == "unreferenced":
        verts = torch.cat([verts, torch.zeros(2, 3)])
    elif kind == "no area":  # the faces around vertex 0 collapse to it
        around = (faces == 0).any(1)
        verts[faces[around].unique()] = verts[0].clone()
    elif kind == "index":
        faces = faces + 1
    return verts, faces


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("nan", "1 of 18 vertices are NaN or infinite"),
        ("infinite", "2 of 18 vertices are NaN or infinite"),
        ("unreferenced", "2 of 20 vertices belong to no face of positive area, the first is vertex"),
        ("no area", "1 of 18 vertices belong to no face of positive area"),
        ("index", "face indices must lie in"),
    ],
)
def test_bad_meshes_are_named(kind, message):
    verts, faces = spoil(kind)
    with pytest.raises(ValueError, match=message):
        laplacian_eigenpairs(verts, faces, 5)
    with pytest.raises(ValueError, match=message):
        wave_kernel_signature(verts, faces, num_eigenpairs=5)
    with pytest.raises(ValueError, match=message):
        wave_kernel_signature(verts[None], faces, num_eigenpairs=5)
    with pytest.raises(ValueError, match=message):
        intrinsic_descriptors(verts, faces, num_eigenpairs=5)


@pytest.mark.parametrize("k", [0, 18, -1])
def test_number_of_pairs_out_of_range(k):
    with pytest.raises(ValueError, match=rf"k must lie in \[1, V - 1\] = \[1, 17\], got {k}"):
        laplacian_eigenpairs(*sphere(1), k)


def test_shape_errors():
    verts, faces = sphere(1)
    for bad in (verts[None], verts[:, :2], verts[0]):
        with pytest.raises(ValueError, match=r"verts must have shape \(V, 3\), got"):
            laplacian_eigenpairs(bad, faces, 5)
    with pytest.raises(ValueError, match=r"verts must have shape \(V, 3\) or \(B, V, 3\), got \(18,\)"):
        wave_kernel_signature(verts[:, 0], faces)


def test_meshes_and_spectra_too_small():
    triangle = torch.eye(3).double(), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match="at least 4 vertices, got 3"):
        wave_kernel_signature(*triangle)
    with pytest.raises(ValueError, match="num_signatures must be at least 2, got 1"):
        wave_kernel_signature(*sphere(1), num_signatures=1)
    with pytest.raises(ValueError, match="num_eigenpairs"):
        wave_kernel_signature(*sphere(1), num_eigenpairs=1)


# Heat-kernel signature


def hks_literally(eigenvalues: np.ndarray, vectors: np.ndarray, count: int) -> np.ndarray:
    """Loops over vertices and times of the definition."""
    first, last = 4 * math.log(10) / eigenvalues[-1], 4 * math.log(10) / eigenvalues[1]
    out = np.empty((len(vectors), count))
    for i in range(count):
        time = first * (last / first) ** (i / (count - 1))
        for v in range(len(vectors)):
            out[v, i] = sum(math.exp(-lam * time) * phi**2 for lam, phi in zip(eigenvalues, vectors[v], strict=True))
    return out


@meshes
def test_heat_signature_equals_its_definition(name):
    verts, faces = MESHES[name]()
    value = heat_kernel_signature(verts, faces, num_signatures=6, num_eigenpairs=20)
    expected, vectors = dense_eigenpairs(name)
    literal = hks_literally(expected[:20], vectors[:, :20], 6)
    assert (value / torch.from_numpy(literal) - 1).abs().max() < 1e-6
    assert (value.diff(dim=1) < 0).all()


def test_heat_signature_of_the_sphere_is_its_heat_trace():
    """sum_l (2 l + 1) exp(-4 pi l (l + 1) t) at every point, by the addition theorem; 25 pairs are degrees 0 to 4."""
    verts, faces = sphere(4)
    value = heat_kernel_signature(verts, faces, num_signatures=5, num_eigenpairs=25)
    eigenvalues = laplacian_eigenpairs(verts, faces, 25)[0]
    first, last = (4 * math.log(10) / eigenvalues[i].item() for i in (-1, 1))
    for i in range(5):
        time = first * (last / first) ** (i / 4)
        trace = sum((2 * n + 1) * math.exp(-4 * math.pi * n * (n + 1) * time) for n in range(5))
        assert_near(value[:, i], torch.full((len(verts),), trace, dtype=torch.float64), 5e-3)


def test_heat_signature_of_a_mesh_of_two_components():
    """Both constants count: each vertex starts as on its own component, whose share of the area is a half."""
    verts, faces = sphere(1, 0.1)
    double = torch.cat([verts, verts + 5]), torch.cat([faces, faces + 18])
    value = heat_kernel_signature(*double, num_signatures=4, num_eigenpairs=20)
    assert_near(value[:18], value[18:], 1e-8)
    assert (value > 2).all()


@pytest.mark.parametrize("signature", [heat_kernel_signature, wave_kernel_signature])
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_signatures_ignore_the_unit(signature, scale):
    verts, faces = MESHES["sphere"]()
    expected = signature(verts, faces, num_eigenpairs=20)
    assert_near(signature(scale * verts, faces, num_eigenpairs=20), expected, 1e-6)


def multiplet(level: int, around: int) -> tuple[int, int]:
    """``(inside, end)``: numbers of pairs that cut a repeated eigenvalue of the octahedral sphere, and that do not."""
    verts, faces = sphere(level)
    mass = mass_matrix(verts, faces).numpy()
    stiffness = cotangent_laplacian(verts, faces).to_dense().numpy()
    values = scipy.linalg.eigh(stiffness, np.diag(mass / mass.sum()), eigvals_only=True)
    repeated = values[1:] - values[:-1] < 1e-8 * values[1:]  # entry k - 1: pairs k and k + 1 belong together
    inside = next(k for k in range(around, len(values)) if repeated[k - 1])
    end = next(k for k in range(inside, len(values)) if not repeated[k - 1])
    return inside, end


@pytest.mark.parametrize("signature", [heat_kernel_signature, wave_kernel_signature])
def test_basis_of_an_eigenspace_does_not_matter_unless_it_is_cut(signature):
    verts, faces = sphere(2)
    inside, end = multiplet(2, 20)
    for k, same in ((end, True), (inside, False)):
        kept: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
        laplacian_eigenpairs(verts, faces, end, cache=kept)
        ((values, vectors, area),) = kept.values()
        turned = vectors.clone()
        for value in values:
            space = (values - value).abs() < 1e-6 * (1 + value)
            turned[:, space] = vectors[:, space] @ torch.linalg.qr(rand(int(space.sum()), int(space.sum()), seed=1))[0]
        results = []
        for basis in (vectors, turned):
            kept.clear()
            signature(verts, faces, num_eigenpairs=k, cache=kept)
            (key,) = kept
            kept[key] = (values[:k], basis[:, :k], area)
            results.append(signature(verts, faces, num_eigenpairs=k, cache=kept))
        difference = (results[0] - results[1]).abs().max() / results[0].abs().max()
        assert (difference < 1e-10) if same else (difference > 1e-6)


def test_heat_signature_of_a_padded_batch_equals_the_loop():
    verts, faces, mask, singles = ragged(math.nan)
    value = heat_kernel_signature(verts, faces, num_signatures=6, num_eigenpairs=12, mask=mask)
    assert (value[~mask] == 0).all()
    for b, (v, f) in enumerate(singles):
        assert_near(value[b, mask[b]], heat_kernel_signature(v, f, num_signatures=6, num_eigenpairs=12), 1e-6)


# Fast method


@cache
def posed_bodies() -> tuple[Tensor, Tensor]:
    human = load_humans(1000)
    with torch.no_grad():
        return human(torch.tensor([3, 100, 50]), torch.tensor([5, 700, 321])), human.faces


def test_fast_eigenpairs_against_the_exact_ones():
    verts, faces = posed_bodies()
    for points in verts.double():
        expected, _ = laplacian_eigenpairs(points, faces, 64)
        values, vectors = laplacian_eigenpairs(points, faces, 64, method="fast")
        error = values[1:] / expected[1:] - 1
        assert (error > -1e-9).all()  # from above, as Ritz values are
        assert (error[:32] < 1e-5).all() and (error < 0.1).all()
        mass = mass_matrix(points, faces)
        gram = vectors.T @ ((mass / mass.sum())[:, None] * vectors)
        assert_near(gram, torch.eye(64, dtype=torch.float64), 1e-8)


@pytest.mark.parametrize(
    "signature",
    [
        lambda *a, **k: heat_kernel_signature(*a, **k).log(),
        wave_kernel_signature,
        lambda *a, **k: wave_kernel_signature(*a, width=1.0, **k),
    ],
    ids=["heat", "wave", "narrow wave"],
)
def test_fast_signatures_within_a_tenth_of_a_deviation(signature):
    verts, faces = posed_bodies()
    exact, fast = signature(verts, faces), signature(verts, faces, method="fast")
    error = (fast - exact).square().mean((0, 1)).sqrt() / exact.std((0, 1))
    assert error.square().mean().sqrt() < 0.1
    assert 0 < error.max() < 0.2  # it is another method


def test_fast_signatures_ignore_order_place_and_unit():
    verts, faces = posed_bodies()
    points = verts[0].double()
    expected = wave_kernel_signature(points, faces, method="fast")
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    value = wave_kernel_signature(points[order], order.argsort()[faces], method="fast")
    assert_near(value, expected[order], 1e-6)
    moved = 1000 * points + torch.tensor([30.0, -4.0, 7.0])
    assert_near(wave_kernel_signature(moved, faces, method="fast"), expected, 1e-6)
    turned = wave_kernel_signature(points @ rotation().T, faces, method="fast")
    assert (turned - expected).square().mean().sqrt() < 0.1 * expected.std()


def test_fast_method_finds_repeated_eigenvalues():
    """The octahedral sphere, whose symmetry would keep simpler starting functions from most eigenvectors."""
    verts, faces = sphere(4)
    expected, _ = laplacian_eigenpairs(verts, faces, 32)
    values, _ = laplacian_eigenpairs(verts, faces, 32, method="fast")
    np.testing.assert_allclose(values[:25], expected[:25], rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(values[:16], expected[:16], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("name", "k"), [("sphere", 20), ("sheet", 62)])
def test_fast_method_is_exact_on_small_meshes(name, k):
    verts, faces = MESHES[name]()
    values, vectors = laplacian_eigenpairs(verts, faces, k, method="fast")
    np.testing.assert_allclose(values, dense_eigenpairs(name)[0][:k], rtol=1e-8, atol=1e-8)
    assert vectors.shape == (len(verts), k)


def test_fast_method_on_sheets_that_coincide():
    """Functions of the position cannot tell the pages of a closed book apart; the exact solver takes over."""
    verts, faces = book(4, opened=0.0)
    values, _ = laplacian_eigenpairs(verts, faces, 8, method="fast")
    np.testing.assert_allclose(values, laplacian_eigenpairs(verts, faces, 8)[0], rtol=1e-8, atol=1e-8)


def test_fast_method_on_many_components():
    verts, faces = sphere(2, 0.05)
    copies = torch.cat([verts + 5 * i for i in range(14)]), torch.cat([faces + len(verts) * i for i in range(14)])
    values, _ = laplacian_eigenpairs(*copies, 16, method="fast")
    np.testing.assert_allclose(values, laplacian_eigenpairs(*copies, 16)[0], rtol=1e-8, atol=1e-8)
    assert (values[:14] < 1e-6).all() and (values[14:] > 1).all()


# Cache


def forbid_solving(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("solved again")

    monkeypatch.setattr("meshkit.descriptors._spectrum.normalised_laplacian", fail)


@pytest.mark.parametrize("kind", ["mapping", "folder", "folder as text"])
def test_cached_pairs_are_not_solved_for_again(kind, tmp_path, monkeypatch):
    verts, faces = sphere(2, 0.05)
    cache = {"mapping": {}, "folder": tmp_path / "new" / "folder", "folder as text": str(tmp_path)}[kind]
    options = {"num_eigenpairs": 12, "cache": cache}
    expected = [wave_kernel_signature(verts, faces, num_eigenpairs=12), laplacian_eigenpairs(verts, faces, 12)[1]]
    first = wave_kernel_signature(verts, faces, **options)
    forbid_solving(monkeypatch)
    pairs = laplacian_eigenpairs(verts, faces, 12, cache=cache)
    assert torch.equal(first, expected[0]) and torch.equal(pairs[1], expected[1])
    for signature in (wave_kernel_signature, heat_kernel_signature, intrinsic_descriptors):
        assert torch.isfinite(signature(verts, faces, **options)).all()
    padded = torch.cat([faces, torch.full((2, 3), -1)])
    assert torch.equal(wave_kernel_signature(verts[None], padded[None], **options)[0], first)
    files = [f for f in tmp_path.rglob("*") if f.is_file()]
    assert len(cache if kind == "mapping" else files) == 1
    with pytest.raises(AssertionError, match="solved again"):
        laplacian_eigenpairs(verts, faces, 12)


def test_cache_tells_contents_apart():
    verts, faces = sphere(2, 0.05)
    moved = verts.clone()
    moved[3, 0] += 1e-12
    kept: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
    base = (verts, faces, 6)
    variants = [
        (base, {}),
        ((moved, faces, 6), {}),
        ((verts, faces[1:], 6), {}),
        ((verts, faces.roll(1, 0), 6), {}),
        ((verts, faces, 7), {}),
        (base, {"tol": 1e-3}),
        (base, {"method": "fast"}),
    ]
    for count, (arguments, options) in enumerate(variants, 1):
        laplacian_eigenpairs(*arguments, **options, cache=kept)
        assert len(kept) == count


def test_changing_a_result_does_not_change_the_cache():
    verts, faces = sphere(1, 0.1)
    kept: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
    values, vectors = laplacian_eigenpairs(verts, faces, 5, cache=kept)
    expected = values.clone(), vectors.clone()
    values.zero_(), vectors.zero_()
    for again, wanted in zip(laplacian_eigenpairs(verts, faces, 5, cache=kept), expected, strict=True):
        assert torch.equal(again, wanted)


def test_cache_serves_every_dtype():
    verts, faces = sphere(1, 0.1)
    verts = verts.float()
    kept: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
    assert laplacian_eigenpairs(verts, faces, 5, cache=kept)[1].dtype == torch.float32
    assert laplacian_eigenpairs(verts.double(), faces.int(), 5, cache=kept)[1].dtype == torch.float64
    assert len(kept) == 1


# Robust Laplacian and point clouds


def book(pages: int = 3, opened: float = 1.0) -> Mesh:
    """Sheets that meet in one edge line: edges of as many faces as there are pages. Closed, the pages coincide."""
    flat, faces = grid(5, 4)
    verts, triangles = [], []
    for page in range(pages):
        angle = torch.tensor(opened * 2 * math.pi * page / pages)
        verts.append(torch.stack([flat[:, 0] * angle.cos(), flat[:, 0] * angle.sin(), flat[:, 1]], 1))
        index = torch.arange(20) + 16 * page
        index[:4] = torch.arange(4)  # the spine, shared
        triangles.append(index[faces])
    return torch.cat([verts[0], *(v[4:] for v in verts[1:])]), torch.cat(triangles)


def dense_robust(stiffness, mass) -> np.ndarray:
    weights = mass.diagonal()
    return scipy.linalg.eigh(stiffness.toarray(), np.diag(weights / weights.sum()), eigvals_only=True)


def test_robust_pairs_of_an_edge_of_three_faces_equal_the_dense_solver():
    package = pytest.importorskip("robust_laplacian")
    verts, faces = book()
    expected = dense_robust(*package.mesh_laplacian(verts.numpy(), faces.numpy()))
    for method in ("exact", "fast"):
        values, _ = laplacian_eigenpairs(verts, faces, 12, robust=True, method=method)
        np.testing.assert_allclose(values, expected[:12], rtol=1e-7, atol=1e-7)


def test_cotangent_pairs_of_an_edge_of_three_faces_equal_the_dense_solver():
    verts, faces = book()
    mass = mass_matrix(verts, faces).numpy()
    stiffness = cotangent_laplacian(verts, faces).to_dense().numpy()
    expected = scipy.linalg.eigh(stiffness, np.diag(mass / mass.sum()), eigvals_only=True)
    np.testing.assert_allclose(laplacian_eigenpairs(verts, faces, 12)[0], expected[:12], rtol=1e-8, atol=1e-8)


def test_robust_laplacian_accepts_faces_without_area():
    pytest.importorskip("robust_laplacian")
    verts, faces = spoil("no area")
    value = wave_kernel_signature(verts, faces, num_eigenpairs=8, robust=True)
    assert torch.isfinite(value).all()
    with pytest.raises(ValueError, match="2 of 20 vertices belong to no face"):
        laplacian_eigenpairs(*spoil("unreferenced"), 5, robust=True)


@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_robust_spectrum_of_the_sphere(kind):
    pytest.importorskip("robust_laplacian")
    verts, faces = sphere(4)
    values, _ = laplacian_eigenpairs(verts, faces if kind == "mesh" else None, 16, robust=True)
    expected = [degree * (degree + 1) * 4 * math.pi for degree in range(4) for _ in range(2 * degree + 1)]
    np.testing.assert_allclose(values, expected, rtol=0.02 if kind == "mesh" else 0.1, atol=1e-6)


def test_signatures_of_point_clouds_are_near_those_of_the_surface():
    pytest.importorskip("robust_laplacian")
    verts, faces = sphere(3, 0.02)
    verts = verts * torch.tensor([1.0, 1.5, 2.0])
    surface = heat_kernel_signature(verts, faces, num_eigenpairs=30).log()
    cloud = heat_kernel_signature(verts, None, num_eigenpairs=30).log()
    assert (cloud - surface).square().mean().sqrt() < 0.25 * surface.std(0).mean()
    order = torch.randperm(len(verts), generator=torch.Generator().manual_seed(0))
    assert_near(heat_kernel_signature(verts[order], None, num_eigenpairs=30).log(), cloud[order], 1e-6)


def test_point_clouds_in_a_padded_batch_equal_the_loop():
    pytest.importorskip("robust_laplacian")
    singles = [sphere(2, 0.05)[0], sphere(2, 0.1)[0][:50]]
    mask = scattered_mask([len(v) for v in singles], 70)
    verts = scatter(singles, mask, math.nan)
    value = intrinsic_descriptors(verts, None, num_signatures=4, num_eigenpairs=10, mask=mask)
    assert (value[~mask] == 0).all()
    for b, v in enumerate(singles):
        assert_near(value[b, mask[b]], intrinsic_descriptors(v, None, num_signatures=4, num_eigenpairs=10), 1e-6)


@pytest.mark.parametrize(("kind", "message"), [("mesh", "robust=True needs"), ("cloud", "a point cloud .* needs")])
def test_missing_robust_laplacian_is_named(kind, message, monkeypatch):
    monkeypatch.setitem(sys.modules, "robust_laplacian", None)
    verts, faces = sphere(1)
    with pytest.raises(ImportError, match=message + r".*robust-laplacian: pip install 'meshkit-torch\[solvers\]'"):
        laplacian_eigenpairs(verts, faces if kind == "mesh" else None, 5, robust=True)


# Errors of the options


def test_option_errors():
    verts, faces = sphere(1)
    mask = torch.ones(1, 18, dtype=torch.bool)
    with pytest.raises(ValueError, match='method must be "exact" or "fast", got \'slow\''):
        laplacian_eigenpairs(verts, faces, 5, method="slow")
    with pytest.raises(ValueError, match="mask needs a batch"):
        wave_kernel_signature(verts, faces, mask=mask)
    with pytest.raises(ValueError, match=r"differ in their batch size"):
        wave_kernel_signature(verts[None], faces.expand(2, -1, -1))
    with pytest.raises(ValueError, match=r"verts must have shape .* got \(0, 18, 3\)"):
        wave_kernel_signature(verts.expand(0, -1, -1), faces)
    hidden = mask.clone()
    hidden[0, 0] = False
    with pytest.raises(ValueError, match="4 faces refer to vertices that the mask calls padding"):
        wave_kernel_signature(verts[None], faces, mask=hidden)
    with pytest.raises(ValueError, match="num_signatures must be at least 2, got 1"):
        heat_kernel_signature(verts, faces, num_signatures=1)


def test_the_fast_method_keeps_to_one_thread(monkeypatch):
    """Threads of NumPy's own cannot be bounded from here, so it must not do the dense algebra."""
    seen = []
    inner = _solvers._ritz_pairs

    def look(*arguments):
        seen.append(torch.get_num_threads())
        return inner(*arguments)

    def refuse(*arguments, **options):
        raise AssertionError("dense algebra in NumPy")

    monkeypatch.setattr(_solvers, "_ritz_pairs", look)
    for name in ("qr", "eigh"):
        monkeypatch.setattr(f"numpy.linalg.{name}", refuse)
    body = load_humans(1000)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        laplacian_eigenpairs(body.template, body.faces, 8, method="fast")
        after = torch.get_num_threads()
    finally:
        torch.set_num_threads(threads)
    assert seen == [1]
    assert after == 2
