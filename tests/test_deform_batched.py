"""Whole batches solved at once where their tensors are, against meshes solved one by one on the CPU."""

from typing import Any

import pytest
import torch
from conftest import rand

from meshkit.data import load_humans
from meshkit.deform import ARAPDeformer, ARAPInfo, arap_deform, arap_energy, closest_rotation
from meshkit.deform.batched_factor import BatchedFactor
from meshkit.deform.batched_objective import BatchedObjective
from meshkit.deform.batched_rest import BatchedRest
from meshkit.deform.batched_rotation import BatchedRotation
from meshkit.deform.local_global import alternate
from meshkit.deform.whole_batch import WholeBatch
from meshkit.topology import connected_components, cotangent_laplacian

ENERGIES = ["spokes_and_rims", "spokes", "spokes_unclamped", "elements"]
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")),
]
ON_DEVICES = pytest.mark.parametrize("device", DEVICES)
UNROLL: dict[str, Any] = {"method": "local_global", "max_iter": 5, "tol": 0.0, "grad": "unroll"}
TIGHT: dict[str, Any] = {"tol": 1e-18, "max_iter": 2000, "grad_tol": 1e-8}


def grid(rows: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A bumpy square of rows x rows vertices; some of its angles are obtuse."""
    plane = torch.cartesian_prod(torch.arange(float(rows)), torch.arange(float(rows))).double()
    verts = torch.cat([plane, 0.4 * plane.sin().prod(1, keepdim=True)], 1) + 0.12 * rand(rows**2, 3, seed=seed)
    low = torch.tensor([i for i in range(rows * (rows - 1)) if i % rows < rows - 1])
    first = torch.stack([low, low + rows, low + rows + 1], 1)
    return verts, torch.cat([first, torch.stack([low, low + rows + 1, low + 1], 1)])


def ragged() -> tuple[torch.Tensor, ...]:
    """Three meshes with their own faces, masks, handles and targets; NaN in the padding."""
    verts, faces = torch.full((3, 40, 3), torch.nan).double(), torch.full((3, 60, 3), -1)
    handles, pos = torch.full((3, 8), -1), torch.full((3, 8, 3), torch.nan).double()
    mask = torch.zeros(3, 40, dtype=torch.bool)
    for b, rows in enumerate((5, 6, 4)):
        v, f = grid(rows, seed=b)
        order = torch.randperm(40, generator=torch.Generator().manual_seed(b))[: rows**2]
        verts[b, order], faces[b, : len(f)], mask[b, order] = v, order[f], True
        picked = torch.arange(0, rows**2, 5)
        handles[b, : len(picked)] = order[picked]
        pos[b, : len(picked)] = v[picked] + 0.3 * rand(len(picked), 3, seed=b)
    return verts, faces, handles, pos, mask


def both(device: str, inputs: dict[str, Any], **options: Any) -> list[tuple[torch.Tensor, ARAPInfo, list[Any]]]:
    """Results, reports and gradients, one by one on the CPU and at once on the device."""
    results = []
    for place, solver in (("cpu", "splu"), (device, "dense")):
        own = {k: v.to(place) if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
        for name, value in own.items():
            refused = options.get("grad") == "unroll" and name == "verts"
            if isinstance(value, torch.Tensor) and value.is_floating_point() and not refused:
                value.requires_grad_()
        x, info = arap_deform(**own, solver=solver, **options)
        assert x.device.type == place
        grads = []
        if x.requires_grad:
            x.mul(rand(*x.shape, seed=9).to(x)).sum().backward()
            grads = [v.grad.cpu() for v in own.values() if isinstance(v, torch.Tensor) and v.grad is not None]
        for value in own.values():
            if isinstance(value, torch.Tensor) and value.is_floating_point():
                value.requires_grad_(False).grad = None
        results.append((x.detach().cpu(), info, grads))
    return results


# ---------------------------------------------------------------- parts


def transposed(x: torch.Tensor) -> torch.Tensor:
    """The same values in another order of memory: columns side by side, meshes interleaved."""
    order = list(range(x.dim()))[::-1]
    return x.permute(order).contiguous().permute(order)


@pytest.mark.parametrize("solver", ["splu", "dense"])  # the latter is the way that CUDA tensors take
@pytest.mark.parametrize("batch", [0, 1, 2])
@pytest.mark.parametrize("options", [{}, UNROLL], ids=["implicit", "unroll"])
def test_strides_change_no_bit(options: dict[str, Any], batch: int, solver: str) -> None:
    verts, faces = grid(4, 0)
    verts = torch.cat([verts, rand(1, 3)])  # a vertex of no face, which the mask takes out
    verts = torch.stack([verts, 1.1 * verts])[:batch] if batch else verts
    handles, mask = torch.tensor([0, 3, 15]), torch.ones(verts.shape[:-1], dtype=torch.bool)
    mask[..., 16] = False
    weights = 0.1 * rand(*verts.shape[:-1], seed=4).square()
    found = []
    for order in (torch.clone, transposed):
        x, goal, soft, w = (
            order(t).requires_grad_() for t in (verts, verts[..., handles, :] + 0.1, verts + 0.2, weights)
        )
        if "grad" in options:
            x, w = x.detach(), w.detach()
        more: dict[str, Any] = {"init": order(verts * 1.01), "mask": order(mask), "solver": solver}
        bent, _ = arap_deform(x, faces, handles, goal, soft_targets=soft, soft_weights=w, **more, **options)
        wanted = [t for t in (x, goal, soft, w) if t.requires_grad]
        found.append([bent.detach(), *torch.autograd.grad(bent, wanted, order(rand(*bent.shape, seed=5)))])
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


@ON_DEVICES
def test_rotations_equal_the_closed_form(device: str) -> None:
    S = torch.cat([rand(200, 3, 3), 1e-25 * rand(9, 3, 3, seed=1), torch.eye(3).double()[None]]).to(device)
    S.requires_grad_()
    upstream = rand(210, 3, 3, seed=2).to(device)
    got, expected = BatchedRotation.apply(S), closest_rotation(S)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-10)
    grads = [torch.autograd.grad((R * upstream).sum(), S)[0] for R in (got, expected)]
    torch.testing.assert_close(*grads, rtol=1e-7, atol=1e-7)


@ON_DEVICES
def test_ill_determined_rotations_maximise_and_zero_is_the_identity(device: str) -> None:
    S = torch.stack([torch.zeros(3, 3), -torch.eye(3), torch.diag(torch.tensor([1.0, 1, -1])), torch.ones(3, 3)])
    S = S.double().to(device).requires_grad_()
    R = BatchedRotation.apply(S)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).to(R).expand(4, 3, 3))
    torch.testing.assert_close((R * S).sum((1, 2)).cpu(), torch.tensor([0.0, 1, 1, 3]).double())
    assert torch.equal(R[0].cpu(), torch.eye(3).double())
    assert torch.isfinite(torch.autograd.grad(R.square().sum() + R[:, 0, 1].sum(), S)[0]).all()


@ON_DEVICES
def test_operators_of_a_ragged_batch(device: str) -> None:
    verts, faces, _, _, mask = (value.to(device) for value in ragged())
    energy = BatchedRest(verts, faces, mask, "spokes_and_rims")
    labels = energy.components.view(3, 40).cpu()
    for b in range(3):
        own = connected_components(faces[b].cpu(), 40)
        assert torch.equal(labels[b][:, None] == labels[b], own[:, None] == own)
        rest = torch.where(mask[b, :, None], verts[b] - energy.origin[b], 0.0).cpu()
        torch.testing.assert_close(energy.verts.view(3, 40, 3)[b].cpu(), rest)
        dense = torch.zeros(40, 40).double()
        inside = energy.rows // 40 == b
        dense[(energy.rows % 40)[inside].cpu(), (energy.cols % 40)[inside].cpu()] = energy.values[inside].cpu()
        torch.testing.assert_close(dense, cotangent_laplacian(rest, faces[b].cpu()).to_dense())


@ON_DEVICES
@pytest.mark.parametrize("solver", ["dense", "pcg"])
def test_factor_solves(device: str, solver: str) -> None:
    verts, faces, _, _, mask = (value.to(device) for value in ragged())
    energy = BatchedRest(verts, faces, mask, "spokes_and_rims")
    free = mask & (torch.arange(40, device=device) % 6 > 0)
    soft = rand(3, 40, seed=3).abs().to(device) * mask
    right = torch.where(free[..., None], rand(3, 40, 3).to(device), 0.0)
    got = BatchedFactor(energy, free, soft, solver).solve(right.view(-1, 3)).view(3, 40, 3).cpu()
    for b in range(3):
        own = free[b].cpu()
        rest = energy.verts.view(3, 40, 3)[b].cpu()
        matrix = cotangent_laplacian(rest, faces[b].cpu()).to_dense() + torch.diag(soft[b].cpu())
        expected = torch.linalg.solve(matrix[own][:, own], right[b].cpu()[own])
        torch.testing.assert_close(got[b][own], expected, rtol=1e-8, atol=1e-8)
        assert not got[b][~own].any()


@ON_DEVICES
@pytest.mark.parametrize("energy", ENERGIES)
def test_energy_and_its_gradients(device: str, energy: str) -> None:
    verts, faces, _, _, mask = ragged()
    deformed = verts + 0.2 * rand(*verts.shape, seed=8)
    results = []
    for place, whole in (("cpu", False), (device, True)):
        leaves = [value.clone().to(place).requires_grad_() for value in (verts, deformed)]
        own = faces.to(place), mask.to(place)
        if whole:
            values = WholeBatch(leaves[0], *own, energy, "raise").energies(leaves[1])
            assert values is not None
        else:
            values = arap_energy(leaves[0], own[0], leaves[1], energy=energy, mask=own[1], degenerate="raise")
        (values * rand(3, seed=1).to(place)).sum().backward()
        results.append([value.cpu() for value in (values, *(leaf.grad for leaf in leaves))])
    for got, expected in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-8, atol=1e-9)
    assert WholeBatch(verts, faces, None, energy, "raise").energies(deformed) is None  # NaN in the padding


# ---------------------------------------------------------------- deformation


@ON_DEVICES
@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("init", [False, True])
def test_unrolled_batch_equals_one_by_one(device: str, energy: str, init: bool) -> None:
    verts, faces, handles, pos, mask = ragged()
    inputs = {"verts": verts, "faces": faces, "handles": handles, "handle_pos": pos, "mask": mask, "energy": energy}
    if init:
        inputs["init"] = verts + 0.1 * rand(*verts.shape, seed=4)
    (x, info, grads), (got, own, got_grads) = both(device, inputs, **UNROLL)
    torch.testing.assert_close(got, x, rtol=0, atol=1e-9)
    assert len(grads) == 1
    torch.testing.assert_close(got_grads[0].nan_to_num(), grads[0].nan_to_num(), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(own.energy.cpu(), info.energy, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(own.residual.cpu(), info.residual, rtol=1e-6, atol=1e-10)
    assert torch.equal(own.evaluations.cpu(), info.evaluations)


@ON_DEVICES
@pytest.mark.parametrize("energy", ["spokes_and_rims", "spokes"])
def test_minimum_and_its_gradients_equal_one_by_one(device: str, energy: str) -> None:
    verts, faces, handles, pos, mask = ragged()
    handles[1] = -1  # held by soft targets alone
    inputs = {"verts": verts, "faces": faces, "handles": handles, "handle_pos": pos, "mask": mask, "energy": energy}
    inputs["soft_targets"] = verts + 0.2 * rand(*verts.shape, seed=5)
    inputs["soft_weights"] = rand(3, 40, seed=6).abs()
    (x, info, grads), (got, own, got_grads) = both(device, inputs, **TIGHT)
    assert info.converged.all() and own.converged.all() and not own.negative_curvature.any()
    torch.testing.assert_close(got, x, rtol=0, atol=1e-7)
    assert len(grads) == len(got_grads) == 4
    for a, b in zip(got_grads, grads, strict=True):
        torch.testing.assert_close(a.nan_to_num(), b.nan_to_num(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(own.energy.cpu(), info.energy, rtol=1e-8, atol=1e-10)


@ON_DEVICES
def test_gradients_of_a_single_float32_mesh(device: str) -> None:
    verts, faces = grid(5, seed=0)
    inputs: dict[str, Any] = {"verts": verts.float(), "faces": faces, "handles": torch.tensor([0, 4, 22])}
    inputs["handle_pos"] = (verts[[0, 4, 22]] + 0.5 * rand(3, 3)).float()
    (x, _, grads), (got, own, got_grads) = both(device, inputs, tol=1e-10, max_iter=500, grad_tol=1e-6)
    assert got.dtype == torch.float32 and own.energy.shape == () and own.converged
    torch.testing.assert_close(got, x, rtol=0, atol=1e-3)  # one by one the rotations are float32
    for a, b in zip(got_grads, grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-2)


@ON_DEVICES
@pytest.mark.parametrize("method", ["local_global", "lbfgs"])
def test_meshes_stop_on_their_own(device: str, method: str) -> None:
    verts, faces, handles, pos, mask = ragged()
    pos[0] = verts[0, handles[0].clamp_min(0)]  # already at rest
    inputs = {"verts": verts, "faces": faces, "handles": handles, "handle_pos": pos, "mask": mask}
    (x, info, _), (got, own, _) = both(device, inputs, method=method, tol=1e-4, max_iter=100, grad="none")
    assert own.converged[:2].all() and own.evaluations[0] < own.evaluations[1] < 100
    torch.testing.assert_close(got[:2], x[:2], rtol=0, atol=5e-2)
    torch.testing.assert_close(own.energy[:2].cpu(), info.energy[:2], rtol=1e-3, atol=1e-5)
    if method == "local_global":
        assert torch.equal(own.evaluations.cpu()[1:], info.evaluations[1:])


@ON_DEVICES
def test_all_vertices_fixed(device: str) -> None:
    verts, faces = grid(4, seed=0)
    order = torch.randperm(16, generator=torch.Generator().manual_seed(0))
    inputs = {"verts": verts, "faces": faces, "handles": order, "handle_pos": rand(16, 3)}
    (x, info, grads), (got, own, got_grads) = both(device, inputs)
    torch.testing.assert_close(got, x)
    assert own.evaluations == info.evaluations == 0 and own.converged
    for a, b in zip(got_grads, grads, strict=True):
        torch.testing.assert_close(a, b)


@ON_DEVICES
def test_degenerate_faces_and_edges_of_three_faces_may_stay(device: str) -> None:
    verts, faces = grid(5, seed=0)
    fin = torch.cat([verts, verts[:1] + 1.0])
    faces = torch.cat([faces, torch.tensor([[int(faces[0, 0]), int(faces[0, 1]), 25], [3, 3, 4]])])
    inputs: dict[str, Any] = {"verts": fin, "faces": faces, "handles": torch.tensor([0, 4, 22])}
    inputs["handle_pos"] = fin[[0, 4, 22]] + 0.5 * rand(3, 3)
    (x, info, _), (got, own, _) = both(device, inputs, degenerate="ignore", **TIGHT)
    assert info.converged and own.converged
    torch.testing.assert_close(got, x, rtol=0, atol=1e-6)


@ON_DEVICES
def test_a_saddle_is_reported(device: str) -> None:
    verts, faces = (value.to(device) for value in grid(5, seed=0))
    handles = torch.tensor([0, 4, 20, 24], device=device)
    pos = (-1.5 * verts[handles]).requires_grad_()
    x, info = arap_deform(verts, faces, handles, pos, max_iter=1, solver="dense")
    assert not info.converged and not info.negative_curvature
    with pytest.warns(UserWarning, match="negative curvature: the deformation is a saddle"):
        x.square().sum().backward()
    assert info.negative_curvature and pos.grad is not None and pos.grad.isfinite().all()


@ON_DEVICES
@pytest.mark.parametrize("solver", ["splu", "dense"])
def test_a_saddle_is_reported_for_its_mesh(device: str, solver: str) -> None:
    verts, faces = (value.to(device) for value in grid(5, seed=0))
    handles = torch.tensor([0, 4, 20, 24], device=device)
    pos = torch.stack([1.01 * verts[handles], -1.5 * verts[handles]]).requires_grad_()
    x, info = arap_deform(verts.expand(2, -1, 3), faces, handles, pos, max_iter=1, solver=solver)
    assert info.negative_curvature.tolist() == [False, False]
    with pytest.warns(UserWarning, match="negative curvature: the deformation is a saddle"):
        x.square().sum().backward()
    assert info.negative_curvature.tolist() == [False, True]


@ON_DEVICES
def test_bad_input_is_described_by_the_other_path(device: str) -> None:
    verts, faces = (value.to(device) for value in grid(4, seed=0))
    good = {"verts": verts, "faces": faces, "handles": torch.tensor([0, 7]).to(device), "handle_pos": verts[[0, 7]]}
    loose = torch.cat([verts, verts[:1]])
    nan = verts.clone()
    nan[3] = torch.nan
    flat = verts.clone()
    flat[faces[0, 0]] = flat[faces[0, 1]]
    for change, message in (
        ({"verts": loose}, "1 vertices are in no face of positive area and are no handles"),
        (
            {"verts": torch.cat([verts, verts + 9]), "faces": torch.cat([faces, faces + 16])},
            "1 connected components have no handle",
        ),
        (
            {"verts": verts[faces].view(-1, 3), "faces": torch.arange(54).view(18, 3).to(device)},
            "the mesh is in 18 pieces, which are 1 once",
        ),
        ({"verts": nan}, "verts holds NaN"),
        ({"verts": flat}, "faces have an edge of length zero"),
        ({"verts": verts.long()}, "verts must be a floating"),
        ({"verts": verts.expand(0, -1, 3)}, r"verts \(0, 16, 3\) holds no vertex"),
        ({"verts": verts[None], "faces": faces.expand(2, -1, 3)}, "differ in batch size"),
        ({"faces": faces + 1}, r"face indices must lie in \[0, 16\)"),
        ({"handles": torch.tensor([0, 16])}, r"handles must lie in \[0, 16\)"),
        ({"handles": torch.tensor([7, 7])}, "1 handles repeat"),
        ({"handles": torch.tensor([0.0, 7])}, "handles must be an integer"),
        ({"handles": torch.zeros(0, dtype=torch.int64), "handle_pos": verts[:0]}, "1 of 1 meshes have no handle"),
        ({"handle_pos": nan[2:4]}, "handle_pos holds NaN"),
        ({"handle_pos": verts[:1]}, "handle_pos must have shape"),
        ({"init": verts[1:]}, "init must have the shape of verts"),
        ({"mask": torch.arange(16).to(device) != 3}, "faces use a vertex that mask declares padding"),
        ({"mask": torch.ones(15, dtype=torch.bool)}, "mask must be bool of shape"),
        ({"soft_targets": verts, "soft_weights": -torch.ones(16)}, "16 soft_weights are negative"),
        ({"soft_targets": verts, "soft_weights": torch.ones(15)}, "soft_weights must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            arap_deform(**good | change, solver="dense")  # type: ignore[arg-type]


# ---------------------------------------------------------------- deformer


@ON_DEVICES
@pytest.mark.parametrize("padded", [False, True])
def test_deformer_draws_the_same_handles(device: str, padded: bool) -> None:
    verts, faces, _, _, mask = ragged()
    if not padded:
        verts, faces = (value.expand(3, -1, 3) for value in grid(6, seed=1))
        faces = torch.cat([faces[:, :25], faces[:, 40:]], 1)  # in pieces, with isolated vertices
        mask = None
    target = (verts + 0.2 * rand(*verts.shape, seed=7)).to(device).requires_grad_()
    results = []
    for solver in ("splu", "dense"):
        module = ARAPDeformer(0.15, max_iter=6, grad="unroll", solver=solver)
        torch.manual_seed(3)
        x = module(verts.to(device), target, faces.to(device), mask=None if mask is None else mask.to(device))
        (gradient,) = torch.autograd.grad(x.square().sum(), target)
        results.append((x, gradient))
        assert module.info is not None
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-8)
    given = [
        ARAPDeformer(max_iter=3, solver=s)(
            verts.to(device),
            target,
            faces.to(device),
            mask=mask if mask is None else mask.to(device),
            handles=torch.arange(36),
        )
        for s in ("splu", "dense")
        if not padded
    ]
    for x in given[1:]:
        torch.testing.assert_close(x, given[0])


@ON_DEVICES
def test_deformer_chooses_the_path_of_the_device(device: str) -> None:
    rig = load_humans(1000)
    rest, faces = rig.shape(torch.tensor([0, 1]))[0].to(device), rig.faces.to(device)
    target = rig(torch.tensor([0, 1]), torch.tensor([7, 9])).to(device).requires_grad_()
    module = ARAPDeformer(0.1, max_iter=10, grad="unroll", generator=torch.Generator().manual_seed(0))
    x = module(rest, target, faces)
    expected = ARAPDeformer(0.1, max_iter=10, grad="unroll", generator=torch.Generator().manual_seed(0), solver="splu")(
        rest, target, faces
    )
    assert x.device.type == device and x.dtype == torch.float32
    torch.testing.assert_close(x, expected, rtol=0, atol=1e-4)
    assert module.info is not None and module.info.energy.device.type == device
    with pytest.raises(ValueError, match="target must have the shape of verts"):
        ARAPDeformer(solver="dense")(rest, target[:, 1:], faces)
    with pytest.raises(ValueError, match="handles must be an integer"):
        ARAPDeformer(solver="dense")(rest, target, faces, handles=torch.zeros(3))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_iterations_do_not_wait_for_the_device() -> None:
    rig = load_humans(1000)
    rest, faces = rig.shape(torch.arange(4))[0].cuda(), rig.faces.cuda().expand(4, -1, 3)
    target = rig(torch.arange(4), torch.arange(4)).cuda().requires_grad_()
    energy = BatchedRest(rest, faces, torch.ones(4, 1000, dtype=torch.bool, device="cuda"), "spokes_and_rims")
    fixed = (torch.arange(1000, device="cuda") % 10 == 0).expand(4, -1)
    objective = BatchedObjective(BatchedFactor(energy, ~fixed, None, "dense"), None)

    def run() -> torch.Tensor:
        goal = torch.where(fixed[..., None], target.double() - energy.origin, 0.0).flatten(0, 1)
        x, _ = alternate(objective, goal, None, max_iter=3, tol=0.0)
        return torch.autograd.grad(x.square().sum(), target)[0]

    run()  # constants are copied to the device once
    torch.cuda.set_sync_debug_mode("error")
    try:
        gradient = run()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert gradient.isfinite().all()
