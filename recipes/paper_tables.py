"""The paper's tables and figure sheets in one command: trains what is missing, measures all systems alike.

    python recipes/paper_tables.py                              # humans and animals, 1000 pairs for each system
    python recipes/paper_tables.py --pairs 6400 --seeds 5       # a larger budget
    python recipes/paper_tables.py --no-train                   # tables of what is trained already

Every system gets the same number of training pairs (--pairs), or of minutes on this machine (--minutes), and the same
preset; all are measured on the same 400 pairs of unseen identities in unseen poses. It may be stopped at any time and
begun again: finished runs and measurements are kept under --out. Tables (tables.md, CSV files) and sheets are written
to --out, or to --to. The paper's Table 4, the layers of the networks, is what :func:`meshkit.models.model_card` prints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from _command_line import read
from _run import UserError, guard
from _tables_measure import (
    METRICS,
    copies,
    digest,
    fingerprint,
    generator_of,
    kept,
    measure,
    seconds_per_transfer,
    shipped_file,
    test_pairs,
    transferred,
)
from _tables_sheets import WEIGHTS, draw_sheets, noise_curve, topology_errors
from _tables_train import COMPARED, SYSTEMS, Job, finished, jobs, train_missing
from _tables_write import Row, write_tables

from meshkit.models import pretrained_names


@dataclass(frozen=True)
class Config:
    """What to compare, and how much to spend on it."""

    data: tuple[Literal["humans", "animals"], ...] = ("humans", "animals")
    """Kinds of bodies. The ablations are on humans, as the paper's."""
    preset: Literal["tiny", "small"] = "tiny"
    """Preset of every system. The tables are of meshes of 1000 and 1962 vertices; preset paper is for 6890."""
    pairs: int = 1000
    """Training pairs that each system sees. Paper: 200 epochs of 6400 (humans), 9000 (animals)."""
    minutes: float | None = None
    """Minutes of training on this machine for each system, instead of --pairs."""
    batch: int = 4
    """Pairs per step."""
    seeds: int = 3
    """Runs of each system."""
    eval_pairs: int = 400
    """Fixed test pairs."""
    emd_pairs: int = 100
    """Of these, pairs whose earth mover's distance is computed."""
    large_pairs: int = 12
    """Test pairs at 6890 vertices, for the humans' first seed; 0 for none."""
    train: bool = True
    """Train what is missing; --no-train makes tables of what there is."""
    sheets: Literal["all", "runs", "none"] = "all"
    """Figure sheets: all, with noise, triangulations and the time of a transfer; those of the runs alone; none."""
    out: Path = Path("runs/tables")
    """Folder of the runs and measurements."""
    to: Path | None = None
    """Folder of the tables and sheets, None for --out."""
    threads: int = 1
    """Threads of each run."""


def figures(job_name: str, kind: str, vertices: int | None, count: int, cfg: Config) -> dict[str, list[float]]:
    """Each metric of each test pair, of a run or of shipped weights."""

    def make() -> dict[str, list[float]]:
        pairs = test_pairs(kind, vertices, count, cfg.out)
        special: dict[str, Callable[..., dict[str, list[float]]]] = {"copy": copies, "dt": transferred}
        if job_name in special:
            return special[job_name](pairs, moved)
        return measure(generator_of(job_name, cfg.out), pairs, moved, job_name)

    weights = "" if job_name in ("copy", "dt") else f"-{fingerprint(job_name, cfg.out)}"
    moved = cfg.emd_pairs if vertices is None else 0  # a minute for each pair of 6890 vertices
    where = cfg.out / "figures" / f"{kind}-{job_name}{weights}-{vertices or 'least'}-{count}-{moved}.json"
    found: dict[str, list[float]] = kept(where, make)
    return found


def pmd_of(job: Job, cfg: Config) -> list[float]:
    """PMD of each test pair, of a run."""
    return figures(job.name, job.data, None, cfg.eval_pairs, cfg)["pmd"]


def row(title: str, names: list[str], kind: str, cfg: Config, vertices: int | None = None, paper: Any = ()) -> Row:
    """A row of a table: mean and spread over runs of the means over pairs."""
    count = cfg.eval_pairs if vertices is None else cfg.large_pairs
    means: dict[str, list[float]] = {name: [] for name in METRICS}
    for name in names:
        for metric, values in figures(name, kind, vertices, count, cfg).items():
            means[metric].append(METRICS[metric] * sum(values) / len(values))
    printed = dict(zip(METRICS, paper, strict=False))
    endings = [name.rpartition("-")[2] for name in names]  # the seed, of runs
    by_seed = {int(seed): pmd for seed, pmd in zip(endings, means["pmd"], strict=True) if seed.isdigit()}
    return Row(title, {m: summary(v) for m, v in means.items() if v}, len(names), printed, by_seed)


def summary(values: list[float]) -> tuple[float, float]:
    """Mean and sample standard deviation, NaN of a single value."""
    mean = sum(values) / len(values)
    square = sum((value - mean) ** 2 for value in values)
    return mean, math.sqrt(square / (len(values) - 1)) if len(values) > 1 else math.nan


