"""L-BFGS, implicit gradients, soft constraints, the re-usable parts and the solvers of ARAP."""

import sys
from typing import Any

import igl
import numpy as np
import pytest
import torch
import trimesh

from meshkit.data import load_humans
from meshkit.deform import (
    PRESETS,
    ARAPDeformer,
    ARAPFactor,
    ARAPRest,
    ARAPTopology,
    arap_deform,
    arap_energy,
)
from meshkit.deform.conjugate_gradients import conjugate_gradients
from meshkit.deform.mesh_objective import MeshObjective

ENERGIES = ["spokes_and_rims", "spokes", "spokes_unclamped", "elements"]
TIGHT: dict[str, Any] = {"tol": 1e-20, "max_iter": 3000, "grad_tol": 1e-10}


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def ellipsoid(subdivisions: int = 1, noise: float = 0.02) -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    verts = torch.tensor(np.asarray(mesh.vertices)) * torch.tensor([1.0, 0.8, 0.6])
    return verts + noise * randn(*verts.shape), torch.tensor(np.asarray(mesh.faces), dtype=torch.int64)


def posed_body(size: int = 1000, share: int = 100) -> tuple[torch.Tensor, ...]:
    """Rest shape, faces, handles and their positions in a pose of a shipped body."""
    rig = load_humans(size)
    posed = rig(torch.tensor([0]), torch.tensor([7]))[0].double()
    handles = torch.randperm(size, generator=torch.Generator().manual_seed(0))[: size // share]
    return rig.shape(torch.tensor([0]))[0][0].double(), rig.faces, handles, posed[handles]


# ---------------------------------------------------------------- the minimum


@pytest.mark.parametrize("energy", ENERGIES)
def test_minimum_is_stationary_and_stays_put(energy: str) -> None:
    verts, faces = ellipsoid()
    handles = torch.tensor([0, 3, 20])
    pos = verts[handles] + 0.2 * randn(3, 3)
    x, info = arap_deform(verts, faces, handles, pos, energy=energy, tol=1e-20, max_iter=3000)
    assert info.converged and info.residual < 1e-19 and not info.negative_curvature
    assert info.energy.item() == pytest.approx(arap_energy(verts, faces, x, energy=energy).item(), rel=1e-10)
    assert torch.equal(x[handles], pos)
    # The gradient of the energy, computed without the solver's operators, vanishes off the handles.
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(arap_energy(verts, faces, x, energy=energy), x)
    gradient[handles] = 0
    assert gradient.abs().max() < 1e-8
    again, same = arap_deform(verts, faces, handles, pos, energy=energy, method="local_global", init=x, max_iter=1)
    torch.testing.assert_close(again, x.detach(), rtol=0, atol=1e-8)
    assert same.evaluations == 1


def test_lbfgs_needs_a_third_of_the_evaluations_of_local_global_and_goes_further() -> None:
    verts, faces, handles, pos = posed_body()
    slow = arap_deform(verts, faces, handles, pos, method="local_global", max_iter=50, tol=0.0)[1]
    fast = arap_deform(verts, faces, handles, pos, max_iter=17)[1]
    assert fast.evaluations <= 17 and fast.energy < slow.energy
    best = arap_deform(verts, faces, handles, pos, tol=1e-12, max_iter=2000)[1]
    near = arap_deform(verts, faces, handles, pos, max_iter=50)[1]
    assert near.energy < 1.004 * best.energy < slow.energy


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("iterations", [1, 10])
def test_local_global_equals_libigl(energy: str, iterations: int) -> None:
    if energy == "spokes":
        pytest.skip("libigl does not clamp")
    kinds = {"spokes_unclamped": "SPOKES", "spokes_and_rims": "SPOKES_AND_RIMS", "elements": "ELEMENTS"}
    verts, faces = ellipsoid(3, 0.005)
    handles = torch.arange(0, len(verts), 12)
    pos = verts[handles] * torch.tensor([1.2, 0.9, 1.0]) + 0.02 * randn(len(handles), 3)
    data = igl.ARAPData()
    data.energy = getattr(igl.ARAPEnergyType, f"ARAP_ENERGY_TYPE_{kinds[energy]}")
    data.max_iter = iterations
    igl.arap_precomputation(verts.numpy(), faces.numpy(), 3, handles.numpy().astype(np.int32), data)
    expected = igl.arap_solve(pos.numpy(), data, verts.numpy())
    options: dict[str, Any] = {"method": "local_global", "max_iter": iterations, "tol": 0.0, "init": verts}
    got, _ = arap_deform(verts, faces, handles, pos, energy=energy, **options)
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-3)  # libigl computes its rotations in float32
    assert np.median(np.abs(got.numpy() - expected)) < 1e-5


