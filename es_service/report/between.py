"""Is one group of runs better than another? Averages, probabilities and tests for what the runs have found.

A measure is a number of each run, such as its certified value or its steps to a target. All runs of all groups have
it, or it is left out. Measures are compared between each two groups, and the tests of one measure are corrected
together.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.config.text import unknown_name
from es_service.errors import ConfigError
from es_service.report import statistics
from es_service.report.compare import Group, runs_of
from es_service.report.data import RunData
from es_service.report.markup import Markup, table, tag
from es_service.report.measures import Measure, chosen, measure_named
from es_service.report.page import section
from es_service.report.statistics import Difference
from es_service.report.summary import number
from es_service.runs.selection import LEVEL

FORMATS = (".json", ".csv", ".tex")
"""Kinds of files of statistics."""
COST = "cost_to_target"
Ends = tuple[float, float]


class Average(NamedTuple):
    group: str
    runs: int
    median: float
    median_interval: Ends | None
    iqm: float | None
    """Interquartile mean; None if a run never reached a target."""
    iqm_interval: Ends | None
    reached: int = 0
    """Number of runs with a finite value: if it is the cost of a target, those that reach it."""


class Pair(NamedTuple):
    """A measure of two groups."""

    first: str
    second: str
    difference: Difference
    """The first group against the second, so that above 0.5 the first is better."""
    p_corrected: float
    """By Holm's correction for all pairs of the measure."""


class Compared(NamedTuple):
    name: str
    title: str
    lower_is_better: bool
    averages: tuple[Average, ...]
    pairs: tuple[Pair, ...]

    @property
    def smallest_p(self) -> float:
        """The smallest corrected p that all pairs allow, with as many runs as the groups have."""
        smallest = min((pair.difference.smallest_p for pair in self.pairs), default=1.0)
        return min(1.0, max(1, len(self.pairs)) * smallest)


def compared(
    groups: Sequence[Group],
    threshold: float | None = None,
    *,
    paired: bool = False,
    metrics: Sequence[str] = (),
) -> list[Compared]:
    """All measures that all runs have, between each two groups.

    Args:
        threshold: fitness of which the cost to reach it is compared; None: it is not.
        paired: whether runs with equal seeds belong together; otherwise all are independent.
        metrics: names of measures; none: all, and the cost.

    Raises:
        ConfigError: groups are paired that have not the same seeds, once each.
    """
    if paired:
        _require_pairs(groups)
    found = []
    for name, (measure, value) in _measures(groups, threshold, metrics).items():
        values_R = _values(groups, value)
        if any(np.isnan(np.concatenate(of_group)).any() for of_group in values_R):
            continue
        sign = -1.0 if measure.less_is_better else 1.0
        averages = tuple(_average(group, of_group) for group, of_group in zip(groups, values_R, strict=True))
        places = list(combinations(range(len(groups)), 2))
        differences = [
            statistics.difference(*([sign * task_R for task_R in values_R[k]] for k in pair), paired=paired)
            for pair in places
        ]
        corrected = statistics.holm([difference.p for difference in differences])
        pairs = tuple(
            Pair(groups[i].name, groups[j].name, difference._replace(shift=sign * difference.shift + 0.0), p)
            for (i, j), difference, p in zip(places, differences, corrected, strict=True)
        )
        found.append(Compared(name, measure.label, measure.less_is_better, averages, pairs))
    return found


def values(groups: Sequence[Group], name: str) -> tuple[str, float, list[list[NDArray[np.float64]]]]:
    """A measure of each run: (title, -1 if less is better or else 1, values of each group). They are [R] of each task,
    in the order of seeds.

    Raises ConfigError if there is no such measure, or if a run lacks it.
    """
    known = _measures(groups, None)
    measure, value = known.get(name, (Measure("", "", ""), lambda _: np.nan))
    found = _values(groups, value)
    if any(np.isnan(np.concatenate(of_group)).any() for of_group in found):
        if name not in known:
            raise unknown_name("measure", name, known, "metrics")
        raise ConfigError(f"not every run has a newest value of {name}", field="metrics", value=name)
    return measure.label, -1.0 if measure.less_is_better else 1.0, found


def _values(groups: Sequence[Group], value: Callable[[RunData], float]) -> list[list[NDArray[np.float64]]]:
    """The values of each group: [R] of each task."""
    return [[np.array([value(run) for run in runs], float) for runs in group.tasks.values()] for group in groups]


def _measures(
    groups: Sequence[Group], threshold: float | None, metrics: Sequence[str] = ()
) -> dict[str, tuple[Measure, Callable[[RunData], float]]]:
    """Name -> (what is said of a measure, its number of a run; NaN if there is none)."""

    def cost(run: RunData) -> float:
        reached = np.flatnonzero(run.history["best_fitness"] >= (np.inf if threshold is None else threshold))
        return float(run.history["env_steps"][reached[0]]) if reached.size else np.inf

    found = {name: (measure, _last(name)) for name, measure in chosen(runs_of(groups), metrics).items()}
    if threshold is not None and not metrics:
        label = f"environment steps until a best fitness of {number(threshold)}"
        found[COST] = (Measure(label, label, "", less_is_better=True), cost)
    return found


