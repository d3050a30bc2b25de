"""What ``meshkit-transfer`` does before PyTorch is imported: its options, and mistakes that cost nothing to find."""

import argparse
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from meshkit._names import did_you_mean, nearest, shipped_weights

__all__ = ["FORMATS", "UNITS", "check", "main", "parser"]

FORMATS = (".obj", ".ply", ".off", ".stl", ".glb")
UNITS = ("m", "cm", "mm", "in", "ft")
_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
_WRITTEN_OUT = {
    f"{power}met{end}": f"{short}m"
    for power, short in (("", ""), ("centi", "c"), ("milli", "m"))
    for end in ("re", "er")
}
_WRITTEN_OUT |= {"inch": "in", "inche": "in", "foot": "ft", "feet": "ft"}


class _Parser(argparse.ArgumentParser):
    """Tells a mistake in one line, and names the option that was probably meant."""

    def error(self, message: str) -> NoReturn:
        known = [option for option in self._option_string_actions if option.startswith("--")]
        for word in re.findall(r"--[\w-]+", message) if "unrecognized" in message else ():
            message += did_you_mean(word, known)
        self.exit(2, f"error: {message}; --help lists the options\n")

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Takes ``--pose-facing -y`` as well as ``--pose-facing=-y``: an axis is no option."""
        words: list[str] = []
        for word in sys.argv[1:] if args is None else args:
            if words and self._is_value(word) and self._takes_axis(words[-1]):
                words[-1] += f"={word}"
            else:
                words.append(word)
        return super().parse_known_args(words, namespace)

    def _is_value(self, word: str) -> bool:
        return re.match("-[^-]", word) is not None and word[:2] not in self._option_string_actions

    def _takes_axis(self, word: str) -> bool:
        """Whether a word is an option whose value is an axis, or the beginning of that option alone."""
        known = self._option_string_actions
        found = [word] if word in known else [option for option in known if option.startswith(word)]
        return len(found) == 1 and found[0].startswith("--") and found[0].endswith(("-up", "-facing"))

    def format_help(self) -> str:
        self.epilog = f"Weights that come with this installation: {', '.join(shipped_weights()) or 'none'}."
        return super().format_help()


def _one_of(names: Sequence[str], written_out: Mapping[str, str] | None = None) -> Callable[[str], str]:
    """A type of argparse's: one of the names. A mistake is told with the nearest of them, and all there are.

    Of units the nearest letters say nothing, km is no m: with ``written_out`` only what says the same is named.
    """

    def meant(word: str) -> str | None:
        if written_out is None:
            return nearest(word, names)
        plain = word.casefold()
        return plain if plain in names else written_out.get(plain.removesuffix("s"))

    def read(word: str) -> str:
        if word in names:
            return word
        near = meant(word)
        instead = "" if near is None else f": did you mean {near}?"
        raise argparse.ArgumentTypeError(f"takes {', '.join(names[:-1])} or {names[-1]}, got {word!r}{instead}")

    return read


def parser() -> argparse.ArgumentParser:
    """What the command takes."""
    made = _Parser(
        prog="meshkit-transfer",
        description="Give the body of IDENTITY the pose of POSE: any two meshes (obj, ply, off, stl, glb). POSE may "
        "also be a folder of meshes, an .npz file with verts (T, V, 3) and faces (F, 3), or a .glb file of several "
        "meshes with equal faces: then every pose is transferred, in order.",
    )
    made.add_argument("identity", type=Path, help="mesh that gives the body")
    made.add_argument("pose", type=Path, help="mesh, or many, that give the pose")
    made.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("posed.obj"),
        help="file to write (default: posed.obj); for a folder of poses posed_NAME.obj for each NAME.*, for many poses "
        "in one file posed_0000.obj and so on; or one .npz file",
    )
    made.add_argument("--weights", default="auto", help="auto, a name, or the folder of a training run")
    made.add_argument("--refine", type=float, metavar="WEIGHT", help="weight of the network's result (default: 0.1)")
    made.add_argument("--no-refine", action="store_true", help="the network's result as it is")
    frames = ("pose", "identity")
    made.add_argument(
        "--frame", type=_one_of(frames), choices=frames, default="pose", help="axes, unit and place of the result"
    )
    axis, unit = _one_of(_AXES), _one_of(UNITS, _WRITTEN_OUT)
    for role in ("identity", "pose"):
        made.add_argument(f"--{role}-up", type=axis, choices=_AXES, help="signed axis to the head (default: found)")
        made.add_argument(f"--{role}-facing", type=axis, choices=_AXES, help="signed axis of the gaze (default: found)")
        made.add_argument(f"--{role}-unit", type=unit, choices=UNITS, help="unit of the file (default: guessed)")
    made.add_argument("--report", type=Path, metavar="FILE", help="save the reports, with all numbers, as JSON")
    made.add_argument("--skip-bad", action="store_true", help="of many poses, leave out those that cannot be used")
    made.add_argument("--device", default="cpu", help="cpu, cuda, ... (default: cpu)")
    made.add_argument("--threads", type=int, default=0, metavar="N", help="threads on the CPU, 0 for PyTorch's choice")
    made.add_argument("--no-picture", action="store_true", help="no .png beside the result")
    made.add_argument("--no-html", action="store_true", help="no .html page beside the result")
    made.add_argument("--quiet", action="store_true", help="print warnings only")
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command. A user's error is one line, with one more for each of many bad poses, and exit status 2."""
    args = parser().parse_args(arguments)
    written: list[Path] = []
    try:
        check(args)
        from meshkit.transfer.command import run

        run(args, written)
    except OSError as error:
        _fail(f"{error.filename or 'file'}: {error.strerror or error}", written)
    except (ValueError, ImportError) as error:
        _fail(str(error), written)
    except RuntimeError as error:  # of PyTorch: a device that is missing or has too little memory
        _fail(f"{' '.join(str(error).split()) or type(error).__name__} (on device {args.device})", written)
    except KeyboardInterrupt:
        _fail("interrupted", written, status=130)


