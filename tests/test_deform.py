"""Closest rotations and ARAP against SVD, dense literal transcriptions, libigl, and the properties they must have."""

from importlib import resources

import igl
import numpy as np
import pytest
import torch
import trimesh

from meshkit.deform import ARAPDeformer, arap_deform, arap_energy, closest_rotation

DTYPES = [torch.float32, torch.float64]
ENERGIES = ["spokes_and_rims", "spokes", "spokes_unclamped", "elements"]
LOCAL_GLOBAL: dict = {"method": "local_global", "tol": 0.0, "grad": "unroll"}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def randn(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=seeded(seed)).to(dtype)


def sphere(subdivisions: int = 1, noise: float = 0.08, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an icosphere shaken enough to have negative cotangent weights."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    verts = torch.tensor(np.asarray(mesh.vertices))
    return verts + noise * randn(*verts.shape, seed=seed), torch.tensor(np.asarray(mesh.faces), dtype=torch.int64)


def human() -> tuple[torch.Tensor, torch.Tensor]:
    path = resources.files("meshkit") / "data" / "assets" / "humans_baked.npz"
    with path.open("rb") as file, np.load(file) as arrays:
        return torch.tensor(arrays["v1000"]).double(), torch.tensor(arrays["f1000"].astype(np.int64))


def svd_rotation(S: torch.Tensor) -> torch.Tensor:
    U, _, Vh = torch.linalg.svd(S)
    flip = torch.ones_like(S[..., 0])
    flip[..., 2] = torch.linalg.det(U @ Vh)
    return (U * flip[..., None, :]) @ Vh


def random_rotation(seed: int) -> torch.Tensor:
    return svd_rotation(randn(3, 3, seed=seed))


# ---------------------------------------------------------------- closest rotation


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["general", "reflection", "rank 2", "tiny", "huge"])
def test_rotation_matches_svd(dtype: torch.dtype, kind: str) -> None:
    S = randn(7, 60, 3, 3)
    if kind == "reflection":
        S = S * -torch.linalg.det(S).sign()[..., None, None]
    if kind == "rank 2":
        S = S @ torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)) @ random_rotation(1)
    S = (S * {"tiny": 1e-25, "huge": 1e25}.get(kind, 1.0)).to(dtype)
    got, expected = closest_rotation(S), svd_rotation(S.double())
    assert got.shape == S.shape and got.dtype == dtype
    # The condition of the problem is the inverse of the smallest sum of two signed singular values.
    sigma = torch.linalg.svdvals(S.double())
    gap = (sigma[..., 1] + sigma[..., 2] * torch.linalg.det(S.double()).sign()) / sigma[..., 0]
    error = (got - expected).abs().amax((-1, -2)) * gap
    assert error.max() < 20 * torch.finfo(dtype).eps


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rank", [0, 1])
def test_ill_determined_rotations_still_maximise(dtype: torch.dtype, rank: int) -> None:
    S = (randn(50, 3, rank) @ randn(50, rank, 3, seed=1)).to(dtype)
    got = closest_rotation(S).double()
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(got.mT @ got, torch.eye(3).double().expand(50, 3, 3), rtol=0, atol=50 * eps)
    assert (torch.linalg.det(got) > 0).all()
    best, reached = torch.linalg.svdvals(S.double()).sum(-1), (got * S).sum((-1, -2))
    torch.testing.assert_close(reached, best, rtol=50 * eps, atol=1e-300)


