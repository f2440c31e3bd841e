"""The table of the baselines: a row for each run, whatever system and library it is of."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

KEY = ("task", "system", "seed")
"""Columns that name a run."""
COLUMNS = (
    *KEY,
    *("steps", "cpu_seconds", "is_finished"),
    *("return_mean", "return_low", "return_high", "success", "success_low", "success_high", "episodes"),
    *("updates_per_step", "network", "settings", "versions", "cpu"),
)
"""Environment steps and CPU seconds of all processes are those that the run has reached, certification not included.
Return and share of successes are those of the certification, with intervals of 95 %."""


def read(table: Path) -> list[dict[str, Any]]:
    """The rows of a table; none if there is none yet."""
    if not table.exists():
        return []
    found = pd.read_csv(table, dtype={"seed": int})
    return [{str(name): value for name, value in row.items()} for row in found.to_dict("records")]


def put(table: Path, row: Mapping[str, Any]) -> None:
    """Write the row of a run in the place of an older one, the rows in the order of task, system and seed.

    Raises:
        ValueError: it has other columns than all rows.
    """
    if {*row} != {*COLUMNS}:
        raise ValueError(f"a row has the columns {', '.join(COLUMNS)}, but this one has {', '.join(row)}")
    others = [one for one in read(table) if any(one[name] != row[name] for name in KEY)]
    rows = sorted([*others, dict(row)], key=lambda one: [one[name] for name in KEY])
    new = table.with_suffix(".new")
    pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(new, index=False, float_format="%.6g", lineterminator="\n")
    os.replace(new, table)


def in_words(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a table in Markdown; a run that goes on says how far it is."""
    lines = ["| task | system | seed | steps | CPU s | certified return | successes |", "| --- " * 7 + "|"]
    for row in rows:
        cost = f"{row['cpu_seconds']:,.0f}" + ("" if row["is_finished"] else ", goes on")
        value = f"{row['return_mean']:,.1f} ({row['return_low']:,.1f} to {row['return_high']:,.1f})"
        share = "" if pd.isna(row["success"]) else f"{row['success']:.0%}"
        named = " | ".join(str(row[name]) for name in KEY)
        lines.append(f"| {named} | {row['steps']:,} | {cost} | {value} | {share} |")
    return "\n".join(lines)
