"""Threads of a run: no more than it gets cores for."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import torch
from tqdm import tqdm

TASKS = Path("/proc/self/task")


class Threads:
    """Takes away threads that must wait for a core.

    PyTorch's threads wait for one another at the end of each operation, and spin meanwhile. Where another program has a
    core, one spins for another that is not running: two threads on two cores, one of them taken, were over 50 times
    slower than one thread. Looks at :func:`waited`; nothing is taken away where the system does not count it.

    Args:
        stay: take none away: the number was asked for, or the steps are not computed by these threads.
        window: seconds to look back on, and a step at the least.
    """

    def __init__(self, *, stay: bool, window: float = 5.0) -> None:
        self.all = self.number = 1 if stay else torch.get_num_threads()
        self.window, self.began, self.before = window, time.perf_counter(), waited()

    def look(self) -> None:
        """To be called after each step."""
        now = time.perf_counter()
        if self.number == 1 or now - self.began < self.window:
            return
        total = waited()
        missing = math.ceil((total - self.before) / (now - self.began) - 0.25)  # cores, but for what passes
        self.began, self.before = now, total
        if missing > 0:
            had, self.number = self.number, max(1, self.number - missing)
            torch.set_num_threads(self.number)
            keep = f"--threads {self.all} keeps all"
            tqdm.write(
                f"other programs take cores: going on with {self.number} of {had} threads ({keep})", file=sys.stderr
            )


def waited() -> float:
    """Seconds that the threads of this process could have run but had no core, all together; 0 where none counts."""
    total = 0
    for task in TASKS.glob("*/schedstat"):
        try:
            total += int(task.read_text().split()[1])
        except OSError:  # the thread has ended
            continue
    return total / 1e9
