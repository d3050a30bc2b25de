"""As-rigid-as-possible deformation against libigl, and Open3D if installed: energy, CPU time and gradients.

    python benchmarks/arap.py                      # 6890 vertices
    python benchmarks/arap.py --vertices 13774     # the 3445-vertex body, subdivided once
    python benchmarks/arap.py --compiled           # with the rotations through torch.compile as well
    python benchmarks/arap.py --finite-differences # check the gradients by differences, too
    python benchmarks/arap.py --plot energy.png    # only the energy over the evaluations, as a picture

A shipped body takes another pose: 10 % or 1 % of its vertices, or six patches at its ends, are handles. All entries run
in one process on one thread and take turns; the smallest CPU time counts. The set-up of meshkit is that of a rest shape
and a set of handles; that of the connectivity, done once per mesh, is apart. Energies are spokes and rims, against the
minimum, found at tolerance 1e-12. The wrong gradient is the one that holds the rotations fixed.
"""

import argparse
import time
import warnings

import numpy as np
import torch

from meshkit.data import load_humans
from meshkit.deform import ARAPFactor, ARAPRest, ARAPTopology, arap_deform, arap_energy
from meshkit.deform.lbfgs import minimise
from meshkit.deform.local_global import alternate
from meshkit.deform.mesh_objective import MeshObjective


def body(vertices):
    """Rest shape, faces and posed shape, in float64."""
    rig = load_humans(3445 if vertices == 13774 else vertices)
    verts, faces = rig.shape(torch.tensor([0]))[0][0].double(), rig.faces
    posed = rig(torch.tensor([0]), torch.tensor([7]))[0].double()
    if vertices == 13774:
        import igl

        (verts, fine), (posed, _) = (igl.upsample(p.numpy(), faces.numpy()) for p in (verts, posed))
        verts, posed, faces = torch.from_numpy(verts), torch.from_numpy(posed), torch.from_numpy(fine).long()
    return verts, faces, posed


