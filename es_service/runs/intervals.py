"""Intervals of what episodes have shown: 95 % for a mean (Student's t) and for a share (Wilson)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

LEVEL = 0.95
"""Probability with which an interval contains the true value."""


def mean_interval(values: Any) -> tuple[float, float, float]:
    """Mean of independent values, and the lower and the upper end of its interval by Student's t distribution.

    The ends are NaN for a single value, and all three are not finite if a value is not.
    """
    x = np.asarray(values, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        mean = float(x.mean())
        if x.size < 2:
            return mean, math.nan, math.nan
        from scipy.stats import t  # imported late: it takes a second, and most commands do not need it

        half = float(t.ppf((1.0 + LEVEL) / 2.0, x.size - 1) * x.std(ddof=1) / math.sqrt(x.size))
    return mean, mean - half, mean + half


def share_interval(successes: int, count: int) -> tuple[float, float]:
    """Lower and upper end of the interval of a probability of success, after `count` independent trials.

    Source: score interval of Wilson 1927. It stays within [0, 1], and has a width also for no and for only successes.
    """
    from scipy.stats import norm

    z = float(norm.ppf((1.0 + LEVEL) / 2.0))
    share, grown = successes / count, 1.0 + z * z / count
    middle = (share + z * z / (2.0 * count)) / grown
    half = z * math.sqrt(share * (1.0 - share) / count + z * z / (4.0 * count * count)) / grown
    return max(0.0, middle - half), min(1.0, middle + half)


def gap_interval(first: Any, second: Any, *, paired: bool) -> tuple[float, float, float]:
    """Mean of `second` minus that of `first`, and the lower and the upper end of its interval.

    Values that are paired may depend on each other, so the interval is that of their differences; independent ones may
    have other variances (Welch's t). The ends are as those of `mean_interval`.
    """
    x, y = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if paired:
        with np.errstate(invalid="ignore"):
            return mean_interval(y - x)
    with np.errstate(invalid="ignore", over="ignore"):
        gap = float(y.mean() - x.mean())
        if min(x.size, y.size) < 2:
            return gap, math.nan, math.nan
        of_x, of_y = x.var(ddof=1) / x.size, y.var(ddof=1) / y.size
    if of_x + of_y == 0.0:
        return gap, gap, gap
    from scipy.stats import t

    freedom = (of_x + of_y) ** 2 / (of_x**2 / (x.size - 1) + of_y**2 / (y.size - 1))
    half = float(t.ppf((1.0 + LEVEL) / 2.0, freedom) * math.sqrt(of_x + of_y))
    return gap, gap - half, gap + half


def share_gap_interval(first: Any, second: Any, *, paired: bool) -> tuple[float, float, float]:
    """Share of successes among `second` minus that among `first`, and the lower and the upper end of its interval.

    Source: Newcombe 1998, from the intervals of Wilson for both shares, of independent trials (method 10 of "Interval
    estimation for the difference between independent proportions"), and of paired ones (method 10 of "Improved
    confidence intervals ... based on paired data").
    """
    x, y = np.asarray(first, bool), np.asarray(second, bool)
    before, after = float(x.mean()), float(y.mean())
    (low_x, high_x), (low_y, high_y) = (share_interval(int(one.sum()), one.size) for one in (x, y))
    phi = _phi(x, y) if paired else 0.0

    def distance(down: float, up: float) -> float:
        return math.sqrt(max(0.0, down * down - 2.0 * phi * down * up + up * up))

    gap = after - before
    return gap, gap - distance(after - low_y, high_x - before), gap + distance(high_y - after, before - low_x)


def _phi(x: Any, y: Any) -> float:
    """Correlation of two yes or no, with Newcombe's correction of continuity; 0 if one of them is constant."""
    both, neither, only_x, only_y = (int(cells.sum()) for cells in (x & y, ~x & ~y, x & ~y, ~x & y))
    product = math.prod((both + only_x, only_y + neither, both + only_y, only_x + neither))
    if product == 0:
        return 0.0
    over = both * neither - only_x * only_y
    return (max(over - x.size / 2.0, 0.0) if over > 0 else over) / math.sqrt(product)


def false_pass_share(tries: int, episodes: int, below: float) -> float:
    """Probability that at least one of so many policies, whose expected fitness is `below` standard deviations of an
    episode's fitness below a target, has a mean over so many episodes that reaches it (normal approximation)."""
    from scipy.stats import norm

    return 1.0 - float(norm.cdf(below * math.sqrt(episodes))) ** tries
