"""The runs behind the paper's tables: which there are, and how the missing ones are trained."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _run import UserError


@dataclass(frozen=True)
class System:
    """A method of the tables: its title, its recipe, and the flags that it differs by."""

    title: str
    recipe: str
    flags: tuple[str, ...] = ()
    supervised: bool = False


SYSTEMS = {
    "npt": System("NPT", "npt", supervised=True),
    "corenet3d": System("3D-CoreNet", "corenet3d", supervised=True),
    "cycle": System("Baseline", "cycle_baseline"),
    "xdualnet": System("X-DualNet", "xdualnet"),
    "corenet3d_spadain": System("3D-CoreNet, SPAdaIN", "corenet3d", ("--norm", "spadain"), supervised=True),
    "xdualnet_no_arap": System("X-DualNet w/o ARAP", "xdualnet", ("--no-arap",)),
    "xdualnet_no_corr": System("X-DualNet w/o L_corr", "xdualnet", ("--no-corr",)),
}
COMPARED = ("npt", "corenet3d", "cycle", "xdualnet")
"""Systems of Table 1, on every kind of data. The others are ablations, on humans."""


@dataclass(frozen=True)
class Job:
    """One training run."""

    data: str
    system: str
    seed: int

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.data}-{self.system}-{self.seed}"


def jobs(data: tuple[str, ...], seeds: int) -> list[Job]:
    """All runs, the first seed of everything before the second of anything: a stop leaves the broadest tables."""
    systems = {kind: SYSTEMS if kind == "humans" else COMPARED for kind in data}
    return [Job(kind, system, seed) for seed in range(seeds) for kind in data for system in systems[kind]]


def command(job: Job, cfg: Any) -> list[str]:
    """The recipe's command line for a run, but for where it is kept: anybody can repeat a row of a table with it."""
    system = SYSTEMS[job.system]
    words = [f"recipes/{system.recipe}.py", "--preset", cfg.preset, "--data", job.data, "--seed", str(job.seed)]
    if cfg.minutes is None:
        words += ["--steps", str(cfg.pairs // cfg.batch)]
    else:
        words += ["--minutes", str(cfg.minutes)]
    words += ["--batch", str(cfg.batch), "--eval-pairs", "24", "--eval-every", "100000", *system.flags]
    return [*words, "--threads", str(cfg.threads)]


def budget(job: Job, cfg: Any) -> dict[str, Any]:
    """What a finished run must have been given to stand in these tables."""
    return {"preset": cfg.preset, "batch": cfg.batch, "seed": job.seed, "data": job.data} | (
        {"steps": cfg.pairs // cfg.batch} if cfg.minutes is None else {"minutes": cfg.minutes}
    )


def finished(job: Job, cfg: Any) -> bool:
    """Whether the run is there and complete.

    Raises:
        UserError: it is, but was trained with another budget.
    """
    folder = cfg.out / job.name
    if (folder / "config.json").exists():
        config = json.loads((folder / "config.json").read_text())
        other = {key: config.get(key) for key, value in budget(job, cfg).items() if config.get(key) != value}
        if other:
            raise UserError(f"{folder} was trained with {other}, not {budget(job, cfg)}: choose another --out")
    return (folder / "summary.json").exists()


def train_missing(wanted: list[Job], cfg: Any) -> Iterator[Job]:
    """Train what is not there, or not finished; yields every run that was."""
    for job in wanted:
        if finished(job, cfg):
            continue
        folder = cfg.out / job.name
        folder.mkdir(parents=True, exist_ok=True)
        share_pools(folder, cfg.out, job)
        environment = dict(os.environ) | ({"OMP_NUM_THREADS": str(cfg.threads)} if cfg.threads else {})
        words = [sys.executable, *command(job, cfg), "--out", str(cfg.out.resolve()), "--name", job.name, "--resume"]
        status = subprocess.run(words, cwd=Path(__file__).parents[1], env=environment, check=False).returncode
        if status == 130:
            raise KeyboardInterrupt
        if status:
            raise UserError(f"{' '.join(words[1:])} ended with status {status}; see above")
        yield job


def share_pools(folder: Path, out: Path, job: Job) -> None:
    """Let a run use the descriptors that another one with the same data and seed has computed."""
    for other in sorted(out.glob(f"{job.data}-*-{job.seed}")):
        for side in ("train", "test"):
            pool, here = other / f"pool_{side}.safetensors", folder / f"pool_{side}.safetensors"
            if pool.exists() and not here.exists():
                os.link(pool, here)
