"""The picture of `science.py`: where the evaluated centres of each method ended, their best return, their map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle

from workers.environments import point_maze as maze

NAMES = {
    "es": "ES",
    "ns_es": "NS-ES",
    "nsr_es": "NSR-ES",
    "nsra_es": "NSRA-ES",
    "me_es": "ME-ES",
    "me_es explore": "ME-ES, explore",
    "me_es exploit": "ME-ES, exploit",
}
COLOURS = {
    "es": "#777777",
    "ns_es": "#d1495b",
    "nsr_es": "#c77d0a",
    "nsra_es": "#1b6ca8",
    "me_es": "#2a7f3f",
    "me_es explore": "#7fb069",
    "me_es exploit": "#7b4fa3",
}
BINS = 50
COLUMNS = 4
CELLS = 400
DECEPTIVE, BEST_KNOWN = -126.4, -24.0

Found = dict[str, Any]


def draw(found: Sequence[Found], path: Path) -> None:
    """One maze per method, all seeds together, and beneath them the curves, one line per seed."""
    methods = [method for method in NAMES if any(run["row"]["method"] == method for run in found)]
    rows = -(-len(methods) // COLUMNS)
    figure = plt.figure(figsize=(3.0 * COLUMNS, 3.3 * rows + 3.4), layout="constrained")
    grid = figure.add_gridspec(rows + 1, COLUMNS, height_ratios=(*[1.0] * rows, 1.05))
    for number, method in enumerate(methods):
        axes = figure.add_subplot(grid[number // COLUMNS, number % COLUMNS])
        _maze(axes, method, [run for run in found if run["row"]["method"] == method])
    half = COLUMNS // 2
    returns, cells = figure.add_subplot(grid[rows, :half]), figure.add_subplot(grid[rows, half:])
    _curves(returns, found, column=1)
    _curves(cells, found, column=2)
    for value, text in ((DECEPTIVE, "dead end, -126.4"), (BEST_KNOWN, "best known, -24")):
        returns.axhline(value, color="black", linewidth=0.8, linestyle=":")
        returns.annotate(text, (returns.get_xlim()[1], value), ha="right", va="bottom", fontsize=9)
    returns.set(ylim=(-200, 0), ylabel="best centre's return so far\n(mean of 30 episodes)")
    cells.set(ylim=(0, CELLS), ylabel=f"filled cells of {CELLS}")
    figure.legend(*returns.get_legend_handles_labels(), loc="outside lower center", ncols=len(methods), frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _maze(axes: Any, method: str, runs: Sequence[Found]) -> None:
    counts = np.zeros((BINS, BINS))
    for run in runs:
        x, y, count = np.array(run["ends"]).T
        counts[x, y] += count
    shown = np.where(counts > 0, counts, np.nan).T
    axes.imshow(shown, origin="lower", extent=(-1, 1, -1, 1), cmap="YlOrBr", norm=LogNorm(), zorder=1)
    half = maze.GOAL_HALF_SIDE
    for wall in (
        Rectangle((maze.LOWER_WALL_FROM_X, maze.LOWER_WALL[0]), 1 - maze.LOWER_WALL_FROM_X, 0.01, color="black"),
        Rectangle((-1, maze.UPPER_WALL[0]), maze.UPPER_WALL_TO_X + 1, 0.01, color="black"),
        Rectangle((maze.GOAL[0] - half, maze.GOAL[1] - half), 2 * half, 2 * half, color="#2e9e4f", zorder=2),
        Rectangle(
            (maze.START_X[0], maze.START_Y[0]),
            maze.START_X[1] - maze.START_X[0],
            maze.START_Y[1] - maze.START_Y[0],
            fill=False,
            edgecolor="#555555",
            linestyle=":",
        ),
    ):
        axes.add_patch(wall)
    for run in runs:
        axes.plot(*np.array(run["way"]).T, color=COLOURS[method], linewidth=1.1, zorder=3)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal", xticks=(), yticks=())
    cells = np.median([run["row"]["map_cells"] for run in runs])
    solved = sum(run["row"]["steps_to_minus_30"] is not None for run in runs)
    axes.set_title(f"{NAMES[method]}\n{solved} of {len(runs)} beyond -30; {cells:.0f} cells", fontsize=10)


def _curves(axes: Any, runs: Sequence[Found], column: int) -> None:
    for run in runs:
        method, curve = run["row"]["method"], np.array(run["curve"])
        first = run["row"]["seed"] == min(o["row"]["seed"] for o in runs if o["row"]["method"] == method)
        label = NAMES[method] if first else None
        line = {"color": COLOURS[method], "linewidth": 1.3, "alpha": 0.9, "label": label}
        axes.step(curve[:, 0] / 1e6, curve[:, column], where="post", **line)
    axes.set(xlim=(0, None), xlabel="environment steps, millions")
    axes.spines[["top", "right"]].set_visible(False)
