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


def false_pass_share(tries: int, episodes: int, below: float) -> float:
    """Probability that at least one of so many policies, whose expected fitness is `below` standard deviations of an
    episode's fitness below a target, has a mean over so many episodes that reaches it (normal approximation)."""
    from scipy.stats import norm

    return 1.0 - float(norm.cdf(below * math.sqrt(episodes))) ** tries
