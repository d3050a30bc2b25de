"""Plumbing that recipes share: the run's folder, checkpoints and log; errors told in one line. No numerics."""

from __future__ import annotations

import importlib.util
import json
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from _machine import machine, rank
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from meshkit.io import MeshFileError, atomic_write


class UserError(Exception):
    """Something the user can put right; shown without a traceback."""


RESUME = "--resume goes on from the last checkpoint, or begins again if there is none"


def guard(main: Any, *arguments: Any, advice: str = RESUME) -> None:
    """Run ``main``; show a user's error as one line and exit with status 2, an interruption with ``advice`` and 130."""
    try:
        main(*arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except MeshFileError as error:  # of a file that changed under the run
        said = str(error).strip().splitlines()[-1]  # a worker's error comes with its traceback
        print(f"error: {said.removeprefix('meshkit.io.files.MeshFileError: ')}", file=sys.stderr)
        raise SystemExit(2) from None
    except OSError as error:
        print(f"error: {error.filename or 'file'}: {error.strerror or error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(f"\ninterrupted; {advice}", file=sys.stderr)
        raise SystemExit(130) from None


class Run:
    """The folder of a run: ``config.json``, ``state.pt``, ``model.safetensors``, ``model.json``, ``log.jsonl``.

    ``state.pt`` and ``config.json`` are what a resumed run needs. Every file but the log is replaced whole; the log is
    cut back to the step that a resumed run starts from. Of several processes all read and the first alone writes.
    """

    def __init__(self, folder: Path, *, resume: bool) -> None:
        self.folder, self.writes = folder, rank() == 0
        self._made = not folder.exists()
        self.log_file = folder / "log.jsonl"
        self.saved: int | None = None
        self._board: Any = None
        if (folder / "state.pt").exists() and not resume:
            raise UserError(f"{folder} holds a run already: go on with --resume, or choose another --name")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self.writes:
                with atomic_write(folder / "machine.json") as path:
                    path.write_text(json.dumps(machine(), indent=2))
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}. Choose another folder with --out") from None

    def remove_if_empty(self) -> None:
        """Take back a folder made by this run that holds nothing of worth: no checkpoint, log, pool, cache, figures."""
        worth = ("state.pt", "log.jsonl", "pool_*", "cache_*", "summary.json")
        kept = (path for name in worth for path in self.folder.glob(name) if path.is_dir() or path.stat().st_size)
        if self.writes and self._made and not any(kept):
            shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, name: str) -> Path:
        return self.folder / name

    @contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """Write a file whole or not at all; where that fails, for want of space or otherwise, the old one remains."""
        try:
            with atomic_write(self.folder / name) as path:
                yield path
        except (OSError, RuntimeError, SafetensorError) as error:
            raise self._unwritable(name, error) from None

    def _unwritable(self, name: str, error: Exception) -> UserError:
        # torch and safetensors report a full disk as an error of their own, without saying why the write failed.
        full = shutil.disk_usage(self.folder).free < 1 << 20
        reason = getattr(error, "strerror", None) or ("No space left on device" if full else str(error).split("\n")[0])
        said = f"cannot write {self.folder / name}: {reason}; {self.last_checkpoint()}"
        return UserError(f"{said}. Make room, then --resume")

    def last_checkpoint(self) -> str:
        usable = f"the last checkpoint, {self.folder / 'state.pt'} after step {self.saved}, is usable"
        return "there is no checkpoint yet" if self.saved is None else usable

    def save_json(self, name: str, value: Any) -> None:
        if self.writes:
            with self.replacing(name) as path:
                path.write_text(json.dumps(value, indent=2) + "\n")

    def load_json(self, name: str) -> Any:
        path = self.folder / name
        try:
            return json.loads(path.read_text()) if path.exists() else None
        except ValueError:
            raise UserError(f"{path} is damaged: delete {self.folder} or choose another --name") from None

    def save_tensors(self, name: str, tensors: dict[str, Tensor], made_from: str = "") -> None:
        if self.writes:
            values = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
            with self.replacing(name) as path:
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
        """A checkpoint. It holds no state of random numbers: all follow from the seed and the step."""
        if self.writes:
            state = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "step": step, **extra}
            with self.replacing("state.pt") as path:
                torch.save(state, path)
            self.saved = step
            self.save_tensors("model.safetensors", model.state_dict())

    def load_state(self) -> dict[str, Any] | None:
        path = self.folder / "state.pt"
        if not path.exists():
            return None
        try:
            state = dict(torch.load(path, map_location="cpu", weights_only=True))
            known = {key: state[key] for key in ("model", "optimizer", "step", "seconds", "waiting")}
        except Exception:
            advice = f"delete {self.folder} or choose another --name"
            raise UserError(f"{path} is not a readable checkpoint: {advice}") from None
        self.saved = known["step"]
        return known | {"pairs_per_step": state.get("pairs_per_step")}

    def log(self, record: dict[str, Any]) -> None:
        """A line of the log, and the same for TensorBoard where that is installed."""
        if not self.writes:
            return
        try:
            with self.log_file.open("a") as stream:
                stream.write(json.dumps(record) + "\n")
            if self._board is None and importlib.util.find_spec("tensorboard") is not None:
                from torch.utils.tensorboard import SummaryWriter

                # Points of an earlier life of the run that come after this step are forgotten.
                self._board = SummaryWriter(str(self.folder / "tensorboard"), purge_step=record["step"])
            if self._board is not None:
                for name, value in (record | record.get("eval", {})).items():
                    if isinstance(value, float):
                        self._board.add_scalar(name, value, record["step"])
        except OSError as error:
            raise self._unwritable(self.log_file.name, error) from None

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
        if self.writes:
            records = [record for record in self.read_log() if record["step"] <= step]
            with self.replacing(self.log_file.name) as path:
                path.write_text("".join(json.dumps(record) + "\n" for record in records))


class Interruption:
    """Turns the first Ctrl-C into a wish to stop after the step at hand; a second one interrupts at once.

    The processes of a run agree on it: one that was asked to stop stops all.
    """

    def __init__(self, fabric: Any) -> None:
        self._fabric, self._asked = fabric, False
        self._previous = signal.signal(signal.SIGINT, self._note)

    @property
    def wanted(self) -> bool:
        """To be read by all processes at the same time."""
        if self._fabric.world_size == 1:
            return self._asked
        asked = torch.tensor(float(self._asked), device=self._fabric.device)
        return bool(self._fabric.all_reduce(asked, reduce_op="sum") > 0)

    def over(self) -> None:
        """Ctrl-C interrupts at once again."""
        signal.signal(signal.SIGINT, self._previous)

    def _note(self, *_: Any) -> None:
        self._asked = True
        signal.signal(signal.SIGINT, self._previous)
