"""Metrics on shipped bodies against the direct forms: CPU time and memory.

    python benchmarks/metrics.py                       # everything at 6890 vertices; SciPy's assignment takes minutes
    python benchmarks/metrics.py --verts 1000 --groups chamfer emd correspondence quality

Every entry runs in a process of its own, the entries of a group take turns over several rounds, and the smallest CPU
time counts (all threads, one by default). Memory is what the peak of the process adds to its size before the call.
Bodies: two identities in two poses, the vertices of the second in random order, as assignments of points in the same
order are easier. Peers: ``cdist`` is Chamfer from the N x M distances, ``scipy`` is ``linear_sum_assignment`` on the
N x M distances, ``pot`` is ``ot.emd2`` on them.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable

GROUPS = {
    "chamfer": ("meshkit", "cdist", "meshkit, gradient", "cdist, gradient"),
    "emd": ("meshkit", "scipy", "pot", "bounds"),
    "correspondence": ("euclidean", "geodesic near", "geodesic far", "heat near", "heat far"),
    "quality": ("pmd", "edge ratio", "self-intersection", "volume"),
}


def entry(group: str, name: str, verts: int) -> Callable[[], list[float]]:
    """The call to measure; it returns its values, so that entries can be compared."""
    import torch

    from meshkit import metrics
    from meshkit.batching import center
    from meshkit.data import load_humans

    body = load_humans(verts)
    first, second = center(body(torch.tensor([3, 50]), torch.tensor([40, 300])))[:, None]
    order = torch.randperm(verts, generator=torch.Generator().manual_seed(0))
    shuffled = second[:, order].contiguous()

    def chamfer() -> list[float]:
        leaf = first.clone().requires_grad_("gradient" in name)
        if name.startswith("meshkit"):
            value = metrics.chamfer_distance(leaf, shuffled)
        else:
            distances = torch.cdist(leaf, shuffled).square()
            value = distances.amin(2).mean(1) + distances.amin(1).mean(1)
        if leaf.requires_grad:
            value.sum().backward()
        return [value.item()]

    def emd() -> list[float]:
        if name == "meshkit":
            return [metrics.earth_movers_distance(first, shuffled).item()]
        if name == "bounds":
            return [bound.item() for bound in metrics.earth_movers_bounds(first, shuffled)]
        from scipy.spatial.distance import cdist

        cost = cdist(first[0].double().numpy(), shuffled[0].double().numpy())
        if name == "scipy":
            from scipy.optimize import linear_sum_assignment

            rows, columns = linear_sum_assignment(cost)
            return [float(cost[rows, columns].mean())]
        import numpy as np
        import ot

        weights = np.full(verts, 1 / verts)
        return [float(ot.emd2(weights, weights, cost, numItermax=10**8))]

    def correspondence() -> list[float]:
        # Near: each vertex is matched within about 5 cm. Far: to any vertex; a tenth of them, as it takes long.
        distance, _, how = name.partition(" ")
        truth = torch.arange(verts)[None]
        if how == "far":
            truth = truth[:, ::10]
            matches = order[None, : truth.shape[1]]
        else:
            noise = 0.03 * torch.randn(second.shape, generator=torch.Generator().manual_seed(1))
            matches = metrics_nearest(second, second + noise)
        faces = body.faces
        return [metrics.correspondence_error(matches, second, truth, faces=faces, distance=distance).item()]

    def metrics_nearest(points: torch.Tensor, query: torch.Tensor) -> torch.Tensor:
        from meshkit.neighbors import knn

        return knn(points, 1, query=query)[..., 0]

    def quality() -> list[float]:
        if name == "pmd":
            return [metrics.pmd(first, second).item()]
        if name == "self-intersection":
            return [metrics.self_intersection_rate(first, body.faces).item()]
        function = metrics.edge_ratio if name == "edge ratio" else metrics.volume_change
        return [function(first, second, body.faces).item()]

    return {"chamfer": chamfer, "emd": emd, "correspondence": correspondence, "quality": quality}[group]


def status(key: str) -> float:
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key))


def measure(group: str, name: str, verts: int, threads: int) -> dict:
    import torch

    torch.set_num_threads(threads)
    entry(group, name, 1000)()  # imports, and the code's own first-call costs
    call = entry(group, name, verts)
    before = status("VmRSS")
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    seconds: list[float] = []
    values: list[float] = []
    while sum(seconds) < 1 and len(seconds) < 10:
        start = time.process_time()
        values = call()
        seconds.append(time.process_time() - start)
    return {"seconds": min(seconds), "MB": status("VmHWM") - before, "values": values}


def child(group: str, name: str, args: argparse.Namespace) -> dict | None:
    command = [sys.executable, __file__, "--child", group, name]
    command += ["--verts", str(args.verts), "--threads", str(args.threads)]
    environment = os.environ | {key: str(args.threads) for key in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    if result.returncode:
        print(f"{group} {name}: {result.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    return json.loads(result.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--verts", type=int, default=6890, choices=(1000, 2000, 3445, 6890))
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=list(GROUPS))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=1, help="processes per entry")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(*args.child, args.verts, args.threads)))
        return
    print(f"{args.verts} vertices, {args.threads} thread(s), CPU time")
    print("| metric | entry | ms | MB | value |\n|---|---|---|---|---|")
    for group in args.groups:
        best: dict[str, dict] = {}
        for _ in range(args.rounds):
            for name in GROUPS[group]:
                record = child(group, name, args)
                if record is not None:
                    known = best.setdefault(name, record)
                    known["seconds"] = min(known["seconds"], record["seconds"])
                    known["MB"] = min(known["MB"], record["MB"])
        for name, record in best.items():
            values = ", ".join(f"{value:.6g}" for value in record["values"])
            print(f"| {group} | {name} | {1e3 * record['seconds']:.1f} | {record['MB']:.1f} | {values} |", flush=True)


if __name__ == "__main__":
    main()
