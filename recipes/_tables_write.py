"""Tables of means and spreads as Markdown and CSV."""

from __future__ import annotations

import csv
import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from _tables_train import Job, command

from meshkit.io import atomic_write

HEADS = {"pmd": "PMD (e-3)", "cd": "CD (e-3)", "emd": "EMD (e-2)", "match": "match error (e-2)"}
TITLES = {
    "comparison-humans": "Table 1, humans (paper: SMPL)",
    "comparison-animals": "Table 1, animals (paper: SMAL)",
    "norms": "Table 2, conditional normalisation, humans",
    "ablation": "Table 3, parts of X-DualNet, humans",
    "humans-6890": "Humans at 6890 vertices, bare networks, {large_pairs} pairs; trained at 1000 vertices, one seed",
}

SHEETS = {
    "comparison-humans": "Comparison, humans, first seed",
    "comparison-animals": "Comparison, animals, first seed",
    "ablation": "Ablations, first seed",
    "topologies": "Other triangulations, shipped weights",
    "correspondence": "Correspondence, shipped weights: lines of matches more than 10 cm off are red",
    "noise": "Noise on the pose mesh, shipped weights",
    "noise_curve": "PMD against noise, shipped weights, 40 pairs",
    "failures-humans": "The worst test pairs, humans",
    "failures-animals": "The worst test pairs, animals",
}


@dataclass(frozen=True)
class Row:
    """A method: mean and spread of each metric over ``runs``, and the paper's figures."""

    title: str
    figures: dict[str, tuple[float, float]]
    runs: int
    paper: dict[str, float]


def shown(figure: tuple[float, float] | None) -> str:
    """``mean ± spread``; the mean alone of a single run."""
    if figure is None:
        return "-"
    mean, spread = figure
    return f"{mean:.2f}" if math.isnan(spread) else f"{mean:.2f} ± {spread:.2f}"


