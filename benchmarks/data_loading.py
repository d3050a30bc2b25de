"""How many pairs per second, and is the data ever what training waits for?

`--part released`: pairs per second from files (memory maps) and, at 1000 to 6890 vertices, from the rig, with and
without workers, against what the released loaders of NPT, 3D-CoreNet and X-DualNet do per pair: shuffle two meshes and
re-index their faces one by one. These parse three OBJ files per pair as well, with PyMesh, for which libigl's reader,
also C++, stands in; "parsed" is without that. Ground truth included. CPU time, but wall-clock time with workers.

`--part training`: one training step of the tiny preset (without the deformer) against drawing its batch, all in one
process. CPU milliseconds, medians.

    python benchmarks/data_loading.py --threads 1
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from meshkit.consistency import DualReconstruction
from meshkit.data import (
    MeshEntry,
    MeshPairs,
    MeshPool,
    MeshStore,
    PairSampler,
    PosePairs,
    human_split,
    load_humans,
    pair_loader,
)
from meshkit.io import save_mesh
from meshkit.models import xdualnet
from meshkit.topology import unique_edges


def median_ms(function: Callable[[], object], repeats: int) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(1e3 * (time.process_time() - start))
    return sorted(times)[len(times) // 2]


def subdivided(verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Every triangle split into four at the midpoints of its edges: 6890 vertices become 27,554."""
    edges = unique_edges(faces)
    code = {tuple(edge): len(verts) + k for k, edge in enumerate(edges.tolist())}
    a, b, c = faces.unbind(1)
    ab, bc, ca = (
        torch.tensor([code[min(i, j), max(i, j)] for i, j in zip(x.tolist(), y.tolist(), strict=True)])
        for x, y in ((a, b), (b, c), (c, a))
    )
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return torch.cat([verts, verts[edges].mean(1)]), torch.cat([torch.stack(t, 1) for t in corners])


