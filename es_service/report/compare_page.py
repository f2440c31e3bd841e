"""The page that compares runs: curves of groups, a final table, and maps side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from es_service.errors import NotInRunError, counted
from es_service.report import between, compare, maps
from es_service.report.compare import Group, Quartiles, Summary
from es_service.report.curves import draw, values_text
from es_service.report.data import RunData
from es_service.report.markup import Markup, joined, table, tables, tag, value_range
from es_service.report.measures import CERTIFIED, measure_named, measures
from es_service.report.page import axis_choice, document, section
from es_service.report.series import X_AXES
from es_service.report.statistics import WHOLE_RANGE, coverage
from es_service.report.summary import number
from es_service.runs.run_status import state

VALUES = {CERTIFIED: "certified value", "best_fitness": "best fitness"}
"""What `compare.value_column` returns -> its name in a sentence."""


def comparison_page(
    runs: Sequence[RunData], keys: Sequence[str] = (), threshold: float | None = None, *, paired: bool = False
) -> str:
    """HTML of the comparison of runs; arguments and errors as of `comparison_sections`."""
    title, sections, scripts = comparison_sections(runs, keys, threshold, paired=paired)
    return document(title, [html for html in sections.values() if html], scripts)


def comparison_sections(
    runs: Sequence[RunData], keys: Sequence[str] = (), threshold: float | None = None, *, paired: bool = False
) -> tuple[str, dict[str, Markup], dict[str, Any]]:
    """Title, sections by id and data of the script of a page that compares runs; see `compare.grouped` for the keys.

    Args:
        threshold: fitness from which a run counts as solved; None: the target fitness of all runs, if there is one.
        paired: whether tests compare runs with equal seeds; see `between.compared`.

    Raises:
        ConfigError: the runs cannot be compared, or not paired. NotInRunError: a run has no finished generation, or
            there is no run.
    """
    if not runs:
        raise NotInRunError("there is no run with a finished generation to compare")
    for run in runs:
        if not run.history["generation"].size:
            raise NotInRunError(f"{run.folder} has no finished generation yet; leave it out", run=run.folder)
    groups = compare.grouped(runs, keys)
    threshold = compare.common_threshold(runs) if threshold is None else threshold
    on_axes = {axis: compare.charts(groups, axis) for axis in compare.common_axes(runs)}
    figures, points = [], []
    for number_, _ in enumerate(on_axes["env_steps"][0]):
        chart_on = {axis: (charts[number_], x_K) for axis, (charts, x_K) in on_axes.items()}
        figure, axes = draw(chart_on)
        texts = {
            axis: [f"{number(float(x))} {X_AXES[axis]}: {values_text(chart, k)}" for k, x in enumerate(x_K)]
            for axis, (chart, x_K) in chart_on.items()
        }
        figures.append(figure)
        points.append({"axes": axes, "texts": texts})
    task = ", ".join(groups[0].tasks)
    said = tag("p", _sentence(groups, threshold, paired=paired), class_="verdict")
    sections = {
        "what": tag("section", said, *_problems(runs), id="what"),
        "curves": section(
            "Curves",
            tag("p", "Median over the seeds of a group; a shaded region is its interval, explained below the final "
                f"values. A curve ends where the first of its runs ends. {_seeds(groups)}.", class_="note"),
            axis_choice(compare.common_axes(runs)),
            tag("div", *figures, class_="charts"),
            id_="curves",
        ),
        "final": section("Final values", _final(groups, threshold), id_="final"),
        "between": between.section_of(groups, threshold, paired) or Markup(""),
        "maps": joined(_maps(groups)),
        "runs": section("Runs", _runs(groups), id_="runs"),
    }  # fmt: skip
    return f"{counted(len(runs), 'run')} on {task}", sections, {"charts": points}


def _sentence(groups: Sequence[Group], threshold: float | None, *, paired: bool) -> str:
    summaries = compare.summaries(groups, threshold)
    column = compare.value_column(compare.runs_of(groups))
    what = VALUES[column]
    best = max(summaries, key=lambda summary: summary.values[column].median)
    value = number(best.values[column].median)
    runs = counted(len(best.group.runs), "run")
    known = _interval(best, column)
    interval = f", {known}" if known else ""
    if len(groups) == 1:
        sentence = f"{runs} of {best.group.name} end with a {what} of {value} (median{interval})"
    else:
        sentence = (
            f"Of {len(groups)} groups, {best.group.name} ends with the highest median of the {what}: {value} "
            f"({runs}{interval})"
        )
        if (p := between.greatest_p(groups, column, best.group.name, paired=paired)) is not None:
            others = [group.name for group in groups if group.name != best.group.name]
            whose = f"p of its difference from {others[0]}"
            if len(others) > 1:
                whose = "the greatest corrected p of its differences from the others"
            sentence += f"; {whose} is {between.p_text(p)}"
    if column == CERTIFIED and "best_fitness" in best.values:
        sentence += f"; the median of its selected best fitness is {number(best.values['best_fitness'].median)}"
    if threshold is not None:
        solved = sum(summary.solved for summary in summaries)
        total = sum(len(summary.group.runs) for summary in summaries)
        reach = "have a certified value of at least" if column == CERTIFIED else "reach"
        sentence += f"; {solved} of {counted(total, 'run')} {reach} {number(threshold)}"
    return f"{sentence}."


def _problems(runs: Sequence[RunData]) -> list[Markup]:
    return [
        tag("p", tag("b", f"{run.folder} is damaged: "), problem, class_="problem")
        for run in runs
        for problem in run.problems
    ]


def _final(groups: Sequence[Group], threshold: float | None) -> Markup:
    summaries = compare.summaries(groups, threshold)
    heads_of = {name: measure.label for name, measure in measures(compare.runs_of(groups)).items()}
    heads_of |= compare.common_axes(compare.runs_of(groups)) | {"env_steps": "million steps"}
    solved = () if threshold is None else (f"reach {number(threshold)}", "million steps until then")
    rows = []
    for summary in summaries:
        runs = len(summary.group.runs)
        cells = [_shown(summary.values[column], column, _interval(summary, column)) for column in heads_of]
        reached = (
            (
                f"{summary.solved} of {runs}",
                "none" if np.isnan(summary.steps.median) else _shown(summary.steps, "env_steps"),
            )
            if solved
            else ()
        )
        seeds = f"{summary.group.seeds}" + ("" if summary.group.seeds == runs else f" in {counted(runs, 'run')}")
        rows.append((summary.group.name, seeds, *reached, *cells))
    heads = ("group", "seeds", *solved, *heads_of.values())
    return Markup(tables(rows, heads, "numbers") + tag("p", _about_intervals(groups), class_="note"))


def _about_intervals(groups: Sequence[Group]) -> str:
    """What the numbers of the table are, and how far they can be trusted with so many seeds."""
    said = ["Median over the seeds of a group; below it, its interval, and the first to the third quartile."]
    few = sorted({group.seeds for group in groups if 1 < group.seeds <= WHOLE_RANGE and len(group.tasks) == 1})
    if any(group.seeds > 1 and group.are_independent for group in groups) and len(groups[0].tasks) == 1:
        said.append(
            "The interval is the percentile bootstrap of the median: the middle 95 % of the medians of all ways to "
            "draw the seeds anew, with repetitions. They are counted and not sampled, so nothing about it is random."
        )
    said += [
        f"With {seeds} seeds, it reaches from the lowest to the highest value, which hold the median of all possible "
        f"seeds between them with a probability of {100 * coverage(seeds):.0f} %, not 95 %."
        for seeds in few
    ]
    if len(groups[0].tasks) > 1:
        shares = sorted({f"{run.constants['task.environment']} {run.bounds_of_fitness}" for run in groups[0].runs})
        said.append(
            "Fitness is a share of the way between the bounds of each task, which count as 0 and as 1: "
            f"{', '.join(shares)}. Intervals draw runs within each task; curves have none."
        )
    if alone := [group.name for group in groups if group.seeds == 1]:
        said.append(f"A group with one seed has no interval: {', '.join(alone)}.")
    if repeated := [group.name for group in groups if group.seeds > 1 and not group.are_independent]:
        said.append(f"A group in which several runs have the same seed has no interval: {', '.join(repeated)}.")
    return " ".join(said)


def _seeds(groups: Sequence[Group]) -> str:
    return "; ".join(f"{group.name} has {counted(group.seeds, 'seed')}" for group in groups)


def _interval(summary: Summary, column: str) -> str:
    """The interval of a median in words; empty if it has none, or no extent."""
    if column not in summary.intervals:
        return ""
    scale, _ = _unit(column)
    low, high = (number(scale * value) for value in summary.intervals[column])
    return "" if low == high else f"interval {low} to {high}"


def _unit(column: str) -> tuple[float, str]:
    """Factor and unit in which a column is shown."""
    if column == "env_steps":
        return 1e-6, ""
    return (100.0, " %") if measure_named(column).percent else (1.0, "")


def _shown(values: Quartiles, column: str, interval: str = "") -> Markup:
    scale, unit = _unit(column)
    median, low, high = (number(scale * value) for value in values)
    ranges = [interval, "" if low == high else f"quartiles {low} to {high}"]
    return tag("div", f"{median}{unit}", *(_note(text) for text in ranges if text))


def _note(text: str) -> Markup:
    """A range below a number; in a narrow table its name is on a line of its own."""
    name, ends = text.split(" ", 1)
    return tag("div", f"{name} ", tag("span", ends), class_="note")


def _maps(groups: Sequence[Group]) -> list[Markup]:
    """The map of the median run of each group, all with the same colours."""
    shown = [(group, compare.median_run(group)) for group in groups]
    shown = [(group, run) for group, run in shown if run.map is not None and run.map.size]
    if not shown:
        return []
    colours = value_range(np.concatenate([run.map.fitness_N for _, run in shown if run.map is not None]))
    value = VALUES[compare.value_column(compare.runs_of(groups))]
    even = any(len(group.runs) % 2 == 0 for group, _ in shown)
    lower = " (of an even number of runs, the lower of the two in the middle)" if even else ""
    figures = []
    for group, run in shown:
        figure, _, _ = maps.draw_map(run, colours)
        caption = tag("figcaption", tag("b", group.name), " ", tag("span", run.name, class_="note"))
        figures.append(tag("figure", caption, figure))
    return [
        section(
            "Behaviour maps",
            tag(
                "p",
                f"Of the run of each group whose {value} is the median{lower}; all have the same colours.",
                class_="note",
            ),
            tag("div", *figures, class_="side"),
            maps.colour_bar(colours, cells=all(maps.has_area(run.map) for _, run in shown if run.map is not None)),
            id_="maps",
        )
    ]


def _runs(groups: Sequence[Group]) -> Markup:
    rows = [
        (
            str(run.folder),
            group.name,
            f"{run.constants['seed']}",
            f"{run.last('generation'):,.0f}",
            number(run.last("best_fitness")),
            _certified(run),
            state(run.status),
        )
        for group in groups
        for run in group.runs
    ]
    return table(rows, ("run", "group", "seed", "generations", "best fitness", "certified", "state"), "listed")


def _certified(run: RunData) -> str:
    """The newest certified value of a run, and where it was certified unless that was at its end."""
    if not np.isfinite(run.last(CERTIFIED)):
        return "-"
    steps = None if run.certified is None else run.certified.env_steps
    early = f", after {number(steps)} steps" if steps is not None and steps < run.last("env_steps") else ""
    return f"{number(run.last(CERTIFIED))}{early}"
