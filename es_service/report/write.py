"""Writing of reports: which file, from which data; and the small page that a notebook shows."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from es_service.errors import ConfigError, ServiceError, StoreError, WayOut
from es_service.protocol.machine import given_path
from es_service.report import between, compare, curves, maps, series
from es_service.report.compare_page import comparison_page
from es_service.report.data import RunData, read_run
from es_service.report.figures import empty_figure, write_figures
from es_service.report.markup import tag, value_range
from es_service.report.page import EvaluateText, document, run_page, run_title
from es_service.report.replays import MOST_CELLS, replay_section
from es_service.report.summary import verdict
from es_service.runs.run_status import state
from es_service.runs.view import Run

REPORT = "report.html"
"""Name of a run's report in its folder."""
AnyPath = str | os.PathLike[str]


def python_call(folder: Path) -> EvaluateText:
    """The Python call that evaluates a policy of a run in new episodes."""

    def call(name: str) -> str:
        candidate = {"best": "", "centre": "best=False, centre=True, "}.get(name, f"best=False, cells=[[{name}]], ")
        return f"certify_run({str(folder)!r}, {candidate}top=0)"

    return call


def write_report(
    folder: AnyPath,
    out: AnyPath | None = None,
    *,
    best: bool = True,
    cells: Sequence[Sequence[int]] = (),
    certified: bool | None = None,
    trusted: bool = False,
    evaluate: EvaluateText | None = None,
    figures: AnyPath | None = None,
    metrics: Sequence[str] = (),
    against: str = "env_steps",
) -> list[Path]:
    """Write the report of one run and return the files written, the page first.

    Args:
        out: file to write; None: `report.html` in the run's folder.
        best: whether to record an episode of the best centre for a replay, which takes seconds.
        cells: places of at most eight cells whose elites are to be replayed, too.
        certified: whether the certified policy is to be replayed, in its certification episode of median fitness; None:
            if there is one, and `best` is set.
        trusted: whether a replay may execute code that the config of the run names, a task or a search of a user.
        evaluate: what evaluates a policy, as text; None: the Python call.
        figures: folder to write figures into; None: none are written.
        metrics: columns of which curves are drawn as figures; none: all of `measures`.
        against: axis of these curves; see `plots.curves`.

    Raises:
        ConfigError: too many cells, or figures without matplotlib. NotInRunError: a cell does not exist or is empty, or
            no policy is certified. StoreError: the run cannot be read, or the file cannot be written.
    """
    folder = given_path(folder)
    if len(cells) > MOST_CELLS:
        raise ConfigError(
            f"{len(cells)} cells are too many for replays in one page; choose at most {MOST_CELLS}",
            field="replay",
            value=len(cells),
            allowed=f"at most {MOST_CELLS} cells",
        )
    if figures is not None:
        empty_figure()  # a missing matplotlib is reported before episodes are recorded
    data = read_run(folder)
    if certified is None:
        certified = best and data.certified is not None
    has_replay = bool(data.history["generation"].size) and (best or certified or bool(cells))
    replays = replay_section(data, best=best, cells=cells, certified=certified, trusted=trusted) if has_replay else None
    elsewhere = WayOut("report", "write it elsewhere", str(folder), out="FILE")
    page = run_page(data, evaluate or python_call(folder), replays)
    page = write_page(page, given_path(out or folder / REPORT), [elsewhere])
    if figures is None or not data.history["generation"].size:
        return [page]
    return [page, *write_figures([data], given_path(figures), metrics=metrics, against=against)]


