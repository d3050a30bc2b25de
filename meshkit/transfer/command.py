"""The console script ``meshkit-transfer``: the pose of one mesh file for the body of another."""

import argparse
import difflib
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from meshkit.io import MeshFileError, atomic_write, save_mesh
from meshkit.models import pretrained_names
from meshkit.transfer._units import UNITS
from meshkit.transfer.output import save_page, save_picture
from meshkit.transfer.report import TransferResult
from meshkit.transfer.sequence import is_sequence, transfer_sequence
from meshkit.transfer.transfer import transfer_pose

__all__ = ["main"]

_FORMATS = (".obj", ".ply", ".off", ".stl", ".glb")
_ROWS = 6  # of the picture of a sequence


class _Parser(argparse.ArgumentParser):
    """Tells a mistake in one line, and names the option that was probably meant."""

    def error(self, message: str) -> NoReturn:
        known = [option for action in self._actions for option in action.option_strings if option.startswith("--")]
        for word in re.findall(r"--[\w-]+", message) if "unrecognized" in message else ():
            near = difflib.get_close_matches(word, known, n=1)
            message += f"; did you mean {near[0]}?" if near else ""
        self.exit(2, f"error: {message}; --help lists the options\n")

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Takes ``--pose-facing -y`` as well as ``--pose-facing=-y``: an axis is no option."""
        words: list[str] = []
        for word in sys.argv[1:] if args is None else args:
            if words and word in ("-x", "-y", "-z") and words[-1].endswith(("-up", "-facing")):
                words[-1] += f"={word}"
            else:
                words.append(word)
        return super().parse_known_args(words, namespace)


def parser() -> argparse.ArgumentParser:
    """What the command takes."""
    axes = ("+x", "-x", "+y", "-y", "+z", "-z")
    made = _Parser(
        prog="meshkit-transfer",
        description="Give the body of IDENTITY the pose of POSE: any two meshes (obj, ply, off, stl, glb). POSE may "
        "also be a folder of meshes, an .npz file with verts (T, V, 3) and faces (F, 3), or a .glb file of several "
        "meshes with equal faces: then every pose is transferred, in order.",
        epilog=f"Weights that come with this installation: {', '.join(pretrained_names()) or 'none'}.",
    )
    made.add_argument("identity", type=Path, help="mesh that gives the body")
    made.add_argument("pose", type=Path, help="mesh, or many, that give the pose")
    made.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("posed.obj"),
        help="file to write; for many poses posed_0000.obj and so on, or one .npz file (default: posed.obj)",
    )
    made.add_argument("--weights", default="auto", help="auto, a name, or the folder of a training run")
    made.add_argument("--refine", type=float, metavar="WEIGHT", help="weight of the network's result (default: 0.1)")
    made.add_argument("--no-refine", action="store_true", help="the network's result as it is")
    made.add_argument(
        "--frame", choices=("pose", "identity"), default="pose", help="axes, unit and place of the result"
    )
    for role in ("identity", "pose"):
        made.add_argument(f"--{role}-up", choices=axes, help="signed axis to the head (default: found)")
        made.add_argument(f"--{role}-facing", choices=axes, help="signed axis of the gaze (default: found)")
        made.add_argument(f"--{role}-unit", choices=tuple(UNITS), help="unit of the file (default: guessed)")
    made.add_argument("--device", default="cpu", help="cpu, cuda, ... (default: cpu)")
    made.add_argument("--no-picture", action="store_true", help="no .png beside the result")
    made.add_argument("--no-html", action="store_true", help="no .html page beside the result")
    made.add_argument("--quiet", action="store_true", help="print warnings only")
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; a user's error is one line and exit status 2."""
    args = parser().parse_args(arguments)
    try:
        run(args)
    except OSError as error:
        _fail(f"{error.filename or 'file'}: {error.strerror or error}")
    except (ValueError, ImportError) as error:
        _fail(str(error))
    except RuntimeError as error:  # of PyTorch: a device that is missing or has too little memory
        _fail(f"{str(error) or type(error).__name__} (on device {args.device})")