def check(args: argparse.Namespace) -> None:
    """Find what is wrong with files and options without reading any.

    Raises:
        ValueError: a missing file, a kind of result that is not written, or a weight that is none.
    """
    for path in (args.identity, args.pose):
        if not path.exists():
            raise ValueError(f"{path}: no such file")
    if args.identity.is_dir():
        raise ValueError(f"{args.identity}: a folder; the identity is one mesh, only poses may be many")
    many = args.pose.is_dir() or args.pose.suffix.lower() in (".npz", ".glb")  # as far as can be told by the name
    check_out(args.out, many)
    for role in ("identity", "pose"):
        up, facing = getattr(args, f"{role}_up"), getattr(args, f"{role}_facing")
        if up and facing and up[1] == facing[1]:
            raise ValueError(f"--{role}-up {up} and --{role}-facing {facing} must be at right angles")
    if args.threads < 0:
        raise ValueError(f"--threads cannot be negative, got {args.threads}")
    if args.refine is not None and not 0 < args.refine < math.inf:
        raise ValueError(f"--refine must be a positive weight, got {args.refine:g}; --no-refine leaves refining out")
    if args.refine is not None and args.no_refine:
        raise ValueError("--refine and --no-refine exclude each other")


def check_out(out: Path, many: bool) -> None:
    """Refuse a name whose ending says a kind of file that is not written."""
    if out.suffix.lower() not in (*FORMATS, *((".npz",) if many else ())):
        raise ValueError(f"{out}: the result is written as {', '.join(FORMATS)}{' or .npz' if many else ''}")


def _fail(message: str, written: Sequence[Path], *, status: int = 2) -> NoReturn:
    parts = (" ".join(part.split()) for part in message.split("\n  "))
    print("error: " + "\n  ".join(parts), file=sys.stderr)
    if written:
        last = f" to {written[-1]}" if len(written) > 1 else ""
        print(f"kept: {len(written)} {'files' if last else 'file'}, {written[0]}{last}", file=sys.stderr)
    raise SystemExit(status)
