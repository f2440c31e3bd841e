"""The table of the baselines: a row for each run, whatever system and library it is of."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tests.benchmarks.baselines.programs import SYSTEMS
from tests.benchmarks.paper_tables import PAPER, TASKS

KEY = ("task", "system", "seed")
"""Columns that name a run."""
HEADINGS = ("system", "seeds", "steps", "CPU s", "updates a step", "return", "successes", "least distance", "paper")
COLUMNS = (
    *KEY,
    *("steps", "cpu_seconds", "is_finished"),
    *(f"{what}_{part}" for what in ("return", "goal_distance") for part in ("mean", "low", "high")),
    *("success", "success_low", "success_high", "episodes", "candidates"),
    *("updates_per_step", "network", "settings", "versions", "cpu"),
)
"""Environment steps and CPU seconds of all processes are those that the run has reached, certification not included.
Return, least distance to the goal and share of successes are those of the certification, with intervals of 95 %, of the
policy that selection episodes chose among `candidates`. Updates are batches that networks learn from."""


def read(table: Path) -> list[dict[str, Any]]:
    """The rows of a table; none if there is none yet."""
    if not table.exists():
        return []
    frame = pd.read_csv(table, dtype={"seed": int})
    return [{str(name): value for name, value in row.items()} for row in frame.to_dict("records")]


def put(table: Path, row: Mapping[str, Any]) -> None:
    """Write the row of a run in the place of an older one, the rows in the order of task, system and seed.

    Raises:
        ValueError: it has other columns than all rows.
    """
    if {*row} != {*COLUMNS}:
        raise ValueError(f"a row has the columns {', '.join(COLUMNS)}, but this one has {', '.join(row)}")
    others = [entry for entry in read(table) if any(entry[name] != row[name] for name in KEY)]
    rows = sorted([*others, dict(row)], key=lambda entry: [entry[name] for name in KEY])
    new = table.with_suffix(".new")
    pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(new, index=False, float_format="%.6g", lineterminator="\n")
    os.replace(new, table)


def in_words(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a table in Markdown for each task, all runs of a system in one line, in the order of `SYSTEMS`; a run
    that goes on says how far it is."""
    tables = []
    for number, task in enumerate(TASKS):
        runs = [row for row in rows if row["task"] == task]
        lines = [f"**{task}**", "", "| " + " | ".join(HEADINGS) + " |", "| --- " * len(HEADINGS) + "|"]
        for system, program in SYSTEMS.items():
            if of_system := [row for row in runs if row["system"] == system]:
                paper = PAPER.get(program.name, ("",) * len(TASKS))[number]
                lines.append("| " + " | ".join([program.name, *_cells(of_system), paper]) + " |")
        if runs:
            tables.append("\n".join(lines))
    return "\n\n".join(tables)


def _cells(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the runs of a system have reached; what all have alike is named once."""
    ends = ["" if row["is_finished"] else ", goes on" for row in rows]
    cells = [
        [str(row["seed"]) for row in rows],
        [f"{row['steps'] / 1e6:.3g}M{end}" for row, end in zip(rows, ends, strict=True)],
        [f"{row['cpu_seconds']:,.0f}" for row in rows],
        [f"{row['updates_per_step']:.2g}" for row in rows],
        [f"{row['return_mean']:,.1f}" for row in rows],
        ["" if pd.isna(row["success"]) else f"{row['success']:.0%}" for row in rows],
        ["" if pd.isna(row["goal_distance_mean"]) else f"{row['goal_distance_mean']:.2f}" for row in rows],
    ]
    return [values[0] if len({*values}) == 1 else ", ".join(values) for values in cells]
