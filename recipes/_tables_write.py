"""Tables of means and spreads as Markdown and CSV."""

from __future__ import annotations

import csv
import math
from collections import Counter
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from _tables_sheets import (
    COARSE,
    MATCHING_WEIGHTS,
    NOISE_PAIRS,
    NOISE_WEIGHTS,
    TOPOLOGY_PAIRS,
    TOPOLOGY_WEIGHTS,
    WEIGHTS,
)
from _tables_train import Job, command, jobs

from meshkit.io import atomic_write

KINDS = {"humans": "SMPL", "animals": "SMAL"}  # and the paper's bodies of that kind
HEADS = {
    "pmd": "PMD (e-3)",
    "cd": "CD (e-3)",
    "emd": "EMD (e-2)",
    "edges": "edges (%)",
    "match": "match error (e-2)",
}
HEADS_OF_HUMANS = HEADS | {"match": "match error (cm)"}  # they are in metres
TITLES = {
    "comparison-humans": "Table 1, humans (paper: SMPL)",
    "comparison-animals": "Table 1, animals (paper: SMAL)",
    "norms": "Table 2, conditional normalisation, humans",
    "ablation": "Table 3, parts of X-DualNet, humans",
    "humans-6890": "Humans at 6890 vertices, bare networks, {large_pairs} pairs; trained at 1000 vertices, one seed",
}
ABLATIONS = ("norms", "ablation")
"""Tables whose last row is the whole method."""

SHEETS = {
    "comparison-humans": "Comparison, humans, first seed",
    "comparison-animals": "Comparison, animals, first seed",
    "ablation": "Ablations, first seed",
    "topologies": f"Other triangulations, shipped weights {TOPOLOGY_WEIGHTS}; the mesh of {COARSE} vertices is "
    "simplified from the one of 6890, and not in the table of triangulations",
    "correspondence": f"Correspondence, shipped weights {MATCHING_WEIGHTS}: lines of matches more than 10 cm off are "
    "red",
    "noise": f"Noise on the pose mesh, shipped weights {NOISE_WEIGHTS}",
    "noise_curve": f"PMD against noise, shipped weights {' and '.join(WEIGHTS)}, first {NOISE_PAIRS} test pairs",
    "failures-humans": "The worst test pairs of X-DualNet, humans, beside shipped weights xdualnet-humans",
    "failures-animals": "The worst test pairs of X-DualNet, animals, beside shipped weights xdualnet-animals",
}


@dataclass(frozen=True)
class Row:
    """A method: mean and spread of each metric over ``runs``, and the paper's figures."""

    title: str
    figures: dict[str, tuple[float, float]]
    runs: int
    paper: dict[str, float]
    by_seed: dict[int, float] = field(default_factory=dict)
    """PMD of each run."""


def shown(figure: tuple[float, float] | None) -> str:
    """``mean ± spread``; the mean alone of a single run."""
    if figure is None:
        return "-"
    value, spread = figure
    return f"{value:.2f}" if math.isnan(spread) else f"{value:.2f} ± {spread:.2f}"