def _fail(message: str) -> None:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)


def run(args: argparse.Namespace) -> None:
    """Transfer, write and report. What costs nothing to find wrong is found first."""
    for path in (args.identity, args.pose):
        if not path.exists():
            raise MeshFileError(f"{path}: no such file")
    many = is_sequence(args.pose)
    suffix = args.out.suffix.lower()
    if suffix not in (*_FORMATS, *((".npz",) if many else ())):
        raise MeshFileError(f"{args.out}: the result is written as {', '.join(_FORMATS)}{' or .npz' if many else ''}")
    _check_inputs_are_safe(args, many)
    options: dict[str, Any] = {
        name: getattr(args, name) for name in ("weights", "frame", "device") if getattr(args, name) is not None
    }
    for role in ("identity", "pose"):
        options |= {f"{role}_{what}": getattr(args, f"{role}_{what}") for what in ("up", "facing", "unit")}
    options["refine"] = False if args.no_refine else True if args.refine is None else args.refine
    if many:
        shown = _write_sequence(transfer_sequence(args.identity, args.pose, **options), args)
    else:
        result = transfer_pose(args.identity, args.pose, **options)
        save_mesh(args.out, result.verts, result.faces)
        _tell(result, args, args.out, whole=True, said=set())
        shown = [result]
    if not args.no_picture:
        save_picture(args.out.with_suffix(".png"), shown)
    if not args.no_html:
        save_page(args.out.with_suffix(".html"), shown[-1])


def _check_inputs_are_safe(args: argparse.Namespace, many: bool) -> None:
    """Refuse to write over what is read. Of many results it is not known how many there will be."""
    out, inputs = args.out.resolve(), (args.identity.resolve(), args.pose.resolve())
    if many and out.parent == inputs[1]:
        raise ValueError(f"{args.out} lies among the poses and could overwrite them: choose an --out in another folder")
    numbered = re.compile(rf"{re.escape(out.stem)}_\d{{4,}}{re.escape(out.suffix)}")
    if out in inputs or (many and any(p.parent == out.parent and numbered.fullmatch(p.name) for p in inputs)):
        raise ValueError(f"{args.out} would overwrite an input: choose another --out")


def _write_sequence(results: Iterator[TransferResult], args: argparse.Namespace) -> list[TransferResult]:
    """Write every pose as it comes; the results that the picture shows."""
    as_archive = args.out.suffix.lower() == ".npz"
    frames, kept = [], []
    step, said = 1, set[str]()
    for number, result in enumerate(results):
        file = args.out.with_name(f"{args.out.stem}_{number:04d}{args.out.suffix}")
        if as_archive:
            frames.append(result.verts.numpy())
        else:
            save_mesh(file, result.verts, result.faces)
        _tell(result, args, None if as_archive else file, whole=number == 0, said=said)
        if number % step == 0:
            kept.append(result)
        if len(kept) > _ROWS:  # evenly spaced ones, however many there will be
            kept, step = kept[::2], 2 * step
    if as_archive:
        with atomic_write(args.out) as path:
            np.savez_compressed(path, verts=np.stack(frames), faces=kept[0].faces.cpu().numpy())
        if not args.quiet:
            print(f"{args.out}: {len(frames)} poses of {len(frames[0])} vertices")
    return kept


def _tell(result: TransferResult, args: argparse.Namespace, file: Path | None, *, whole: bool, said: set[str]) -> None:
    """Print the report, or of a later pose what has no headline ``said`` of an earlier one."""
    report = result.report
    news = [doubt for doubt in report.doubts if doubt.headline not in said]
    said.update(doubt.headline for doubt in news)
    if whole and not args.quiet:
        print(report)
    else:
        for doubt in news:
            print(f"unusual: {report.blamed(doubt)}: {doubt.text}", file=sys.stderr if args.quiet else sys.stdout)
    if file is not None and not args.quiet:
        print(f"{file}: {len(result.verts)} vertices")
