"""Several runs of one task, grouped by their settings: medians over seeds with their intervals, and quartiles.

Axes: R runs of a group, K points of a curve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.config.parts import RESOURCES
from es_service.config.resolution import LEFT_OPEN
from es_service.config.text import did_you_mean, in_line, nearest, unknown_name
from es_service.errors import ConfigError
from es_service.report import statistics
from es_service.report.data import RunData
from es_service.report.measures import CERTIFIED, GAP, SUCCESS, as_compared, has_curve, measures
from es_service.report.series import X_AXES, Chart, Line, axes_of
from es_service.report.statistics import median_interval
from es_service.runs.sweep_plan import ENVIRONMENT, settings_words

POINTS = 200
"""Equally spaced points of a curve; the ends of each group are points, too."""
OWN_TO_A_RUN = ("seed", "compute.", RESOURCES)
"""Keys, or beginnings of keys, by which runs are not grouped unless a user says so."""


class Group(NamedTuple):
    """Runs with the same values of the keys by which runs are grouped."""

    name: str
    runs: tuple[RunData, ...]

    @property
    def seeds(self) -> int:
        """Number of different seeds among the runs."""
        return len({run.constants["seed"] for run in self.runs})

    @property
    def tasks(self) -> dict[str, list[RunData]]:
        """Task -> its runs, in the order of their seeds."""
        names = sorted({run.constants[ENVIRONMENT] for run in self.runs})
        by_seed = sorted(self.runs, key=lambda run: run.constants["seed"])
        return {name: [run for run in by_seed if run.constants[ENVIRONMENT] == name] for name in names}

    @property
    def are_independent(self) -> bool:
        """Whether no two runs of a task have the same seed."""
        return len({(run.constants[ENVIRONMENT], run.constants["seed"]) for run in self.runs}) == len(self.runs)

    def interval(self, y_R_K: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Interval of the median over the runs at each point, [2, K]; None if there are no two seeds.

        It is also None if two runs have the same seed, since their results do not vary independently. Over several
        tasks, runs are drawn within each of them, and curves of many points have none, since this takes long.
        """
        if self.seeds < 2 or not self.are_independent:
            return None
        if len(self.tasks) == 1:
            return median_interval(y_R_K)
        task_R = np.array([run.constants[ENVIRONMENT] for run in self.runs])
        drawn = statistics.interval(statistics.median, [y_R_K[task_R == task, 0] for task in self.tasks])
        return None if drawn is None or y_R_K.shape[1] > 1 else np.array(drawn)[:, None]


class Quartiles(NamedTuple):
    """Median and quartiles of one number over runs."""

    median: float
    low: float
    high: float


class Summary(NamedTuple):
    """The final values of a group."""

    group: Group
    values: Mapping[str, Quartiles]
    """History column -> its value at the end of each run."""
    intervals: Mapping[str, tuple[float, float]]
    """History column -> interval of the median of these values; empty if there is none, see `Group.interval`."""
    solved: int
    """Number of runs whose value, of `value_column`, reaches the threshold."""
    steps: Quartiles
    """Environment steps until the best fitness reached it, of the runs in which it did; NaN if it never did."""


def grouped(runs: Sequence[RunData], keys: Sequence[str] = ()) -> list[Group]:
    """Groups by the median of their certified values, the highest first, or else in the order of their first runs;
    each is named by the values of the keys.

    Args:
        keys: dotted config keys; none: the groups of their sweep, if the runs are of one sweep that has named them; or
            else the keys in which the runs differ, but for the seed and what follows from others, or the algorithm
            alone if it explains all differences.

    Raises:
        ConfigError: a key is unknown, or the runs are of different tasks.
    """
    constants = [run.constants for run in runs]
    known = sorted({key for settings in constants for key in settings})
    for key in keys if keys != GROUP else ():
        if key not in known:
            raise ConfigError(
                f"the runs cannot be grouped by {key}: no run has this setting{did_you_mean(key, known)}",
                field="group_by",
                value=key,
                suggestion=nearest(key, known),
            )
    tasks = {settings[ENVIRONMENT] for settings in constants}
    differing = [
        key
        for key in known
        if any(len({in_line(one.get(key)) for one in constants if one[ENVIRONMENT] == task}) > 1 for task in tasks)
    ]
    if len(tasks) > 1 and not all(run.bounds_of_fitness for run in runs):
        _refuse_other_tasks(runs, [ENVIRONMENT])
    of_one_sweep = all(run.group for run in runs) and len({run.folder.parent for run in runs}) == 1
    are_named = keys == GROUP or (not keys and of_one_sweep)
    allowed = {*keys, *(differing if are_named else ())} - {ENVIRONMENT}
    _refuse_other_tasks(runs, [key for key in differing if key not in allowed])
    chosen = list(keys) or _explaining(constants, differing)
    groups: dict[str, list[RunData]] = {}
    for run in runs:
        settings = {key: run.constants[key] for key in chosen if key in run.constants}
        name = run.group if are_named else settings_words(settings)
        groups.setdefault(name or str(run.constants["search.algorithm"]), []).append(run)
    found = [Group(name, tuple(members)) for name, members in groups.items()]
    for group in found:
        if lacking := tasks - group.tasks.keys():
            raise ConfigError(
                f"{group.name} has no run of {', '.join(sorted(lacking))}; over several tasks, each group must have "
                "runs of all of them",
                field=ENVIRONMENT,
                value=sorted(group.tasks),
            )
    if value_column(runs) == CERTIFIED:
        found.sort(key=lambda group: -np.median([run.last(CERTIFIED) for run in group.runs]))
    return found