def table(rows: list[Row], heads: dict[str, str]) -> str:
    """Markdown; the paper's own figures in brackets. A metric that no row has is left out."""
    names = [name for name in heads if any(name in row.figures or name in row.paper for row in rows)]
    lines = ["| method | runs | " + " | ".join(heads[name] for name in names) + " |", "|---|---|" + "---|" * len(names)]
    for row in rows:
        cells = [
            shown(row.figures.get(name)) + (f" [{row.paper[name]:.2f}]" if name in row.paper else "") for name in names
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
    text, signs = here[0].title, set[str]()
    for first, second in pairwise(here):
        (a, spread_a), (b, spread_b) = first.figures["pmd"], second.figures["pmd"]
        error = math.hypot(spread_a / math.sqrt(first.runs), spread_b / math.sqrt(second.runs))
        sign = "?" if math.isnan(error) else "<" if b - a > 2 * error else "~"
        text += f" {sign} {second.title}"
        signs.add(sign)
    paper = " < ".join(row.title for row in printed)
    meanings = {
        "<": "by more than two standard errors of the difference of means",
        "~": "by less than two standard errors of the difference of means",
        "?": "a single run, whose spread is not known",
    }
    legend = "; ".join(f"`{sign}`: {meaning}" for sign, meaning in meanings.items() if sign in signs)
    return f"PMD here: {text}. Paper: {paper}. Here {legend}.\n"


def paired(rows: list[Row]) -> str:
    """How the PMD of each ablation differs from the whole method's, the last row, in runs of one seed.

    Runs of one seed see the same pairs and, but for what is left out, begin with the same parameters; what a seed does
    to both falls out of their difference.
    """
    *parts, whole = rows
    said = []
    for row in parts:
        seeds = sorted(row.by_seed.keys() & whole.by_seed.keys())
        if len(seeds) > 1:
            changes = [row.by_seed[seed] - whole.by_seed[seed] for seed in seeds]
            each = ", ".join(f"{change:+.2f}" for change in changes)
            said.append(f"{row.title} {mean(changes):+.2f} ± {stdev(changes):.2f} ({each})")
    return f"PMD less that of {whole.title} with the same seed and pairs: {'; '.join(said)}.\n" if said else ""


def plain(title: str, said: str, heads: list[str], rows: list[list[Any]]) -> str:
    """A table of other things."""
    lines = [
        f"## {title}",
        "",
        *([said, ""] if said else []),
        "| " + " | ".join(heads) + " |",
        "|" + "---|" * len(heads),
    ]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)]) + "\n"


def given(cfg: Any) -> str:
    """What every run was trained with."""
    return f"{cfg.pairs} training pairs" if cfg.minutes is None else f"{cfg.minutes:g} minutes"


def budget_text(tables: dict[str, list[Row]], cfg: Any, missing: list[Job]) -> str:
    """What the figures are of; words are explained where they are used."""
    kinds = [kind for kind in KINDS if f"comparison-{kind}" in tables]
    sizes = {"humans": "humans with 1000 vertices", "animals": "animals with 1962"}
    units = {"humans": "of humans in centimetres", "animals": "of animals in hundredths of their unit"}
    sentences = [
        f"Every system is trained with {given(cfg)} (batch {cfg.batch}, preset `{cfg.preset}`) and measured on the "
        f"same {cfg.eval_pairs} pairs of unseen identities in unseen poses (EMD: the first "
        f"{min(cfg.emd_pairs, cfg.eval_pairs)}), {', '.join(sizes[kind] for kind in kinds)}.",
    ]
    if any(row.runs > 1 for rows in tables.values() for row in rows):
        sentences.append("`±` is the standard deviation over runs that differ in their seed.")
    if any(row.paper for rows in tables.values() for row in rows):
        bodies = " and ".join(KINDS[kind] for kind in kinds)
        sentences.append(
            f"In brackets: the paper's figures, on {bodies}, after 24 to 90 GPU hours; the data differ, so only the "
            "order compares."
        )
    if any("edges" in row.figures for rows in tables.values() for row in rows):
        sentences.append("Edges: mean change of the lengths of edges from those of the ground truth.")
    if any("match" in row.figures for rows in tables.values() for row in rows):
        where = ", ".join(units[kind] for kind in kinds)
        sentences.append(f"Match error: distance between the matched and the true vertex, {where}.")
    text = " ".join(sentences) + "\n"
    text += (
        "\nWhat the presets make unequal: X-DualNet and the baseline resolve exchanged limbs in evaluation "
        "(`symmetry`), 3D-CoreNet does not need to; NPT takes no descriptors, as published.\n"
    )
    if missing:
        counts = Counter(f"{job.data} {job.system}" for job in missing)
        listed = ", ".join(f"{name} ({n})" for name, n in counts.items())
        why = "still to be trained" if set(KINDS) <= set(cfg.data) else "still to be trained or left out by `--data`"
        text += f"\nRuns that are not in these tables, {why}: {listed}.\n"
    return text


