"""Figures of the paper's tables: every system on the same fixed pairs of unseen identities in unseen poses."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from _data import Pairs
from _machine import machine
from _report import generate
from _run import UserError
from deformation_transfer import DeformationTransfer
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm import tqdm, trange

from meshkit._names import weights_folder
from meshkit.batching import center
from meshkit.data import MeshPool, PosePairs, load_humans, load_shipped
from meshkit.deform import deformation_transfer
from meshkit.io import atomic_write
from meshkit.metrics import chamfer_distance, correspondence_error, earth_movers_distance, edge_ratio, pmd
from meshkit.models import corenet3d, load_generator, load_pretrained, npt, xdualnet

METRICS = {"pmd": 1e3, "cd": 1e3, "emd": 1e2, "edges": 1e2, "match": 1e2}
"""Factors of what is printed: the first three as in the paper, edge lengths in percent, matches in hundredths."""


# Read once, for all rows and sheets.
pretrained = cache(load_pretrained)
shipped = cache(load_shipped)


@cache
def test_pairs(kind: str, vertices: int | None, count: int, out: Path) -> PosePairs:
    """The first ``count`` fixed test pairs, with their descriptors, which are computed once and kept in ``out``."""
    body, split = shipped(kind, vertices)
    listed = split.test_pairs[:count]
    file = out / f"descriptors-{kind}-{len(body.template)}-{count}.safetensors"
    if not file.exists():
        identity, pose = listed.view(-1, 2).unbind(1)
        pool = MeshPool.of(body, identity, pose, progress=True)
        with atomic_write(file) as path:
            save_file(pool.state_dict(), path)
    pool = MeshPool(**load_file(file))
    return PosePairs(body, split.test_identities, split.test_poses, pool=pool, listed=listed)


@torch.no_grad()
def measure(generator: nn.Module, pairs: Pairs, emd_pairs: int, title: str) -> dict[str, list[float]]:
    """Each metric of each pair; the earth mover's distance, which is dear, of the first ``emd_pairs``."""
    columns: dict[str, list[Tensor]] = {name: [] for name in METRICS}
    generator.eval()
    for i in tqdm(range(0, len(pairs), 4), desc=title, unit="batch", dynamic_ncols=True):
        batch = pairs[[(0, j) for j in range(i, min(i + 4, len(pairs)))]]
        result = generate(generator, batch, i)
        output, truth = center(result.vertices), batch.ground_truth
        columns["pmd"].append(pmd(output, truth))
        columns["cd"].append(chamfer_distance(output, truth))
        columns["edges"].append(edge_ratio(output, truth, batch.identity_faces))
        if i < emd_pairs:
            columns["emd"].append(earth_movers_distance(output[: emd_pairs - i], truth[: emd_pairs - i]))
        if result.plan is not None:
            columns["match"].append(correspondence_error(result.plan.argmax(), batch.pose, batch.correspondence))
    return {name: torch.cat(v).tolist() for name, v in columns.items() if v}


def kept(file: Path, make: Callable[[], Any]) -> Any:
    """What ``make`` gives, made once and kept as JSON."""
    if not file.exists():
        value = make()
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as path:
            path.write_text(json.dumps(value) + "\n", encoding="utf-8")
    return json.loads(file.read_text())


def fingerprint(name: str, out: Path) -> str:
    """A few digits that change with the weights of a run, or with shipped ones."""
    file = out / name / "model.safetensors"
    return digest(file if file.exists() else shipped_file(name))


def shipped_file(name: str) -> Path:
    """The file of shipped weights."""
    return Path(str(weights_folder() / f"{name}.safetensors"))


def digest(file: Path) -> str:
    """A few digits that change with a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:8] if file.exists() else "none"


@cache
def generator_of(name: str, out: Path) -> nn.Module:
    """The generator of a run, or of shipped weights.

    Raises:
        UserError: the run's weights cannot be read.
    """
    if (out / name).exists():
        try:
            return load_generator(out / name)[0]
        except ValueError as error:
            raise UserError(str(error)) from None
    return pretrained(name).generator


def copies(pairs: PosePairs, emd_pairs: int) -> dict[str, list[float]]:
    """What the unchanged identity mesh scores."""

    class Copy(nn.Module):
        takes_batches = True

        def forward(self, batch: Any, place: int) -> Any:
            return type("Result", (), {"vertices": batch.identity, "warped": None, "plan": None})

    return measure(Copy(), pairs, emd_pairs, "copy")


def transferred(pairs: PosePairs, emd_pairs: int) -> dict[str, list[float]]:
    """Deformation transfer that knows the correspondence, and an average body in the identity's pose."""
    return measure(DeformationTransfer(pairs, "template"), pairs, emd_pairs, "deformation transfer")


@torch.no_grad()
def seconds_per_transfer(repeats: int = 3) -> dict[str, Any]:
    """Median seconds of one transfer at 6890 vertices, as in the paper's Table 5, and the processor they are of."""
    body = load_humans(6890)
    verts = body(torch.tensor([3, 50, 50]), torch.tensor([10, 500, 10]))
    identity, pose, rest = center(verts)[:, None]
    baseline, supervised, matching = npt().eval(), corenet3d().eval(), xdualnet().eval()
    calls: dict[str, Callable[[], Any]] = {
        "DT": lambda: deformation_transfer(rest[0], pose[0], identity[0], faces=body.faces),
        "NPT": lambda: baseline(identity, pose),
        "3D-CoreNet": lambda: supervised(identity, pose),
        "X-DualNet": lambda: matching(identity, pose),
    }
    times = {}
    for name, call in calls.items():
        measured = []
        for _ in trange(repeats, desc=f"time of a transfer, {name}", dynamic_ncols=True):
            start = time.perf_counter()
            call()
            measured.append(time.perf_counter() - start)
        times[name] = round(sorted(measured)[repeats // 2], 3)
    return {"seconds": times, "threads": torch.get_num_threads(), "processor": machine()["processor"]}
