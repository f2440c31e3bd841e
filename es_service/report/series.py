"""The curves of a run: which columns of the history are drawn together, thinned to as many points as a page can show.

Axes: G generations, K points of a curve.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.loop.history import METRIC, evaluated_word
from es_service.runs.run_status import objectives, weights

HistoryColumns = Mapping[str, NDArray[np.float64]]
"""Column name -> its values; NaN stands for no value."""
MOST_POINTS = 300
"""A curve of more generations shows groups of neighbouring ones."""
X_AXES = {
    "generation": "generation",
    "env_steps": "environment steps",
    "wall_clock_s": "seconds",
    "rollout_s": "seconds of rollouts",
    "cpu_s": "seconds of processors",
}
"""History columns that curves can be drawn against -> labels."""
IN_EVERY_RUN = ("generation", "env_steps", "wall_clock_s")
"""Those of them that every run has; see `axes_of`."""
PHASES = {
    "seconds_rollout": "episodes of the population",
    "seconds_gradient": "gradient",
    "seconds_evaluation": "evaluation",
    "seconds_driver": "driver",
    "seconds_store": "store",
}
"""History columns that divide a generation's time -> labels."""

Thinning = Literal["last", "mean", "held"]
"""What a point shows of a group of generations: "last" for values so far, "mean" for values of one generation."""


class Line(NamedTuple):
    """A curve: its label and its values, [K]."""

    label: str
    y_K: NDArray[np.float64]
    range_K: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    """(low [K], high [K]) of the region around the curve, such as the interval of a median."""


class Chart(NamedTuple):
    """Curves that share both axes."""

    title: str
    note: str
    """What the values mean, one sentence."""
    lines: tuple[Line, ...]
    band: tuple[str, NDArray[np.float64], NDArray[np.float64]] | None
    """(label, low [K], high [K]) of a shaded region."""
    percent: bool
    """Whether values are fractions that are shown as percentages."""


class _Spec(NamedTuple):
    title: str
    note: str
    lines: tuple[tuple[str, str, Thinning], ...]
    band: tuple[str, str, str] | None = None
    percent: bool = False


_OF_METRICS = (
    "Metric of the search, of the task (mean over the evaluation episodes of the {evaluated}), or of the program that "
    "ran the session."
)
QD_ABOVE_LEAST = "qd_score_above_least"
"""Column of `qd_columns`."""
# {evaluated} is what `evaluated_word` says of the newest generation, {below} what `qd_columns` says.
_SPECS = (
    _Spec(
        "Fitness",
        "Mean over the evaluation episodes of a {evaluated}; of the population, the episodes of its members, which are "
        "training episodes with noise where a centre moves. Corrected: in the new episodes of map.correct_every.",
        (
            ("best {evaluated} so far", "best_fitness", "last"),
            ("{evaluated}", "centre_fitness_mean", "mean"),
            ("population, median", "population_fitness_median", "mean"),
            ("best elite, corrected", "corrected_fitness_max", "held"),
        ),
        ("population, quartiles", "population_fitness_q25", "population_fitness_q75"),
    ),
    _Spec(
        "Distance to the goal",
        "In the evaluation episodes of the {evaluated}.",
        (("at the end, mean", "goal_distance", "mean"), ("on the way, least", "goal_distance_min", "mean")),
    ),
    _Spec(
        "Coverage of the behaviour map",
        "Filled cells as a share of all cells, and of those that can be reached where the task knows its walls. "
        "Corrected: where the elites are by the means of new episodes.",
        (
            ("of all cells", "coverage", "last"),
            ("of reachable cells", "coverage_reachable", "last"),
            ("of all cells, corrected", "corrected_coverage", "held"),
        ),
        percent=True,
    ),
    _Spec(
        "QD-score",
        "Sum over all elites of fitness less map.qd_offset{below}. Corrected: of their means in new episodes.",
        (
            ("QD-score", "qd_score", "last"),
            ("above the least fitness", QD_ABOVE_LEAST, "last"),
            ("corrected", "corrected_qd_score", "held"),
        ),
    ),
    _Spec(
        "Novelty of the {evaluated}",
        "Mean distance of its descriptor to the nearest ones that were in the novelty archive before it.",
        (("novelty", "centre_novelty", "mean"),),
    ),
    _Spec(
        "Exploring and exploiting centres",
        "Share of the centres that climb novelty alone, and of those that climb fitness alone.",
        (
            ("exploring", "exploring", "mean"),
            ("exploiting", "exploiting", "mean"),
            ("exploring so far", "exploring_so_far", "last"),
            ("exploiting so far", "exploiting_so_far", "last"),
        ),
        percent=True,
    ),
    _Spec(
        "Weight of fitness (w)",
        "Weight beside novelty in the utilities, mean over centres: 1 follows fitness alone, 0 novelty alone.",
        (("w", "w", "mean"),),
    ),
)


def charts(history: HistoryColumns, centres: HistoryColumns, qd_offset: float) -> list[Chart]:
    """The charts of a run that have values, from the columns of its history and of its evaluated centres.

    Args:
        qd_offset: `map.qd_offset`.
    """
    ends_K = groups(len(history["generation"]))
    of_map, below = qd_columns(history, centres, qd_offset)
    history = {**history, **weight_columns(history["generation"], centres), **of_map}
    newest = {name: values_G[-1] for name, values_G in history.items() if values_G.size}
    word = evaluated_word(newest) if newest else "centre"
    chart_list = []
    own = [
        _Spec(name.removeprefix(METRIC), _OF_METRICS, ((name.removeprefix(METRIC), name, "mean"),))
        for name in history
        if name.startswith(METRIC)
    ]
    for spec in (*_SPECS, *own):
        lines = tuple(
            Line(label.format(evaluated=word), thinned(history[column], ends_K, group))
            for label, column, group in spec.lines
            if column in history and np.isfinite(history[column]).any()
        )
        if not lines:
            continue
        band = None
        if spec.band is not None and np.isfinite(history.get(spec.band[1], np.full(1, np.nan))).any():
            label, low, high = spec.band
            band = (label, thinned(history[low], ends_K, "mean"), thinned(history[high], ends_K, "mean"))
        chart_list.append(
            Chart(
                spec.title.format(evaluated=word),
                spec.note.format(evaluated=word, below=below),
                lines,
                band,
                spec.percent,
            )
        )
    return chart_list