def tables_command(cfg: Any) -> str:
    """The command that these tables are of, but for its folders."""
    words = ["python recipes/paper_tables.py"]
    for f in fields(cfg):
        value = getattr(cfg, f.name)
        if f.name not in ("train", "sheets", "out", "to") and value != f.default:
            words.append(f"--{f.name.replace('_', '-')} {' '.join(value) if isinstance(value, tuple) else value}")
    return " ".join(words)


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


def measured_once(extra: dict[str, Any], paper_seconds: dict[str, float], made_by: str) -> list[str]:
    """Tables of what does not depend on the runs: times, and the shipped weights under noise and triangulations."""
    seconds, noise, sizes = extra["seconds"], extra["noise"], extra["topologies"]
    threads = f"{seconds['threads']} thread{'s' if seconds['threads'] > 1 else ''}"
    times, where = seconds["seconds"], f"{seconds['processor']}, {threads}"
    timed = [[name, f"{s:.3f}", f"{s / times['NPT']:.1f}", paper_seconds[name]] for name, s in times.items()]
    curves = [[name, *(f"{v:.2f}" for v in noise[name])] for name in noise if name != "sigma_mm"]
    cells = [[place, *(f"{v:.2f}" for v in values)] for place, values in sizes["pmd"].items()]
    heads_of_times = ["method", f"s ({where})", "times NPT's", "paper, s (GPU)"]
    heads = ["noise of the pose mesh (mm)", *(f"{sigma:g}" for sigma in noise["sigma_mm"])]
    others = ["identity, pose vertices", *sizes["weights"]]
    noisy = f"Noise: PMD (e-3) of shipped weights, humans, first {NOISE_PAIRS} test pairs"
    triangulated = f"Triangulations: PMD (e-3) of shipped weights, humans, first {TOPOLOGY_PAIRS} test pairs"
    return [
        plain(
            "Table 5, time of a transfer at 6890 vertices, the papers' sizes",
            f"DT: deformation transfer. {made_by}",
            heads_of_times,
            timed,
        ),
        plain(noisy, f"Normal noise of that deviation on every coordinate. {made_by}", heads, curves),
        plain(triangulated, f"Bodies of three triangulations, without simplification. {made_by}", others, cells),
    ]


def write_tables(
    to: Path,
    tables: dict[str, list[Row]],
    extra: dict[str, Any],
    paper_seconds: dict[str, float],
    cfg: Any,
    done: list[Job],
    drawn: list[str],
) -> None:
    """tables.md, and a CSV file for each table; ``done`` are the runs they are of, ``drawn`` the sheets."""
    made_by = tables_command(cfg)
    missing = [job for job in jobs(tuple(KINDS), cfg.seeds) if job not in done]
    parts = [f"# The paper's tables after {given(cfg)}\n", budget_text(tables, cfg, missing)]
    for name, rows in tables.items():
        heads = HEADS if name.endswith("animals") else HEADS_OF_HUMANS
        parts += [f"## {TITLES[name].format(large_pairs=cfg.large_pairs)}\n", table(rows, heads), order(rows)]
        parts += [paired(rows)] if name in ABLATIONS else []
        write_csv(to / f"{name}.csv", rows)
    parts += measured_once(extra, paper_seconds, f"`{made_by}`") if extra else []
    parts += [f"## {title}\n\n![{title}]({name}.png)\n" for name, title in SHEETS.items() if name in drawn]
    commands = "\n".join([made_by, *(f"python {' '.join(command(job, cfg))}" for job in done)])
    parts.append(f"## Commands\n\n```sh\n{commands}\n```\n")
    with atomic_write(to / "tables.md") as path:
        path.write_text("\n".join(part for part in parts if part), encoding="utf-8")