def write_comparison(
    folders: Iterable[AnyPath | RunData],
    out: AnyPath,
    group_by: Sequence[str] = (),
    threshold: float | None = None,
    figures: AnyPath | None = None,
    *,
    paired: bool = False,
    statistics: AnyPath | None = None,
    bounds: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    metrics: Sequence[str] = (),
    against: str = "env_steps",
) -> list[Path]:
    """Write the page that compares runs and return the files written, the page first.

    Args:
        folders: those of the runs; a run that is read already can stand for its folder.
        group_by: config keys that group the runs; see `compare.grouped`.
        threshold: fitness from which a run counts as solved; None: the target fitness of all runs, if there is one.
        figures: folder to write figures into; None: none are written.
        paired: whether tests compare runs with equal seeds; otherwise all runs are independent.
        statistics: file to write the statistics between groups into, by its name as JSON, CSV or LaTeX (.json, .csv,
            .tex); None: none is written.
        bounds: task -> fitness that counts as 0 and as 1; with them, runs of several tasks can be compared, of which
            each group must have all.
        metrics: columns of the figures and of the file of statistics; none: all that all runs have.
        against: axis of the curves of the figures; see `plots.curves`.

    Raises:
        ConfigError: the runs cannot be compared, grouped or paired, the file of statistics has another ending, or
            figures are wanted without matplotlib. NotInRunError: a run has no finished generation. StoreError: a run
            cannot be read, or a file cannot be written.
    """
    if figures is not None:
        empty_figure()  # a missing matplotlib is reported before anything is read
    kind = "" if statistics is None else between.checked_kind(given_path(statistics))
    read = (run if isinstance(run, RunData) else read_compared(given_path(run)) for run in folders)
    # A run that is given twice counts once.
    different = compare.normalised(list({run.folder.resolve(): run for run in read}.values()), bounds)
    written = [write_page(comparison_page(different, group_by, threshold, paired=paired), given_path(out))]
    if statistics is not None:
        groups = compare.grouped(different, group_by)
        limit = compare.common_threshold(different) if threshold is None else threshold
        text = between.text_of(between.compared(groups, limit, paired=paired, metrics=metrics), kind)
        written.append(write_page(text, given_path(statistics)))
    if figures is not None:
        written += write_figures(different, given_path(figures), group_by, threshold, metrics, against)
    return written


def read_compared(folder: Path) -> RunData:
    """What a comparison needs of a run. Raises StoreError if the run cannot be read."""
    return read_run(folder, paths=False, digest=False)


def write_page(page: str, file: Path, ways_out: Sequence[WayOut] = ()) -> Path:
    """Write a page so that a reader never sees half of it. Raises StoreError, with the ways out, if this fails."""
    half = file.parent / f".{file.name}.{os.getpid()}"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        # A folder's name may be no UTF-8; then it is shown with question marks.
        half.write_text(page, encoding="utf-8", errors="replace")
        half.replace(file)
    except OSError as error:
        with contextlib.suppress(OSError):  # where no file can be written, none can be removed
            half.unlink()
        what = f"cannot write {file}: {error.strerror or error}; choose another file"
        raise StoreError(what, field="out", value=str(file), ways_out=ways_out) from error
    return file


# A run as a notebook shows it: a small page in a frame of its own, so that neither changes the other.

SHOWN = ("Fitness", "Coverage of the behaviour map")
"""Titles of the charts that are shown."""
HEIGHT = 560
"""Pixels of the frame, which is scrolled if it is too low."""


def run_html(run: Run) -> str:
    """Summary, curves and map of a run as HTML for the output of a cell; the error if it cannot be read."""
    try:
        page = _page(read_run(run.folder, paths=False, digest=False))
    except ServiceError as error:
        return tag("pre", error.sentence)
    # In a sandbox without the notebook's origin, the page cannot reach the notebook.
    return tag("iframe", srcdoc=page, sandbox="allow-scripts", width="100%", height=HEIGHT, frameborder=0)


def _page(data: RunData) -> str:
    how = f"{state(data.status)}; {data.folder}"
    said = [tag("p", verdict(data), class_="verdict"), tag("p", how, class_="note")]
    problems = [tag("p", tag("b", "Damaged: "), problem, class_="problem") for problem in data.problems]
    sections, points = [tag("section", *said, *problems, id="what")], []
    if data.history["generation"].size:
        charts = [
            chart
            for chart in series.charts(data.history, data.centres, data.constants["map.qd_offset"])
            if chart.title in SHOWN
        ]
        shown, points = curves.draw_charts(charts, {"generation": series.x_axes(data.history)["generation"]})
        if data.map is not None and data.map.size:
            figure, explanation, _ = maps.draw_map(data)
            bar = maps.colour_bar(value_range(data.map.fitness_N), cells=maps.has_area(data.map))
            caption = tag("figcaption", tag("b", "Behaviour map"), " ", tag("span", explanation, class_="note"))
            shown.append(tag("figure", caption, figure, bar))
        sections.append(tag("section", tag("div", *shown, class_="charts side"), id="curves"))
    return document(run_title(data), sections, {"charts": points})
