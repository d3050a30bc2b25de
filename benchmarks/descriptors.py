"""Which descriptors tell the vertices of a body apart, how fast, and how far is the fast method from the exact one?

Pairs of unseen bodies (identities and poses of the test split) are matched by nearest neighbour among standardised
descriptors; the same index is the true match. Columns:

- CPU ms per mesh, the minimum over interleaved repeats, from vertices and faces to descriptors;
- root-mean-square difference from the exact descriptors, in their standard deviations, and the lowest correlation of a
  channel over one body;
- distance from the match to the truth on the target's rest pose, in centimetres, mean over vertices and pairs; and
  the same to the truth or its mirror image, whichever is nearer: no intrinsic descriptor tells left from right.

    python benchmarks/descriptors.py --threads 1
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy.sparse import csgraph, csr_array
from torch import Tensor

from meshkit.data import RiggedModel, human_split, load_humans
from meshkit.descriptors import heat_kernel_signature, laplacian_eigenpairs, wave_kernel_signature
from meshkit.topology import mass_matrix, unique_edges

Descriptor = Callable[[Tensor, Tensor], Tensor]


def geodesic_quantiles(verts: Tensor, faces: Tensor, count: int = 16, landmarks: int = 0) -> Tensor:
    """Quantiles, over the area, of the distance along edges; from all vertices or from farthest-point landmarks."""
    mass = mass_matrix(verts, faces).numpy()
    edges = unique_edges(faces).numpy()
    lengths = np.linalg.norm(verts.numpy()[edges[:, 0]] - verts.numpy()[edges[:, 1]], axis=1)
    graph = csr_array((lengths, edges.T), shape=(len(verts), len(verts)))
    if landmarks:
        offset = np.square(verts.numpy() - mass @ verts.numpy() / mass.sum()).sum(1)
        rows = [csgraph.dijkstra(graph, directed=False, indices=offset.argmax())]
        while len(rows) < landmarks:
            rows.append(csgraph.dijkstra(graph, directed=False, indices=np.min(rows, 0).argmax()))
        distances = np.stack(rows, 1)
        mass = np.bincount(distances.argmin(1), mass, landmarks)
    else:
        distances = csgraph.dijkstra(graph, directed=False)
    order = distances.argsort(1)
    below = mass[order].cumsum(1) / mass.sum()
    index = np.stack([(below < (i + 0.5) / count).sum(1) for i in range(count)], 1).clip(max=distances.shape[1] - 1)
    quantiles = np.take_along_axis(np.take_along_axis(distances, order, 1), index, 1)
    return torch.from_numpy(quantiles / np.sqrt(mass.sum())).to(verts)


def log_heat(verts: Tensor, faces: Tensor, **options) -> Tensor:
    return heat_kernel_signature(verts, faces, **options).log()


def wide(verts: Tensor, faces: Tensor, **options) -> Tensor:
    return wave_kernel_signature(verts, faces, width=7.0, **options)


def narrow(verts: Tensor, faces: Tensor, **options) -> Tensor:
    return wave_kernel_signature(verts, faces, width=1.0, **options)


def both(first: Descriptor, second: Descriptor) -> Descriptor:
    return lambda verts, faces: torch.cat([first(verts, faces), second(verts, faces)], 1)


def fast(descriptor: Callable[..., Tensor], **options) -> Descriptor:
    return lambda verts, faces: descriptor(verts, faces, method="fast", **options)


# name -> descriptor, and the exact one it stands for
TABLE: dict[str, tuple[Descriptor, str | None]] = {
    "wave 16, width 7": (wide, None),
    "wave 16, width 7, fast": (fast(wide), "wave 16, width 7"),
    "wave 16, width 1": (narrow, None),
    "wave 16, width 1, fast": (fast(narrow), "wave 16, width 1"),
    "wave 16, width 1, fast, 48 pairs": (fast(narrow, num_eigenpairs=48), None),
    "wave 16, width 1, fast, 32 pairs": (fast(narrow, num_eigenpairs=32), None),
    "wave 64, width 7": (partial(wide, num_signatures=64), None),
    "log heat 16": (log_heat, None),
    "log heat 16, fast": (fast(log_heat), "log heat 16"),
    "log heat 16, fast, 32 pairs": (fast(log_heat, num_eigenpairs=32), None),
    "geodesic 16": (geodesic_quantiles, None),
    "geodesic 16, 32 landmarks": (lambda v, f: geodesic_quantiles(v, f, landmarks=32), None),
    "wave 16, width 1 + geodesic 16": (both(narrow, geodesic_quantiles), None),
    "wave 16, width 1 + log heat 16": (both(narrow, log_heat), None),
}


def milliseconds(calls: list[Callable[[], object]], repeats: int) -> list[float]:
    best = [float("inf")] * len(calls)
    for _ in range(repeats):
        for i, call in enumerate(calls):
            start = time.process_time()
            call()
            best[i] = min(best[i], 1e3 * (time.process_time() - start))
    return best


def match_errors(first: list[Tensor], second: list[Tensor], rests: list[Tensor], mirror: Tensor) -> tuple[float, float]:
    stacked = torch.cat(first + second)
    mean, std = stacked.mean(0), stacked.std(0)
    errors = []
    for x, y, rest in zip(first, second, rests, strict=True):
        match = torch.cdist((x - mean) / std, (y - mean) / std).argmin(1)
        straight, mirrored = ((rest[match] - goal).norm(dim=1) for goal in (rest, rest[mirror]))
        errors.append(torch.stack([straight.mean(), torch.minimum(straight, mirrored).mean()]))
    direct, either = (100 * torch.stack(errors).mean(0)).tolist()
    return direct, either


def deviations(values: list[Tensor], exact: list[Tensor]) -> tuple[float, float]:
    """Mean over bodies of the standardised difference, and the lowest correlation of a channel over a body."""
    differences, correlations = [], []
    for a, b in zip(values, exact, strict=True):
        x, y = ((z - z.mean(0)) / b.std(0) for z in (a, b))
        differences.append(((a - b) / b.std(0)).square().mean().sqrt())
        correlations.append(((x * y).sum(0) / (x.norm(dim=0) * y.norm(dim=0))).min())
    return torch.stack(differences).mean().item(), torch.stack(correlations).min().item()


def posed(body: RiggedModel, pairs: Tensor) -> list[Tensor]:
    with torch.no_grad():
        return list(body(pairs[:, 0], pairs[:, 1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=20, help="pairs of bodies matched")
    parser.add_argument("--repeats", type=int, default=15, help="timed rounds")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument(
        "--sizes", type=int, nargs="*", default=[1000, 2000, 3445, 6890], help="of the eigensolver table"
    )
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    body = load_humans(1000)
    pairs = human_split().test_pairs[: args.pairs]
    sources, targets = posed(body, pairs[:, :2]), posed(body, pairs[:, 2:])
    with torch.no_grad():
        rests = list(body(pairs[:, 2], torch.zeros(len(pairs), body.num_joints, 3)))
    mirror = torch.cdist(body.template * torch.tensor([-1.0, 1.0, 1.0]), body.template).argmin(1)
    times = milliseconds([partial(d, sources[0], body.faces) for d, _ in TABLE.values()], args.repeats)
    print(f"{'descriptor':<34} {'ms':>6} {'rms':>7} {'corr':>7} {'match cm':>9} {'or mirror':>10}")
    values: dict[str, list[Tensor]] = {}
    for (name, (descriptor, exact)), ms in zip(TABLE.items(), times, strict=True):
        values[name] = [descriptor(v, body.faces) for v in sources + targets]
        direct, either = match_errors(values[name][: len(sources)], values[name][len(sources) :], rests, mirror)
        rms, corr = "", ""
        if exact is not None:
            difference, lowest = deviations(values[name], values[exact])
            rms, corr = f"{difference:.4f}", f"{lowest:.4f}"
        print(f"{name:<34} {ms:>6.1f} {rms:>7} {corr:>7} {direct:>9.1f} {either:>10.1f}", flush=True)

    print(f"\n{'64 eigenpairs, vertices':<24} {'exact ms':>9} {'fast ms':>9} {'worst eigenvalue':>17}")
    for size in args.sizes:
        human = load_humans(size)
        verts = posed(human, pairs[:1])[0].double()
        solve = [partial(laplacian_eigenpairs, verts, human.faces, method=m) for m in ("exact", "fast")]
        exact_ms, fast_ms = milliseconds(solve, max(3, args.repeats // 3))
        exact_values, fast_values = (s()[0][1:] for s in solve)
        print(
            f"{size:<24} {exact_ms:>9.1f} {fast_ms:>9.1f} {(fast_values / exact_values - 1).max():>17.1%}", flush=True
        )


if __name__ == "__main__":
    main()
