"""The picture of `science.py`: where the evaluated centres of each algorithm ended, and their best return over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle

from workers.environments import point_maze as maze

if TYPE_CHECKING:
    from tests.benchmarks.science import Found

NAMES = {"es": "ES", "ns_es": "NS-ES", "nsr_es": "NSR-ES", "nsra_es": "NSRA-ES"}
COLOURS = {"es": "#777777", "ns_es": "#d1495b", "nsr_es": "#c77d0a", "nsra_es": "#1b6ca8"}
BINS = 50
DECEPTIVE, BEST_KNOWN = -126.4, -24.0


def draw(found: Sequence[Found], path: Path) -> None:
    """One maze per algorithm, all seeds together, and beneath them the curves, one line per seed."""
    algorithms = list(dict.fromkeys(one.row["algorithm"] for one in found))
    figure = plt.figure(figsize=(3.1 * len(algorithms), 6.6), layout="constrained")
    grid = figure.add_gridspec(2, len(algorithms), height_ratios=(1.0, 0.95))
    for column, algorithm in enumerate(algorithms):
        _maze(
            figure.add_subplot(grid[0, column]), algorithm, [one for one in found if one.row["algorithm"] == algorithm]
        )
    _curves(figure.add_subplot(grid[1, :]), found)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _maze(axes: Any, algorithm: str, found: Sequence[Found]) -> None:
    ends = np.concatenate([one.ends_N_2 for one in found])
    axes.hist2d(*ends.T, bins=BINS, range=((-1, 1), (-1, 1)), cmap="YlOrBr", norm=LogNorm(), zorder=1)
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
    for one in found:
        axes.plot(*one.way_T_2.T, color=COLOURS[algorithm], linewidth=1.1, zorder=3)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal", xticks=(), yticks=())
    third = np.mean([one.row["chamber_3_percent"] for one in found])
    axes.set_title(f"{NAMES[algorithm]}\n{third:.1f} % of centres in the last chamber", fontsize=10)


def _curves(axes: Any, found: Sequence[Found]) -> None:
    for one in found:
        name = one.row["algorithm"]
        steps, best = one.curve_N_2.T
        label = NAMES[name] if one.row["seed"] == min(o.row["seed"] for o in found) else None
        axes.step(steps / 1e6, best, where="post", color=COLOURS[name], linewidth=1.4, alpha=0.9, label=label)
    for value, text in ((DECEPTIVE, "dead end, -126.4"), (BEST_KNOWN, "best known, -24")):
        axes.axhline(value, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(text, (axes.get_xlim()[1], value), ha="right", va="bottom", fontsize=9)
    axes.set(ylim=(-200, 0), xlim=(0, None), xlabel="environment steps, millions")
    axes.set_ylabel("best centre's return so far\n(mean of 30 episodes)")
    axes.legend(loc="center right", ncols=len(NAMES), frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
