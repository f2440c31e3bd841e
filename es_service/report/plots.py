"""Figures for papers and notebooks: functions that draw a run into an Axes of matplotlib.

    from es_service import open_run, plots
    plots.behaviour_map(open_run("runs/a"), axes)

`run` is what `open_run` returns, or the folder of a run. matplotlib is an extra: figures.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from es_service.config.text import unknown_name
from es_service.errors import ConfigError, NotInRunError
from es_service.protocol.machine import given_path
from es_service.report import between, compare, maps, statistics
from es_service.report.data import RunData, read_run
from es_service.report.floor import beside_walls, detours, is_plan
from es_service.report.markup import tick_text, value_range
from es_service.report.measures import measure_named
from es_service.report.series import X_AXES, axes_of, lone
from es_service.runs.selection import LEVEL
from es_service.runs.view import Run
from es_service.search.maps.geometry import Cvt, Dominated, Grid, Tessellation, intervals

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RunSource = Run | RunData | str | os.PathLike[str]
Several = list[RunSource] | list[RunData] | tuple[RunSource, ...]
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#59626d")
DASHES = ("-", "--", ":", "-.", (0, (3, 1)), (0, (8, 2)), (0, (6, 2, 1, 2, 1, 2)))
WALL, PATH = "#1d2126", "#d55e00"
DOT_AREA = (2.5, 12.0)
"""Least and greatest area of a dot in square points; all dots of a panel have DOTS_AREA, if that is between."""
DOTS_AREA = 3000.0


def behaviour_map(run: RunSource, axes: Axes, colours: tuple[float, float] | None = None) -> Any:
    """Draw the behaviour map of a run with a descriptor of one or two dimensions, with its walls and its goal.

    A cvt map of two dimensions has a hexagon for each elite, at the centroid of its cell. If the task has walls, it is
    at the elite's descriptor, since the centroid may be on the other side of a wall. Those of a dominated map always
    are; in one dimension, the other axis is their fitness.

    Args:
        colours: fitness of the first and last colour; None: those of this map.

    Returns:
        what `Figure.colorbar` takes. Raises NotInRunError without a map, or for more dimensions.
    """
    data = _data(run)
    if data.map is None or len(data.names) > 2:
        what = f"a map of {len(data.names)} dimensions, of which no plot is made"
        if data.map is None:
            what = "no finished generation yet" if not data.history["generation"].size else "no behaviour map"
        raise NotInRunError(f"{data.folder} has {what}", run=data.folder)
    map_, geometry = data.map, data.map.geometry
    low, high = colours or value_range(map_.fitness_N)
    collections = importlib.import_module("matplotlib.collections")
    style: dict[str, Any] = {
        "cmap": "viridis",
        "norm": importlib.import_module("matplotlib.colors").Normalize(low, high),
    }
    if len(data.names) == 1:
        if isinstance(geometry, Dominated):
            shapes = axes.scatter(map_.descriptor_N_B[:, 0], map_.fitness_N, c=map_.fitness_N, **style)
        else:
            shapes = collections.PolyCollection(_bars(data, geometry), array=map_.fitness_N, **style)
            axes.add_collection(shapes)
        axes.set(xlim=data.bounds[0])
        _name_axes(axes, data.names[0], "fitness")
        axes.set_ylim(min(low, float(map_.fitness_N.min(initial=low))), high)
        return shapes
    _plane(data, axes)
    if isinstance(geometry, Grid):
        filled, parts = np.full(geometry.shape, np.nan), beside_walls(map_, data.task)
        fitness_of = dict(zip(map_.cell_N.tolist(), map_.fitness_N.tolist(), strict=True))
        for cell in fitness_of.keys() - parts:
            filled[geometry.index_of(cell)] = fitness_of[cell]
        corners = [[(left, low), (right, low), (right, high), (left, high)]
                   for (left, right), (low, high) in parts.values()]  # fmt: skip
        beside = np.array([fitness_of[cell] for cell in parts])
        axes.add_collection(collections.PolyCollection(corners, array=beside, zorder=1.1, **style))
        return axes.pcolormesh(*geometry.edges, filled.T, zorder=1, rasterized=True, **style)
    place_N_2 = np.clip(map_.descriptor_N_B, *np.transpose(data.bounds))
    if isinstance(geometry, Cvt) and not data.task.walls:
        place_N_2 = geometry.centroid_C_B[map_.cell_N]
    return axes.scatter(*place_N_2.T, c=map_.fitness_N, marker="h", zorder=1, **style)


def centres(run: RunSource, axes: Axes, colours: tuple[float, float] | None = None) -> Any:
    """Draw all evaluated centres, or policies, at the first two dimensions of their descriptors, coloured by fitness.

    With one dimension, the vertical axis is fitness. Where centres overlap, the fittest is seen.

    Args:
        colours: fitness of the first and last colour; None: those of this run.

    Returns:
        what `Figure.colorbar` takes.
    """
    data = _data(run)
    order = np.argsort(data.centres["fitness_mean"], kind="stable")
    x, fitness = data.centres[data.names[0]][order], data.centres["fitness_mean"][order]
    if len(data.names) == 1:
        y = fitness
        axes.set(xlim=data.bounds[0])
        _name_axes(axes, data.names[0], "fitness")
    else:
        y = data.centres[data.names[1]][order]
        _plane(data, axes)
    low, high = colours or value_range(fitness)
    return axes.scatter(
        x,
        y,
        c=fitness,
        cmap="viridis",
        vmin=low,
        vmax=high,
        s=dot_area(len(x)),
        linewidths=0,
        zorder=2,
        clip_on=False,
        rasterized=True,
    )


def dot_area(count: int) -> float:
    """Area in square points of each of so many dots: few ones are seen in print, and many do not cover each other."""
    return float(np.clip(DOTS_AREA / max(count, 1), *DOT_AREA))


def trajectory(run: RunSource, axes: Axes, cell: int | Sequence[int] | None = None, **style: Any) -> None:
    """Draw the path of an elite's first evaluation episode: a line through the points that the run stored.

    Where a wall is between two of them, the shortest way round it is dashed; see `es_service.report.floor`.

    Args:
        cell: place of the elite's cell; None: that of the fittest elite.
        style: passed on to `Axes.plot`.

    Raises NotInRunError for an empty or missing cell, or a descriptor without two dimensions.
    """
    data = _data(run)
    opened = Run(data.folder)
    if len(data.names) != 2:
        raise NotInRunError(f"the descriptor of {data.folder} is no place in the plane", run=data.folder)
    if cell is None:
        map_ = opened.behaviour_map
        if not map_.size:
            raise NotInRunError(f"the map of {data.folder} is empty", run=data.folder)
        cell = map_.geometry.index_of(int(map_.cell_N[map_.fitness_N.argmax()]))
    _plane(data, axes)
    path_T_2 = opened.elite(cell).trace_T_B
    detours_at = detours(path_T_2, data.task, data.bounds)
    gaps = [at + 1 for at in detours_at]
    [line] = axes.plot(
        *np.insert(path_T_2, gaps, np.nan, axis=0).T, **{"color": PATH, "linewidth": 1.4, "zorder": 4} | style
    )
    for at, place_N_2 in detours_at.items():
        if len(place_N_2):
            [dashed] = axes.plot(*np.concatenate([path_T_2[at, None], place_N_2, path_T_2[at + 1, None]]).T)
            dashed.update_from(line)
            dashed.set(linestyle="--", label="_a part of the path")


def curves(
    runs: RunSource | Several,
    axes: Axes,
    column: str = "best_fitness",
    against: str = "env_steps",
    group_by: Sequence[str] = (),
) -> None:
    """Draw a history column: of one run as a line, of several as the median of each group.

    A shaded region is the interval of the median that a comparison page draws, by `statistics.median_interval`; a group
    with one seed, or with several runs of the same seed, has none.

    Args:
        against: `generation`, `env_steps`, `wall_clock_s`, `rollout_s` or `cpu_s`.
        group_by: config keys that group the runs; see `compare.grouped`.

    Raises ConfigError for another column or axis, and for runs of different tasks, and NotInRunError for a run without
    a finished generation.
    """
    all_data = [_data(source) for source in (runs if isinstance(runs, list | tuple) else [runs])]
    for data in all_data:
        if not data.history["generation"].size:
            raise NotInRunError(f"{data.folder} has no finished generation yet", run=data.folder)
    allowed = [name for name in X_AXES if all(name in axes_of(data.history) for data in all_data)]
    if against not in allowed:
        raise unknown_name("axis", against, allowed, "against")
    if any(column not in data.history for data in all_data):
        of_first = ", ".join(all_data[0].history)
        raise ConfigError(f"{column} is no history column of all runs", value=column, allowed=of_first)
    groups = compare.grouped(all_data, group_by)
    x_K = compare.places(groups, against)
    for index, group in enumerate(groups):
        style = _style(index)
        if len(all_data) == 1:
            _curve(axes, group.runs[0].history[against], group.runs[0].history[column], style)
            continue
        y_R_K = compare.values_at(group, column, against, x_K)
        _curve(axes, x_K, np.median(y_R_K, axis=0), style | {"label": group.name})
        if (interval_2_K := group.interval(y_R_K)) is not None:
            axes.fill_between(x_K, *interval_2_K, color=style["color"], alpha=0.18, linewidth=0)
    axes.set(xlabel=X_AXES[against], ylabel=measure_named(column).label)
    if against == "env_steps":
        axes.xaxis.set_major_formatter(importlib.import_module("matplotlib.ticker").EngFormatter(sep=""))
    _frame(axes, legend=len(groups) > 1, lines="median")


def profile(runs: Several, axes: Axes, measure: str = "best_fitness", group_by: Sequence[str] = ()) -> None:
    """Draw performance profiles: the share of the runs of a group that are at least as good as each value of a measure.

    A shaded region is the bootstrap interval at each value by itself; see `statistics.profile`.

    Args:
        measure: name of a measure of `between.values`, such as `certified`, `best_fitness` or `coverage`.
        group_by: config keys that group the runs; see `compare.grouped`.

    Raises ConfigError for a measure that a run lacks, and for runs of different tasks.
    """
    groups = compare.grouped([_data(source) for source in runs], group_by)
    title, sign, values = between.values(groups, measure)
    place_K = np.unique(np.concatenate([task_R for of_group in values for task_R in of_group]))
    place_K = place_K[np.isfinite(place_K)]
    for index, (group, values_R) in enumerate(zip(groups, values, strict=True)):
        style = _style(index)
        signed, sign_K = [sign * task_R for task_R in values_R], sign * place_K
        steps: dict[str, Any] = {"step": "pre" if sign > 0 else "post"}
        axes.step(place_K, statistics.profile(signed, sign_K), where=steps["step"], label=group.name, **style)
        if (ends_2_K := statistics.profile_interval(signed, sign_K)) is not None:
            axes.fill_between(place_K, *ends_2_K, color=style["color"], alpha=0.18, linewidth=0, **steps)
    axes.set(ylim=(-0.02, 1.02), ylabel=f"share of runs at {'least' if sign > 0 else 'most'} here")
    axes.set_xlabel(title, parse_math=False)
    _frame(axes, legend=True, lines="share")


def archive_profile(runs: RunSource | Several, axes: Axes, group_by: Sequence[str] = ()) -> None:
    """Draw archive profiles: the share of the cells of a map whose elite has at least each fitness.

    Of several runs, the median of each group, with its interval as in `curves`. Raises NotInRunError for a run without
    a map.
    """
    all_data = [_data(source) for source in (runs if isinstance(runs, list | tuple) else [runs])]
    for data in all_data:
        if data.map is None or not data.map.size:
            raise NotInRunError(f"{data.folder} has no behaviour map with elites", run=data.folder)
    groups = compare.grouped(all_data, group_by)
    low, high = value_range(np.concatenate([data.map.fitness_N for data in all_data if data.map is not None]))
    fitness_K = np.linspace(low, high, compare.POINTS)
    for index, group in enumerate(groups):
        share_R_K = np.stack([maps.profile(run.map, fitness_K) for run in group.runs if run.map is not None])
        axes.plot(fitness_K, np.median(share_R_K, axis=0), label=group.name, **_style(index))
        if (interval_2_K := group.interval(share_R_K)) is not None:
            axes.fill_between(fitness_K, *interval_2_K, color=_style(index)["color"], alpha=0.18, linewidth=0)
    axes.set(ylim=(0, None), xlabel="fitness", ylabel="share of cells with at least this fitness")
    _frame(axes, legend=len(groups) > 1, lines="median")


def snapshots(run: RunSource, figure: Any, count: int = 4) -> Any:
    """Draw the map of a run at equal intervals of its environment steps, side by side, the last at its end.

    Each map is that of all evaluated centres until then; see `maps.until`.

    Args:
        figure: an empty figure of matplotlib, or a part of one.

    Returns:
        what `Figure.colorbar` takes. Raises NotInRunError as `behaviour_map`, and for a dominated map.
    """
    data = _data(run)
    steps_G, generation_G = data.history["env_steps"], data.history["generation"]
    if data.map is None or not steps_G.size:
        raise NotInRunError(f"{data.folder} has no behaviour map", run=data.folder)
    if isinstance(data.map.geometry, Dominated):
        what = "a dominated map, whose earlier elites do not follow from what was evaluated until then alone"
        raise NotInRunError(f"{data.folder} has {what}", run=data.folder)
    colours, drawn = value_range(data.map.fitness_N), None
    panels = figure.subplots(1, count, squeeze=False, sharey=True).ravel()
    for k, axes in enumerate(panels):
        row = int(np.searchsorted(steps_G, steps_G[-1] * (k + 1) / count))
        shown = data if k == count - 1 else maps.until(data, int(generation_G[row]))
        drawn = behaviour_map(shown, axes, colours)
        axes.set_title(f"{tick_text(float(steps_G[row]), 1.0)} steps", fontsize=9)
        axes.label_outer()
    return drawn


def _style(index: int) -> dict[str, Any]:
    """How the line of a group is drawn."""
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[index % len(DASHES)], "linewidth": 1.6}


def _frame(axes: Axes, *, legend: bool, lines: str) -> None:
    """No lines above and on the right, and a legend whose title says what lines and shaded regions are."""
    axes.spines[["top", "right"]].set_visible(False)
    if legend:
        title = f"{lines}, {100 * LEVEL:.0f} % interval" if axes.collections else lines
        for text in axes.legend(frameon=False, title=title, alignment="left").get_texts():
            text.set_parse_math(False)


def _curve(axes: Axes, x_K: NDArray[np.float64], y_K: NDArray[np.float64], style: dict[str, Any]) -> None:
    """A line through points, with a dot for each that has no neighbour."""
    [line] = axes.plot(x_K, y_K, **style)
    if (lone_K := lone(x_K, y_K)).any():
        line.set(marker="o", markersize=4, markevery=np.flatnonzero(lone_K).tolist())


def _data(run: RunSource) -> RunData:
    if isinstance(run, RunData):
        return run
    return read_run(run.folder if isinstance(run, Run) else given_path(run), paths=False, digest=False)


def _bars(data: RunData, geometry: Tessellation) -> list[list[tuple[float, float]]]:
    assert data.map is not None
    ends_N_2, floor = intervals(geometry)[data.map.cell_N].tolist(), value_range(data.map.fitness_N)[0]
    return [
        [(low, floor), (low, fitness), (high, fitness), (high, floor)]
        for (low, high), fitness in zip(ends_N_2, data.map.fitness_N.tolist(), strict=True)
    ]


def _name_axes(axes: Axes, x: str, y: str) -> None:
    """Label both axes; what a user named is never read as a formula."""
    axes.set_xlabel(x, parse_math=False)
    axes.set_ylabel(y, parse_math=False)


def _plane(data: RunData, axes: Axes) -> None:
    """The plane of the first two dimensions, its walls and its goal."""
    axes.set(xlim=data.bounds[0], ylim=data.bounds[1])
    _name_axes(axes, *data.names[:2])
    if not is_plan(data.task, data.names):
        return
    axes.set_aspect("equal")
    for start, end in data.task.walls or ():
        axes.plot(*np.transpose([start, end]), color=WALL, linewidth=1.5, solid_capstyle="butt", zorder=3)
    if data.task.goal is not None:
        axes.plot(*data.task.goal, "o", markerfacecolor="none", markeredgecolor=PATH, markersize=9, markeredgewidth=2,
                  zorder=3)  # fmt: skip
