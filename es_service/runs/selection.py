"""Episodes by which candidates are chosen, or by which what was chosen is certified, and intervals of what they show:
95 % for a mean (Student's t) and for a share (Wilson).

Axes: E episodes, D policy parameters, O observation, B descriptor dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from es_service.loop.contents import policy_work
from es_service.loop.generation import episodes_of
from es_service.protocol.content import Policy
from es_service.protocol.episodes import Evaluator, completed, part_of
from es_service.protocol.messages import EpisodesResult
from es_service.protocol.noise import Domain

FIRST_EPISODES = 16
"""Selection episodes of each candidate in the first round; each later round has twice as many as the one before."""


RankedBy = Literal["return", "last_reward", "success", "goal_distance"]
"""What selection episodes rank by; the least goal distance ranks by its negative, since higher is better."""
RANKED_BY: tuple[RankedBy, ...] = get_args(RankedBy)


@dataclass(frozen=True)
class StoredEpisodes:
    """What is kept of episodes of a policy, whatever the run's `task.fitness` is."""

    return_E: NDArray[np.float64]
    last_reward_E: NDArray[np.float64]
    """Reward of the last valid step."""
    goal_distance_E: NDArray[np.float64]
    """Least distance to the goal along the episode; NaN if the task has no goal."""
    success_E: NDArray[np.bool_] | None
    """Whether the episode succeeded; None if the task does not declare success."""
    steps_E: NDArray[np.int64]
    descriptor_E_B: NDArray[np.float64]

    @property
    def steps(self) -> int:
        return int(self.steps_E.sum())

    @property
    def count(self) -> int:
        return self.return_E.size

    def fitness(self, kind: str) -> NDArray[np.float64]:
        """Fitness of each episode, [E]; `kind` is `task.fitness`."""
        return self.return_E if kind == "sum" else self.last_reward_E

    def mean_fitness(self, kind: str) -> float:
        with np.errstate(invalid="ignore", over="ignore"):
            return float(self.fitness(kind).mean())

    @property
    def measures(self) -> dict[RankedBy, NDArray[Any] | None]:
        """What each episode has of each measure, [E]; None for what the task does not have."""
        has_goal = not np.isnan(self.goal_distance_E).all()
        return {
            "return": self.return_E,
            "last_reward": self.last_reward_E,
            "goal_distance": self.goal_distance_E if has_goal else None,
            "success": self.success_E,
        }

    def values(self) -> dict[str, float | int | None]:
        """Means with their intervals, and successes, by column name; None for what the task does not have."""
        columns: dict[str, float | int | None] = {}
        for name, values_E in self.measures.items():
            if name != "success":
                columns |= interval_columns(name, None if values_E is None else mean_interval(values_E))
        successes = None if self.success_E is None else int(self.success_E.sum())
        low, high = (None, None) if successes is None else share_interval(successes, self.count)
        return columns | {"successes": successes, "success_low": low, "success_high": high}


@dataclass(frozen=True)
class SelectionRecord:
    """A candidate with its selection episodes so far."""

    index: int
    rounds: tuple[StoredEpisodes, ...] = ()

    @property
    def count(self) -> int:
        return sum(episodes.count for episodes in self.rounds)

    def mean(self, by: RankedBy) -> float:
        """Mean of a measure over all its episodes, higher is better; NaN without episodes."""
        values = {
            "return": lambda episodes: episodes.return_E,
            "last_reward": lambda episodes: episodes.last_reward_E,
            "success": lambda episodes: episodes.success_E,
            "goal_distance": lambda episodes: -episodes.goal_distance_E,
        }[by]
        if not self.rounds:
            return math.nan
        with np.errstate(invalid="ignore", over="ignore"):
            return float(np.concatenate([values(episodes) for episodes in self.rounds]).mean(dtype=np.float64))

    def order(self, by: RankedBy) -> tuple[float, float]:
        """Key by which the best is the first; a mean that is not finite comes last."""
        means = (self.mean(by), self.mean("return"))
        first, second = (-mean if math.isfinite(mean) else math.inf for mean in means)
        return first, second


def halved(
    engine: Evaluator, given: Sequence[Policy], seed: int, number: int, keep: int, by: RankedBy
) -> tuple[list[SelectionRecord], int]:
    """The `keep` best candidates by successive halving, best first, and the environment steps that it took.

    In each round, every candidate that is left has the same new episodes as the others, twice as many as in the round
    before; then the worse half leaves. Means are over the episodes of all rounds. Source: Karnin, Koren and Somekh 2013
    (sequential halving), with doubled instead of equal budgets.
    """
    left, episodes, steps, ask = [SelectionRecord(index) for index in range(len(given))], FIRST_EPISODES, 0, 0
    while len(left) > 1:
        policies = [given[record.index] for record in left]
        results = new_episodes(engine, policies, episodes, seed, number, ask, Domain.CANDIDATE_RESET)
        steps += sum(result.steps for result in results)
        left = [replace(record, rounds=(*record.rounds, result)) for record, result in zip(left, results, strict=True)]
        ranked = sorted(left, key=lambda record: record.order(by))  # stable: equal ones stay in the order given
        if len(left) <= keep:
            return ranked, steps
        left = ranked[: max(keep, -(-len(left) // 2))]
        episodes, ask = 2 * episodes, ask + 1
    return left, steps


def new_episodes(
    engine: Evaluator, policies: Sequence[Policy], episodes: int, seed: int, number: int, ask: int, domain: Domain
) -> list[StoredEpisodes]:
    """What is kept of new episodes of each policy; arguments as of `results_of`."""
    return [kept(result) for result in results_of(engine, policies, episodes, seed, number, ask, domain)]


def results_of(
    engine: Evaluator, policies: Sequence[Policy], episodes: int, seed: int, number: int, ask: int, domain: Domain
) -> list[EpisodesResult]:
    """Results [E] of new episodes of each policy. All policies have the same resets, which the address (seed, domain,
    number, ask) determines."""
    asked = [
        policy_work(
            policy.parameters_D[None],
            (policy.observation_mean_O[None], policy.observation_std_O[None]),
            episodes,
            seed=seed,
            generation=number,
            ask=ask,
            request=request,
            domain=domain,
        )
        for request, policy in enumerate(policies)
    ]
    results, _ = completed(episodes_of([(each.work, each.shape) for each in asked]), engine.evaluate)
    return [part_of(result, 0) for result in results]


def kept(result: EpisodesResult) -> StoredEpisodes:
    """What is kept of the results [E] of a policy."""
    return StoredEpisodes(
        result.returns.astype(np.float64),
        result.outputs["last_reward"].astype(np.float64),
        result.goal_distance[:, 1].astype(np.float64),
        result.outputs.get("success"),
        result.steps.astype(np.int64),
        result.descriptor.astype(np.float64),
    )


def interval_columns(name: str, interval: tuple[float, float, float] | None) -> dict[str, float | None]:
    """A mean and the ends of its interval by column name."""
    return dict(zip((f"{name}_mean", f"{name}_low", f"{name}_high"), interval or (None, None, None), strict=True))


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
    return (0.0 if successes == 0 else middle - half), (1.0 if successes == count else middle + half)


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