def _last(column: str) -> Callable[[RunData], float]:
    return lambda run: run.last(column)


def _average(group: Group, values_R: list[NDArray[np.float64]]) -> Average:
    is_finite = bool(np.isfinite(np.concatenate(values_R)).all())

    return Average(
        group.name,
        len(group.runs),
        float(statistics.median(values_R)),
        statistics.interval_of_median(values_R) if group.are_independent else None,
        float(statistics.iqm(values_R)) if is_finite else None,
        statistics.interval(statistics.iqm, values_R) if is_finite and group.are_independent else None,
        int(np.isfinite(np.concatenate(values_R)).sum()),
    )


def _require_pairs(groups: Sequence[Group]) -> None:
    seeds = {
        group.name: [run.constants["seed"] for of_task in group.tasks.values() for run in of_task] for group in groups
    }
    first, *others = seeds.items()
    for name, of_group in [first, *others]:
        if of_group != first[1] or not all(group.are_independent for group in groups):
            raise ConfigError(
                f"runs cannot be paired by their seeds: {first[0]} has the seeds {first[1]}, {name} has {of_group}; "
                "give each group one run with each seed, or leave pairs out",
                field="paired",
                value=seeds,
            )


def section_of(groups: Sequence[Group], threshold: float | None, paired: bool = False) -> Markup | None:
    """The part of a page that answers whether groups differ; None if there are no two groups of two runs or more."""
    if len(groups) < 2 or min(len(group.runs) for group in groups) < 2:
        return None
    parts: list[Markup] = []
    measures = compared(groups, threshold, paired=paired)
    for measure in measures:
        title, scale = _title_and_scale(measure)
        averages = [
            (
                average.group,
                f"{average.runs}"
                if average.reached == average.runs
                else f"{average.reached} of {average.runs} reach it",
                _with_ends(average.median, average.median_interval, scale),
                "-" if average.iqm is None else _with_ends(average.iqm, average.iqm_interval, scale),
            )
            for average in measure.averages
        ]
        pairs = [
            (
                f"{pair.first} over {pair.second}",
                _with_ends(pair.difference.improvement, pair.difference.interval),
                "-" if np.isnan(pair.difference.shift) else number(scale * pair.difference.shift),
                p_text(pair.difference.p),
                p_text(pair.p_corrected),
            )
            for pair in measure.pairs
        ]
        parts += [
            tag("h3", f"{title}{' (less is better)' if measure.lower_is_better else ''}"),
            tag(
                "div",
                table(averages, ("group", "runs", "median", "interquartile mean"), "numbers"),
                table(pairs, ("pair", "probability of improvement", "difference", "p", "p, corrected"), "numbers"),
                class_="side",
            ),
            tag("p", _smallest(measure), class_="note"),
        ]
    explained = _explained(groups, paired)
    if any(average.iqm is None for measure in measures for average in measure.averages):
        explained += " Runs that never reach a target count as equal and as worse than all that do; they have no mean."
    return section("Between groups", *parts, tag("p", explained, class_="note"), id_="between")


def p_text(p: float) -> str:
    """A probability of a test, with two digits."""
    return f"{p:.2g}" if p >= 0.0001 else "< 0.0001"


def greatest_p(groups: Sequence[Group], column: str, first: str, *, paired: bool) -> float | None:
    """The greatest corrected p of the pairs of a measure in which a group is; None if there are no two groups of two
    runs or more."""
    if len(groups) < 2 or min(len(group.runs) for group in groups) < 2:
        return None
    [measure] = compared(groups, paired=paired, metrics=[column])
    return max(pair.p_corrected for pair in measure.pairs if first in (pair.first, pair.second))


def _title_and_scale(measure: Compared) -> tuple[str, float]:
    """Title of a measure and the factor of its numbers, since shares are shown as percentages."""
    return (f"{measure.title} (%)", 100.0) if measure_named(measure.name).percent else (measure.title, 1.0)


def _with_ends(value: float, ends: Ends | None, scale: float = 1.0) -> Markup:
    low, high = (np.nan, np.nan) if ends is None else ends
    shown = "" if np.isnan(low) or low == high else f"{_known(scale * low)} to {_known(scale * high)}"
    return tag("div", _known(scale * value), tag("div", shown, class_="note") if shown else None)


def _known(value: float) -> str:
    """A number, or that a target is never reached, whose cost is infinite."""
    return "never" if value == np.inf else number(value)


def _smallest(measure: Compared) -> str:
    words = "The smallest corrected p that so many runs allow is"
    return f"{words} {p_text(measure.smallest_p)}."


