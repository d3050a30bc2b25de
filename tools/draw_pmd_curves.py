"""Draw PMD on unseen pairs against training time, of one run or several.

python tools/draw_pmd_curves.py docs/images/pmd_minutes.png supervised=runs/sup30 unsupervised=runs/unsup30
"""

import argparse
import json
from pathlib import Path

from meshkit.viz import plot_curves


def curve(run: Path) -> tuple[list[float], list[float]]:
    """Minutes, and PMD at them; the last evaluation, on all pairs, is not of the curve."""
    try:
        records = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines() if line.endswith("}")]
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {run}/log.jsonl: {error}") from None
    points = [(r["seconds"] / 60, r["eval"]["pmd"]) for r in records if "pmd" in r.get("eval", {})]
    if not points:
        raise SystemExit(f"error: {run}/log.jsonl holds no evaluation: train with a smaller --eval-every")
    return [minutes for minutes, _ in points], [pmd for _, pmd in points]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("runs", nargs="+", metavar="NAME=FOLDER")
    args = parser.parse_args()
    series = {name: curve(Path(folder)) for name, _, folder in (word.partition("=") for word in args.runs)}
    plot_curves(args.picture, series, xlabel="training time (minutes)", ylabel="PMD (1e-3 m²)", logy=True)


if __name__ == "__main__":
    main()