def reindex_in_a_loop(faces: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Faces after the vertices were permuted, as the released loaders find them: by a dictionary, each in turn."""
    place = {}
    for new in range(len(order)):
        place[order[new]] = new
    out = []
    for face in range(len(faces)):
        out.append([place[faces[face][0]], place[faces[face][1]], place[faces[face][2]]])
    return np.array(out)


def reindex(faces: Tensor, order: Tensor) -> Tensor:
    """The same, as meshkit.data does it: invert the permutation by a scatter, then look the corners up in it."""
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))
    return rank.index_select(0, faces.flatten()).view(-1, 3)


def released_pair(meshes: list[np.ndarray], faces: np.ndarray) -> tuple[object, ...]:
    """One item of the released loaders, their three files already parsed."""
    identity, pose, truth = (torch.from_numpy((v - (v.min(0) + v.max(0)) / 2).astype(np.float32)) for v in meshes)
    num = len(identity)
    order_a = np.random.choice(num, size=num, replace=False)
    order_b = np.random.choice(num, size=num, replace=False)
    faces_a, faces_b = reindex_in_a_loop(faces, order_a), reindex_in_a_loop(faces, order_b)
    return identity[order_a], pose[order_b], truth[order_a], faces_a, faces_b


def parse(path: Path) -> np.ndarray:
    import igl

    verts, _ = igl.read_triangle_mesh(str(path))
    return verts


def per_second(dataset: PosePairs | MeshPairs, batch: int, workers: int, seconds: float) -> float:
    """Pairs per second out of a loader that is running."""
    loader = iter(pair_loader(dataset, PairSampler(len(dataset), batch, stop=1 << 30), workers=workers))
    for _ in range(2 * max(1, workers)):
        next(loader)
    clock = time.perf_counter if workers else time.process_time
    start, count = clock(), 0
    while clock() - start < seconds:
        next(loader)
        count += batch
    return count / (clock() - start)


def against_released(args: argparse.Namespace) -> None:
    split = human_split()
    print(
        f"{'vertices':>8} {'re-index, ms':>20} {'ratio':>6} {'released':>9} {'parsed':>7} {'files':>6} {'ratios':>11} "
        f"{'files, workers':>15} {'rig':>6} {'rig, workers':>13}   (pairs per second)"
    )
    for vertices in args.vertices:
        body = load_humans(min(vertices, 6890))
        with tempfile.TemporaryDirectory() as name:
            folder, entries = Path(name), []
            for who in range(4):
                for how in range(4):
                    verts, faces = body(torch.tensor([who]), torch.tensor([how]))[0], body.faces
                    if vertices == 27554:
                        verts, faces = subdivided(verts, faces)
                    entries.append(MeshEntry(folder / f"{who}_{how}.obj", who, how))
                    save_mesh(entries[-1].path, verts, faces)
            pairs = MeshPairs(MeshStore.build(entries, folder / "cache", progress=False))
            meshes = [pairs.store.verts(k).double().numpy() for k in range(3)]
            order = torch.randperm(len(verts))
            old_faces, old_order = faces.numpy().astype(np.int32), order.numpy()
            faces = faces.int()  # as a store keeps them
            assert np.array_equal(reindex_in_a_loop(old_faces, old_order), reindex(faces, order).numpy())
            slow = median_ms(lambda f=old_faces, o=old_order: reindex_in_a_loop(f, o), args.repeats)
            fast = median_ms(lambda f=faces, o=order: [reindex(f, o) for _ in range(20)], args.repeats) / 20
            old = 1e3 / median_ms(lambda m=meshes, f=old_faces: released_pair(m, f), args.repeats)
            paths = [entry.path for entry in entries[:3]]
            full = 1e3 / median_ms(
                lambda p=paths, f=old_faces: released_pair([parse(path) for path in p], f), args.repeats
            )
            new, more = (per_second(pairs, args.batch, w, args.seconds) for w in (0, args.workers))
            rig = ["-", "-"]
            if vertices <= 6890:
                drawn = PosePairs(body, split.train_identities, split.train_poses)
                rig = [f"{per_second(drawn, args.batch, w, args.seconds):.0f}" for w in (0, args.workers)]
        print(
            f"{vertices:>8} {slow:>11.2f} {fast:>8.3f} {slow / fast:>6.0f} {full:>9.1f} {old:>7.1f} {new:>6.0f} "
            f"{new / full:>5.0f} {new / old:>5.0f} {more:>15.0f} {rig[0]:>6} {rig[1]:>13}"
        )


def against_training(args: argparse.Namespace) -> None:
    split = human_split()
    who, how = split.train_identities, split.train_poses
    print(f"{'vertices':>8} {'from rig':>9} {'from pool':>9} {'step':>8} {'rig / step':>11} {'pool / step':>11}")
    for vertices in (v for v in args.vertices if v <= 6890):
        body = load_humans(vertices)
        pool = MeshPool.build(body, who, how, 8)
        sampler = PairSampler(6400, args.batch, stop=10_000)
        rig, pooled = (iter(pair_loader(PosePairs(body, who, how, pool=p), sampler)) for p in (None, pool))
        batch, system = next(pooled), DualReconstruction(xdualnet("tiny"), points=384)

        def step(batch=batch, system=system) -> None:
            result = system(
                batch.identity,
                batch.pose,
                identity_descriptors=batch.identity_descriptors,
                pose_descriptors=batch.pose_descriptors,
            )
            sum(x.square().mean() for x in (result.reconstruction_a, result.reconstruction_b)).backward()

        a, b, c = (median_ms(f, args.repeats) for f in (lambda it=rig: next(it), lambda it=pooled: next(it), step))
        print(f"{vertices:>8} {a:>9.1f} {b:>9.1f} {c:>8.0f} {a / c:>11.1%} {b / c:>11.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=["released", "training", "both"], default="both", help="which comparison")
    parser.add_argument("--batch", type=int, default=4, help="pairs per step")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls")
    parser.add_argument("--seconds", type=float, default=3, help="time to count pairs for")
    parser.add_argument("--workers", type=int, default=2, help="processes of the loader")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument("--vertices", type=int, nargs="+", default=[1000, 6890, 27554], help="resolutions")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.part != "training":
        against_released(args)
    if args.part != "released":
        against_training(args)


if __name__ == "__main__":
    main()
