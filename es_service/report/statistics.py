"""Statistics of groups of runs: averages with intervals, and how likely one group is better than another.

The measures are those of Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (NeurIPS
2021, and its package rliable). A group has for each task an array of the values of its runs, [R]; greater values are
better. A value may be infinite, such as minus the cost of a run that never reached its target; then there is no mean.

Intervals are percentile bootstraps (Efron, Annals of Statistics 7, 1979) in which the runs of each task are drawn anew,
with repetitions. If there are few enough ways to draw them, all are counted, otherwise DRAWS are drawn by a generator
with a fixed seed: the same values always have the same interval. For the median over the seeds of one task, all n^n
ways to draw n of them are always counted.

Axes: R runs of a task, W ways to draw them, K thresholds or points of a curve, M pairs of runs between which a median
can lie.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import combinations, combinations_with_replacement
from math import comb, factorial, prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from es_service.runs.selection import LEVEL

WHOLE_RANGE = 5
"""With at most so many seeds, the interval reaches from the lowest to the highest value."""
MOST_COUNTED = 20_000
"""Most ways to draw runs, or to share them out between two groups, that are all counted."""
DRAWS = 20_000
TRIM = 0.25
"""Share of the values that an interquartile mean leaves out at each end."""
Array = NDArray[np.float64]
TaskValues = Sequence[Array]
"""Values of the runs of a group, an array for each task."""
Statistic = Callable[[TaskValues], Any]
"""A number of each way [W] to draw runs, from their values [W, R] of each task."""


def median_interval(y_R_K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interval of the median over at least two runs, (low, high) at each point [2, K]; NaN where a run has no value."""
    lower_M, upper_M, share_M = _medians(len(y_R_K))
    sorted_R_K = np.sort(y_R_K, axis=0)
    median_M_K = (sorted_R_K[lower_M] + sorted_R_K[upper_M]) / 2
    order_M_K = np.argsort(median_M_K, axis=0, kind="stable")
    share_M_K = share_M[order_M_K]
    tail = (1 - LEVEL) / 2 * (1 - 1e-12)
    first_K = np.argmax(np.cumsum(share_M_K, axis=0) >= tail, axis=0)
    last_K = len(share_M) - 1 - np.argmax(np.cumsum(share_M_K[::-1], axis=0) >= tail, axis=0)
    ends_2_K = np.take_along_axis(order_M_K, np.stack([first_K, last_K]), axis=0)
    found_2_K = np.take_along_axis(median_M_K, ends_2_K, axis=0)
    return np.where(np.isnan(y_R_K).any(axis=0), np.nan, found_2_K)


def coverage(seeds: int) -> float:
    """Probability that the lowest and the highest of so many values hold the median of all possible seeds between them.

    It is that of not having all values on one side, whatever their distribution (Thompson, Annals of Mathematical
    Statistics 7, 1936).
    """
    return 1 - 2.0 ** (1 - seeds)


