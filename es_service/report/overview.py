"""One figure of a comparison, for a README or a talk: where the centres of all groups ended, and curves beneath."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from es_service.errors import counted
from es_service.report import compare, plots
from es_service.report.colours import value_range
from es_service.report.data import RunData
from es_service.report.measures import CERTIFIED, has_curve, measures

PANELS_IN_A_ROW = 6
PANEL_SIZE = 1.7
"""Width of a panel in inches; its title is above it."""
CURVES_HEIGHT = 2.4
DOT_AREA = 2.5
"""In square points."""
FEWEST_COLUMNS = 4
"""So many panels wide is the figure at least, or the curves were too narrow."""
CURVES = (CERTIFIED, "best_fitness", "coverage")


def draw_overview(
    runs: Sequence[RunData], figure: Any, keys: Sequence[str] = (), threshold: float | None = None
) -> None:
    """Draw all evaluated centres of each group, the runs of a group on top of each other, and under them the curves.

    The colours are fitness, the same in all panels; where centres overlap, the fittest is seen.

    Args:
        figure: an empty figure of matplotlib, whose size is changed.
        keys: config keys that group the runs; see `compare.grouped`.
        threshold: fitness from which a run counts as solved; None: the target fitness of all runs, if there is one.
    """
    threshold = compare.common_threshold(runs) if threshold is None else threshold
    summaries = compare.summaries(compare.grouped(runs, keys), threshold)
    columns = [column for column in CURVES if column in measures(runs) and has_curve(runs, column)]
    wide = max(FEWEST_COLUMNS, min(PANELS_IN_A_ROW, len(summaries)))
    rows = -(-len(summaries) // wide)
    figure.set_size_inches(wide * PANEL_SIZE, rows * (PANEL_SIZE + 0.5) + CURVES_HEIGHT)
    figure.set_layout_engine("constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(rows * (PANEL_SIZE + 0.5), CURVES_HEIGHT))
    colours = value_range(np.concatenate([run.centres["fitness_mean"] for run in runs]))
    panels, drawn = above.subplots(rows, wide, squeeze=False).ravel(), []
    for axes, summary in zip(panels, summaries, strict=False):
        count = len(summary.group.runs)
        solved = "" if threshold is None else f"{summary.solved} of {count} reach {threshold:g}"
        drawn += [plots.centres(run, axes, colours) for run in summary.group.runs]
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
        axes.set_title(f"{summary.group.name}\n{solved or counted(count, 'run')}", fontsize=9, parse_math=False)
    for axes in panels[len(summaries) :]:
        axes.set_axis_off()
    for points in drawn:
        points.set_sizes([DOT_AREA])
    above.colorbar(drawn[-1], ax=panels, label="fitness", aspect=30, fraction=0.02, pad=0.01)
    curves = below.subplots(1, len(columns), squeeze=False).ravel()
    for axes, column in zip(curves, columns, strict=True):
        plots.curves(list(runs), axes, column, group_by=keys)
    if len(summaries) > 1:
        handles, labels = curves[0].get_legend_handles_labels()
        for axes in curves:
            axes.get_legend().remove()
        legend = below.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
        for text in legend.get_texts():
            text.set_parse_math(False)