GROUP = ("group",)
"""In the place of config keys: runs are grouped by the names of groups that they have, see `labelled`."""
NORMALISED = (CERTIFIED, "best_fitness")
SAME_IN_ALL_TASKS = (*X_AXES, SUCCESS, "coverage", "corrected_coverage")


def normalised(runs: Sequence[RunData], bounds: Mapping[str, tuple[float, float]]) -> list[RunData]:
    """Runs that can be compared over several tasks: their fitness is its share of the way between two bounds. What
    depends on the task otherwise is left out, and so are the maps.

    Args:
        bounds: task -> fitness that counts as 0 and as 1. None: the runs remain as they are.

    Raises ConfigError for a task that has no bounds, or equal ones.
    """
    if not bounds:
        return list(runs)
    found = []
    for run in runs:
        low, high = bounds_of_task(bounds, run.constants[ENVIRONMENT])
        history = {name: run.history[name] for name in SAME_IN_ALL_TASKS if name in run.history}
        history |= {name: (run.history[name] - low) / (high - low) for name in NORMALISED if name in run.history}
        if GAP in run.history:
            history[GAP] = run.history[GAP] / (high - low)
        found.append(replace(run, history=history, map=None, bounds_of_fitness=(low, high)))
    return found


def bounds_of_task(bounds: Mapping[str, tuple[float, float]], task: str) -> tuple[float, float]:
    """The fitness of a task that counts as 0, and that which counts as 1. Raises ConfigError if there are not two."""
    low, high = bounds.get(task, (0.0, 0.0))
    if low == high:
        raise ConfigError(
            f"bounds: {task} has {'equal ones' if task in bounds else 'none'}; name the fitness that counts as 0 "
            f"and as 1, such as {task}=-130,-25",
            field="bounds",
            value=bounds.get(task),
        )
    return low, high


def value_column(runs: Sequence[RunData]) -> str:
    """Column of the value by which runs are judged: certified if all are, else the best fitness."""
    return CERTIFIED if CERTIFIED in measures(runs) else "best_fitness"


def runs_of(groups: Sequence[Group]) -> list[RunData]:
    return [run for group in groups for run in group.runs]


def labelled(runs: Sequence[RunData], keys: Sequence[str], labels: Mapping[str, str]) -> list[RunData]:
    """Runs that know their groups under other names, which `GROUP` groups.

    Args:
        labels: name of a group -> what is shown.

    Raises ConfigError if there is no such group.
    """
    groups = grouped(runs, keys)
    names = [group.name for group in groups]
    for name in labels:
        if name not in names:
            raise unknown_name("group", name, names, "label")
    return [replace(run, group=labels.get(group.name, group.name)) for group in groups for run in group.runs]


def swept_keys(runs: Sequence[RunData]) -> list[str]:
    """Settings in which the runs of one sweep differ, also options of their task: whoever swept them compares them."""
    constants = [run.constants for run in runs]
    known = dict.fromkeys(key for settings in constants for key in settings)
    return _explaining(
        constants, [key for key in known if len({in_line(settings.get(key)) for settings in constants}) > 1]
    )


def _refuse_other_tasks(runs: Sequence[RunData], differing: Sequence[str]) -> None:
    for key in differing:
        if key.startswith("task."):
            values = {in_line(run.constants.get(key)): run for run in reversed(runs)}
            shown = "; ".join(f"{run.folder} has {value}" for value, run in reversed(values.items()))
            ways = "compare runs of one task"
            if key == ENVIRONMENT:
                ways += ", or name for each of them the fitness that counts as 0 and as 1, such as point_maze=-130,-25"
            else:
                ways += f", or group by {key}"
            raise ConfigError(
                f"these runs cannot be compared, because {key} differs: {shown}; {ways}", field=key, value=list(values)
            )


def _explaining(constants: Sequence[Mapping[str, Any]], differing: Sequence[str]) -> list[str]:
    own = [key for key in differing if not key.startswith(OWN_TO_A_RUN) and key not in LEFT_OPEN]
    if "search.algorithm" in own:
        by_algorithm: dict[str, set[str]] = {}
        for settings in constants:
            by_algorithm.setdefault(settings["search.algorithm"], set()).add(
                str([in_line(settings.get(key)) for key in own])
            )
        if all(len(values) == 1 for values in by_algorithm.values()):
            return ["search.algorithm"]
    return own