@cache
def _medians(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """The medians of all n^n ways to draw n values, as the ranks of the two middle values and the share of the ways.

    Both middle values are the same one if n is odd.
    """
    half, is_even = (n + 1) // 2, n % 2 == 0

    def above_half(i: int) -> int:
        """Ways to draw more than half of the values among the i least: both middle values are among them."""
        return sum(comb(n, drawn) * i**drawn * (n - i) ** (n - drawn) for drawn in range(n // 2 + 1, n + 1))

    below = [above_half(i) for i in range(n + 1)]
    count = {(i, i): below[i] - below[i - 1] for i in range(1, n + 1)}
    if is_even:
        # One half of the draws has its greatest at i, the other half its least at j.
        greatest = [i**half - (i - 1) ** half for i in range(1, n + 1)]
        for j in range(1, n + 1):
            least = comb(n, half) * ((n - j + 1) ** half - (n - j) ** half)
            count[j, j] -= least * (j - 1) ** half  # the lower middle value is less than j
            for i in range(1, j):
                count[i, j] = least * greatest[i - 1]
    ranks_M_2 = np.array(list(count)) - 1
    return ranks_M_2[:, 0], ranks_M_2[:, 1], np.array([number / n**n for number in count.values()])


class Difference(NamedTuple):
    """How one group differs from another."""

    improvement: float
    """Probability that a run of the first has a greater value than one of the second; of equal ones half."""
    interval: tuple[float, float]
    """Of that probability, at LEVEL."""
    shift: float
    """By how much values of the first are greater: the median of all differences (Hodges and Lehmann 1963), in units
    of the values; over several tasks their mean. NaN if a value is infinite."""
    p: float
    """Two-sided probability of at least so uneven a comparison of equal groups: of Mann and Whitney's test, or, if
    runs are paired, of Wilcoxon's."""
    smallest_p: float
    """The smallest p that so many runs can have."""


def median(values: TaskValues) -> Any:
    return np.median(np.concatenate(values, axis=-1), axis=-1)


def iqm(values: TaskValues) -> Any:
    """The interquartile mean of the values of all tasks, [W]: the mean without a quarter of them, rounded down, at each
    end."""
    return stats.trim_mean(np.concatenate(values, axis=-1), TRIM, axis=-1)


def interval(measure: Statistic, values: TaskValues) -> tuple[float, float] | None:
    """Bootstrap interval of a measure at LEVEL, (low, high); None if a task has less than two runs."""
    if min(map(len, values)) < 2:
        return None
    drawn, share_W = _drawn(values)
    return _percentiles(np.asarray(measure(drawn), float), share_W)


def interval_of_median(values: TaskValues) -> tuple[float, float] | None:
    """As `interval` of the median; with one task, all ways to draw its runs are counted, however many there are."""
    if len(values) > 1 or len(values[0]) < 2:
        return interval(median, values)
    low, high = median_interval(values[0][:, None])[:, 0].tolist()
    return low, high


def profile(values: TaskValues, threshold_K: Array) -> Array:
    """Performance profile [K]: the share of runs with at least each threshold, averaged over tasks."""
    return np.mean([(task[:, None] >= threshold_K).mean(axis=0) for task in values], axis=0)


def profile_interval(values: TaskValues, threshold_K: Array) -> Array | None:
    """Bootstrap interval of a performance profile at each threshold by itself, (low, high) [2, K]; see `interval`."""
    ends = [
        interval(lambda drawn, at=at: np.mean([(x >= at).mean(axis=-1) for x in drawn], axis=0), values)
        for at in threshold_K
    ]
    return None if None in ends else np.array(ends, float).T


def improvement(first: TaskValues, second: TaskValues) -> Any:
    """Probability that a run of the first group has a greater value than one of the second, [W], averaged over tasks;
    of equal values half (Vargha and Delaney, Journal of Educational and Behavioral Statistics 25, 2000)."""
    return np.mean([_greater(x, y) for x, y in zip(first, second, strict=True)], axis=0)


def difference(first: TaskValues, second: TaskValues, *, paired: bool = False) -> Difference:
    """How the first group differs from the second.

    Args:
        paired: whether the runs of a task at the same place belong together, such as those with equal seeds. Then runs
            are compared and drawn in pairs.

    Raises:
        ValueError: paired groups have different numbers of runs.
    """
    shift = float(np.mean([_shift(x, y, paired) for x, y in zip(first, second, strict=True)]))
    if paired:
        gaps = [_gap(x, y) for x, y in zip(first, second, strict=True)]
        known = interval(_share_above, gaps) or (np.nan, np.nan)
        p, smallest = _sign_test(gaps)
        return Difference(float(_share_above(gaps)), known, shift, p, smallest)
    (x_draws, x_share), (y_draws, y_share) = _drawn(first), _drawn(second, seed=1)
    if len(x_share) * len(y_share) <= MOST_COUNTED:
        x_row, y_row = (rows.ravel() for rows in np.indices((len(x_share), len(y_share))))
        share_W = x_share[x_row] * y_share[y_row]
    else:
        rng = np.random.default_rng(2)
        x_row, y_row = (rng.choice(len(share), DRAWS, p=share) for share in (x_share, y_share))
        share_W = np.full(DRAWS, 1 / DRAWS)
    drawn = improvement([x[x_row] for x in x_draws], [y[y_row] for y in y_draws])
    known = _percentiles(drawn, share_W) if min(map(len, (*first, *second))) > 1 else (np.nan, np.nan)
    p, smallest = _rank_test(first, second)
    return Difference(float(improvement(first, second)), known, shift, p, smallest)


def holm(p_values: Sequence[float]) -> list[float]:
    """The probabilities of several tests, corrected so that the least of them may be believed (Holm, Scandinavian
    Journal of Statistics 6, 1979): the k-th least of n, times n - k + 1, and never below those before it."""
    order, corrected, least = np.argsort(p_values, kind="stable"), [1.0] * len(p_values), 0.0
    for done, place in enumerate(order):
        least = corrected[place] = min(1.0, max(least, (len(p_values) - done) * p_values[place]))
    return corrected


def _greater(x: Array, y: Array) -> Any:
    """Share of pairs of values [W, R] in which x is greater, [W]; equal values count half."""
    above, below = x[..., :, None] > y[..., None, :], x[..., :, None] < y[..., None, :]
    return 0.5 + (above.mean(axis=(-2, -1)) - below.mean(axis=(-2, -1))) / 2


def _gap(x: Array, y: Array) -> Array:
    """First less second of each pair; of two equal infinities 0."""
    if len(x) != len(y):
        raise ValueError(f"groups of {len(x)} and {len(y)} runs cannot be paired")
    with np.errstate(invalid="ignore"):
        return np.where(x == y, 0.0, x - y)


def _share_above(gaps: TaskValues) -> Any:
    """Share of pairs with a positive gap, averaged over tasks, [W]; a gap of 0 counts half."""
    return np.mean([0.5 + np.sign(gap).mean(axis=-1) / 2 for gap in gaps], axis=0)


def _shift(x: Array, y: Array, paired: bool) -> float:
    with np.errstate(invalid="ignore"):
        gaps = _gap(x, y) if paired else (x[:, None] - y[None, :]).ravel()
    if not np.isfinite(gaps).all():
        return float("nan")
    if paired:  # of the means of all pairs of gaps, each with itself, too
        i, j = np.triu_indices(len(gaps))
        gaps = (gaps[i] + gaps[j]) / 2
    return float(np.median(gaps))


def _rank_test(first: TaskValues, second: TaskValues) -> tuple[float, float]:
    """(two-sided p of Mann and Whitney's test, over tasks of the mean probability of improvement; the smallest)."""
    ways = [comb(len(x) + len(y), len(x)) for x, y in zip(first, second, strict=True)]
    smallest = min(1.0, 2 / prod(ways))
    if len(first) == 1 and ways[0] > MOST_COUNTED:
        return float(stats.mannwhitneyu(first[0], second[0], method="asymptotic").pvalue), smallest
    pooled = [np.concatenate(both) for both in zip(first, second, strict=True)]
    shared = [_ways_to_share(len(x), len(values)) for x, values in zip(first, pooled, strict=True)]
    if is_counted := prod(ways) <= MOST_COUNTED:
        rows = np.indices([len(task) for task in shared]).reshape(len(shared), -1)
    else:
        rng = np.random.default_rng(3)
        rows = [rng.integers(len(task), size=DRAWS) for task in shared]
    means = []
    for values, chosen_C_R, row_W in zip(pooled, shared, rows, strict=True):
        rank = stats.rankdata(values)
        size, others = chosen_C_R.shape[1], len(values) - chosen_C_R.shape[1]
        wins_C = rank[chosen_C_R].sum(axis=1) - size * (size + 1) / 2
        means.append((wins_C / (size * others))[row_W])
    uneven_W = np.abs(np.mean(means, axis=0) - 0.5)
    found = abs(float(improvement(first, second)) - 0.5)
    is_as_uneven_W = uneven_W >= found - 1e-9
    # What was found is one way, too: a p of 0 is none (Phipson and Smyth 2010).
    return float(is_as_uneven_W.mean() if is_counted else (1 + is_as_uneven_W.sum()) / (1 + DRAWS)), smallest


def _sign_test(gaps: TaskValues) -> tuple[float, float]:
    """(two-sided p of Wilcoxon's signed-rank test, over the pairs of all tasks; the smallest that it can be)."""
    gap = np.concatenate(gaps)
    smallest = min(1.0, 2.0 ** (1 - len(gap)))
    if not gap.any():
        return 1.0, smallest
    rank = np.where(gap == 0, 0.0, stats.rankdata(np.abs(gap)))  # pairs without a gap have no sign (Pratt 1959)
    if 2 ** len(gap) <= MOST_COUNTED:
        sign_W_R = 1 - 2 * ((np.arange(2 ** len(gap))[:, None] >> np.arange(len(gap))) & 1)
        uneven_W = np.abs(sign_W_R @ rank)
        return float((uneven_W >= abs(np.sign(gap) @ rank) - 1e-9).mean()), smallest
    found: Any = stats.wilcoxon(np.sign(gap) * rank, zero_method="pratt", method="asymptotic")
    return float(found.pvalue), smallest


@cache
def _ways_to_share(first: int, both: int) -> NDArray[np.intp]:
    """All choices of `first` places among `both`, or DRAWS of them by a generator with a fixed seed, [C, first]."""
    if comb(both, first) <= MOST_COUNTED:
        return np.array(list(combinations(range(both), first)))
    rng = np.random.default_rng(4)
    return rng.permuted(np.tile(np.arange(both), (DRAWS, 1)), axis=1)[:, :first]


@cache
def _ways_to_draw(runs: int) -> tuple[NDArray[np.intp], Array]:
    """All ways to draw as many runs as there are, regardless of their order [C, R], and the share of each [C]."""
    ways = np.array(list(combinations_with_replacement(range(runs), runs)))
    times = np.apply_along_axis(np.bincount, 1, ways, minlength=runs)
    orders = np.array([factorial(runs) / prod(map(factorial, row)) for row in times.tolist()])
    return ways, orders / orders.sum()


def _drawn(values: TaskValues, seed: int = 0) -> tuple[list[Array], Array]:
    """Values of drawn runs [W, R] of each task, and the share of each way [W]."""
    sizes = [len(task) for task in values]
    if prod(comb(2 * size - 1, size) for size in sizes) <= MOST_COUNTED:
        ways = [_ways_to_draw(size) for size in sizes]
        rows = np.indices([len(share) for _, share in ways]).reshape(len(ways), -1)
        drawn = [task[way[row]] for task, (way, _), row in zip(values, ways, rows, strict=True)]
        return drawn, np.prod([share[row] for (_, share), row in zip(ways, rows, strict=True)], axis=0)
    rng = np.random.default_rng(seed)
    drawn = [task[rng.integers(len(task), size=(DRAWS, len(task)))] for task in values]
    return drawn, np.full(DRAWS, 1 / DRAWS)


def _percentiles(number_W: Array, share_W: Array) -> tuple[float, float]:
    """The ends of the middle of numbers that has LEVEL of all shares; NaN if one is NaN."""
    if np.isnan(number_W).any():
        return float("nan"), float("nan")
    tail = (1 - LEVEL) / 2 * (1 - 1e-12)
    order = np.argsort(number_W, kind="stable")
    low = order[np.argmax(np.cumsum(share_W[order]) >= tail)]
    high = order[::-1][np.argmax(np.cumsum(share_W[order][::-1]) >= tail)]
    return float(number_W[low]), float(number_W[high])
