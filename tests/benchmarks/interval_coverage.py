"""How often do the intervals of a comparison hold the true value, with few runs?

    python -m tests.benchmarks.interval_coverage

Runs are drawn from distributions whose median, interquartile mean and probability of improvement are known: normal,
skewed (lognormal, sigma 1), and of two kinds (a run gets stuck with probability 0.4). The table has the share of 2,000
comparisons whose 95 % interval holds the true value, and how often p is below 0.05 where both groups are the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from es_service.report import statistics

COMPARISONS, SEEDS, TRUTH = 2000, (3, 5, 10), 2_000_000
Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]


def _two_kinds(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    return np.where(rng.random(count) < 0.4, rng.normal(0.0, 0.1, count), rng.normal(1.0, 0.1, count))


DRAWS: dict[str, Draw] = {
    "normal": lambda rng, count: rng.normal(size=count),
    "skewed": lambda rng, count: rng.lognormal(size=count),
    "two kinds": _two_kinds,
}


def main() -> None:
    """Print the table."""
    heads = ("values", "runs a group", "median", "interquartile mean", "probability of improvement")
    print(f"| {' | '.join(heads)} | p < 0.05 of equal groups |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, draw in DRAWS.items():
        many = draw(np.random.default_rng(0), TRUTH)
        truth = {statistics.median: float(np.median(many)), statistics.iqm: float(statistics.iqm([many]))}
        for runs in SEEDS:
            rng, held, improved, false = np.random.default_rng(runs), dict.fromkeys(truth, 0), 0, 0
            for _ in range(COMPARISONS):
                x, y = draw(rng, runs), draw(rng, runs)
                for measure, value in truth.items():
                    low, high = statistics.interval(measure, [x]) or (np.nan, np.nan)
                    held[measure] += low <= value <= high
                found = statistics.difference([x], [y])
                improved += found.interval[0] <= 0.5 <= found.interval[1]
                false += found.p < 0.05
            shares = [100 * count / COMPARISONS for count in (*held.values(), improved, false)]
            print(f"| {name} | {runs} | " + " | ".join(f"{share:.0f} %" for share in shares) + " |")


if __name__ == "__main__":
    main()