def common_axes(runs: Sequence[RunData]) -> dict[str, str]:
    """The costs against which groups are compared: column of the history that all runs have -> label."""
    return {
        column: label
        for column, label in X_AXES.items()
        if column != "generation" and all(column in axes_of(run.history) for run in runs)
    }


def charts(groups: Sequence[Group], axis: str) -> tuple[list[Chart], NDArray[np.float64]]:
    """A chart for each measure of all runs, and the places of its points on an axis, [K].

    A curve ends where the first run of its group ends, so that every point is over all of its runs. It is empty if that
    is before another run begins; so every axis has the same charts.
    """
    x_K = places(groups, axis)
    chart_list = []
    for column, measure in measures(runs_of(groups)).items():
        if not has_curve(runs_of(groups), column):
            continue
        lines = []
        for group in groups:
            y_R_K = values_at(group, column, axis, x_K)
            interval = group.interval(y_R_K)
            range_K = None if interval is None else (interval[0], interval[1])
            lines.append(Line(group.name, np.median(y_R_K, axis=0), range_K))
        chart_list.append(Chart(measure.title, measure.note, tuple(lines), None, measure.percent))
    return chart_list, x_K


def places(groups: Sequence[Group], axis: str) -> NDArray[np.float64]:
    """Places of the points of curves on a history column [K]: equally spaced ones from 0 to the end of the longest run,
    and the first and the last place at which all runs of a group have values, so that no curve loses its ends."""
    ends = [
        (
            max(float(np.nanmin(run.history[axis])) for run in group.runs),
            min(float(np.nanmax(run.history[axis])) for run in group.runs),
        )
        for group in groups
    ]
    last = max(float(np.nanmax(run.history[axis])) for group in groups for run in group.runs)
    return np.unique([*np.linspace(0.0, last, POINTS), *np.ravel(ends)])


def values_at(group: Group, column: str, axis: str, x_K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of the runs of a group at places of an axis [R, K]; NaN where a run has none."""
    return np.stack([at(run.history[axis], as_compared(run.history, column), x_K) for run in group.runs])


def at(x_G: NDArray[np.float64], y_G: NDArray[np.float64], x_K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Value of a run at places of an axis: that of its newest generation by then; NaN before the first and after the
    last generation."""
    row_K = np.searchsorted(x_G, x_K * (1 + 1e-12), side="right") - 1
    inside_K = (row_K >= 0) & (x_K <= x_G[-1] * (1 + 1e-12))
    return np.where(inside_K, y_G[np.maximum(row_K, 0)], np.nan)


def common_threshold(runs: Sequence[RunData]) -> float | None:
    """The target fitness of the runs' budgets, if they all have the same; a share where the fitness is one."""
    targets = set()
    for run in runs:
        target, (low, high) = run.meta.config["budget"].get("target_fitness"), run.bounds_of_fitness or (0.0, 1.0)
        targets.add(None if target is None else (target - low) / (high - low))
    return targets.pop() if len(targets) == 1 else None


def summaries(groups: Sequence[Group], threshold: float | None) -> list[Summary]:
    """The final values of each group; `threshold`: fitness from which a run counts as solved, None: no run does."""
    summary_list = []
    value, columns = value_column(runs_of(groups)), (*measures(runs_of(groups)), *common_axes(runs_of(groups)))
    for group in groups:
        last = {column: np.array([[run.last(column)] for run in group.runs], float) for column in columns}
        intervals = {column: group.interval(y_R_1) for column, y_R_1 in last.items()}
        steps = []
        for run in group.runs:
            if threshold is None:
                break
            reached = np.flatnonzero(run.history["best_fitness"] >= threshold)
            steps += [float(run.history["env_steps"][reached[0]])] if reached.size else []
        summary_list.append(
            Summary(
                group,
                {column: _quartiles(y_R_1[:, 0].tolist()) for column, y_R_1 in last.items()},
                {column: (float(x[0, 0]), float(x[1, 0])) for column, x in intervals.items() if x is not None},
                0 if threshold is None else int(np.sum(last[value] >= threshold)),
                _quartiles(steps),
            )
        )
    return summary_list


def _quartiles(values: Sequence[float]) -> Quartiles:
    if not values:
        return Quartiles(np.nan, np.nan, np.nan)
    with np.errstate(invalid="ignore"):  # of values that are infinite
        low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return Quartiles(float(median), float(low), float(high))


def median_run(group: Group) -> RunData:
    """The run of a group whose final value is the median (of an even number, the lower of the two)."""
    value = value_column(group.runs)
    ordered = sorted(group.runs, key=lambda run: run.last(value))
    return ordered[(len(ordered) - 1) // 2]
