"""What runs are compared by: columns of their history, and columns that are made of their certifications.

Axes: G generations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.config.text import unknown_name
from es_service.loop.history import CORRECTED, METRIC
from es_service.report.series import HistoryColumns
from es_service.runs.certified import measure_of

if TYPE_CHECKING:
    from es_service.report.data import RunData

CERTIFIED = "certified"
SUCCESS = "certified_success"
GAP = "selection_gap"
ELSEWHERE, GAP_ELSEWHERE = "certified in ", "gap in "
"""Beginnings of the columns of what was certified in another task: the value, and how much higher it is there."""


class Measure(NamedTuple):
    """What is said of a column by which runs are compared."""

    title: str
    """Of its chart."""
    label: str
    """Its name on an axis or in a table."""
    note: str
    percent: bool = False
    """Whether it is a fraction that is shown as a percentage."""
    less_is_better: bool = False


_CORRECTED = "Of the elites' means in the new episodes of map.correct_every."
MEASURES = {
    CERTIFIED: Measure(
        "Certified value",
        "certified",
        "Mean fitness of the certified policy in episodes that no selection has seen; each holds until the next one.",
    ),
    SUCCESS: Measure("Certified successes", "certified success", "Share of the same episodes that succeed.", True),
    "best_fitness": Measure(
        "Best fitness so far",
        "best fitness",
        "Highest mean fitness of an evaluated centre or policy: selected, and so partly luck.",
    ),
    GAP: Measure(
        "Gap of selection",
        "best less certified",
        "How much higher the best fitness is than the certified value.",
        less_is_better=True,
    ),
    "goal_distance": Measure(
        "Distance to the goal",
        "distance to the goal",
        "Mean over the evaluation episodes of the newest centre or policy.",
        less_is_better=True,
    ),
    "corrected_coverage": Measure("Corrected coverage", "corrected coverage", _CORRECTED, True),
    "corrected_qd_score": Measure("Corrected QD-score", "corrected QD-score", _CORRECTED),
    "coverage": Measure("Coverage of the behaviour map", "coverage", "Filled cells as a share of all cells.", True),
    "qd_score": Measure(
        "QD-score",
        "QD-score",
        "Sum over all elites of fitness less map.qd_offset; an elite below that offset lowers it.",
    ),
}
"""Columns by which runs are compared wherever all of them have these, in the order in which they are shown."""


def measure_named(column: str) -> Measure:
    """What is said of a column of the history."""
    for beginning, note in (
        (ELSEWHERE, "Mean fitness of the policy in this other task, in episodes that no selection has seen."),
        (GAP_ELSEWHERE, "How much higher the certified value is in this other task than in the task of the run."),
    ):
        if column.startswith(beginning):
            return Measure(column[:1].upper() + column[1:], column, note)
    if column.startswith(METRIC):
        name = column.removeprefix(METRIC)
        return Measure(name, name, "A metric that the run records; greater values count as better.")
    return MEASURES.get(column) or Measure(column, column, "")


def measures(runs: Sequence[RunData]) -> dict[str, Measure]:
    """Column -> what is said of it, for all columns that all runs have a value of."""
    of_both = (ELSEWHERE, GAP_ELSEWHERE), METRIC
    elsewhere, own = ([column for column in runs[0].history if column.startswith(one)] for one in of_both)
    names = [CERTIFIED, SUCCESS, *elsewhere, *(name for name in MEASURES if name not in (CERTIFIED, SUCCESS)), *own]
    has_values = [{name for name, values in run.history.items() if np.isfinite(values).any()} for run in runs]
    return {name: measure_named(name) for name in names if all(name in known for known in has_values)}


def chosen(runs: Sequence[RunData], names: Sequence[str]) -> dict[str, Measure]:
    """What `measures` returns, or some of it. Raises ConfigError for one that a run lacks."""
    found = measures(runs)
    for name in names:
        if name not in found:
            raise unknown_name("measure", name, found, "metrics")
    return {name: found[name] for name in names} or found


def has_curve(runs: Sequence[RunData], column: str) -> bool:
    """Whether a measure of runs is drawn as a curve: certified values only if they were certified before their ends."""
    if column == GAP or column.startswith((CERTIFIED, GAP_ELSEWHERE)):
        return column.startswith(CERTIFIED) and all(np.isfinite(run.history[column][:-1]).any() for run in runs)
    return True


def with_derived(history: HistoryColumns, certified: Sequence[Mapping[str, Any]], fitness: str) -> HistoryColumns:
    """A history with the columns of certifications, in which corrected values hold until the next ones.

    Args:
        certified: what `certified_over_time` returns; the value holds from the generation on from which a policy was
            taken, or from the last one, if that is not known.
        fitness: `task.fitness`.
    """
    derived = {name: held(history[name]) for name in history if name in CORRECTED}
    steps_G, value = history["env_steps"], f"{measure_of(fitness)}_mean"
    if not steps_G.size:
        return history
    for row in sorted(certified, key=lambda row: np.inf if row["env_steps"] is None else row["env_steps"]):
        since = steps_G[-1] if row["env_steps"] is None else row["env_steps"]
        found = {CERTIFIED: row[value]}
        if row["successes"] is not None:
            found[SUCCESS] = row["successes"] / row["episodes"]
        if "elsewhere" in row:
            found[f"{ELSEWHERE}{row['elsewhere']}"] = row[f"elsewhere_{value}"]
            found[f"{GAP_ELSEWHERE}{row['elsewhere']}"] = row[f"gap_{value}"]
        for name, number in found.items():
            column_G = derived.setdefault(name, np.full(steps_G.size, np.nan))
            column_G[steps_G >= since] = number
    if CERTIFIED in derived:
        with np.errstate(invalid="ignore"):  # both may be -inf
            derived[GAP] = history["best_fitness"] - derived[CERTIFIED]
    return {**history, **derived}


def as_compared(history: HistoryColumns, column: str) -> NDArray[np.float64]:
    """A column as runs are compared by it, [G]: a metric that only some generations have holds until its next value."""
    return held(history[column]) if column.startswith(METRIC) else history[column]


def held(values_G: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each value until the next one, [G]."""
    last_G = np.maximum.accumulate(np.where(np.isfinite(values_G), np.arange(values_G.size), -1))
    return np.where(last_G >= 0, values_G[np.maximum(last_G, 0)], np.nan)
