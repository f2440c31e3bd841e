"""How well a median over seeds is known: the percentile bootstrap, computed exactly, without random numbers.

A bootstrap draws as many seeds as there are, with repetitions, and takes their median; the interval holds the middle
95 % of these medians (Efron, Annals of Statistics 7, 1979). All n^n ways to draw n seeds are counted here, not sampled,
so the same runs always have the same interval.

Axes: R runs with different seeds, K points of a curve, M pairs of runs between which a median can lie.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from es_service.runs.selection import LEVEL

WHOLE_RANGE = 5
"""With at most so many seeds, the interval reaches from the lowest to the highest value."""


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