def qd_columns(history: HistoryColumns, centres: HistoryColumns, qd_offset: float) -> tuple[HistoryColumns, str]:
    """The QD-score counted from the least fitness that was evaluated, which does not fall as cells fill, and what is to
    be said of the stored one; nothing unless a fitness was below the offset.

    The offset is 0 for a task that specifies no lowest reward. An elite below it then lowers the stored score, although
    the map has grown.
    """
    fitness_N = centres.get("fitness_mean", np.zeros(0))
    least = float(fitness_N[np.isfinite(fitness_N)].min(initial=np.inf))
    if "qd_score" not in history or least >= qd_offset:
        return {}, ""
    below = f" = {qd_offset:g}, so an elite below that lowers it; the other curve counts from {least:.6g}, the "
    return {QD_ABOVE_LEAST: history["qd_score"] + history["map_cells"] * (qd_offset - least)}, f"{below}least evaluated"


def weight_columns(generation_G: NDArray[np.float64], centres: HistoryColumns) -> HistoryColumns:
    """What the centres of each generation climb; nothing if all weights of fitness are the same.

    Where each centre of the run either explores or exploits: the shares of both, `exploring` and `exploiting`. With a
    single centre a generation, each share would be 0 or 1, so they are those of all centres so far. Where centres climb
    a mixture: their mean weight of fitness, `w`.
    """
    generation_N, weight_N = weights(centres)
    if not weight_N.size or np.ptp(weight_N) == 0.0:
        return {}
    row_N = np.searchsorted(generation_G, generation_N)
    count_G = np.bincount(row_N, minlength=generation_G.size)
    sum_G = np.bincount(row_N, weight_N, generation_G.size)
    with np.errstate(invalid="ignore"):  # no centre, in generation 0
        mean_G, so_far_G = sum_G / count_G, np.cumsum(sum_G) / np.cumsum(count_G)
    if not objectives(weight_N).are_separate:
        return {"w": mean_G}
    if count_G.max() == 1:
        return {"exploring_so_far": 1.0 - so_far_G, "exploiting_so_far": so_far_G}
    return {"exploring": 1.0 - mean_G, "exploiting": mean_G}


def axes_of(history: HistoryColumns) -> dict[str, str]:
    return {
        column: label
        for column, label in X_AXES.items()
        if column in IN_EVERY_RUN or (column in history and np.isfinite(history[column]).all())
    }


def x_axes(history: HistoryColumns) -> dict[str, NDArray[np.float64]]:
    """Values of every axis of a run at the end of each group of generations, [K]."""
    ends_K = groups(len(history["generation"]))
    return {column: thinned(history[column], ends_K, "last") for column in axes_of(history)}


def phase_seconds(history: HistoryColumns) -> dict[str, float]:
    """Seconds of each phase over the whole run, by label of PHASES."""
    return {label: float(np.nansum(history[column])) for column, label in PHASES.items() if column in history}


def phase_curves(history: HistoryColumns) -> tuple[NDArray[np.float64], Mapping[str, NDArray[np.float64]]]:
    """Generation at the end of each group [K], and by label of PHASES the mean seconds of a generation [K]."""
    ends_K = groups(len(history["generation"]))
    curves = {
        label: np.maximum(np.nan_to_num(thinned(history[column], ends_K, "mean")), 0.0)  # a forged time may be negative
        for column, label in PHASES.items()
        if column in history
    }
    return thinned(history["generation"], ends_K, "last"), curves


def groups(generations: int) -> NDArray[np.int64]:
    """End (exclusive) of each group of neighbouring generations, [K], at most MOST_POINTS; all but the last equal."""
    size = max(1, -(-generations // MOST_POINTS))
    return np.minimum(np.arange(1, -(-generations // size) + 1) * size, generations)


def thinned(values_G: NDArray[np.float64], ends_K: NDArray[np.int64], group: Thinning) -> NDArray[np.float64]:
    """One value for each group, [K]: the last or the mean of its finite values; NaN for a group without any. held: the
    last finite value up to the end of the group, for values that only some generations have."""
    starts_K = np.concatenate([[0], ends_K[:-1]])
    if not ends_K.size:
        return np.zeros(0)
    finite_G = np.isfinite(values_G)
    if group != "mean":
        last_G = np.maximum.accumulate(np.where(finite_G, np.arange(values_G.size), -1))[ends_K - 1]
        first_K = 0 if group == "held" else starts_K
        return np.where(last_G >= first_K, values_G[np.maximum(last_G, 0)], np.nan)
    with np.errstate(invalid="ignore"):
        sums_K = np.add.reduceat(np.where(finite_G, values_G, 0.0), starts_K)
        return sums_K / np.where(counts := np.add.reduceat(finite_G.astype(float), starts_K), counts, np.nan)


def lone(x_K: NDArray[np.float64], y_K: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether a point of a curve is there and its neighbours are not, so that no line leads to it, [K]."""
    there_K = np.pad(np.isfinite(x_K) & np.isfinite(y_K), 1)
    return there_K[1:-1] & ~there_K[:-2] & ~there_K[2:]
