"""What the live pages show: the list of runs, one run, several compared. The sections are those of the reports."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from es_service.errors import ServiceError, counted
from es_service.report.compare_page import comparison_sections
from es_service.report.data import RunData
from es_service.report.facts import elsewhere_text, number
from es_service.report.maps import empty_pattern
from es_service.report.markup import Markup, tag
from es_service.report.page import REPLAY, run_sections, run_title, section
from es_service.report.progress import short
from es_service.runs.replay import CERTIFIED
from es_service.runs.run_status import state
from es_service.watch.channels import Picture
from es_service.watch.runs import Found, Reading, Runs, Summary

SECTION_OF = {"charts": "curves", "map": "map", "cloud": "centres"}
"""Data of the page's script -> the section that they belong to."""
NO_DIGEST = "not computed for a live page; es-service digest and report compute it"
NO_REPLAY = (
    "Click a cell of the map, or choose one with the arrow keys and press Enter, to see its elite's episode here."
)
HEADS = (
    "", "run", "state", "generation", "steps", "steps/s", "best", "certified", "coverage", "task", "search", "seed"
)  # fmt: skip


def shell(title: str, events: str, base: str = "") -> str:
    """HTML of a live page, whose sections arrive as events.

    Args:
        events: address of the events.
        base: address of the run, below which its cells and replays are; empty for other pages.
    """
    head = tag(
        "head",
        Markup('<meta charset="utf-8">'),
        Markup('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        tag("title", title),
        *(Markup(f'<link rel="stylesheet" href="/assets/{name}">') for name in ("page.css", "live.css")),
    )
    status = tag("span", "connecting", id="connection", role="status")
    home = tag("a", "All runs", href="/") if events != "/events/list" else None
    header = tag("header", tag("nav", home, status), tag("h1", title))
    scripts = [tag("script", src=f"/assets/{name}") for name in ("page.js", "replay.js", "live.js")]
    body = tag("body", empty_pattern(), header, tag("main"), *scripts, data_events=events, data_base=base)
    return f"<!DOCTYPE html>\n{tag('html', head, body, lang='en')}\n"


def draw_list(runs: Runs) -> Callable[[], Picture]:
    """What draws the list of all runs."""

    def draw() -> Picture:
        summaries = sorted(runs.summaries(), key=lambda summary: not _is_running(summary))  # these first, else by name
        running = sum(map(_is_running, summaries))
        said = (
            f"{counted(len(summaries), 'run')}, {running:,} of them running." if summaries else "There is no run yet."
        )
        rows = [tag("tr", *_cells(summary)) for summary in summaries]
        heads = tag("thead", tag("tr", *(tag("th", head, scope="col") for head in HEADS)))
        listed = tag("div", tag("table", heads, tag("tbody", *rows), class_="runs"), class_="scroll") if rows else None
        choice = tag("button", "Compare the ticked runs", type="submit") if len(summaries) > 1 else None
        form = tag("form", tag("p", said, class_="verdict"), listed, choice, action="/compare", method="get")
        return Picture("Runs", {"runs": tag("section", form, id="runs")}, {})

    return draw


def _is_running(summary: Summary) -> bool:
    return summary.status is not None and summary.status.driver is not None


def _cells(summary: Summary) -> list[Markup]:
    """The cells of a row, each with the name of its column for narrow windows."""
    run, status = summary.found, summary.status
    box = tag("input", type="checkbox", name="run", value=run.key, aria_label=f"compare {run.name}")
    link = tag("a", run.name, href=f"/run/{run.key}")
    if status is None:
        values = [None, link, tag("span", summary.problem, class_="problem"), *[None] * (len(HEADS) - 3)]
    else:
        constants, row, limits = status.run.constants, status.row or {}, status.limits
        of = {key: f" of {short(limit)}" for key, limit in limits.items()}
        best = number(row["best_fitness"]) if row else ""
        value, policy = summary.certified_fitness, summary.certified
        certified = [] if value is None or policy is None else [f"{number(value)} ({policy.title})"]
        certified += [f"{task}: {elsewhere_text(of, summary.measure)}" for task, of in summary.elsewhere.items()]
        share = row.get("coverage")
        coverage = "" if share is None else f"{100 * share:.1f} %"
        values = [
            box, link, state(status),
            f"{row['generation']:,}{of.get('generations', '')}" if row else "",
            f"{short(row['env_steps'])}{of.get('env_steps', '')}" if row else "",
            _short(row.get("steps_per_second")), best, "; ".join(certified), coverage,
            constants["task.environment"], constants["search.algorithm"], constants["seed"],
        ]  # fmt: skip
    return [tag("td", value, data_head=head) for head, value in zip(HEADS, values, strict=True)]


def _short(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else short(value)


def draw_run(runs: Runs, run: Found, reading: Reading) -> Callable[[], Picture | None]:
    """What draws one run; what was seen of it remains if it is moved or deleted."""
    last, told = Picture(run.name, {}, {}), ""

    def draw() -> Picture | None:
        nonlocal last, told
        try:
            if not reading.update() and not told:
                return None
        except ServiceError as error:
            other = None if reading.data is None else runs.moved(reading.data.meta.run_id, run)
            before, told = told, f"{error.sentence} {other}"
            where = () if other is None else (" It is now ", tag("a", other.name, href=f"/run/{other.key}"), ".")
            others = {id_: html for id_, html in last.sections.items() if id_ != "live"}
            shown = {"live": _notice(error.sentence, *where), **others}
            return None if told == before else last._replace(sections=shown, more=False)
        assert reading.data is not None
        last, told = _run_picture(reading.data, whole=reading.whole), ""
        return last

    return draw


def _run_picture(data: RunData, *, whole: bool) -> Picture:
    sections, scripts = run_sections(replace(data, digest=NO_DIGEST), None)
    if not whole:
        newest = data.last("generation")
        said = f"Generations up to {newest:,.0f} are shown, since the others are still being read."
        sections = {"live": _notice(said)} | sections
    shown = {("replays" if id_ == REPLAY else id_): html for id_, html in sections.items()}
    if "replays" in shown:
        policies = {"best": "the best centre"} | ({CERTIFIED: "the certified policy"} if data.certified else {})
        buttons = [
            tag("button", f"Replay {what}", type="button", class_="replay", value=which)
            for which, what in policies.items()
        ]
        note = tag("p", NO_REPLAY, class_="note") if "map" in scripts else None
        controls = tag("div", *buttons, tag("span", id="recording", role="status"), class_="controls")
        shown["replays"] = section("Replay", note, controls, tag("div", id="shown"), id_="replays")
    return Picture(
        run_title(data), shown, {SECTION_OF[name]: {name: script} for name, script in scripts.items()}, not whole
    )


def draw_comparison(readings: Sequence[tuple[Found, Reading]], keys: Sequence[str]) -> Callable[[], Picture | None]:
    """What draws the comparison of runs; arguments as of `comparison_sections`."""
    drawn: Any = None

    def draw() -> Picture | None:
        nonlocal drawn
        notices, changed = [], []
        for _, reading in readings:
            try:
                changed.append(reading.update())
            except ServiceError as error:
                notices.append(error.sentence)
        used = [reading for _, reading in readings if reading.data is not None and _begun(reading.data)]
        notices += [
            f"{run.name} has no finished generation yet." for run, each_reading in readings if each_reading not in used
        ]
        if not any(changed) and notices == drawn:
            return None
        drawn = notices
        try:
            title, sections, scripts = comparison_sections(
                [each_reading.data for each_reading in used if each_reading.data], keys
            )
        except ServiceError as error:
            title, sections, scripts = "Comparison", {}, {}
            notices = [*notices, error.sentence]
        shown = {"live": _notice(*notices)} if notices else {}
        of = {SECTION_OF[name]: {name: script} for name, script in scripts.items()}
        return Picture(title, shown | sections, of, not all(each_reading.whole for each_reading in used))

    return draw


def _begun(data: RunData) -> bool:
    return bool(data.history["generation"].size)


def _notice(*said: object) -> Markup:
    return tag("section", tag("p", *said, class_="problem", role="alert"), id="live")