def test_rotation_of_special_matrices() -> None:
    half_turns = [torch.diag(torch.tensor(d)) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    for R in [torch.eye(3), *half_turns]:
        torch.testing.assert_close(closest_rotation(4 * R), R)
    assert torch.equal(closest_rotation(torch.zeros(3, 3)), torch.eye(3))
    assert torch.linalg.det(closest_rotation(-torch.eye(3))) > 0.99
    assert closest_rotation(torch.empty(0, 3, 3)).shape == (0, 3, 3)


def test_rotation_of_nonfinite_input_is_nan_and_spoils_nothing_else() -> None:
    S = randn(4, 3, 3)
    S[1, 0, 2], S[2, 1, 1] = torch.nan, torch.inf
    got = closest_rotation(S)
    assert got[1:3].isnan().all()
    torch.testing.assert_close(got[[0, 3]], svd_rotation(S[[0, 3]]))


def test_rotation_in_low_precision_is_computed_in_float32() -> None:
    S = randn(20, 3, 3).bfloat16()
    assert torch.equal(closest_rotation(S), closest_rotation(S.float()).bfloat16())


def test_rotation_leaves_autocast() -> None:
    S = torch.cat([randn(20, 3, 3), -torch.eye(3).double()[None], torch.zeros(1, 3, 3).double()]).float()
    expected = closest_rotation(S)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(closest_rotation(S), expected)


def test_rotation_gradient() -> None:
    S = randn(6, 3, 3).requires_grad_()  # both signs of the determinant
    assert torch.linalg.det(S).sign().unique().numel() == 2
    assert torch.autograd.gradcheck(closest_rotation, (S,))
    equal = (2 * random_rotation(3)).requires_grad_()  # three equal singular values: an SVD backward is infinite here
    assert torch.autograd.gradcheck(closest_rotation, (equal,))


def test_rotation_gradient_scales_inversely() -> None:
    S, weight = randn(30, 3, 3), randn(30, 3, 3, seed=1)

    def gradient(S: torch.Tensor) -> torch.Tensor:
        S.requires_grad_()
        return torch.autograd.grad((closest_rotation(S) * weight).sum(), S)[0]

    exact = gradient(S.clone())
    torch.testing.assert_close(gradient(S.float() * 1e-20).double() * 1e-20, exact, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("dtype", DTYPES)
def test_rotation_gradient_is_finite_where_the_rotation_is_not_unique(dtype: torch.dtype) -> None:
    rank_one = torch.zeros(3, 3)
    rank_one[0, 1] = 1
    S = torch.stack([torch.eye(3), torch.zeros(3, 3), -torch.eye(3), torch.diag(torch.tensor([1.0, 1, -1])), rank_one])
    S = S.to(dtype).requires_grad_()
    (closest_rotation(S) * randn(5, 3, 3, dtype=dtype)).sum().backward()
    assert torch.isfinite(S.grad).all()
    assert not S.grad[1].any()


@pytest.mark.parametrize("S", [torch.zeros(3, 2), torch.zeros(3), torch.eye(3).long()])
def test_rotation_rejects(S: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"S must be a floating \(\.\.\., 3, 3\) tensor, got"):
        closest_rotation(S)


# ---------------------------------------------------------------- energy and deformation against literal code


def cells(verts: torch.Tensor, faces: torch.Tensor, energy: str) -> list[list[tuple[int, int, float]]]:
    """Return for every vertex its (j, k, weight), straight from the definitions."""
    v = verts.numpy()
    per_face = energy == "elements"
    result: list[list[tuple[int, int, float]]] = [[] for _ in (faces if per_face else v)]
    summed: dict[tuple[int, int], float] = {}
    for number, face in enumerate(faces.tolist()):
        for k in range(3):
            o, i, j = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            a, b = v[i] - v[o], v[j] - v[o]
            half = 0.5 * (a @ b) / np.linalg.norm(np.cross(a, b))
            summed[min(i, j), max(i, j)] = summed.get((min(i, j), max(i, j)), 0.0) + half
            if energy == "spokes_and_rims":
                for cell in face:
                    result[cell].append((i, j, half))
            if per_face:
                result[number].append((i, j, half))
    if energy.startswith("spokes") and energy != "spokes_and_rims":
        assert min(summed.values()) < 0  # so that the clamp is tested
        least = 0.0 if energy == "spokes" else -np.inf
        for (i, j), w in summed.items():
            result[i].append((i, j, max(w, least)))
            result[j].append((j, i, max(w, least)))
    return result


def literal_rotation(cell: list[tuple[int, int, float]], v: np.ndarray, x: np.ndarray) -> np.ndarray:
    S = sum(w * np.outer(x[j] - x[k], v[j] - v[k]) for j, k, w in cell)
    U, _, Vt = np.linalg.svd(S)
    return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt


def literal_energy(all_cells: list, v: np.ndarray, x: np.ndarray) -> float:
    total = 0.0
    for cell in all_cells:
        R = literal_rotation(cell, v, x)
        total += sum(w * np.sum((x[j] - x[k] - R @ (v[j] - v[k])) ** 2) for j, k, w in cell)
    return total


def literal_deform(all_cells: list, v: np.ndarray, handles: list, pos: np.ndarray, iterations: int) -> np.ndarray:
    n = len(v)
    x, R = v.copy(), [np.eye(3)] * len(all_cells)
    A = np.zeros((n, n))
    for cell in all_cells:
        for j, k, w in cell:
            A[[j, k, j, k], [j, k, k, j]] += [w, w, -w, -w]
    for step in range(iterations):
        if step:
            R = [literal_rotation(cell, v, x) for cell in all_cells]
        b = np.zeros((n, 3))
        for cell, rotation in zip(all_cells, R, strict=True):
            for j, k, w in cell:
                b[j] += w * rotation @ (v[j] - v[k])
                b[k] -= w * rotation @ (v[j] - v[k])
        system = A.copy()
        system[handles] = np.eye(n)[handles]
        b[handles] = pos
        x = np.linalg.solve(system, b)
    return x


@pytest.mark.parametrize("energy", ENERGIES)
def test_energy_matches_the_definition(energy: str) -> None:
    verts, faces = sphere(1, noise=0.15)
    deformed = verts + 0.2 * randn(*verts.shape, seed=5)
    expected = literal_energy(cells(verts, faces, energy), verts.numpy(), deformed.numpy())
    assert arap_energy(verts, faces, deformed, energy=energy).item() == pytest.approx(expected, rel=1e-10)
    rigid = verts @ random_rotation(0).T + 3
    assert abs(arap_energy(verts, faces, rigid, energy=energy).item()) < 1e-12


@pytest.mark.parametrize("energy", ENERGIES)
def test_energy_gradient_and_padding(energy: str) -> None:
    verts, faces = sphere(0, noise=0.25)
    deformed = (verts + 0.2 * randn(*verts.shape, seed=5)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: arap_energy(verts, faces, x, energy=energy), (deformed,))
    both = torch.stack([verts, verts.flip(0)])
    padded = torch.cat([both, torch.full((2, 3, 3), torch.nan)], 1)
    mask = ~padded[..., 0].isnan()
    expected = torch.stack([arap_energy(v, faces, deformed, energy=energy) for v in both])
    moved = torch.cat([deformed.expand(2, -1, 3), padded[:, -3:]], 1)
    torch.testing.assert_close(arap_energy(padded, faces, moved, energy=energy, mask=mask), expected)


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("iterations", [1, 2, 7])
def test_deform_matches_dense_local_global(energy: str, iterations: int) -> None:
    verts, faces = sphere(1, noise=0.15)
    handles = [0, 5, 17, 30]
    pos = verts[handles] + 0.4 * randn(4, 3, seed=2)
    expected = literal_deform(cells(verts, faces, energy), verts.numpy(), handles, pos.numpy(), iterations)
    got, info = arap_deform(
        verts, faces, torch.tensor(handles), pos, energy=energy, max_iter=iterations, **LOCAL_GLOBAL
    )
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-10)
    assert info.evaluations.item() == iterations
    assert info.energy.item() == pytest.approx(arap_energy(verts, faces, got, energy=energy).item(), rel=1e-9)


@pytest.mark.parametrize("iterations", [1, 15])
def test_deform_matches_libigl_on_a_body(iterations: int) -> None:
    verts, faces = human()
    handles = torch.randperm(len(verts), generator=seeded())[:100]
    angle = 1.5 * verts[:, 2]  # twist about the vertical axis
    x, y = verts[:, 0], verts[:, 1]
    twisted = torch.stack([angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y, verts[:, 2]], 1)
    pos = twisted[handles] + 0.01 * randn(100, 3)
    data = igl.ARAPData()
    data.energy, data.max_iter = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_SPOKES_AND_RIMS, iterations
    igl.arap_precomputation(verts.numpy(), faces.numpy(), 3, handles.numpy().astype(np.int32), data)
    expected = igl.arap_solve(pos.numpy(), data, verts.numpy())
    got, _ = arap_deform(verts, faces, handles, pos, max_iter=iterations, **LOCAL_GLOBAL, init=verts)
    assert np.abs(expected - twisted.numpy()).max() > 0.01
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-4)  # libigl computes its rotations in float32