def test_preset_equals_open3d() -> None:
    open3d = pytest.importorskip("open3d")
    verts, faces, handles, pos = posed_body(share=10)
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(verts.numpy()), open3d.utility.Vector3iVector(faces.int().numpy())
    )
    chosen = open3d.utility.IntVector(handles.int().numpy())
    expected = mesh.deform_as_rigid_as_possible(chosen, open3d.utility.Vector3dVector(pos.numpy()), 50).vertices
    got, info = arap_deform(verts, faces, handles, pos, **PRESETS["xdualnet"])
    np.testing.assert_allclose(got.numpy(), np.asarray(expected), atol=1e-10)
    assert info.evaluations == 50


def test_far_and_tiny_meshes() -> None:
    verts, faces = ellipsoid(2)
    handles = torch.arange(0, len(verts), 20)
    pos = verts[handles] * torch.tensor([1.5, 0.7, 1.2])
    expected, info = arap_deform(verts, faces, handles, pos, tol=1e-10)
    for scale, shift in ((1e-12, 0.0), (1e9, 0.0), (1.0, 1e6)):
        got, same = arap_deform(scale * verts + shift, faces, handles, scale * pos + shift, tol=1e-10)
        torch.testing.assert_close((got - shift) / scale, expected, rtol=0, atol=1e-5)
        assert same.energy.item() == pytest.approx(info.energy.item() * scale**2, rel=1e-6)


def test_float32_input_and_a_rest_pose() -> None:
    verts, faces, handles, _ = posed_body(share=10)
    x, info = arap_deform(verts.float(), faces, handles, verts[handles].float())
    assert x.dtype == torch.float32 and info.converged and info.evaluations <= 3
    torch.testing.assert_close(x, verts.float(), rtol=0, atol=1e-5)
    assert info.energy < 1e-10


