"""What did long runs find on AntMaze and AntTrap? Summaries of run folders, as curves, tables and a picture.

    es-service run configs/ant_maze_me_es.yaml --out RUN --set budget.env_steps=1_000_000_000 \\
        --set budget.generations=null       # and a --set for each of USUAL
    python -m tests.benchmarks.ants RUN [RUN ...] --to FOLDER

Writes into the folder ants.csv, a row per run, ants_curves.csv, up to 60 rows per run, and ants.png: where all
evaluated centres ended, early ones light, and the way of the best one's first episode. Those of our own runs are in
tests/benchmarks/results.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from es_service import open_run
from es_service.protocol.machine import cpu_kind
from es_service.runs.view import Run
from workers.environments import SHIPPED

USUAL = (
    *("policy.hidden=[256,256]", "search.pairs=64", "search.evaluation_episodes=30"),
    *("search.sigma=0.02", "search.step.learning_rate=0.01", "search.step.l2=0.005"),
)
"""The usual settings, which the long runs and their trials have, and before version 0.10.0 the configs of AntMaze."""
POINTS = 60
"""Of a curve."""
NEAR_GOAL_M = 5.0
BEHIND = {"ant_maze": 10.5, "ant_trap": 12.5}
"""x beyond which a centre has got around the wall that stands in the straight way."""
SETTINGS = ("sigma", "learning_rate", "l2", "pairs")
OWN_SETTINGS = {
    "nsra_es": ("fitness_weight_start", "fitness_weight_patience", "fitness_weight_min_gain"),
    "me_es": ("mode", "block_generations", "cell_sampling", "parent_statistics"),
}


def first_steps(history: pd.DataFrame, which: pd.Series) -> float:
    """Environment steps until something first was so; NaN if it never was."""
    return float(history.env_steps[which].iloc[0]) if which.any() else float("nan")


def summary(name: str, run: Run) -> dict[str, Any]:
    """The row of a run."""
    config, history = run.config, run.history
    task, last = config["task"]["environment"], history.iloc[-1]
    search = config["search"] | config["search"].get("step", {})
    best = history.loc[history.centre_fitness_mean.idxmax()]
    settings = (*SETTINGS, *OWN_SETTINGS.get(search["algorithm"], ()))
    row = {
        "run": name,
        "task": task,
        "algorithm": search["algorithm"],
        "seed": config["seed"],
        "settings": " ".join(f"{key}={search[key]}" for key in settings),
        "workers": int(last.workers),
        "env_steps": int(last.env_steps),
        "hours": round(float(last.wall_clock_s) / 3600, 2),
        "generations": int(history.index[-1]),
        "best_return": round(float(last.best_fitness), 1),
        "steps_to_best": int(best.env_steps),
        "best_centre_ends_at": f"{best.centre_x:.1f} {best.centre_y:.1f}",
        "steps_to_behind_the_wall": first_steps(history, history.centre_x > BEHIND[task]),
        "centres_behind_the_wall_percent": round(100 * float((history.centre_x > BEHIND[task]).mean()), 1),
        "cells": round(400 * float(last.coverage)) if "coverage" in history else None,
        "cpu": cpu_kind(),
    }
    if "goal_distance" in history:
        row |= {
            "least_goal_distance_at_the_end_m": round(float(history.goal_distance.min()), 2),
            "steps_to_goal_passed": first_steps(history, history.goal_distance_min < NEAR_GOAL_M),
            "steps_to_ending_at_goal": first_steps(history, history.goal_distance < 2 * NEAR_GOAL_M),
        }
    return row


def curve(name: str, run: Run) -> pd.DataFrame:
    """Up to POINTS rows: what had been reached by then."""
    history = run.history
    columns = {
        "env_steps": history.env_steps,
        "hours": (history.wall_clock_s / 3600).round(3),
        "best_return": history.best_fitness.round(1),
        "farthest_x": history.centre_x.cummax().round(2),
    }
    if "goal_distance" in history:
        columns["least_goal_distance_m"] = history.goal_distance.cummin().round(2)
    if "coverage" in history:
        columns["coverage"] = history.coverage.round(4)
    table = pd.DataFrame(columns)
    chosen = np.unique(np.linspace(0, len(table) - 1, min(POINTS, len(table))).astype(int))
    return table.iloc[chosen].reset_index().assign(run=name)


def best_way(run: Run) -> np.ndarray | None:
    """Of the best centre's first evaluation episode, if it is still in its cell."""
    history = run.history
    best = history.loc[history.centre_fitness_mean.idxmax()]
    if "cell" not in history or pd.isna(best.cell):
        return None
    _, elites = run.elites(lambda snapshot: [int(best.cell)])
    return np.asarray(elites[int(best.cell)].trace_T_B)


def draw(runs: dict[str, Run], path: Path) -> None:
    """A maze per run."""
    columns = min(3, len(runs))
    rows = -(-len(runs) // columns)
    figure, all_axes = plt.subplots(
        rows, columns, figsize=(4.2 * columns, 4.4 * rows), squeeze=False, layout="constrained"
    )
    for axes in all_axes.ravel()[len(runs) :]:
        axes.axis("off")
    for axes, (name, run) in zip(all_axes.ravel(), runs.items(), strict=False):
        history, task = run.history, SHIPPED[run.config["task"]["environment"]]
        order = history.env_steps / 1e6
        shown = axes.scatter(history.centre_x, history.centre_y, c=order, s=3, cmap="viridis_r", linewidths=0)
        for (x0, y0), (x1, y1) in task.walls or ():
            axes.plot((x0, x1), (y0, y1), color="black", linewidth=2.5, solid_capstyle="round")
        if (way := best_way(run)) is not None:
            axes.plot(*way.T, color="#d1495b", linewidth=1.5)
        if task.has_goal:
            axes.plot(35, -25, "*", color="#d1495b", markersize=12)
        axes.set(aspect="equal")
        axes.set_title(f"{name}: best {history.best_fitness.iloc[-1]:,.0f}", fontsize=10)
        figure.colorbar(shown, ax=axes, label="env steps, millions", shrink=0.75)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main(words: Sequence[str] | None = None) -> None:
    """The command line, or other words in its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    # Without a default: runs of a reader are not to take the place of ours.
    parser.add_argument("--to", type=Path, required=True, metavar="FOLDER")
    arguments = parser.parse_args(words)
    runs = {path.name: open_run(path) for path in arguments.runs}
    table = pd.DataFrame([summary(name, run) for name, run in runs.items()])
    print(table.T.to_string())
    arguments.to.mkdir(parents=True, exist_ok=True)
    table.to_csv(arguments.to / "ants.csv", index=False)
    pd.concat([curve(name, run) for name, run in runs.items()]).to_csv(arguments.to / "ants_curves.csv", index=False)
    draw(runs, arguments.to / "ants.png")


if __name__ == "__main__":
    main()