# ---------------------------------------------------------------- properties


@pytest.mark.parametrize("energy", ["spokes_and_rims", "spokes"])  # the others may stop at a crumpled minimum
@pytest.mark.parametrize("dtype", DTYPES)
def test_rigid_handles_move_the_mesh_rigidly(energy: str, dtype: torch.dtype) -> None:
    verts, faces = sphere(2)
    handles = torch.arange(0, len(verts), 10)
    moved = verts @ random_rotation(1).T + torch.tensor([1.0, -2.0, 0.5])
    got, info = arap_deform(
        verts.to(dtype), faces, handles, moved[handles].to(dtype), energy=energy, max_iter=150, method="local_global"
    )
    assert got.dtype == dtype
    torch.testing.assert_close(got.double(), moved, rtol=0, atol=1e-5)
    assert info.energy < 1e-8
    warm, _ = arap_deform(verts, faces, handles, moved[handles], energy=energy, max_iter=1, **LOCAL_GLOBAL, init=moved)
    torch.testing.assert_close(warm, moved, rtol=0, atol=1e-10)


@pytest.mark.parametrize("energy", ["spokes_and_rims", "spokes", "elements"])
def test_energy_never_increases_and_tolerance_stops(energy: str) -> None:
    verts, faces = sphere(2)
    handles = torch.arange(0, len(verts), 20)
    pos = verts[handles] * torch.tensor([1.5, 0.7, 1.2], dtype=torch.float64)
    runs = [arap_deform(verts, faces, handles, pos, energy=energy, max_iter=k, **LOCAL_GLOBAL)[1] for k in range(1, 12)]
    energies = torch.stack([info.energy for info in runs])
    assert (energies.diff() < 0).all()
    # The residual promises a decrease that the next iteration keeps.
    promised = torch.stack([info.residual for info in runs])[:-1]
    assert (-energies.diff() / energies[:-1] >= promised).all() and (promised > 0).all()
    assert not runs[-1].converged
    arguments = {"energy": energy, "max_iter": 1000, "tol": 1e-4}
    stopped = arap_deform(verts, faces, handles, pos, method="local_global", **arguments)[1]
    assert stopped.converged and stopped.residual <= 1e-4 and 1 < stopped.evaluations < 1000


