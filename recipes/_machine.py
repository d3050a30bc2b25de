"""The machine a run is on: what it is, how it keeps memory, which precision is fast on it, which process this is."""

from __future__ import annotations

import ctypes
import os
import platform
import time
from pathlib import Path
from typing import Any, Literal

import torch


def rank() -> int:
    """Number of this process among those of the run; 0 writes files. Known before they are connected."""
    return int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0")))


def world_size(devices: int) -> int:
    """Number of processes of the run: what torchrun says, else one per device."""
    return int(os.environ.get("WORLD_SIZE", devices))


def machine() -> dict[str, Any]:
    """What the run's figures depend on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "platform": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def keep_freed_memory() -> None:
    """Let glibc keep large freed blocks for the next step instead of returning them to the system each time.

    A training step frees and takes the same buffers over and over; faulting them in anew costs 15-20 % of a step on
    the CPU. Does nothing where the C library is another one.
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    trim_threshold, mmap_threshold = -1, -3
    mallopt(mmap_threshold, 1 << 30)
    mallopt(trim_threshold, (1 << 31) - 1)


def pick_precision(device: torch.device) -> Literal["bf16-mixed", "32-true"]:
    """``"bf16-mixed"`` where a bfloat16 product measures at least 1.5 times faster than float32, else full precision.

    Processors without bfloat16 instructions emulate them at a twentieth of the speed, so the name of the type says
    nothing about its speed.
    """

    def seconds(dtype: torch.dtype) -> float:
        x = torch.ones(1024, 256, dtype=dtype, device=device)
        times = []
        for _ in range(5):
            start = time.perf_counter()
            float((x @ x[:256].mT).sum())
            times.append(time.perf_counter() - start)
        return min(times)

    return "bf16-mixed" if seconds(torch.float32) > 1.5 * seconds(torch.bfloat16) else "32-true"
