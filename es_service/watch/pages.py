"""What the live pages show: the list of runs, one run, several compared. The sections are those of the reports;
and the newest numbers of all runs as text for Prometheus (`metrics`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from es_service.errors import ServiceError, counted
from es_service.report.compare_page import comparison_sections
from es_service.report.data import RunData
from es_service.report.maps import empty_pattern
from es_service.report.markup import Markup, tag
from es_service.report.page import REPLAY, run_sections, run_title, section
from es_service.report.progress import short
from es_service.report.summary import elsewhere_text, number
from es_service.runs.replay import CERTIFIED
from es_service.runs.run_status import FAULTS_OF, read_recent, state
from es_service.watch.channels import Picture
from es_service.watch.runs import FoundRun, RunReading, Runs, RunSummary

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


def _is_running(summary: RunSummary) -> bool:
    return summary.status is not None and summary.status.driver is not None


def _cells(summary: RunSummary) -> list[Markup]:
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


def draw_run(runs: Runs, run: FoundRun, reading: RunReading) -> Callable[[], Picture | None]:
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


def draw_comparison(
    readings: Sequence[tuple[FoundRun, RunReading]], keys: Sequence[str], left_out: int = 0
) -> Callable[[], Picture | None]:
    """What draws the comparison of runs.

    Args:
        keys: as of `comparison_sections`.
        left_out: number of further runs that were asked for.
    """
    drawn: Any = None
    first = f"Only the first {len(readings)} of {len(readings) + left_out} runs are compared here; report compares all."

    def draw() -> Picture | None:
        nonlocal drawn
        notices, changed, unread = [first] if left_out else [], [], []
        for _, reading in readings:
            try:
                changed.append(reading.update())
            except ServiceError as error:
                notices.append(error.sentence)
                unread.append(reading)
        used = [
            reading for _, reading in readings if reading.data is not None and reading.data.history["generation"].size
        ]
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
        more = any(not each_reading.whole for each_reading in used if each_reading not in unread)
        return Picture(title, shown | sections, of, more)

    return draw


def _notice(*said: object) -> Markup:
    return tag("section", tag("p", *said, class_="problem", role="alert"), id="live")


GAUGES = {
    "generation": ("generation", "Newest committed generation."),
    "env_steps": ("env_steps", "Environment steps until then."),
    "steps_per_second": ("steps_per_second", "Environment steps a second of the newest generation."),
    "best_fitness": ("best_fitness", "Highest mean fitness of an evaluated centre or policy: selected, not certified."),
    "coverage": ("coverage", "Filled cells as a share of all cells."),
    "workers": ("workers", "Workers of the newest generation."),
}
"""Metric -> history column, meaning."""
OTHERS = {
    "running": "Whether a driver is writing.",
    "readable": "Whether the run can be read.",
    "certified_fitness": "Mean fitness, in certified episodes, of the policy that the newest certification put first.",
    "certified_elsewhere_fitness": "The same in the other task that the label elsewhere names.",
    "certified_gap": "Mean fitness there minus that of the same policy in the task of the run.",
    "lost_workers": f"Workers lost in the newest {FAULTS_OF} generations.",
    "retries": f"Chunks sent again in the newest {FAULTS_OF} generations.",
}
PREFIX = "es_service_"


def metrics(summaries: Iterable[RunSummary]) -> str:
    """A gauge for each number of each run, labelled with the run, its task and its search."""
    values: dict[str, list[str]] = {name: [] for name in (*GAUGES, *OTHERS)}
    for summary in summaries:
        labels = {"run": summary.found.name}
        numbers = _values(summary)
        if summary.status is not None:
            constants = summary.status.run.constants
            labels |= {"task": constants["task.environment"], "search": constants["search.algorithm"]}
        lines = [(labels, numbers)]
        lines += [
            (labels | {"elsewhere": task}, _elsewhere(one.row(), summary)) for task, one in summary.elsewhere.items()
        ]
        for labelled, of in lines:
            shown = ",".join(f'{name}="{_escaped(str(text))}"' for name, text in labelled.items())
            for name, value in of.items():
                if math.isfinite(value):
                    values[name].append(f"{PREFIX}{name}{{{shown}}} {value!r}\n")
    about = {name: text for name, (_, text) in GAUGES.items()} | OTHERS
    return "".join(
        f"# HELP {PREFIX}{name} {about[name]}\n# TYPE {PREFIX}{name} gauge\n{''.join(lines)}"
        for name, lines in values.items()
        if lines
    )


def _values(summary: RunSummary) -> Mapping[str, float]:
    numbers: dict[str, float] = {"readable": float(summary.status is not None)}
    if summary.status is None:
        return numbers
    row = summary.status.row
    numbers["running"] = float(summary.status.driver is not None)
    if summary.certified_fitness is not None:
        numbers["certified_fitness"] = summary.certified_fitness
    if row is not None:
        numbers |= {name: float(row[column]) for name, (column, _) in GAUGES.items() if column in row}
        try:
            recent = read_recent(summary.status.run, int(row["generation"]))
        except ServiceError:  # it was deleted meanwhile
            return numbers
        if recent.problem is None:
            numbers |= {"lost_workers": float(recent.lost_workers), "retries": float(recent.retries)}
    return numbers


def _elsewhere(row: Mapping[str, Any], summary: RunSummary) -> Mapping[str, float]:
    """The numbers of a policy that was certified in another task."""
    columns = {"certified_elsewhere_fitness": "elsewhere", "certified_gap": "gap"}
    return {name: row[f"{prefix}_{summary.measure}_mean"] for name, prefix in columns.items()}


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