def test_initial_positions_shorten_the_way() -> None:
    verts, faces = sphere(2)
    handles = torch.arange(0, len(verts), 20)
    pos = verts[handles] * 1.3
    far, info = arap_deform(verts, faces, handles, pos, max_iter=200, method="local_global", tol=1e-7)
    again, warm = arap_deform(verts, faces, handles, pos, max_iter=200, method="local_global", tol=1e-7, init=far)
    assert warm.evaluations < 3 < info.evaluations
    torch.testing.assert_close(again, far, atol=1e-4, rtol=0)


@pytest.mark.parametrize("energy", ENERGIES)
def test_ragged_batch_equals_the_loop(energy: str) -> None:
    meshes = [sphere(1, seed=1), sphere(2, seed=2), sphere(1, seed=3)]
    size, rows = max(len(v) for v, _ in meshes), max(len(f) for _, f in meshes)
    verts, faces = torch.full((3, size, 3), torch.nan).double(), torch.full((3, rows, 3), -1)
    handles, pos = torch.full((3, 6), -1), torch.full((3, 6, 3), torch.nan).double()
    expected = torch.zeros(3, size, 3).double()
    energies = []
    for b, (v, f) in enumerate(meshes):
        order = torch.randperm(len(f), generator=seeded(b))
        count = 4 + b
        picked = torch.randperm(len(v), generator=seeded(b))[:count]
        target = v[picked] + 0.3 * randn(count, 3, seed=b)
        verts[b, : len(v)], faces[b, : len(f)] = v, f[order]
        handles[b, :count], pos[b, :count] = picked, target
        expected[b, : len(v)], info = arap_deform(v, f, picked, target, energy=energy, max_iter=8, **LOCAL_GLOBAL)
        energies.append(info.energy)
    mask = ~verts[..., 0].isnan()
    got, info = arap_deform(verts, faces, handles, pos, mask=mask, energy=energy, max_iter=8, **LOCAL_GLOBAL)
    torch.testing.assert_close(got, expected)
    torch.testing.assert_close(info.energy, torch.stack(energies))


