"""The runs behind the paper's tables: which there are, and how the missing ones are trained."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _run import UserError

from meshkit.io import atomic_write


@dataclass(frozen=True)
class System:
    """A method of the tables: its title, its recipe, and the flags that it differs by."""

    title: str
    recipe: str
    flags: tuple[str, ...] = ()


SYSTEMS = {
    "npt": System("NPT", "npt"),
    "corenet3d": System("3D-CoreNet", "corenet3d"),
    "cycle": System("Baseline", "cycle_baseline"),
    "xdualnet": System("X-DualNet", "xdualnet"),
    "corenet3d_spadain": System("3D-CoreNet, SPAdaIN", "corenet3d", ("--norm", "spadain")),
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
    """The recipe's command line for a run, but for the folder of runs: anybody can repeat a row of a table with it."""
    system = SYSTEMS[job.system]
    words = [f"recipes/{system.recipe}.py", "--preset", cfg.preset, "--data", job.data, "--seed", str(job.seed)]
    if cfg.minutes is None:
        words += ["--steps", str(cfg.pairs // cfg.batch)]
    else:
        words += ["--minutes", str(cfg.minutes), "--steps", "None"]
    words += ["--batch", str(cfg.batch), "--eval-pairs", "24", "--eval-every", "100000", *system.flags]
    return [*words, "--name", job.name, "--threads", str(cfg.threads)]


def budget(cfg: Any) -> dict[str, Any]:
    """What every run of these tables is given."""
    given = {"pairs": cfg.pairs} if cfg.minutes is None else {"minutes": cfg.minutes}
    return {"preset": cfg.preset, "batch": cfg.batch, **given}


def finished(job: Job, cfg: Any) -> bool:
    """Whether the run is there and complete.

    Raises:
        UserError: it is there, but was begun with another budget.
    """
    folder = cfg.out / job.name
    if (folder / "config.json").exists():
        file = folder / "budget.json"
        known = json.loads(file.read_text()) if file.exists() else None
        if known != budget(cfg):
            raise UserError(f"{folder} was begun with the budget {known}, not {budget(cfg)}: choose another --out")
    return (folder / "summary.json").exists()


def train_missing(wanted: list[Job], cfg: Any) -> Iterator[tuple[Job, str | None]]:
    """Train what is not there, or not finished; yields every run that was, and what went wrong with it, if anything."""
    for job in wanted:
        if finished(job, cfg):
            continue
        folder = cfg.out / job.name
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / "budget.json") as path:
            path.write_text(json.dumps(budget(cfg)) + "\n")
        share_pools(folder, cfg.out, job)
        words = [sys.executable, *command(job, cfg), "--out", str(cfg.out.resolve()), "--resume"]
        threads = {"OMP_NUM_THREADS": str(cfg.threads)} if cfg.threads else {}
        status = run_to_end(words, dict(os.environ) | threads)
        yield job, None if status == 0 else f"{' '.join(words[1:])} ended with status {status}"


def run_to_end(words: list[str], environment: dict[str, str]) -> int:
    """Status of a recipe that runs as a process of its own.

    Ctrl-C reaches the recipe as well, which saves its state; it is waited for. It does not outlive this process.

    Raises:
        KeyboardInterrupt: the recipe was interrupted.
    """
    child = subprocess.Popen(words, cwd=Path(__file__).parents[1], env=environment)
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    terminated = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        status = child.wait()
    finally:
        signal.signal(signal.SIGINT, previous)
        signal.signal(signal.SIGTERM, terminated)
        if child.poll() is None:
            child.terminate()
            child.wait()
    if status in (130, -signal.SIGINT):
        raise KeyboardInterrupt
    return status


def share_pools(folder: Path, out: Path, job: Job) -> None:
    """Let a run use the descriptors that another one with the same data and seed has computed."""
    for other in sorted(out.glob(f"{job.data}-*-{job.seed}")):
        for side in ("train", "test"):
            pool, here = other / f"pool_{side}.safetensors", folder / f"pool_{side}.safetensors"
            if pool.exists() and not here.exists():
                with atomic_write(here) as path:
                    shutil.copyfile(pool, path)
