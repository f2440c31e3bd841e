"""The page of one run, one HTML file that opens without a network, and its cloud of centres."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any

import numpy as np

from es_service.errors import counted
from es_service.protocol.options import FREE
from es_service.report import curves, floor, maps, series, summary
from es_service.report.data import RunData
from es_service.report.markup import SCALE, Frame, Markup, data_script, level, packed, spread, table, tag, value_range
from es_service.report.summary import changed_settings, number

# All evaluated centres, or policies, as a cloud of points, with a slider over the generations.
#
# The points are drawn by the page on a canvas, because there may be many; their places and colours are computed here.

MOST_POINTS = 20_000
STOPS = 200
"""Most places of the slider."""


def cloud(data: RunData) -> tuple[Markup, dict[str, Any], tuple[float, float], str] | None:
    """The cloud of a run; None if no evaluation was valid.

    Returns:
        figure; what its script needs: `x`, `y` in tenths of a pixel and `level` (index in `colours`) in base64, and in
        `stops` [points shown, text] of each place of the slider; fitness of the first and last colour; explanation.
    """
    names, nouns = data.names, data.evaluated
    place_N_B = np.stack([data.centres[name] for name in names], axis=1)
    fitness_N, generation_N = data.centres["fitness_mean"], data.centres["generation"]
    fine_N = np.isfinite(place_N_B).all(axis=1) & np.isfinite(fitness_N)
    kept = np.flatnonzero(fine_N)
    if not kept.size:
        return None
    valid = kept.size
    if valid > MOST_POINTS:
        kept = kept[np.linspace(0, valid - 1, MOST_POINTS).astype(int)]
    place_N_B, fitness_N, generation_N = place_N_B[kept], fitness_N[kept], generation_N[kept]
    x_N = place_N_B[:, 0]
    if len(names) == 1:
        y_N, labels = fitness_N, (names[0], "fitness")
        frame = Frame(data.bounds[0], spread([fitness_N]), floor.LEFT, floor.TOP, floor.WIDTH - 62, 320)
    else:
        y_N, labels = place_N_B[:, 1], (names[0], names[1])
        frame = floor.plan_frame(data.bounds[:2])
    (x_low, x_high), (y_low, y_high) = frame.x, frame.y
    colours = value_range(fitness_N)
    width, height = floor.size(frame)
    walls = floor.walls_and_goal(frame, data.task) if len(names) == 2 else None
    box = f"0 0 {width:.0f} {height:.0f}"
    figure = tag(
        "div",
        tag("svg", floor.ground(frame, labels), viewBox=box, role="img", aria_label=f"Evaluated {nouns[1]}"),
        tag("canvas", width=2 * round(width), height=2 * round(height), id="cloud"),
        tag("svg", walls, viewBox=box, class_="above"),
        class_="layers",
    )
    ends = np.unique(np.linspace(0, generation_N[-1], STOPS).astype(int))
    counts = np.searchsorted(generation_N, ends, side="right").tolist()
    points = {
        "x": packed(10 * frame.across(np.clip(x_N, x_low, x_high)), "int16"),
        "y": packed(10 * frame.down(np.clip(y_N, y_low, y_high)), "int16"),
        "level": packed(level(fitness_N, *colours), "int8"),
        "colours": SCALE,
        "stops": [
            [count, f"generation {end:,}: {counted(count, *nouns)}, best {number(best)}"]
            for end, count, best in zip(ends.tolist(), counts, _best_until(fitness_N, counts), strict=True)
        ],
    }
    which = f"Each point is an evaluated {nouns[0]}, at its mean descriptor"
    more = f"; {len(kept):,} of {valid:,} are shown, at equal distances" if valid > len(kept) else ""
    also = f", in the first two of {len(names)} dimensions" if len(names) > 2 else ""
    return figure, points, colours, f"{which}{also}; the colour is its fitness{more}."


def _best_until(fitness_N: np.ndarray, counts: list[int]) -> list[float]:
    best_N = np.maximum.accumulate(fitness_N)
    return [float(best_N[count - 1]) if count else float("nan") for count in counts]


EvaluateText = Callable[[str], str]
"""Function from the name of a policy ("best", or a cell such as "3,17") to the text that evaluates it."""
REPLAY = "replay"
"""Id of the section of replays."""
MOST_FAULTS = 20
"""Generations with faults that are listed one by one."""

MAP_NOTE = "Point at a cell for its values; click it for its elite's path, a line through points of the episode."
DETOUR_NOTE = (
    "Where a wall is between two of these points, the episode's way is unknown: the shortest way round the wall is "
    "dashed, and a gap is left if that is too long."
)


def run_page(data: RunData, evaluate: EvaluateText, replays: Mapping[str, Any] | None = None) -> str:
    """HTML of the report of a run.

    Args:
        evaluate: what evaluates a policy, as text to copy.
        replays: what `replays.replay_section` returns; None for no replay.
    """
    sections, scripts = run_sections(data, evaluate)
    if replays is not None and data.history["generation"].size:
        sections[REPLAY] = replays["section"]
        scripts |= replays["scripts"]
    libraries = list(replays["libraries"]) if replays is not None else []
    return document(run_title(data), [html for html in sections.values() if html], scripts, libraries)


def run_title(data: RunData) -> str:
    return f"{data.name}: {data.constants['search.algorithm']} on {data.constants['task.environment']}"


def run_sections(data: RunData, evaluate: EvaluateText | None) -> tuple[dict[str, Markup], dict[str, Any]]:
    """The sections of a run's page by their ids, in order (that of replays is empty), and the data of its script.

    Args:
        evaluate: see `run_page`; None: the page asks for the path of a chosen cell, and for what evaluates it.
    """
    sections, scripts = {"what": _head(data)}, {}
    if data.history["generation"].size:
        sections |= {
            "curves": _curves(data, scripts),
            "map": _map(data, evaluate, scripts),
            "centres": _cloud(data, scripts),
            REPLAY: Markup(),
            "time": _time(data),
            "faults": _faults(data),
        }
        if parameters := _parameters(data):
            sections["parameters"] = parameters
    return sections, scripts


def document(title: str, sections: list[Markup], scripts: Mapping[str, Any], libraries: list[str] | None = None) -> str:
    """A whole page: title, sections, data for the script, scripts and stylesheet of `assets`."""
    policy = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
    head = tag(
        "head",
        Markup('<meta charset="utf-8">'),
        Markup('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Markup(f'<meta http-equiv="Content-Security-Policy" content="{policy}">'),
        tag("title", title),
        tag("style", Markup(asset("page.css"))),
    )
    data = [data_script(f"data-{name}", value) for name, value in scripts.items()]
    code = [tag("script", Markup(text)) for text in (asset("page.js"), *(libraries or []))]
    body = tag("body", maps.empty_pattern(), tag("header", tag("h1", title)), tag("main", *sections), *data, *code)
    return f"<!DOCTYPE html>\n{tag('html', head, body, lang='en')}\n"


def asset(name: str, package: str = "es_service.report") -> str:
    return (resources.files(package) / "assets" / name).read_text(encoding="utf-8")


def section(title: str, *content: object, id_: str) -> Markup:
    return tag("section", tag("h2", title), *content, id=id_)


def axis_choice(axes: Mapping[str, str]) -> Markup:
    """Buttons that choose what curves are drawn against, the first one chosen; axes are columns with labels."""
    buttons = [
        tag("label", Markup(f'<input type="radio" name="x" value="{column}"{" checked" * (index == 0)}>'), label)
        for index, (column, label) in enumerate(axes.items())
    ]
    return tag("div", tag("span", "against"), *buttons, class_="choice", role="radiogroup")


def _head(data: RunData) -> Markup:
    changed = changed_settings(data.meta.config, data.task)
    rows = [(setting.key, setting.value, setting.default or "unknown") for setting in changed]
    settings = table(rows, ("setting", "value", "default"), "settings") if rows else tag("p", "None.")
    problems = [tag("p", tag("b", "Damaged: "), problem, class_="problem") for problem in data.problems]
    return tag(
        "section",
        tag("p", summary.verdict(data), class_="verdict"),
        *problems,
        tag(
            "div",
            tag("div", tag("h2", "What was run"), table(summary.what_was_run(data))),
            tag("div", tag("h2", "Settings that differ from their defaults"), settings),
            class_="columns",
        ),
        tag("details", tag("summary", "Versions, machine and digest"), table(summary.provenance(data)), open="open"),
        id="what",
    )


def _curves(data: RunData, scripts: dict[str, Any]) -> Markup:
    charts, axes = (
        series.charts(data.history, data.centres, data.constants["map.qd_offset"]),
        series.x_axes(data.history),
    )
    figures, scripts["charts"] = curves.draw_charts(charts, axes)
    generations = data.history["generation"].size
    together = series.groups(generations)[0]
    grouped = None
    if together > 1:
        text = f"Each point summarises {together} neighbouring generations: values 'so far', coverage and QD-score "
        text += "are those of the last of these generations, and all other values are means."
        grouped = tag("p", text, class_="note")
    return section(
        "Curves",
        axis_choice(series.axes_of(data.history)),
        tag("div", *figures, class_="charts"),
        grouped,
        id_="curves",
    )


def _map(data: RunData, evaluate: EvaluateText | None, scripts: dict[str, Any]) -> Markup:
    if data.map is None:
        enabled = data.constants.get("map.enabled")
        text = "The map cannot be read." if enabled else "This run has no behaviour map (map.enabled is false)."
        return section("Behaviour map", tag("p", text), id_="map")
    if not data.map.size:
        return section("Behaviour map", tag("p", "No cell is filled yet."), id_="map")
    figure, explanation, frame = maps.draw_map(data)
    rows = maps.cell_rows(data)
    scripts["map"] = {"rows": rows, "overlay": frame is not None}  # overlay: paths are drawn above the map
    names = {cell: row[0] for cell, row in rows.items()}
    if evaluate is not None:
        scripts["map"] |= maps.path_lines(data) | {"evaluate": {cell: evaluate(name) for cell, name in names.items()}}
    detours = data.task.walls if evaluate is None else scripts["map"]["detours"]
    fittest = str(int(data.map.cell_N[data.map.fitness_N.argmax()]))
    scripts["map"]["first"] = fittest
    return section(
        "Behaviour map",
        tag("p", f"{explanation} {MAP_NOTE}{f' {DETOUR_NOTE}' if detours else ''}", class_="note"),
        tag(
            "div",
            tag("div", figure, maps.colour_bar(value_range(data.map.fitness_N), cells=maps.has_area(data.map))),
            tag(
                "div",
                tag("h3", "Chosen cell"),
                tag("p", id="cell", class_="readout", aria_live="polite"),
                maps.path_figure(data) if frame is None else None,
                tag("p", "Evaluate its elite on fresh episodes:", class_="note"),
                tag("pre", id="command"),
                tag("p", "Its stored fitness is the highest of many noisy means; fresh episodes show how much of it "
                    "is luck.", class_="note"),
            ),
            class_="columns",
        ),
        id_="map",
    )  # fmt: skip


def _cloud(data: RunData, scripts: dict[str, Any]) -> Markup:
    drawn, (word, words) = cloud(data), data.evaluated
    if drawn is None:
        return section(f"Evaluated {words}", tag("p", f"No valid {word} was evaluated."), id_="centres")
    figure, scripts["cloud"], colours, explanation = drawn
    last = len(scripts["cloud"]["stops"]) - 1
    slider = Markup(f'<input type="range" id="until" min="0" max="{last}" value="{last}" aria-label="generation">')
    return section(
        f"Evaluated {words}",
        tag("p", explanation, class_="note"),
        tag(
            "div",
            figure,
            tag(
                "div",
                tag("h3", "Until a generation"),
                tag("div", slider, tag("span", id="until-text", class_="readout"), class_="slider"),
                maps.colour_bar(colours),
            ),
            class_="columns",
        ),
        id_="centres",
    )


def _parameters(data: RunData) -> Markup:
    """The parameters of the best centre or policy, if the task is a function of them."""
    spec = data.task.parameters
    if spec is None or not data.best_parameters:
        return Markup()
    rows = []
    for (name, value), (low, high), start in zip(data.best_parameters.items(), spec.bounds, spec.start, strict=True):
        bounds = "none" if (low, high) == FREE else f"{low:g} to {high:g}"
        rows.append((name, f"{value:.9g}", bounds, f"{start:g}"))
    listed = table(rows, ("parameter", "value", "bounds", "start"), "numbers")
    return section(f"Parameters of the best {data.evaluated[0]}", listed, id_="parameters")


def _time(data: RunData) -> Markup:
    x_K, phases = series.phase_curves(data.history)
    figure = curves.phase_figure(series.phase_seconds(data.history), x_K, phases)
    return section("Where the time went", tag("p", summary.time_sentence(data)), figure, id_="time")


def _faults(data: RunData) -> Markup:
    faults = summary.faults(data)
    rows = [
        (f"{fault.generation:,}", f"{fault.lost_workers:,}", f"{fault.retries:,}") for fault in faults[:MOST_FAULTS]
    ]
    more = None
    if len(faults) > MOST_FAULTS:
        more = tag("p", f"{len(faults) - MOST_FAULTS:,} more generations are not listed.", class_="note")
    listed = table(rows, ("generation", "workers lost", "chunks sent again"), "numbers") if rows else None
    return section("Faults survived", tag("p", summary.fault_sentence(faults)), listed, more, id_="faults")
