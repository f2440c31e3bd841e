"""The tables of the guide about the paper's measures, written from results/paper_runs.csv; and the runs' curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from tests.benchmarks.paper_readings import AT, READINGS, column, power

RUNS_CSV = Path(__file__).parent / "results" / "paper_runs.csv"
CURVES_CSV = RUNS_CSV.with_name("paper_curves.csv")
RUN = ("task", "method", "seed")
"""Columns that name a run."""
GUIDE = Path(__file__).parent / "README.md"
BEGIN, END = (
    "<!-- begin of the paper's tables: python -m tests.benchmarks.paper -->",
    "<!-- end of the paper's tables -->",
)
METHODS = {
    "es": "ES",
    "ns_es": "NS-ES",
    "nsr_es": "NSR-ES",
    "nsra_es": "NSRA-ES",
    "me_es": "ME-ES",
    "memes": "MEMES",
    "map_elites": "MAP-Elites",
    "ars": "ARS",
}
TASKS = {
    "point_maze": ("PointMaze: best fitness", 1_000_000),
    "ant_maze": ("AntMaze: minimum distance to the goal, negative, in metres", 100_000_000),
    "ant_trap": ("AntTrap: best fitness", 100_000_000),
}
"""Measure of each task, and after how many steps the paper gives it."""
PAPER = {
    "QD-PG": ("-24 ± 0", "-1 ± 7", "1540 ± 46"),
    "SAC": ("-126 ± 0", "-26 ± 0", "1075 ± 7"),
    "TD3": ("-129 ± 1", "-35 ± 1", "1131 ± 4"),
    "RND": ("-102 ± 4", "-31 ± 1", "1014 ± 27"),
    "CEM-RL": ("-312 ± 1", "-26 ± 0", "977 ± 3"),
    "P3S-TD3": ("-144 ± 14", "-60 ± 0", "1173 ± 4"),
    "AGAC": ("-32 ± 49", "-43 ± 3", "1113 ± 8"),
    "DIAYN": ("-96 ± 14", "-47 ± 4", "949 ± 34"),
    "PGA-ME": ("-126 ± 0", "-18 ± 6", "1455 ± 17"),
    "ME-ES": ("", "-5 ± 0 after 2.4e10", ""),
    "NSR-ES": ("", "-26 ± 0", ""),
    "NSRA-ES": ("", "-2 ± 1 after 2.1e10", ""),
}
"""The paper's values by method, in the order of TASKS: the median, and the mean distance to the quartiles."""
PAPER_STEPS_TO_GOAL = {"QD-PG": "8.4e7", "ME-ES": "2.4e10", "NSRA-ES": "2.1e10", "NSR-ES": "never", "CEM-RL": "never"}
"""The paper's environment steps to the goal of AntMaze."""

WHOLE = ("env_steps", "generations", "seconds", "cells", "steps_to_goal_centre", "steps_to_goal_single")
"""Columns of whole numbers."""


def read() -> pd.DataFrame:
    """The table of runs; without rows if there is none yet."""
    return pd.read_csv(RUNS_CSV) if RUNS_CSV.exists() else pd.DataFrame(columns=[*RUN, "env_steps"])


def read_curves() -> pd.DataFrame:
    """The curves of the runs: task, method, seed, env_steps, centre, single; without rows if there are none yet."""
    columns = [*RUN, "env_steps", *READINGS]
    return pd.read_csv(CURVES_CSV)[columns] if CURVES_CSV.exists() else pd.DataFrame(columns=columns)


def with_run(table: pd.DataFrame, run: dict[str, object], rows: pd.DataFrame) -> pd.DataFrame:
    """The table with these rows of a run, in the place of those that it has."""
    is_old = np.logical_and.reduce([table[key] == value for key, value in run.items()])
    return pd.concat([table[~is_old], rows]) if (~is_old).any() else rows