def test_an_edge_of_three_faces_works() -> None:
    verts, faces = ellipsoid()
    fin = torch.cat([verts, torch.tensor([[2.0, 0.3, 0.1]])])
    faces = torch.cat([faces, torch.tensor([[int(faces[0, 0]), int(faces[0, 1]), len(verts)]])])
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    handles = torch.arange(0, len(verts), 6)
    x, info = arap_deform(fin, faces, handles, fin[handles] @ turn.T)
    assert info.converged
    torch.testing.assert_close(x, fin @ turn.T, rtol=0, atol=1e-4)


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("soft", [False, True])
def test_implicit_gradient(energy: str, soft: bool) -> None:
    verts, faces = ellipsoid()
    handles = torch.tensor([0, 3, 20])
    inputs = [verts, verts[handles] + 0.1 * randn(3, 3)]
    if soft:
        inputs += [verts + 0.05 * randn(*verts.shape, seed=2), 0.1 * randn(len(verts), seed=3).abs()]

    def run(v: torch.Tensor, p: torch.Tensor, *soft: torch.Tensor) -> torch.Tensor:
        extra = {"soft_targets": soft[0], "soft_weights": soft[1]} if soft else {}
        return arap_deform(v, faces, handles, p, energy=energy, **extra, **TIGHT)[0]

    leaves = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(run, leaves, eps=1e-5, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_rest_gradient_at_right_angles_and_beside_degenerate_faces() -> None:
    # A grid: the diagonals lie opposite right angles, where cotangents vanish but their derivatives do not.
    rows = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0)).double()
    verts = torch.cat([rows, 0.3 * (rows[:, :1] - 1.5) ** 2], 1)
    low = torch.tensor([i for i in range(11) if i % 4 < 3])
    faces = torch.cat([torch.stack([low, low + 4, low + 5], 1), torch.stack([low, low + 5, low + 1], 1)])
    faces = torch.cat([faces, torch.tensor([[0, 0, 1]])])
    handles = torch.tensor([0, 3, 12, 15])
    pos = verts[handles] + torch.tensor([0.0, 0, 0.5]) * torch.tensor([[1.0], [0], [0], [1]])

    def run(v: torch.Tensor) -> torch.Tensor:
        return arap_deform(v, faces, handles, pos, degenerate="ignore", **TIGHT)[0]

    assert torch.autograd.gradcheck(run, verts.requires_grad_(), eps=1e-5, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_energy_gradient_with_respect_to_the_rest_shape() -> None:
    verts, faces = ellipsoid(0)
    deformed = verts + 0.2 * randn(*verts.shape, seed=5)
    for energy in ENERGIES:
        leaves = (verts.clone().requires_grad_(), deformed.clone().requires_grad_())
        run = lambda v, x, energy=energy: arap_energy(v, faces, x, energy=energy)  # noqa: E731
        assert torch.autograd.gradcheck(run, leaves, fast_mode=True)
    (first,) = torch.autograd.grad(arap_energy(verts, faces, leaves[1]), leaves[1], create_graph=True)
    with pytest.raises(RuntimeError, match="does not require grad"):  # a second derivative would be wrong
        first.sum().backward()


def test_unrolled_and_implicit_gradients_meet_at_the_minimum_and_not_before() -> None:
    verts, faces = ellipsoid()
    handles = torch.arange(0, len(verts), 4)
    weight = randn(*verts.shape, seed=9)

    def gradient(**options: Any) -> torch.Tensor:
        pos = (verts[handles] + 0.1 * randn(len(handles), 3)).requires_grad_()
        x, _ = arap_deform(verts, faces, handles, pos, **options)
        return torch.autograd.grad((x * weight).sum(), pos)[0]

    exact = gradient(**TIGHT)
    unrolled = gradient(method="local_global", tol=0.0, grad="unroll", max_iter=400)
    torch.testing.assert_close(unrolled, exact, rtol=1e-4, atol=1e-5)
    error = (gradient(max_iter=2) - exact).norm() / exact.norm()
    assert error > 1e-2


@pytest.mark.parametrize("solver", ["auto", "dense"])
def test_preset_is_differentiated_as_it_ran(solver: str) -> None:
    """50 iterations of local-global are no minimum; asking for its gradient there is answered with a warning."""
    verts, faces = ellipsoid()
    handles, weight = torch.tensor([0, 20, 31]), randn(*verts.shape, seed=9)
    goal, direction = verts[handles] + 0.3 * randn(3, 3), randn(3, 3, seed=4)

    def loss(pos: torch.Tensor, **options: Any) -> torch.Tensor:
        preset = PRESETS["xdualnet"] | {"solver": solver, "max_iter": 5} | options
        return (arap_deform(verts, faces, handles, pos, **preset)[0] * weight).sum()

    pos = goal.clone().requires_grad_()
    along = (torch.autograd.grad(loss(pos), pos)[0] * direction).sum()
    difference = (loss(goal + 1e-5 * direction) - loss(goal - 1e-5 * direction)) / 2e-5
    assert along.item() == pytest.approx(difference.item(), rel=1e-5)
    with pytest.warns(UserWarning, match="exact at a minimum only, and the deformation ended at a residual above 1e-"):
        implicit = torch.autograd.grad(loss(pos, grad="implicit"), pos)[0]
    assert abs((implicit * direction).sum() - along) > 1e-3 * abs(along)


def test_unrolling_refuses_what_it_would_leave_out() -> None:
    verts, faces = ellipsoid()
    handles, weights = torch.tensor([0, 20, 31]), torch.ones(len(verts), dtype=verts.dtype)
    rest, options = verts.clone().requires_grad_(), {"method": "local_global", "grad": "unroll", "max_iter": 2}
    with pytest.raises(ValueError, match=r'no gradient for verts: detach\(\) them or take grad="implicit"'):
        arap_deform(rest, faces, handles, verts[handles], **options)
    soft = {"soft_targets": verts, "soft_weights": weights.requires_grad_()}
    with pytest.raises(ValueError, match="no gradient for soft_weights"):
        arap_deform(verts, faces, handles, verts[handles], **soft, **options)
    with pytest.raises(ValueError, match="no gradient for rest"):
        ARAPDeformer(grad="unroll")(rest, verts, faces)
    with torch.no_grad():
        assert ARAPDeformer(grad="unroll")(rest, verts, faces).isfinite().all()


def test_a_saddle_is_reported() -> None:
    # A strip turned over and pressed together stops at a state that a forward pass of one step cannot leave.
    verts, faces = ellipsoid()
    handles = torch.tensor([0, 3, 20, 31])
    pos = (-1.5 * verts[handles]).requires_grad_()
    x, info = arap_deform(verts, faces, handles, pos, max_iter=1)
    assert not info.converged and not info.negative_curvature
    with pytest.warns(UserWarning, match="negative curvature: the deformation is a saddle"):
        x.square().sum().backward()
    assert info.negative_curvature and pos.grad.isfinite().all()


# ---------------------------------------------------------------- soft constraints


def test_soft_targets_without_handles_against_a_dense_minimiser() -> None:
    verts, faces = ellipsoid(0)
    weights = torch.zeros(len(verts), dtype=torch.float64)
    weights[[0, 4, 7]] = torch.tensor([0.5, 2.0, 1.0], dtype=torch.float64)
    targets = verts + 0.3 * randn(*verts.shape)
    none = torch.zeros(0, dtype=torch.int64)
    soft: dict[str, Any] = {"soft_targets": targets, "soft_weights": weights}
    x, info = arap_deform(verts, faces, none, torch.zeros(0, 3), **soft, tol=1e-18, max_iter=2000)

    def total(y: torch.Tensor) -> torch.Tensor:
        return arap_energy(verts, faces, y) + (weights * (y - targets).square().sum(1)).sum()

    y = x.clone().requires_grad_()
    assert info.energy.item() == pytest.approx(total(y).item(), rel=1e-9)
    assert torch.autograd.grad(total(y), y)[0].abs().max() < 1e-7
    once = {"method": "local_global", "max_iter": 1, "init": x}
    again, _ = arap_deform(verts, faces, none, torch.zeros(0, 3), **soft, **once)
    torch.testing.assert_close(again, x, rtol=0, atol=1e-7)
    stopped = arap_deform(verts, faces, none, torch.zeros(0, 3), **soft, method="local_global", tol=1e-3)[1]
    assert stopped.converged and stopped.evaluations < 100


def test_heavy_soft_targets_are_handles() -> None:
    verts, faces = ellipsoid()
    handles = torch.tensor([0, 3, 20])
    pos = verts[handles] + 0.1 * randn(3, 3)
    weights, targets = torch.zeros(2, len(verts)), verts.expand(2, -1, -1).clone()
    weights[1, handles], targets[1, handles] = 1e7, pos
    own = torch.tensor([[0, 3, 20], [-1, -1, -1]])
    batch = verts.expand(2, -1, -1)
    x, _ = arap_deform(batch, faces, own, pos, soft_targets=targets, soft_weights=weights, tol=1e-14, max_iter=1000)
    torch.testing.assert_close(x[0], x[1], rtol=0, atol=1e-5)


# ---------------------------------------------------------------- parts, batches, solvers


def test_parts_serve_again() -> None:
    verts, faces = ellipsoid(2)
    topology = ARAPTopology(torch.cat([faces, torch.tensor([[-1, -1, -1]])]), len(verts))
    assert torch.equal(topology.faces, faces)
    assert ARAPTopology.cached(faces, len(verts)) is ARAPTopology.cached(faces.clone(), len(verts))
    assert ARAPTopology.cached(faces, len(verts)) is not ARAPTopology.cached(faces, len(verts), energy="elements")
    expected = -igl.cotmatrix(verts.numpy(), faces.numpy())
    for stretch in (1.0, 2.0):
        shape = verts * torch.tensor([stretch, 1.0, 1.0])
        rest = ARAPRest(topology, shape)
        expected = -igl.cotmatrix(shape.numpy(), faces.numpy())
        np.testing.assert_allclose(rest.laplacian.toarray(), expected.toarray(), atol=1e-12)
        for handles in (torch.tensor([0, 9]), torch.arange(5)):
            factor = ARAPFactor(rest, handles)
            right = randn(len(factor.free), 3).numpy()
            free = factor.free.numpy()
            np.testing.assert_allclose(factor.solve(right), np.linalg.solve(expected.toarray()[free][:, free], right))


@pytest.mark.parametrize("solver", ["qdldl", "cholespy", "pcg"])
def test_solvers_agree(solver: str) -> None:
    if solver != "pcg":
        pytest.importorskip(solver)
    verts, faces = ellipsoid(2)
    handles = torch.arange(0, len(verts), 20)
    pos = verts[handles] * torch.tensor([1.5, 0.7, 1.2])
    expected, _ = arap_deform(verts, faces, handles, pos, tol=1e-12)
    got, _ = arap_deform(verts, faces, handles, pos, tol=1e-12, solver=solver)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("solver", ["qdldl", "cholespy"])
def test_a_missing_solver_names_the_extra(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, solver, None)
    verts, faces = ellipsoid(0)
    with pytest.raises(ImportError, match=rf'solver="{solver}" needs .* "meshkit-torch\[solvers\]"'):
        arap_deform(verts, faces, torch.tensor([0]), verts[:1], solver=solver)


def test_batch_equals_the_loop_with_gradients() -> None:
    verts, faces = ellipsoid()
    batch = torch.stack([verts, verts * torch.tensor([1.0, 1.3, 0.9])]).requires_grad_()
    handles = torch.tensor([[0, 3, 20, -1], [5, 6, 30, 8]])
    pos = randn(2, 4, 3).mul(0.1).add(batch.detach()[torch.arange(2)[:, None], handles]).requires_grad_()
    x, info = arap_deform(batch, faces, handles, pos)
    whole = torch.autograd.grad(x.square().sum(), (batch, pos))
    for b in range(2):
        used = handles[b] >= 0
        own, one = arap_deform(batch[b], faces, handles[b][used], pos[b][used])
        torch.testing.assert_close(x[b], own)
        assert info.energy[b] == one.energy and info.evaluations[b] == one.evaluations
        alone = torch.autograd.grad(own.square().sum(), (batch, pos))
        torch.testing.assert_close(whole[0][b], alone[0][b])
        torch.testing.assert_close(whole[1][b], alone[1][b])


def test_deformer_is_implicit_and_follows_presets() -> None:
    verts, faces = ellipsoid(2)
    rest, target = verts.clone().requires_grad_(), (verts + 0.02 * randn(*verts.shape)).requires_grad_()
    module = ARAPDeformer(0.2, generator=torch.Generator().manual_seed(0))
    x = module(rest, target, faces)
    x.square().sum().backward()
    assert module.info is not None and module.info.converged
    assert rest.grad.abs().sum() > 0 and target.grad.abs().sum() > 0
    paper = ARAPDeformer(**(PRESETS["xdualnet"] | {"grad": "none"}))
    assert repr(paper) == repr(ARAPDeformer(energy="spokes", max_iter=50, grad="none"))
    assert "method='local_global', max_iter=50, tol=0.0" in repr(paper)
    assert "local_global" in repr(ARAPDeformer(grad="unroll"))


def test_set_up_stays_on_the_cpu_whatever_the_default_device() -> None:
    verts, faces = ellipsoid()
    handles, pos = torch.tensor([0, 3, 20]), verts[[0, 3, 20]].float() * 1.2
    rest, generator = verts.float().requires_grad_(), torch.Generator().manual_seed(0)
    module = ARAPDeformer(0.2, generator=generator)
    torch.set_default_device("meta")  # any tensor made there would be without data
    try:
        for options in ({}, {"method": "local_global", "grad": "unroll", "max_iter": 3}, {"method": "local_global"}):
            x, _ = arap_deform(rest.detach() if options.get("grad") else rest, faces, handles, pos, **options)
            assert x.device.type == "cpu" and x.isfinite().all()
        module(rest, rest.detach(), faces).sum().backward()
        assert arap_energy(rest, faces, x.detach()).isfinite()
    finally:
        torch.set_default_device(None)


def test_compiled_callers_step_around() -> None:
    verts, faces = ellipsoid()
    module = ARAPDeformer(0.2, generator=torch.Generator().manual_seed(0))
    handles = torch.tensor([0, 3, 20])
    compiled = torch.compile(lambda v, t: 2 * module(v, t, faces, handles=handles), backend="eager")
    expected = 2 * module(verts, verts * 1.1, faces, handles=handles)
    torch.testing.assert_close(compiled(verts, verts * 1.1), expected)


def test_factor_and_rest_check_their_own_input() -> None:
    verts, faces = ellipsoid(0)
    topology = ARAPTopology(faces, len(verts))
    with pytest.raises(ValueError, match=r"verts must be a floating \(12, 3\) tensor for this topology, got .*11, 3"):
        ARAPRest(topology, verts[1:])
    with pytest.raises(ValueError, match="verts holds NaN or infinity"):
        ARAPRest(topology, verts * torch.nan)
    rest = ARAPRest(topology, verts)
    with pytest.raises(ValueError, match=r"handles must lie in \[0, 12\), got a range of \[0, 12\]"):
        ARAPFactor(rest, torch.tensor([0, 12]))
    with pytest.raises(ValueError, match="the mesh has no handle"):
        ARAPFactor(rest, torch.zeros(0, dtype=torch.int64))


def test_memory_is_linear() -> None:
    verts, faces = ellipsoid(3)
    rest = ARAPRest(ARAPTopology(faces, len(verts)), verts)
    objective = MeshObjective(ARAPFactor(rest, torch.arange(0, len(verts), 9)), None, dtype=torch.float32)
    kept = [value for value in vars(objective).values() if isinstance(value, torch.Tensor)]
    assert sum(t.values().numel() if t.layout == torch.sparse_csr else t.numel() for t in kept) < 80 * len(verts)


def test_conjugate_gradients_end_at_nan():
    """A gradient of NaN from above is not worth thousands of products."""
    products = []
    right = torch.full((4, 3), torch.nan, dtype=torch.float64)
    options = {"dot": lambda a, b: (a * b).sum(), "tol": 1e-8, "max_iter": 100}
    solution, _ = conjugate_gradients(lambda x: products.append(x) or 2 * x, lambda x: x, right, **options)
    assert not products and solution.shape == right.shape
