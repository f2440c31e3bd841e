"""Files of figures for a paper, each as SVG, PDF and PNG; one of them is the overview of a comparison."""

from __future__ import annotations

import importlib
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from es_service.errors import ConfigError, StoreError, WayOut, counted
from es_service.report import compare, plots
from es_service.report.data import RunData
from es_service.report.maps import have_same_cells, over_seeds
from es_service.report.markup import value_range
from es_service.report.measures import CERTIFIED, chosen, has_curve, measures

# One figure of a comparison, for a README or a talk: where the centres of all groups ended, and curves beneath.

GROUPS_IN_A_ROW = 6
PANEL_SIZE = 1.7
"""Width of a panel in inches; its title is above it."""
CURVES_HEIGHT = 2.4
FEWEST_COLUMNS = 4
"""So many panels wide is the figure at least, or the curves were too narrow."""
CURVES = (CERTIFIED, "best_fitness", "coverage")


def draw_overview(
    runs: Sequence[RunData],
    figure: Any,
    keys: Sequence[str] = (),
    threshold: float | None = None,
    against: str = "env_steps",
) -> None:
    """Draw all evaluated centres of each group, the runs of a group on top of each other, and under them the curves.

    The colours are fitness, the same in all panels; where centres overlap, the fittest is seen.

    Args:
        figure: an empty figure of matplotlib, whose size is changed.
        keys: config keys that group the runs; see `compare.grouped`.
        threshold: fitness from which a run counts as solved; None: the target fitness of all runs, if there is one.
        against: as in `plots.curves`.
    """
    threshold = compare.common_threshold(runs) if threshold is None else threshold
    summaries = compare.summaries(compare.grouped(runs, keys), threshold)
    columns = [column for column in CURVES if column in measures(runs) and has_curve(runs, column)]
    across = min(GROUPS_IN_A_ROW, len(summaries))
    rows = -(-len(summaries) // across)
    figure.set_size_inches(max(FEWEST_COLUMNS, across) * PANEL_SIZE, rows * (PANEL_SIZE + 0.5) + CURVES_HEIGHT)
    figure.set_layout_engine("constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(rows * (PANEL_SIZE + 0.5), CURVES_HEIGHT))
    colours = value_range(np.concatenate([run.centres["fitness_mean"] for run in runs]))
    panels, drawn = above.subplots(rows, across, squeeze=False).ravel(), []
    for axes, summary in zip(panels, summaries, strict=False):
        count = len(summary.group.runs)
        solved = "" if threshold is None else f"{summary.solved} of {count} reach {threshold:g}"
        drawn += [plots.centres(run, axes, colours) for run in summary.group.runs]
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
        axes.set_title(f"{summary.group.name}\n{solved or counted(count, 'run')}", fontsize=9, parse_math=False)
    for axes in panels[len(summaries) :]:
        axes.set_axis_off()
    most = max(sum(len(run.centres["fitness_mean"]) for run in summary.group.runs) for summary in summaries)
    for points in drawn:
        points.set_sizes([plots.dot_area(most)])
    above.colorbar(drawn[-1], ax=panels, label="fitness", aspect=30, fraction=0.02, pad=0.01)
    curves = below.subplots(1, len(columns), squeeze=False).ravel()
    for axes, column in zip(curves, columns, strict=True):
        plots.curves(list(runs), axes, column, against, keys)
    if len(summaries) > 1:
        handles, labels = curves[0].get_legend_handles_labels()
        title = curves[0].get_legend().get_title().get_text()
        for axes in curves:
            axes.get_legend().remove()
        legend = below.legend(
            handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, title=title
        )
        for text in legend.get_texts():
            text.set_parse_math(False)


DPI = 300
KINDS = ("svg", "pdf", "png")
COLUMN, PAGE = 3.4, 7.0
"""Width of a figure in inches: in a column, and over both columns of a page."""
SIZE = (COLUMN, 2.6)
"""Width and height of a figure in inches, unless it has several panels."""
PANELS_IN_A_ROW, SMALL_PANELS_IN_A_ROW = 4, 7
FEW = 8
"""With more groups, their maps are small."""
STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "legend.title_fontsize": 7,
    "lines.linewidth": 1.2,
    "pdf.fonttype": 42,
}
"""Sizes of text as in a paper; text in a PDF stays text."""


def empty_figure() -> Any:
    """A figure of matplotlib that draws into files, whatever a notebook draws into. Raises ConfigError without it."""
    try:
        made_by = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        ways_out = [WayOut("install", "install it", extra="figures")]
        raise ConfigError("figures need matplotlib", field="figures", ways_out=ways_out) from error
    return made_by.Figure(figsize=SIZE, layout="compressed")


def write_figures(
    runs: Sequence[RunData],
    folder: Path,
    keys: Sequence[str] = (),
    threshold: float | None = None,
    metrics: Sequence[str] = (),
    against: str = "env_steps",
) -> list[Path]:
    """Write all figures of one run, or of the comparison of several; return the files.

    Args:
        keys: config keys that group the runs.
        threshold: fitness from which a run of a comparison counts as solved; see `draw_overview`.
        metrics: columns of which curves and profiles are drawn; none: curves of all of `measures`, and a profile of the
            value by which runs are judged.
        against: axis of the curves; see `plots.curves`.

    Raises:
        ConfigError: matplotlib is missing, the runs cannot be compared, or one lacks a metric. StoreError: the folder
            cannot be written.
    """
    drawings: dict[str, Callable[[Any], Any]] = {}
    for column in chosen(runs, metrics):
        if has_curve(runs, column):
            drawings[column] = lambda figure, column=column: plots.curves(
                list(runs), figure.subplots(), column, against, keys
            )
    mapped = [run for run in runs if run.map is not None and run.map.size and len(run.names) <= 2]
    if mapped:
        drawings["archive_profile"] = lambda figure: plots.archive_profile(mapped, figure.subplots(), keys)
    if len(runs) == 1:
        if mapped:
            drawings["behaviour_map"] = lambda figure: _map(mapped[0], figure.subplots())
            if mapped[0].constants["map.kind"] != "dominated":
                drawings["behaviour_map_over_time"] = lambda figure: _snapshots(mapped[0], figure)
            if len(mapped[0].names) == 2:
                drawings["trajectory"] = lambda figure: _path(mapped[0], figure.subplots())
        drawings["centres"] = lambda figure: figure.colorbar(plots.centres(runs[0], figure.subplots()), label="fitness")
    else:
        if len({run.constants["task.environment"] for run in runs}) == 1:
            drawings["overview"] = lambda figure: draw_overview(runs, figure, keys, threshold, against)
        for column in metrics or [compare.value_column(runs)]:
            drawings[f"profile_{column}" if metrics else "profile"] = lambda figure, column=column: plots.profile(
                list(runs), figure.subplots(), column, keys
            )
        groups = compare.grouped(runs, keys)
        if len(mapped) == len(runs):
            drawings["behaviour_maps"] = lambda figure: _grid(figure, [
                (group.name, compare.median_run(group)) for group in groups
            ], "fitness")  # fmt: skip
        if all(have_same_cells(group.runs) for group in groups):
            drawings["behaviour_maps_median"] = lambda figure: _grid(figure, [
                (group.name, over_seeds(group.runs, "median")) for group in groups
            ], "median fitness")  # fmt: skip
            drawings["behaviour_maps_filled"] = lambda figure: _grid(figure, [
                (group.name, over_seeds(group.runs, "share")) for group in groups
            ], "share of runs", (0.0, 1.0))  # fmt: skip
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, draw in drawings.items():
            with importlib.import_module("matplotlib").rc_context(STYLE):
                figure = empty_figure()
                draw(figure)
                for kind in KINDS:
                    # A column may be named after a task of a stranger's run, and no name from there is a path.
                    written.append(folder / f"{re.sub(r'[^a-zA-Z0-9]+', '_', name)}.{kind}")
                    figure.savefig(written[-1], dpi=DPI)
    except OSError as error:
        raise StoreError(f"cannot write into {folder}: {error.strerror or error}; choose another folder") from error
    return written


def _map(run: RunData, axes: Any) -> None:
    axes.figure.colorbar(plots.behaviour_map(run, axes), label="fitness")


def _grid(
    figure: Any, shown: Sequence[tuple[str, RunData]], label: str, colours: tuple[float, float] | None = None
) -> None:
    """Maps with their titles in rows, all with the same colours, and one bar of colours."""
    maps = [run.map for _, run in shown if run.map is not None]
    colours = colours or value_range(np.concatenate([map_.fitness_N for map_ in maps]))
    in_a_row = PANELS_IN_A_ROW if len(shown) <= FEW else SMALL_PANELS_IN_A_ROW
    across, panel = min(in_a_row, len(shown)), PAGE / in_a_row
    rows = -(-len(shown) // across)
    figure.set_size_inches(max(COLUMN, across * panel), rows * (panel + 0.25))
    figure.set_layout_engine("constrained")
    panels, drawn = figure.subplots(rows, across, squeeze=False).ravel(), None
    for axes, (name, run) in zip(panels, shown, strict=False):
        drawn = plots.behaviour_map(run, axes, colours)
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
        # A name may contain a $, which matplotlib takes for a formula where it wraps lines itself.
        size, letters = (8, 38) if len(shown) <= FEW else (5, 26)
        axes.set_title(textwrap.fill(name, letters), parse_math=False, fontsize=size)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    figure.colorbar(drawn, ax=panels, label=label, aspect=30, fraction=0.03, pad=0.02)


def _snapshots(run: RunData, figure: Any) -> None:
    figure.set_size_inches(PAGE, PAGE / PANELS_IN_A_ROW + 0.4)
    figure.set_layout_engine("constrained")
    drawn = plots.snapshots(run, figure, PANELS_IN_A_ROW)
    figure.colorbar(drawn, ax=figure.axes, label="fitness", aspect=30, fraction=0.03, pad=0.02)


def _path(run: RunData, axes: Any) -> None:
    _map(run, axes)
    plots.trajectory(run, axes)