def test_vertex_order_does_not_matter() -> None:
    verts, faces = sphere(2)
    handles = torch.arange(0, 40, 4)
    pos = verts[handles] + 0.2 * randn(10, 3)
    perm = torch.randperm(len(verts), generator=seeded())
    place = torch.argsort(perm)
    got, _ = arap_deform(verts[perm], place[faces], place[handles], pos, max_iter=6, **LOCAL_GLOBAL)
    torch.testing.assert_close(got, arap_deform(verts, faces, handles, pos, max_iter=6, **LOCAL_GLOBAL)[0][perm])


def test_shared_faces_handles_and_positions_broadcast() -> None:
    verts, faces = sphere()
    both = torch.stack([verts, 1.1 * verts])
    handles, pos = torch.tensor([3, 8, 20]), randn(3, 3)
    got, _ = arap_deform(both, faces, handles, pos, max_iter=4, **LOCAL_GLOBAL)
    for b in range(2):
        torch.testing.assert_close(got[b], arap_deform(both[b], faces, handles, pos, max_iter=4, **LOCAL_GLOBAL)[0])


def test_all_vertices_fixed_returns_the_handles() -> None:
    verts, faces = sphere()
    pos = randn(len(verts), 3).requires_grad_()
    order = torch.randperm(len(verts), generator=seeded())
    got, info = arap_deform(verts, faces, order, pos)
    assert torch.equal(got[order], pos) and info.evaluations.item() == 0 and info.converged
    assert info.energy.item() == pytest.approx(arap_energy(verts, faces, got).item())
    assert torch.equal(torch.autograd.grad(got.sum(), pos)[0], torch.ones_like(pos))


def test_a_fixed_isolated_vertex_and_a_zero_area_face_are_fine() -> None:
    verts, faces = sphere()
    isolated = torch.cat([verts, torch.tensor([[9.0, 9, 9]]).double()])
    handles, pos = torch.tensor([0, 7, 22, len(verts)]), randn(4, 3)
    expected, _ = arap_deform(verts, faces, handles[:3], pos[:3], max_iter=5, **LOCAL_GLOBAL)
    flat = torch.cat([faces, torch.tensor([[4, 4, 9]])])
    options = {"max_iter": 5, "degenerate": "ignore"}
    got, _ = arap_deform(isolated, flat, handles, pos, **options, **LOCAL_GLOBAL)
    torch.testing.assert_close(got, torch.cat([expected, pos[3:]]))


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("init", ["rest", "given"])
def test_unrolled_gradient(energy: str, init: str) -> None:
    verts, faces = sphere(0, noise=0.25)
    handles = torch.tensor([0, 4, 9])
    pos = (verts[handles] + 0.3 * randn(3, 3, seed=1)).requires_grad_()
    start = "rest" if init == "rest" else verts + 0.1 * randn(*verts.shape, seed=7)

    def run(p: torch.Tensor) -> torch.Tensor:
        return arap_deform(verts, faces, handles, p, energy=energy, max_iter=4, **LOCAL_GLOBAL, init=start)[0]

    assert torch.autograd.gradcheck(run, (pos,))


def test_gradient_none_records_nothing() -> None:
    verts, faces = sphere()
    rest = verts.clone().requires_grad_()
    handles, pos = torch.tensor([0, 9]), randn(2, 3).requires_grad_()
    assert not arap_deform(rest, faces, handles, pos, max_iter=3, grad="none")[0].requires_grad
    got, info = arap_deform(verts, faces, handles, pos, max_iter=3, **LOCAL_GLOBAL)
    assert not info.energy.requires_grad
    got.sum().backward()
    assert pos.grad is not None