def pick(verts, kind):
    """Handles of a scenario."""
    count = len(verts)
    if kind != "6 patches":
        order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
        return order[: count // (10 if kind == "10 %" else 100)].sort().values
    ends = torch.cat([verts.argmin(0), verts.argmax(0)])
    near = (verts[None] - verts[ends][:, None]).square().sum(-1)
    return near.topk(count // 100, largest=False).indices.flatten().unique()


class Case:
    """One scenario, and the entries that solve it."""

    def __init__(self, verts, faces, posed, kind):
        self.verts, self.faces, self.kind = verts, faces, kind
        self.handles = pick(verts, kind)
        self.goal = posed[self.handles]
        self.topology = ARAPTopology(faces, len(verts))
        self.set_up()

    def set_up(self):
        self.rest = ARAPRest(self.topology, self.verts)
        self.factor = ARAPFactor(self.rest, self.handles)

    def solve(self, max_iter, tol, compiled=False):
        objective = MeshObjective(self.factor, None, dtype=torch.float32, compiled=compiled)
        objective.start_from_rest()
        x, info = minimise(objective, self.start(objective), max_iter=max_iter, tol=tol, refine=False)
        return x + self.rest.origin, int(info.evaluations)

    def start(self, objective):
        """Positions that suit the rotations of the rest shape."""
        goal = torch.zeros_like(self.rest.verts)
        goal[self.handles] = self.goal - self.rest.origin
        return alternate(objective, goal, None, max_iter=1, tol=0.0)[0]

    def igl_set_up(self):
        import igl

        self.data = igl.ARAPData()
        self.data.energy, self.data.max_iter = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_SPOKES_AND_RIMS, 50
        handles = self.handles.numpy().astype(np.int32)
        igl.arap_precomputation(self.verts.numpy(), self.faces.numpy(), 3, handles, self.data)

    def igl_solve(self):
        import igl

        return torch.from_numpy(igl.arap_solve(self.goal.numpy(), self.data, self.verts.numpy().copy()))

    def open3d_solve(self):
        import open3d

        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(self.verts.numpy()), open3d.utility.Vector3iVector(self.faces.int().numpy())
        )
        handles, goal = open3d.utility.IntVector(self.handles.int()), open3d.utility.Vector3dVector(self.goal.numpy())
        return mesh.deform_as_rigid_as_possible(handles, goal, 50)

    def energy(self, x):
        return arap_energy(self.verts, self.faces, x).item()


def timed(entries, rounds):
    """Smallest CPU milliseconds of every entry; they take turns."""
    best, results = dict.fromkeys(entries, float("inf")), {}
    for _ in range(rounds):
        for name, run in entries.items():
            start = time.process_time()
            results[name] = run()
            best[name] = min(best[name], 1e3 * (time.process_time() - start))
    return best, results


def forward(case, args):
    """Time to the energy that libigl reaches in 50 iterations, and the energies after 50 steps of each."""
    entries = {
        "libigl set-up": case.igl_set_up,
        "libigl 50": case.igl_solve,
        "connectivity": lambda: ARAPTopology(case.faces, len(case.verts)),
        "set-up": case.set_up,
        "solve 50": lambda: case.solve(50, 0.0),
    }
    if args.open3d:
        entries["Open3D 50"] = case.open3d_solve
    case.igl_set_up()
    target = case.energy(case.igl_solve())
    enough = next(n for n in range(5, 200) if case.energy(case.solve(n, 0.0)[0]) <= target * (1 + 1e-5))
    entries["solve"] = lambda: case.solve(enough, 0.0)
    if args.compiled:
        case.solve(3, 0.0, True)
        entries["solve compiled"] = lambda: case.solve(enough, 0.0, True)
    best, results = timed(entries, args.rounds)
    x, evaluations = results["solve"]
    _, info = arap_deform(case.verts, case.faces, case.handles, case.goal, tol=1e-12, max_iter=3000, grad="none")
    lowest = info.energy.item()
    exact = arap_deform(
        case.verts, case.faces, case.handles, case.goal, method="local_global", max_iter=50, tol=0.0, grad="none"
    )[1].energy.item()
    total = best["libigl set-up"] + best["libigl 50"]
    print(
        f"\n{case.kind} handles, {len(case.verts)} vertices; minimum {lowest:.6e} (converged: {bool(info.converged)})"
    )
    print("  " + "  ".join(f"{name} {value:.1f} ms" for name, value in best.items()))
    above = {
        "libigl 50": target,
        "local-global 50, from rest and in float64": exact,
        f"solve ({evaluations})": case.energy(x),
        "solve 50": case.energy(results["solve 50"][0]),
    }
    print("  above the minimum: " + ", ".join(f"{name} {value / lowest - 1:.2e}" for name, value in above.items()))
    print(
        f"  solve: {best['libigl 50'] / best['solve']:.1f}x libigl's"
        + (f", compiled {best['libigl 50'] / best['solve compiled']:.1f}x" if args.compiled else "")
        + f", energy {case.energy(x) / target - 1:+.1e} of libigl's; "
        f"set-up and solve: {total / (best['set-up'] + best['solve']):.1f}x libigl's"
        + (f", {best['Open3D 50'] / (best['set-up'] + best['solve']):.1f}x Open3D's" if args.open3d else "")
    )


def gradients(case, posed, args):
    """Cost and error of the implicit gradient, and the error of the one that holds the rotations fixed."""
    wave = posed + 0.02 * torch.sin(30 * case.verts)

    def run(tol, grad_tol):
        verts, goal = case.verts.clone().requires_grad_(), case.goal.clone().requires_grad_()
        x, info = arap_deform(verts, case.faces, case.handles, goal, tol=tol, grad_tol=grad_tol, max_iter=3000)
        return (x - wave).square().mean(), (goal, verts), info

    loss, inputs, info = run(1e-18, 1e-10)
    exact = torch.autograd.grad(loss, inputs)
    x = arap_deform(case.verts, case.faces, case.handles, case.goal, tol=1e-18, max_iter=3000, grad="none")[0]
    upstream = 2 * (x - wave) / x.numel()
    adjoint = torch.zeros_like(x)
    adjoint[case.factor.free] = torch.from_numpy(case.factor.solve(upstream[case.factor.free].numpy()))
    held = upstream - torch.from_numpy(case.rest.laplacian @ adjoint.numpy())
    rotations = case.rest.rotations(x - case.rest.origin).permute(2, 1, 0).contiguous()
    change = torch.zeros_like(rotations)
    edges, centred = case.rest.edges, x - case.rest.origin
    fixed = (
        held[case.handles],
        -edges.stationarity_gradient(case.rest.verts, centred, adjoint, rotations, change),
    )

    def errors(candidate):
        pairs = zip(("handles", "rest"), candidate, exact, strict=True)
        return ", ".join(f"{name} {((a - b).norm() / b.norm()).item():.1e}" for name, a, b in pairs)

    print(f"\nGradient, {case.kind} handles (evaluations for the reference: {int(info.evaluations)})")
    for tol in (1e-5, 1e-7):
        ahead, back, got = float("inf"), float("inf"), exact
        for _ in range(args.rounds):
            start = time.process_time()
            loss, inputs, info = run(tol, 1e-3)
            middle = time.process_time()
            got = torch.autograd.grad(loss, inputs)
            ahead, back = min(ahead, middle - start), min(back, time.process_time() - middle)
        print(
            f"  tol {tol:.0e}: forward {1e3 * ahead:.1f} ms ({int(info.evaluations)} evaluations), backward "
            f"{1e3 * back:.1f} ms = {back / ahead:.2f}x; error {errors(got)}"
        )
    print(f"  rotations held fixed: error {errors(fixed)}")
    if args.finite_differences:
        differences(case, wave, x, exact)


def differences(case, wave, x, exact):
    """Central differences along random directions."""
    generator = torch.Generator().manual_seed(1)
    size = 3e-6
    for name, gradient in zip(("handles", "rest"), exact, strict=True):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        values = []
        for sign in (1, -1):
            step = sign * size * direction
            verts = case.verts + step if name == "rest" else case.verts
            goal = case.goal + step if name == "handles" else case.goal
            options = {"tol": 1e-20, "max_iter": 3000, "init": x, "grad": "none"}
            moved, _ = arap_deform(verts, case.faces, case.handles, goal, **options)
            values.append((moved - wave).square().mean().item())
        slope, predicted = (values[0] - values[1]) / (2 * size), (gradient * direction).sum().item()
        print(f"  differences, {name}: {slope:.8e} against {predicted:.8e}, relative {abs(predicted / slope - 1):.1e}")


class Recorder(MeshObjective):
    """Remembers the lowest energy after every evaluation."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.energies = []

    def __call__(self, x):
        energy, gradient = super().__call__(x)
        self.energies.append(min([float(energy), *self.energies[-1:]]))
        return energy, gradient


def curves(case, count=100):
    """Energies over m after each L-BFGS evaluation, and after each local-global iteration."""
    fast = Recorder(case.factor, None, dtype=torch.float32)
    fast.start_from_rest()
    first = case.start(fast)
    minimise(fast, first, max_iter=count, tol=0.0, refine=False)
    slow = Recorder(case.factor, None, dtype=torch.float64)
    x = first
    for _ in range(count):
        _, gradient = slow(x)
        x = x - slow.solve(gradient)  # with the rotations held: one global step
    exact = Recorder(case.factor, None, dtype=torch.float64)
    minimise(exact, first, max_iter=3000, tol=1e-12, refine=False)
    lowest = exact.energies[-1]
    return fast.energies, slow.energies, lowest


def plot(verts, faces, posed, path):
    """Energy above the minimum over the number of local steps, one panel per scenario."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), sharey=True)
    for axis, kind in zip(axes, ("10 %", "1 %", "6 patches"), strict=True):
        fast, slow, lowest = curves(Case(verts, faces, posed, kind))
        for energies, label, colour in ((slow, "local-global", "#d1603d"), (fast, "L-BFGS", "#3b6ea8")):
            above = np.array(energies) / lowest - 1
            axis.semilogy(np.arange(1, len(above) + 1), above.clip(1e-7), label=label, color=colour)
        axis.axvline(50, color="0.8", linewidth=1, zorder=0)
        axis.set(title=f"{kind} handles" if "%" in kind else kind, xlabel="evaluations", xlim=(0, 100), ylim=(1e-6, 30))
    axes[0].set_ylabel("energy above the minimum")
    axes[0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=6890, choices=[1000, 2000, 3445, 6890, 13774])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--compiled", action="store_true")
    parser.add_argument("--finite-differences", action="store_true")
    parser.add_argument("--plot")
    args = parser.parse_args()
    try:
        import open3d  # noqa: F401

        args.open3d = True
    except ImportError:
        args.open3d = False
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message="negative curvature")
    verts, faces, posed = body(args.vertices)
    if args.plot:
        plot(verts, faces, posed, args.plot)
        return
    for kind in ("10 %", "1 %", "6 patches"):
        case = Case(verts, faces, posed, kind)
        forward(case, args)
        if kind != "6 patches":
            gradients(case, posed, args)


if __name__ == "__main__":
    main()