def write(table: pd.DataFrame) -> None:
    """Write the table of runs and the guide's tables."""
    table = in_order(table)
    for name in table.columns.intersection(WHOLE):  # NaN, where a run has no such number, would make them floats
        table[name] = pd.to_numeric(table[name]).astype("Int64")
    table.to_csv(RUNS_CSV, index=False, lineterminator="\n")
    before, rest = GUIDE.read_text().split(BEGIN)
    GUIDE.write_text(f"{before}{BEGIN}\n\n{text(read())}\n{END}{rest.split(END)[1]}")


def write_curves(table: pd.DataFrame) -> None:
    """Write the curves of the runs."""
    in_order(table)[[*RUN, "env_steps", *READINGS]].to_csv(CURVES_CSV, index=False, lineterminator="\n")


def in_order(table: pd.DataFrame) -> pd.DataFrame:
    """The rows in the order of the tasks, methods, seeds and steps."""
    places = {name: at for names in (TASKS, METHODS) for at, name in enumerate(names)}
    return table.sort_values(
        [*RUN, "env_steps"], key=lambda column: column.map(places) if column.name in ("task", "method") else column
    )


def text(table: pd.DataFrame) -> str:
    """The guide's tables, of all runs in the table."""
    return "\n".join(_of_task(table[table.task == task], task) for task in TASKS if (table.task == task).any())


def _of_task(runs: pd.DataFrame, task: str) -> str:
    title, paper_steps = TASKS[task]
    at_columns = [at for at in AT if runs[column("centre", at)].notna().any()]
    head = ["method", "seeds", *(f"{name}, {power(at)}" for at in at_columns for name in READINGS)]
    with_goal = task == "ant_maze"
    with_fresh = bool(runs["fresh"].notna().any())
    head += ["best centre, fresh episodes"] * with_fresh
    head += ["steps to the goal, single, of each seed"] * with_goal
    lines = [f"**{title}.**", "", _line(head), _line(["---"] * len(head))]
    for method, name in METHODS.items():
        of_method = runs[runs.method == method]
        if len(of_method):
            cells = [name, ", ".join(map(str, of_method.seed))]
            cells += [_quartiles(of_method[column(reading, at)]) for at in at_columns for reading in READINGS]
            if with_fresh:
                cells.append(_quartiles(of_method["fresh"]))
            if with_goal:
                steps = pd.to_numeric(of_method["steps_to_goal_single"]).tolist()
                cells.append(", ".join("never" if np.isnan(count) else f"{count / 1e6:,.0f} M" for count in steps))
            lines.append(_line(cells))
    short = runs[~runs.finished.astype(bool)]
    if len(short):
        which = ", ".join(
            f"{METHODS[row.method]} seed {row.seed} ({row.env_steps / 1e6:,.0f} M)" for row in short.itertuples()
        )
        lines += ["", f"Not finished: {which}."]
    values = {name: row[list(TASKS).index(task)] for name, row in PAPER.items()}
    beside = {name: value + _to_goal(name, with_goal) for name, value in values.items() if value}
    physics = ", with other physics of the ant" if task.startswith("ant_") else ""
    lines += ["", f"In the paper{physics}, after {power(paper_steps)} unless said:", "", _line([*beside])]
    lines += [_line(["---"] * len(beside)), _line([*beside.values()]), ""]
    return "\n".join(lines)


def _quartiles(values: pd.Series) -> str:
    """Median, with quartiles if there are several; with fewer runs than seeds, how many."""
    known = values.dropna().astype(float)
    if known.empty:
        return ""
    low, median, high = (
        f"{value:,.{1 if abs(median) < 100 else 0}f}"
        for median in [known.median()]
        for value in known.quantile([0.25, 0.5, 0.75])
    )
    only = "" if len(known) == len(values) else f", {len(known)} run{'s' * (len(known) > 1)}"
    return f"**{median}**" + (f" ({low} to {high}{only})" if len(known) > 1 else only)


def _to_goal(name: str, with_goal: bool) -> str:
    return f" (the goal: {PAPER_STEPS_TO_GOAL[name]})" if with_goal and name in PAPER_STEPS_TO_GOAL else ""


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