def table(rows: list[Row]) -> str:
    """Markdown; the paper's own figures in brackets."""
    lines = ["| method | runs | " + " | ".join(HEADS.values()) + " |", "|---|---|" + "---|" * len(HEADS)]
    for row in rows:
        cells = [
            shown(row.figures.get(name)) + (f" [{row.paper[name]:.2f}]" if name in row.paper else "") for name in HEADS
        ]
        lines.append(f"| {row.title} | {row.runs} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def order(rows: list[Row]) -> str:
    """Methods by their PMD, here and in the paper; what the number of runs leaves open is said."""
    compared = [row for row in rows if row.paper]
    if len(compared) < 2:
        return ""
    here = sorted(compared, key=lambda row: row.figures["pmd"][0])
    printed = sorted(compared, key=lambda row: row.paper["pmd"])
    text = here[0].title
    for first, second in pairwise(here):
        (a, spread_a), (b, spread_b) = first.figures["pmd"], second.figures["pmd"]
        error = math.hypot(spread_a / math.sqrt(first.runs), spread_b / math.sqrt(second.runs))
        text += (" ? " if math.isnan(error) else " < " if b - a > 2 * error else " ~ ") + second.title
    paper = " < ".join(row.title for row in printed)
    return (
        f"PMD here: {text}. Paper: {paper}. `<`: by more than two standard errors of the difference of means; `~`: by "
        "less; `?`: a single run, whose spread is not known.\n"
    )


def plain(title: str, heads: list[str], rows: list[list[Any]]) -> str:
    """A table of other things."""
    lines = [f"## {title}", "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)]) + "\n"


def budget_text(cfg: Any, missing: list[Job]) -> str:
    """What the figures are of."""
    given = f"{cfg.pairs} training pairs" if cfg.minutes is None else f"{cfg.minutes} minutes"
    text = (
        f"Every system is trained with {given} (batch {cfg.batch}, preset `{cfg.preset}`) and measured on the same "
        f"{cfg.eval_pairs} pairs of unseen identities in unseen poses (EMD: the first "
        f"{min(cfg.emd_pairs, cfg.eval_pairs)}), humans with "
        "1000 vertices, animals with 1962. `±` is the standard deviation over runs that differ in their seed. In "
        "brackets: the paper's figures, on SMPL and SMAL, after 24 to 90 GPU hours; the data differ, so only the order "
        "compares. Match error: distance between the matched and the true vertex, in the unit of the bodies.\n\n"
        "What the presets make unequal: X-DualNet and the baseline resolve exchanged limbs in evaluation (`symmetry`), "
        "3D-CoreNet does not need to; NPT takes no descriptors, as published.\n"
    )
    if missing:
        counts = Counter(f"{job.data} {job.system}" for job in missing)
        listed = ", ".join(f"{name} ({n})" for name, n in counts.items())
        text += f"\nRuns still to be trained, and not in these tables: {listed}.\n"
    return text


def write_csv(path: Path, rows: list[Row]) -> None:
    """A table with its means, spreads and the paper's figures in columns of their own."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(
            ["method", "runs", *(f"{name} {kind}" for name in HEADS for kind in ("mean", "spread", "paper"))]
        )
        for row in rows:
            cells: list[Any] = []
            for name in HEADS:
                known = [round(x, 4) for x in row.figures.get(name, ()) if not math.isnan(x)]
                cells += [*known, *[""] * (2 - len(known)), row.paper.get(name, "")]
            writer.writerow([row.title, row.runs, *cells])


def measured_once(extra: dict[str, Any], paper_seconds: dict[str, float]) -> list[str]:
    """Tables of what does not depend on the runs: times, and the shipped weights under noise and triangulations."""
    seconds, noise, sizes = extra["seconds"], extra["noise"], extra["topologies"]
    times, where = seconds["seconds"], f"{seconds['processor']}, {seconds['threads']} thread(s)"
    timed = [[name, f"{s:.3f}", f"{s / times['NPT']:.1f}", paper_seconds[name]] for name, s in times.items()]
    curves = [[name, *(f"{v:.2f}" for v in noise[name])] for name in noise if name != "sigma_mm"]
    cells = [[place, *(f"{v:.2f}" for v in values)] for place, values in sizes["pmd"].items()]
    heads_of_times = ["method", f"s ({where})", "times NPT's", "paper, s (GPU)"]
    heads = ["noise of the pose mesh (mm)", *(f"{sigma:g}" for sigma in noise["sigma_mm"])]
    others = ["identity, pose vertices", *sizes["weights"]]
    return [
        plain("Table 5, time of a transfer at 6890 vertices, the papers' sizes", heads_of_times, timed),
        plain("Noise: PMD (e-3) of shipped weights, humans", heads, curves),
        plain("Triangulations: PMD (e-3) of shipped weights, humans", others, cells),
    ]


def write_tables(
    to: Path,
    tables: dict[str, list[Row]],
    extra: dict[str, Any],
    paper_seconds: dict[str, float],
    cfg: Any,
    jobs: tuple[list[Job], list[Job]],
    drawn: list[str],
) -> None:
    """tables.md, and a CSV file for each table; ``jobs`` are those wanted and those done, ``drawn`` the sheets."""
    wanted, done = jobs
    parts = ["# The paper's tables\n", budget_text(cfg, [job for job in wanted if job not in done])]
    for name, rows in tables.items():
        parts += [f"## {TITLES[name].format(large_pairs=cfg.large_pairs)}\n", table(rows), order(rows)]
        write_csv(to / f"{name}.csv", rows)
    parts += measured_once(extra, paper_seconds) if extra else []
    parts += [f"## {title}\n\n![{title}]({name}.png)\n" for name, title in SHEETS.items() if name in drawn]
    commands = "\n".join(f"python {' '.join(command(job, cfg))}" for job in done)
    parts.append(f"## Commands\n\n```sh\n{commands}\n```\n")
    with atomic_write(to / "tables.md") as path:
        path.write_text("\n".join(part for part in parts if part), encoding="utf-8")
