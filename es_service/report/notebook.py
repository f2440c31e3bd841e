"""A run as a notebook shows it: a small page in a frame of its own, so that neither changes the other."""

from __future__ import annotations

from es_service.errors import ServiceError
from es_service.report import curves, maps, series
from es_service.report.colours import value_range
from es_service.report.data import RunData, read_run
from es_service.report.facts import verdict
from es_service.report.markup import tag
from es_service.report.page import document, run_title
from es_service.runs.run_status import state
from es_service.runs.view import Run

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