# ---------------------------------------------------------------- deformer


def two_spheres() -> tuple[torch.Tensor, torch.Tensor]:
    verts, faces = sphere(1, seed=4)
    return torch.cat([verts, 0.5 * verts + 4]), torch.cat([faces, faces + len(verts)])


def met(deformed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    return ((deformed - target).abs() < 1e-12).all(-1)


def test_deformer_meets_a_random_fraction_and_is_the_function() -> None:
    verts, faces = sphere(2)
    rest = verts.expand(3, -1, 3)
    target = rest + 0.2 * randn(3, len(verts), 3)
    module = ARAPDeformer(0.1, max_iter=4, grad="unroll", generator=seeded(5))
    got = module(rest, target, faces)
    hit = met(got, target)
    assert hit.sum(1).tolist() == [round(0.1 * len(verts))] * 3
    assert not torch.equal(hit[0], hit[1])
    for b in range(3):
        handles = hit[b].nonzero().squeeze(1)
        torch.testing.assert_close(
            got[b], arap_deform(verts, faces, handles, target[b][handles], max_iter=4, **LOCAL_GLOBAL)[0]
        )
    given = module(rest, target, faces, handles=torch.tensor([1, 2, 3]))
    assert met(given, target).nonzero()[:, 1].tolist() == [1, 2, 3] * 3


def test_deformer_is_reproducible_and_draws_anew() -> None:
    verts, faces = sphere(1)
    target = verts + randn(len(verts), 3)
    module = ARAPDeformer(0.3, max_iter=1, grad="unroll")
    first = module(verts, target, faces, generator=seeded(1))
    assert torch.equal(first, module(verts, target, faces, generator=seeded(1)))
    assert not torch.equal(first, module(verts, target, faces, generator=seeded(2)))
    torch.manual_seed(3)
    default = module(verts, target, faces)
    assert not torch.equal(default, module(verts, target, faces))
    torch.manual_seed(3)
    assert torch.equal(default, module(verts, target, faces))


def test_every_component_gets_a_handle_and_padding_none() -> None:
    verts, faces = two_spheres()
    isolated = torch.cat([verts, torch.tensor([[9.0, 0, 0], [torch.nan] * 3]).double()])
    mask = torch.ones(2, len(isolated), dtype=torch.bool)
    mask[:, -1] = False
    rest = isolated.expand(2, -1, 3)
    target = torch.where(mask[..., None], rest + 0.3, torch.nan)
    target[mask] += 0.1 * randn(int(mask.sum()), 3)
    got = ARAPDeformer(0.01, max_iter=2, grad="unroll", generator=seeded())(rest, target, faces, mask=mask)
    hit, half = met(got, target), len(verts) // 2
    assert hit.sum(1).tolist() == [3, 3] and hit[:, -2].all()
    assert hit[:, :half].sum(1).tolist() == [1, 1]
    assert not got[~mask].any()


def test_deformer_gradient_reaches_the_handles_of_the_target_only() -> None:
    verts, faces = sphere(1)
    target = (verts + 0.2 * randn(len(verts), 3)).requires_grad_()
    got = ARAPDeformer(0.2, max_iter=3, grad="unroll", generator=seeded())(verts, target, faces)
    hit = met(got.detach(), target.detach())
    (gradient,) = torch.autograd.grad(got.square().sum(), target)
    assert torch.equal(gradient.abs().sum(1) > 0, hit)
    assert not ARAPDeformer(0.2, max_iter=3, grad="none")(verts, target, faces).requires_grad


def test_deformer_options() -> None:
    assert repr(ARAPDeformer(0.2)) == (
        "ARAPDeformer(fraction=0.2, energy='spokes_and_rims', degenerate='raise', generator=None, method='lbfgs', "
        "max_iter=50, tol=1e-07, grad='implicit', grad_tol=0.001, solver='auto', compiled=False)"
    )
    for fraction in (0.0, 1.5, float("nan")):
        with pytest.raises(ValueError, match=r"fraction must be in \(0, 1\], got"):
            ARAPDeformer(fraction)
    with pytest.raises(ValueError, match="grad must be one of implicit, unroll, none; got 'both'"):
        ARAPDeformer(grad="both")
    with pytest.raises(ValueError, match=r"energy must be one of .* got 'faces'"):
        ARAPDeformer(energy="faces")
    verts, faces = sphere()
    with pytest.raises(ValueError, match="target must have the shape of verts"):
        ARAPDeformer()(verts, verts[:-1], faces)


# ---------------------------------------------------------------- bad input

VERTS, FACES = sphere()
HANDLES, POS = torch.tensor([0, 7]), torch.zeros(2, 3)
BATCH = VERTS.expand(2, -1, 3)
SPLIT, SPLIT_FACES = two_spheres()
WEIGHTS = torch.ones(42)
UNWELDED = r"the mesh is in 80 pieces, which are 1 once vertices at equal positions are merged: .* = torch.unique\("


def merged(verts: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Put the ends of one edge in one place."""
    spoiled = verts.clone()
    spoiled[faces[0, 0]] = spoiled[faces[0, 1]]
    return spoiled


def flattened(verts: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Put one vertex on the middle of the opposite edge."""
    spoiled = verts.clone()
    spoiled[faces[0, 0]] = 0.5 * (spoiled[faces[0, 1]] + spoiled[faces[0, 2]])
    return spoiled


def with_nan(tensor: torch.Tensor) -> torch.Tensor:
    spoiled = tensor.clone()
    spoiled[1, 0] = torch.nan
    return spoiled


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"energy": "faces"}, "energy must be .* got 'faces'"),
        ({"grad": "both"}, "grad must be .* got 'both'"),
        ({"grad": "unroll"}, 'grad="unroll" needs method="local_global"'),
        ({"grad_tol": 0.0}, r"grad_tol must be in \(0, 1\), got 0.0"),
        ({"method": "newton"}, "method must be one of lbfgs, local_global; got 'newton'"),
        ({"solver": "lu"}, "solver must be one of auto, splu, qdldl, cholespy, pcg, dense; got 'lu'"),
        ({"degenerate": "fix"}, "degenerate must be one of raise, ignore; got 'fix'"),
        ({"soft_targets": VERTS}, "belong together; soft_weights is missing"),
        ({"soft_weights": WEIGHTS}, "belong together; soft_targets is missing"),
        ({"soft_targets": VERTS, "soft_weights": WEIGHTS[1:]}, r"soft_weights must have shape \(42,\), got \(41,\)"),
        ({"soft_targets": VERTS, "soft_weights": -WEIGHTS}, "42 soft_weights are negative"),
        ({"soft_targets": with_nan(VERTS), "soft_weights": WEIGHTS}, "soft_targets holds NaN or infinity"),
        ({"soft_targets": VERTS[1:], "soft_weights": WEIGHTS}, "soft_targets must have the shape of verts"),
        (
            {
                "handles": HANDLES[:0],
                "handle_pos": POS[:0],
                "soft_targets": VERTS,
                "soft_weights": 0 * WEIGHTS,
            },
            "1 connected components have no handle",
        ),
        ({"faces": torch.cat([FACES, torch.tensor([[4, 4, 9]])])}, "1 faces name a vertex twice; repair the mesh"),
        ({"verts": merged(VERTS, FACES)}, "2 faces have an edge of length zero"),
        ({"verts": flattened(VERTS, FACES)}, "1 triangles have area zero"),
        ({"verts": VERTS[FACES].view(-1, 3), "faces": torch.arange(240).view(80, 3)}, UNWELDED),
        ({"init": "zero"}, "init must be \"rest\" or a tensor of positions, got 'zero'"),
        ({"init": VERTS[:4]}, r"init must have the shape of verts \(42, 3\), got \(4, 3\)"),
        ({"init": with_nan(VERTS)}, "init holds NaN or infinity"),
        ({"max_iter": 0}, "max_iter must be a whole number, at least 1, got 0"),
        ({"tol": -1.0}, "tol must be at least 0, got -1.0"),
        ({"verts": VERTS.long()}, "verts must be a floating .* got torch.int64"),
        ({"verts": VERTS[:, :2]}, r"verts must be .* got torch.float64 \(42, 2\)"),
        ({"verts": with_nan(VERTS)}, "verts holds NaN or infinity"),
        ({"faces": FACES + 1}, r"\[0, 42\) .* got a range of \[1, 42\]"),
        ({"faces": FACES[None]}, r"faces must have shape \(F, 3\), got \(1, 80, 3\)"),
        ({"verts": BATCH, "faces": FACES.expand(3, -1, 3)}, "differ in batch size"),
        ({"mask": torch.ones(41, dtype=torch.bool)}, r"mask must be bool of shape \(42,\), got torch.bool \(41,\)"),
        ({"mask": torch.ones(42)}, r"mask must be bool of shape \(42,\), got torch.float32"),
        ({"mask": torch.arange(42) != 3}, "[56] faces use a vertex that mask declares padding"),
        ({"handles": HANDLES.float()}, r"handles must be an integer \(H,\) tensor, got torch.float32"),
        ({"handles": HANDLES[None]}, r"handles must be an integer \(H,\) tensor, got torch.int64 \(1, 2\)"),
        ({"verts": BATCH, "handles": HANDLES[None, None]}, r"integer \(H,\) or \(B, H\) tensor"),
        ({"verts": BATCH, "handles": HANDLES.expand(3, 2)}, r"handles \(3, 2\) and verts .* differ in batch size"),
        ({"handles": torch.tensor([0, 42])}, r"handles must lie in \[0, 42\) .* got a range of \[0, 42\]"),
        ({"handles": torch.tensor([0, -2])}, r"got a range of \[-2, 0\]"),
        ({"handles": HANDLES[:0], "handle_pos": POS[:0]}, "1 of 1 meshes have no handle"),
        ({"verts": BATCH, "handles": torch.tensor([[0, 1], [-1, -1]])}, "1 of 2 meshes have no handle"),
        ({"handles": torch.tensor([7, 7])}, "1 handles repeat an earlier one"),
        ({"handle_pos": POS[:1]}, r"handle_pos must have shape \(2, 3\) like handles, got \(1, 3\)"),
        ({"verts": BATCH, "handle_pos": POS.expand(3, 2, 3)}, r"shape \(2, 3\) or \(2, 2, 3\) like handles"),
        ({"handle_pos": with_nan(POS)}, "handle_pos holds NaN or infinity"),
        ({"verts": torch.cat([VERTS, VERTS[:2] + 9])}, "2 vertices are in no face of positive area and are no handles"),
        (
            {
                "verts": torch.cat([VERTS, VERTS[:1] + 9]),
                "faces": torch.cat([FACES, torch.tensor([[42, 1, 1]])]),
                "degenerate": "ignore",
            },
            "1 vertices are in no face of positive area",
        ),
        ({"verts": SPLIT, "faces": SPLIT_FACES}, "1 connected components have no handle"),
        (
            {
                "verts": torch.cat([VERTS, VERTS[:1]]),
                "mask": torch.arange(43) < 42,
                "handles": torch.tensor([0, 42]),
            },
            "1 handles are vertices that mask declares padding",
        ),
    ],
)
def test_deform_rejects(change: dict, message: str) -> None:
    arguments = {"verts": VERTS, "faces": FACES, "handles": HANDLES, "handle_pos": POS} | change
    with pytest.raises(ValueError, match=message):
        arap_deform(**arguments)


def test_module_level_imports_are_torch_only() -> None:
    import subprocess
    import sys

    code = "import sys, meshkit.deform; print([m for m in ('scipy', 'igl', 'trimesh') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_lists_are_refused_with_what_is_wanted():
    verts, faces = torch.eye(3), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match=r"handles must be a tensor, got list: convert it with torch\.as_tensor"):
        arap_deform(verts, faces, [0, 1, 2], verts)
