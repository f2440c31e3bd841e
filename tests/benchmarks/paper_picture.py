"""The picture of the runs of `paper.py`: both readings of every seed over environment steps, and the paper's values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import pandas as pd

from tests.benchmarks.paper_readings import READINGS, power
from tests.benchmarks.paper_tables import METHODS, PAPER, TASKS

COLOURS = {
    "es": "#777777",
    "ns_es": "#d1495b",
    "nsr_es": "#c77d0a",
    "nsra_es": "#1b6ca8",
    "me_es": "#2a7f3f",
    "memes": "#7b4fa3",
    "map_elites": "#111111",
    "ars": "#8bb8c9",
}
LIMITS = {"point_maze": (-205, -10), "ant_maze": (-62, 3), "ant_trap": (900, 1820)}
"""Limits of the vertical axis for each task; an ant that stands still has 1,000 in AntTrap."""
LANDMARKS = {"point_maze": ("QD-PG", "SAC"), "ant_maze": ("QD-PG", "PGA-ME", "SAC"), "ant_trap": ("QD-PG", "SAC")}
"""Methods of the paper whose values are shown."""


def draw(curves: pd.DataFrame, path: Path) -> None:
    """A column of panels for each task that has runs, a row for each reading.

    A thick line is the median of a method's seeds, where all have a value; thin lines are the single runs.
    """
    tasks = [task for task in TASKS if (curves.task == task).any()]
    size = {"figsize": (4.6 * len(tasks), 6.6), "layout": "constrained"}
    figure, grid = plt.subplots(len(READINGS), len(tasks), squeeze=False, sharex="col", **size)
    for row, reading in enumerate(reversed(READINGS)):
        for axes, task in zip(grid[row], tasks, strict=True):
            _panel(axes, curves[curves.task == task], task, reading)
            axes.set_title(TASKS[task][0].replace(": ", "\n") if row == 0 else "", fontsize=11)
        grid[row, 0].set_ylabel({"centre": "mean of a centre's episodes", "single": "one episode"}[reading])
    for axes in grid[-1]:
        axes.set_xlabel("environment steps")
    lines = {line.get_label(): line for axes in grid.flat for line in axes.get_lines() if line.get_label()[0] != "_"}
    names = [name for name in METHODS.values() if name in lines]
    columns = min(len(names), 3 * len(tasks))
    figure.legend([lines[name] for name in names], names, loc="outside lower center", ncols=columns, frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def _panel(axes: Any, curves: pd.DataFrame, task: str, reading: str) -> None:
    for method, name in METHODS.items():
        runs = curves[curves.method == method].pivot(index="env_steps", columns="seed", values=reading)
        if runs.empty:
            continue
        axes.plot(runs.index, runs, color=COLOURS[method], linewidth=0.6, alpha=0.5)
        axes.plot(runs.index, runs.median(axis=1, skipna=False), color=COLOURS[method], linewidth=2.0, label=name)
    axes.set(xscale="log", ylim=LIMITS[task])
    for name in LANDMARKS[task]:
        text = PAPER[name][list(TASKS).index(task)]
        value = float(text.split()[0])
        axes.axhline(value, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(
            f"{name} in the paper after {power(TASKS[task][1])}: {value:g}",
            (0.01, value),
            xycoords=("axes fraction", "data"),
            va="bottom",
            fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1},
        )
    axes.spines[["top", "right"]].set_visible(False)
