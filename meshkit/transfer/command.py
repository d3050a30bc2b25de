"""The console script ``meshkit-transfer``: the pose of one mesh file for the body of another."""

import argparse
import json
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshkit import _transfer_command
from meshkit.io import atomic_write, save_mesh
from meshkit.io.report import counted
from meshkit.transfer._doubts import following
from meshkit.transfer._open import Mesh
from meshkit.transfer.output import save_page, save_picture
from meshkit.transfer.report import TransferResult
from meshkit.transfer.sequence import is_sequence, read_sequence, transfer_sequence
from meshkit.transfer.transfer import transfer_pose

__all__ = ["main"]

_ROWS = 6  # of the picture of a sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; a user's error is told on the error stream, with exit status 2."""
    _transfer_command.main(arguments)


def run(args: argparse.Namespace, written: list[Path]) -> None:
    """Transfer, write and report.

    Args:
        args: what :func:`meshkit._transfer_command.check` found nothing wrong with.
        written: to which every result is added once it is complete.
    """
    if args.threads:
        torch.set_num_threads(args.threads)
    many = is_sequence(args.pose)
    _transfer_command.check_out(args.out, many)
    meshes = read_sequence(args.pose) if many else [args.pose]
    files = _result_files(args.out, meshes) if many else {str(args.pose): args.out}
    _check_inputs_are_safe(args, meshes, files)
    options: dict[str, Any] = {name: getattr(args, name) for name in ("weights", "frame", "device")}
    for role in ("identity", "pose"):
        options |= {f"{role}_{what}": getattr(args, f"{role}_{what}") for what in ("up", "facing", "unit")}
    options["refine"] = False if args.no_refine else True if args.refine is None else args.refine
    output = _Output(args, files, written)
    with _plain_warnings(), output:
        if many:
            if not args.quiet:
                print(f"{args.pose}: {counted(len(meshes), 'pose')}", flush=True)
            for result in transfer_sequence(args.identity, meshes, skip_bad=args.skip_bad, **options):
                output.add(result)
        else:
            output.add(transfer_pose(args.identity, args.pose, **options))
    if not args.no_picture:
        save_picture(args.out.with_suffix(".png"), output.shown, report=args.report)
    if not args.no_html:
        save_page(args.out.with_suffix(".html"), output.shown[-1])


def _result_files(out: Path, meshes: Sequence[Mesh]) -> dict[str, Path]:
    """The file of each result by the name of its pose.

    A pose from a file of its own gives its stem, and its ending too where two have the same stem; poses from one file
    are numbered.
    """
    sources = [mesh for mesh in meshes if isinstance(mesh, Path)]
    stems = Counter(source.stem.casefold() for source in sources)  # for file systems that know no case
    names = {str(s): s.stem if stems[s.stem.casefold()] == 1 else f"{s.stem}_{s.suffix[1:]}" for s in sources}
    if not sources:
        names = {f"pose {number}": f"{number:04d}" for number in range(len(meshes))}
    owners: dict[str, str] = {}
    for source, name in names.items():
        if (other := owners.setdefault(name.casefold(), source)) != source:
            raise ValueError(f"the results of {other} and {source} would have one name, {name}: rename one of them")
    return {source: out.with_name(f"{out.stem}_{name}{out.suffix}") for source, name in names.items()}


def _partial(out: Path) -> Path:
    """Where the finished poses go if a later one fails."""
    return out.with_name(f"{out.stem}_partial{out.suffix}")


def _check_inputs_are_safe(args: argparse.Namespace, meshes: Sequence[Mesh], files: dict[str, Path]) -> None:
    """Refuse to write over what is read."""
    if args.pose.is_dir() and args.out.resolve().parent == args.pose.resolve():
        raise ValueError(
            f"{args.out} lies among the poses: it could overwrite them, and the next run would take it for one; choose "
            "an --out in another folder"
        )
    inputs = {path.resolve() for path in (args.identity, args.pose, *meshes) if isinstance(path, Path)}
    archive = args.out.suffix.lower() == ".npz"
    for file in (args.out, _partial(args.out)) if archive else files.values():
        if file.resolve() in inputs:
            raise ValueError(f"{file} would overwrite an input: choose another --out")
    if args.report is not None and args.report.resolve() in inputs:
        raise ValueError(f"{args.report} would overwrite an input: choose another --report")


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings as lines of the error stream, without the place in the code that Python puts around them."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)
        yield


class _Output:
    """Writes and tells every result as it comes; what is written at the end is written after an error too."""

    def __init__(self, args: argparse.Namespace, files: dict[str, Path], written: list[Path]) -> None:
        self._args, self._files, self._written = args, files, written
        self._as_archive = args.out.suffix.lower() == ".npz"
        self._frames: list[Tensor] = []
        self._reports: list[dict[str, Any]] = []
        self._said: set[str] = set()
        self._count, self._step = 0, 1
        self.shown: list[TransferResult] = []

    def add(self, result: TransferResult) -> None:
        """One more result."""
        file = self._files[result.report.pose.name]
        if self._as_archive:
            self._frames.append(result.verts)
        else:
            save_mesh(file, result.verts, result.faces)
            self._written.append(file)
        self._reports.append({"file": str(self._args.out if self._as_archive else file)} | result.report.as_dict())
        self._tell(result, None if self._as_archive else file)
        if self._count % self._step == 0:
            self.shown.append(result)
        if len(self.shown) > _ROWS:  # evenly spaced ones, however many there will be
            self.shown, self._step = self.shown[::2], 2 * self._step
        self._count += 1

    def _tell(self, result: TransferResult, file: Path | None) -> None:
        """Print the report, or of a later pose what has no headline that was said of an earlier one."""
        report, quiet = result.report, self._args.quiet
        news = [doubt for doubt in report.doubts if doubt.headline not in self._said]
        self._said.update(doubt.headline for doubt in news)
        if self._count == 0 and not quiet:
            print(report)
        else:
            told = [f"{report.blamed(doubt)}: {doubt.text}" for doubt in news if not doubt.follows]
            if more := following(news):
                told.append(f"{report.pose.name}: {more}")
            for text in told:
                print(f"unusual: {text}", file=sys.stderr if quiet else sys.stdout)
        if file is not None and not quiet:
            print(f"{file}: {len(result.verts)} vertices", flush=True)

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        args = self._args
        if self._frames:
            out = args.out if kind is None else _partial(args.out)
            with atomic_write(out) as path:
                names = [Path(report["pose"]["name"]).name for report in self._reports]
                verts, faces = torch.stack(self._frames).numpy(), self.shown[0].faces.cpu().numpy()
                np.savez_compressed(path, verts=verts, faces=faces, names=np.array(names))
            self._written.append(out)
            if not args.quiet and kind is None:
                print(f"{out}: {len(self._frames)} poses of {len(self._frames[0])} vertices")
        if args.report is not None and self._reports:
            done = {report["pose"]["name"] for report in self._reports}
            missing = [] if kind is not None else [name for name in self._files if name not in done]
            left_out = [{"file": None, "pose": {"name": name}, "left_out": True} for name in missing]
            with atomic_write(args.report) as path:
                path.write_text(json.dumps([*self._reports, *left_out], indent=1) + "\n", encoding="utf-8")
            self._written.append(args.report)