def _explained(groups: Sequence[Group], paired: bool) -> str:
    """What the numbers mean, and how far they can be trusted."""
    test = "Wilcoxon's signed-rank test of runs with equal seeds" if paired else "the test of Mann and Whitney"
    said = [
        f"Ranges are {100 * LEVEL:.0f} % intervals by the percentile bootstrap over runs.",
        "In simulations, those of 3 runs hold the true value three times in four, and those of 5 nine times in ten.",
        "The interquartile mean leaves out a quarter of the runs at each end.",
        "The probability of improvement is an effect size: that of a run of the first group being better than one of "
        "the second.",
        "The difference is the median of the differences between their runs.",
        f"p is two-sided, from {test}, and corrected by Holm's method for all pairs of groups.",
    ]
    if len(groups[0].tasks) > 1:
        said.append("Runs are drawn, compared and shared out within each task, and results averaged over tasks.")
    if not paired:
        said.append("Runs count as independent, also where groups have the same seeds.")
    if len(groups) > 2:
        said.append(
            "Whoever calls the first of several groups the best has chosen it by these values, which are then too high "
            "on the average; new seeds tell its value."
        )
    if repeated := [group.name for group in groups if not group.are_independent]:
        said.append(
            f"Several runs have the same seed in {', '.join(repeated)}: they are not independent, and p is wrong."
        )
    return " ".join(said)


def as_data(measures: Sequence[Compared]) -> list[dict[str, Any]]:
    """Measures as values of JSON; an infinite or missing number is None."""

    def plain(value: Any) -> Any:
        if isinstance(value, float):
            return value if np.isfinite(value) else None
        if hasattr(value, "_asdict"):
            return {key: plain(part) for key, part in value._asdict().items()}
        return [plain(part) for part in value] if isinstance(value, list | tuple) else value

    return [{**plain(measure), "smallest_p": measure.smallest_p, "level": LEVEL} for measure in measures]


def text_of(measures: Sequence[Compared], kind: str) -> str:
    """Measures as a file of a kind of FORMATS."""
    if kind == ".json":
        return json.dumps(as_data(measures), indent=1, allow_nan=False) + "\n"
    return _csv(measures) if kind == ".csv" else _latex(measures)


def _csv(measures: Sequence[Compared]) -> str:
    """A row for each group, whose second group is empty, and one for each pair."""
    file, rows = io.StringIO(), []
    for measure in as_data(measures):
        name = {"measure": measure["name"]}
        rows += [{**name, "first": average.pop("group"), **_flat(average)} for average in measure["averages"]]
        rows += [{**name, **_flat({**pair.pop("difference"), **pair})} for pair in measure["pairs"]]
    names = list(dict.fromkeys(name for row in [{"measure": 0, "first": 0, "second": 0}, *rows] for name in row))
    writer = csv.DictWriter(file, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values in which an interval is two columns."""
    flat = {}
    for name, value in values.items():
        if name.endswith("interval"):
            flat[f"{name}_low"], flat[f"{name}_high"] = value or (None, None)
        else:
            flat[name] = value
    return flat


def _latex(measures: Sequence[Compared]) -> str:
    """A table (booktabs) with a row for each group and a column for each measure."""
    titles, scales = zip(*map(_title_and_scale, measures), strict=True)
    heads = map(_escaped, titles)
    lines = [
        rf"% median, and {100 * LEVEL:.0f} \% interval by the percentile bootstrap over runs",
        rf"\begin{{tabular}}{{lr{'r' * len(measures)}}}",
        r"\toprule",
        " & ".join(["group", "runs", *heads]) + r" \\",
        r"\midrule",
    ]
    for rows in zip(*(measure.averages for measure in measures), strict=True):
        cells = []
        for average, scale in zip(rows, scales, strict=True):
            ends = average.median_interval
            known = "" if ends is None else rf" [{_in_latex(scale * ends[0])}, {_in_latex(scale * ends[1])}]"
            cells.append(f"{_in_latex(scale * average.median)}{known}")
        lines.append(" & ".join([_escaped(rows[0].group), str(rows[0].runs), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _in_latex(value: float) -> str:
    """A number in text, whose sign is a minus and no hyphen, and whose power of ten is one."""
    if power := re.fullmatch(r"(-?[\d.]+)e([+-]\d+)", text := _known(value)):
        return rf"${power[1]} \times 10^{{{int(power[2])}}}$"
    return re.sub(r"-[\d,.]+", r"$\g<0>$", text)


_ESCAPES = {sign: f"\\{sign}" for sign in "_%&#${}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def _escaped(text: str) -> str:
    return text.translate(str.maketrans(_ESCAPES))


def checked_kind(file: Path) -> str:
    """The kind of a file of statistics by its name. Raises ConfigError if it is none of FORMATS."""
    if file.suffix not in FORMATS:
        raise ConfigError(
            f"--statistics {file}: its name must end with one of {', '.join(FORMATS)}",
            field="statistics",
            value=str(file),
        )
    return file.suffix
