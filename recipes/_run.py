"""Plumbing that recipes share: the run's folder, checkpoints, log, thread count and precision. No numerics."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import signal
import sys
import time
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from meshkit.io import atomic_write


class UserError(Exception):
    """Something the user can put right; shown without a traceback."""


def guard(main: Any, *arguments: Any) -> None:
    """Run ``main``; show a user's error as one line and exit with status 2."""
    try:
        main(*arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except OSError as error:
        print(f"error: {error.filename or 'file'}: {error.strerror or error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(
            "\ninterrupted; --resume goes on from the last checkpoint, or begins again if there is none",
            file=sys.stderr,
        )
        raise SystemExit(130) from None


class Run:
    """The folder of a run: ``config.json``, ``state.pt``, ``model.safetensors``, ``model.json``, ``log.jsonl``.

    ``state.pt`` and ``config.json`` are what a resumed run needs. Every file but the log is replaced whole; the log is
    cut back to the step that a resumed run starts from.
    """

    def __init__(self, folder: Path, *, resume: bool) -> None:
        self.folder = folder
        self.log_file = folder / "log.jsonl"
        if (folder / "state.pt").exists() and not resume:
            raise UserError(f"{folder} holds a run already: go on with --resume, or choose another --name")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(folder / "machine.json") as path:
                path.write_text(json.dumps(machine(), indent=2))
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}. Choose another folder with --out") from None

    def path(self, name: str) -> Path:
        return self.folder / name

    def save_json(self, name: str, value: Any) -> None:
        with atomic_write(self.folder / name) as path:
            path.write_text(json.dumps(value, indent=2) + "\n")

    def load_json(self, name: str) -> Any:
        path = self.folder / name
        try:
            return json.loads(path.read_text()) if path.exists() else None
        except ValueError:
            raise UserError(f"{path} is damaged: delete {self.folder} or choose another --name") from None

    def save_tensors(self, name: str, tensors: dict[str, Tensor], made_from: str = "") -> None:
        with atomic_write(self.folder / name) as path:
            values = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
            save_file(values, path, metadata={"made_from": made_from})

    def load_tensors(self, name: str, made_from: str = "") -> dict[str, Tensor] | None:
        """The tensors saved under ``name``, or ``None`` if there are none made from the same things."""
        path = self.folder / name
        if not path.exists():
            return None
        try:
            with safe_open(path, framework="pt") as file:
                if (file.metadata() or {}).get("made_from") != made_from:
                    return None
            return load_file(path)
        except Exception:
            raise UserError(f"{path} is damaged: delete it and start again") from None

    def save_state(self, model: nn.Module, optimizer: torch.optim.Optimizer, step: int, extra: dict[str, Any]) -> None:
        state = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "step": step, **extra}
        with atomic_write(self.folder / "state.pt") as path:
            torch.save(state, path)
        self.save_tensors("model.safetensors", model.state_dict())

    def load_state(self) -> dict[str, Any] | None:
        path = self.folder / "state.pt"
        if not path.exists():
            return None
        try:
            state = dict(torch.load(path, map_location="cpu", weights_only=True))
            return {key: state[key] for key in ("model", "optimizer", "step", "seconds", "waiting")}
        except Exception:
            raise UserError(
                f"{path} is not a readable checkpoint: delete {self.folder} or choose another --name"
            ) from None

    def log(self, **values: Any) -> None:
        with self.log_file.open("a") as stream:
            stream.write(json.dumps(values) + "\n")

    def read_log(self) -> list[dict[str, Any]]:
        """All complete lines; a line cut off by a kill is left out."""
        records = []
        if self.log_file.exists():
            for line in self.log_file.read_text().splitlines():
                try:
                    records.append(json.loads(line))
                except ValueError:
                    continue
        return records

    def cut_log(self, step: int) -> None:
        """Forget what was logged after ``step``: the resumed run logs it again."""
        records = [record for record in self.read_log() if record["step"] <= step]
        with atomic_write(self.log_file) as path:
            path.write_text("".join(json.dumps(record) + "\n" for record in records))


class Interruption:
    """Turns the first Ctrl-C into a wish to stop after the step at hand; a second one interrupts at once."""

    def __init__(self) -> None:
        self.wanted = False
        self._previous = signal.signal(signal.SIGINT, self._note)

    def _note(self, *_: Any) -> None:
        self.wanted = True
        signal.signal(signal.SIGINT, self._previous)


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