PAPER = {  # PMD, CD, EMD as printed: SMPL and SMAL, Tables 1 to 3
    ("humans", "npt"): (2.77, 5.91, 7.88),
    ("humans", "corenet3d"): (0.49, 0.90, 3.61),
    ("humans", "cycle"): (2.23, 4.05, 7.05),
    ("humans", "xdualnet"): (1.67, 2.71, 5.96),
    ("animals", "npt"): (8.01, 17.76, 12.57),
    ("animals", "corenet3d"): (3.55, 6.49, 9.09),
    ("animals", "cycle"): (16.50, 37.54, 23.62),
    ("animals", "xdualnet"): (4.48, 9.05, 10.19),
    ("humans", "corenet3d_spadain"): (1.01, 2.13, 4.66),
    ("humans", "xdualnet_no_arap"): (1.98, 3.37, 6.60),
    ("humans", "xdualnet_no_corr"): (1.84, 3.20, 6.35),
}
PAPER_SECONDS = {"DT": 3.3352, "NPT": 0.0068, "3D-CoreNet": 0.1154, "X-DualNet": 0.1154}  # Table 5


def shipped(kind: str) -> list[str]:
    """Weights that come along, for this kind of bodies."""
    return [name for name in pretrained_names() if name.endswith(kind)]


def tables(cfg: Config, done: list[Job]) -> dict[str, list[Row]]:
    """The rows of all tables, of the runs that are there."""

    def trained(kind: str, system: str, vertices: int | None = None) -> list[Row]:
        names = [job.name for job in done if (job.data, job.system) == (kind, system)]
        names = names if vertices is None else names[:1]
        paper = PAPER[kind, system] if vertices is None else ()
        return [row(SYSTEMS[system].title, names, kind, cfg, vertices, paper)] if names else []

    found: dict[str, list[Row]] = {}
    for kind in cfg.data:
        rows = [r for system in COMPARED for r in trained(kind, system)]
        rows += [row(f"shipped weights {name}", [name], kind, cfg) for name in shipped(kind)]
        rows += [row("copy the identity", ["copy"], kind, cfg), row("deformation transfer", ["dt"], kind, cfg)]
        found[f"comparison-{kind}"] = rows
    if "humans" in cfg.data:
        for name, systems in (
            ("norms", ("corenet3d_spadain", "corenet3d")),
            ("ablation", ("xdualnet_no_arap", "xdualnet_no_corr", "xdualnet")),
        ):
            found[name] = [r for system in systems for r in trained("humans", system)]
        if cfg.large_pairs:
            found["humans-6890"] = [r for system in COMPARED for r in trained("humans", system, 6890)]
            found["humans-6890"] += [row(f"shipped weights {n}", [n], "humans", cfg, 6890) for n in shipped("humans")]
    return {name: rows for name, rows in found.items() if rows}


def measured_once(cfg: Config) -> dict[str, Any]:
    """The time of a transfer on this many threads; noise and triangulations, of the weights that are shipped now."""
    weights = "-".join(digest(shipped_file(name)) for name in WEIGHTS)
    return {
        name: kept(cfg.out / "figures" / f"{name}-{of}.json", make)
        for name, of, make in (
            ("seconds", torch.get_num_threads(), seconds_per_transfer),
            ("noise", weights, noise_curve),
            ("topologies", weights, topology_errors),
        )
    }


def check(cfg: Config) -> None:
    """Refuse values that make no sense before anything is trained."""
    for name in ("pairs", "batch", "seeds", "eval_pairs", "emd_pairs"):
        if getattr(cfg, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(cfg, name)}")
    for name in ("large_pairs", "threads"):
        if getattr(cfg, name) < 0:
            raise UserError(f"--{name.replace('_', '-')} cannot be negative, got {getattr(cfg, name)}")
    if max(cfg.eval_pairs, cfg.large_pairs) > 400:
        raise UserError("there are 400 test pairs: --eval-pairs and --large-pairs can be no more")
    if cfg.minutes is not None and cfg.minutes <= 0:
        raise UserError(f"--minutes must be positive, got {cfg.minutes}")
    if cfg.minutes is None and cfg.pairs % cfg.batch:
        raise UserError(f"--pairs {cfg.pairs} is no multiple of --batch {cfg.batch}")
    if len(set(cfg.data)) < len(cfg.data):
        raise UserError(f"--data names a kind twice: {' '.join(cfg.data)}")


def main() -> None:
    """Train, measure, write."""
    cfg = read(Config, __doc__)
    check(cfg)
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    to = cfg.to or cfg.out
    for folder in (cfg.out, to):
        folder.mkdir(parents=True, exist_ok=True)
    wanted = jobs(cfg.data, cfg.seeds)
    missing = [job for job in wanted if not finished(job, cfg)]
    print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are there", flush=True)
    failures = []
    if cfg.train:
        for number, (job, failure) in enumerate(train_missing(wanted, cfg), 1):
            failures += [] if failure is None else [failure]
            print(f"{job.name}: {failure or 'done'}, {len(missing) - number} to go", flush=True)
    done = [job for job in wanted if finished(job, cfg)]
    extra = measured_once(cfg) if cfg.sheets == "all" else {}
    found, drawn = tables(cfg, done), list[str]()
    if cfg.sheets != "none":
        drawn = draw_sheets(to, done, extra.get("noise"), lambda job: pmd_of(job, cfg), cfg)
    write_tables(to, found, extra, PAPER_SECONDS, cfg, done, drawn)
    print(f"tables and sheets: {to}")
    if failures:
        raise UserError("; ".join(failures) + ". The tables are without them; the same command tries again")


if __name__ == "__main__":
    guard(main, advice="the same command goes on from there")
