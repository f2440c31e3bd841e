"""Files of figures for a paper: each as SVG and as PNG."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from es_service.errors import ConfigError, StoreError, WayOut
from es_service.report import compare, plots
from es_service.report.colours import value_range
from es_service.report.data import RunData
from es_service.report.overview import draw_overview

DPI = 200
SIZE = (4.6, 3.4)
"""Width and height of a figure in inches."""


def empty_figure() -> Any:
    """A figure of matplotlib that draws into files, whatever a notebook draws into. Raises ConfigError without it."""
    try:
        made_by = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        ways_out = [WayOut("install", "install it", extra="figures")]
        raise ConfigError("figures need matplotlib", field="figures", ways_out=ways_out) from error
    return made_by.Figure(figsize=SIZE, layout="compressed")


def write_figures(
    runs: Sequence[RunData], folder: Path, keys: Sequence[str] = (), threshold: float | None = None
) -> list[Path]:
    """Write all figures of one run, or of the comparison of several; return the files.

    Args:
        keys: config keys that group the runs.
        threshold: fitness from which a run of a comparison counts as solved; see `draw_overview`.

    Raises:
        ConfigError: matplotlib is missing, or the runs cannot be compared. StoreError: the folder cannot be written.
    """
    drawings: dict[str, Callable[[Any], Any]] = {}
    for column in compare.COLUMNS:
        if all(column in run.history for run in runs):
            drawings[column] = lambda figure, column=column: plots.curves(
                list(runs), figure.subplots(), column, group_by=keys
            )
    mapped = [run for run in runs if run.map is not None and run.map.size and len(run.names) <= 2]
    if len(runs) == 1:
        if mapped:
            drawings["behaviour_map"] = lambda figure: _map(mapped[0], figure.subplots())
            if len(mapped[0].names) == 2:
                drawings["trajectory"] = lambda figure: _path(mapped[0], figure.subplots())
        drawings["centres"] = lambda figure: figure.colorbar(plots.centres(runs[0], figure.subplots()), label="fitness")
    else:
        drawings["overview"] = lambda figure: draw_overview(runs, figure, keys, threshold)
        drawings["profile"] = lambda figure: plots.profile(list(runs), figure.subplots(), group_by=keys)
        if mapped:
            colours = value_range(np.concatenate([run.map.fitness_N for run in mapped if run.map is not None]))
            for index, group in enumerate(compare.grouped(runs, keys)):
                if (run := compare.median_run(group)) in mapped:
                    drawings[f"behaviour_map_{index}"] = lambda figure, run=run, name=group.name: _map(
                        run, figure.subplots(), colours, name
                    )
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, draw in drawings.items():
            figure = empty_figure()
            draw(figure)
            for kind in ("svg", "png"):
                written.append(folder / f"{name}.{kind}")
                figure.savefig(written[-1], dpi=DPI)
    except OSError as error:
        raise StoreError(f"cannot write into {folder}: {error.strerror or error}; choose another folder") from error
    return written


def _map(run: RunData, axes: Any, colours: tuple[float, float] | None = None, title: str = "") -> None:
    axes.figure.colorbar(plots.behaviour_map(run, axes, colours), label="fitness")
    axes.set_title(title, parse_math=False)  # a name may contain a $


def _path(run: RunData, axes: Any) -> None:
    _map(run, axes)
    plots.trajectory(run, axes)
