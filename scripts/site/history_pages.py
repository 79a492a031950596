"""The history of the benchmarks: a plot of each figure that docs/reference/benchmark-history.csv has more than once."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from pathlib import Path
from typing import Final

import matplotlib as mpl
from matplotlib.figure import Figure

FOLDER: Final = "reference/generated/history"
TITLE: Final = "Benchmarks over time"
INTRODUCTION: Final = f"""# {TITLE}

Each point is one run of a benchmark: its date, its commit, and the load of the machine, if it is
known. All runs were on the machine that [Benchmarks](../benchmarks.md) describes, which other programs
often used. So a ratio to a contender of the same run says more than a rate or a time.

Benchmarks append their figures to [benchmark-history.csv](../benchmark-history.csv) when you start them
with `--store`.
"""
GREY: Final = "#7a8699"  # legible on light and on dark pages
BLUE: Final = "#4f7fe0"

Rows = list[dict[str, str]]


def pages(history: Path) -> tuple[dict[str, tuple[str, str]], dict[str, str]]:
    """Return title and text of the page, by its path, and the plots as SVG, by theirs."""
    figures: dict[str, dict[str, Rows]] = defaultdict(lambda: defaultdict(list))
    with history.open(newline="") as file:
        for row in csv.DictReader(file):
            figures[row["benchmark"]][row["figure"]].append(row)
    parts, plots, once = [INTRODUCTION], {}, []
    for benchmark, found in sorted(figures.items()):
        repeated = {figure: rows for figure, rows in sorted(found.items()) if len(rows) > 1}
        parts += [f"## {benchmark}\n"] if repeated else []
        for number, (figure, rows) in enumerate(repeated.items(), 1):
            name = f"{benchmark}-{number}.svg"
            plots[f"{FOLDER}/{name}"] = _plot(rows)
            parts.append(f"**{figure}**, {_better(rows[0])}\n\n![{_spoken(rows)}](history/{name})\n")
        once += [rows[0] for figure, rows in sorted(found.items()) if figure not in repeated]
    parts.append("## Measured once\n\n| benchmark | figure | value | | date, commit | load |\n" + "|---" * 6 + "|")
    parts += [
        f"| {row['benchmark']} | {row['figure']} | {row['value']} {row['unit']} | {_better(row)} "
        f"| {row['date']}, {row['commit']} | {row['load']} |"
        for row in once
    ]
    return {"reference/generated/benchmark-history.md": (TITLE, "\n".join(parts) + "\n")}, plots


def _better(row: dict[str, str]) -> str:
    return f"{row['better']} is better"


def _load(row: dict[str, str]) -> str:
    """Return the load in words, or nothing if it is not known."""
    return f"load {row['load']}" if row["load"] not in ("", "idle") else row["load"]


def _spoken(rows: Rows) -> str:
    """Return the plot in words, for readers who do not see it."""
    return ", ".join(f"{row['date']}: {row['value']} {row['unit']}" for row in rows)


def _plot(rows: Rows) -> str:
    """Return a plot of a figure's values as SVG, with the runs side by side in their order."""
    figure = Figure(figsize=(max(4.0, 0.9 + 0.85 * len(rows)), 1.9), layout="constrained")
    axes = figure.add_subplot()
    values = [float(row["value"]) for row in rows]
    axes.plot(range(len(rows)), values, color=BLUE, marker="o")
    for place, row in enumerate(rows):
        axes.annotate(
            row["value"], (place, values[place]), xytext=(0, 6), textcoords="offset points", ha="center", color=GREY
        )
    axes.set_ylim(0, 1.25 * max(values))
    axes.set_xlim(-0.5, len(rows) - 0.5)
    axes.set_ylabel(rows[0]["unit"], color=GREY)
    labels = [f"{row['date']}\n{row['commit']}\n{_load(row)}" for row in rows]
    axes.set_xticks(range(len(rows)), labels)
    axes.tick_params(colors=GREY, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    out = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "shmio", "svg.fonttype": "none", "font.family": "sans-serif"}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return out.getvalue()
