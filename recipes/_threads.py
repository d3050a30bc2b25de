"""Threads of a run: no more than it gets cores for."""

from __future__ import annotations

import math
import os
import sys
import time
from pathlib import Path

import torch
from tqdm import tqdm

TASKS = Path("/proc/self/task")
STAT = Path("/proc/stat")


class Threads:
    """Takes away threads that must wait for a core, and gives them back once cores are idle.

    PyTorch's threads wait for one another at the end of each operation, and spin meanwhile. Where another program has a
    core, one spins for another that is not running: two threads on two cores, one of them taken, were 17 times slower
    than one thread. Looks at :func:`waited` and :func:`idle`; nothing changes where the system does not count these.

    Args:
        stay: take none away: the number was asked for, or the steps are not computed by these threads.
        window: seconds to look back on, and a step at the least.
        patience: seconds before threads are given back, twice as many each time: a core may be idle and not ours, as
            where a container is allowed less than it sees.
    """

    def __init__(self, *, stay: bool, window: float = 5.0, patience: float = 30.0) -> None:
        self.all = self.number = 1 if stay else torch.get_num_threads()
        self.window, self.patience = window, patience
        self.began = self.changed = time.perf_counter()
        self.waited, self.idle = waited(), idle()

    def look(self) -> None:
        """To be called after each step."""
        now = time.perf_counter()
        seconds = now - self.began
        if self.all == 1 or seconds < self.window:
            return
        before, self.began, self.waited, self.idle = (self.waited, self.idle), now, waited(), idle()
        passing = max(0.25, 0.015 * self.number)  # cores that something else has for a moment
        missing = math.ceil((self.waited - before[0]) / seconds - passing)
        spare = math.floor((self.idle - before[1]) / seconds + 0.25)
        had = self.number
        if missing > 0:
            self.number = max(1, had - missing)
            said = f"other programs take cores: going on with {self.number} of {had} threads"
            said += f" (--threads {self.all} keeps all)"
        elif spare > 0 and now - self.changed >= self.patience:
            self.number = min(self.all, had + spare)
            said = f"cores are idle again: going on with {self.number} of {self.all} threads"
        if self.number == had:
            return
        if self.number > had:
            self.patience *= 2
        self.changed = now
        torch.set_num_threads(self.number)
        tqdm.write(said, file=sys.stderr)


def waited() -> float:
    """Seconds that the threads of this process could have run but had no core, all together; 0 where none counts."""
    total = 0
    for task in TASKS.glob("*/schedstat"):
        try:
            total += int(task.read_text().split()[1])
        except OSError:  # the thread has ended
            continue
    return total / 1e9


def idle() -> float:
    """Seconds that the cores open to this process had nothing to do, all together; 0 where none counts."""
    if not STAT.exists() or not hasattr(os, "sched_getaffinity"):
        return 0.0
    cores = {f"cpu{core}" for core in os.sched_getaffinity(0)}
    rows = [line.split() for line in STAT.read_text().splitlines() if line.startswith("cpu")]
    # user nice system idle iowait: a core that waits for a disk is free too
    return sum(int(row[4]) + int(row[5]) for row in rows if row[0] in cores) / os.sysconf("SC_CLK_TCK")
