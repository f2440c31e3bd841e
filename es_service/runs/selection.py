"""Episodes by which candidates are chosen, or by which what was chosen is certified.

Axes: E episodes, D policy parameters, O observation, B descriptor dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from es_service.loop.generation import episodes_of
from es_service.loop.policies import policy_work
from es_service.protocol.episodes import part_of
from es_service.protocol.evaluator import Evaluator, completed
from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.protocol.noise import Domain
from es_service.runs.intervals import mean_interval, share_interval

FIRST_EPISODES = 16
"""Selection episodes of each candidate in the first round; each later round has twice as many as the one before."""
Parameters = tuple[FloatArray, FloatArray, FloatArray]
"""A policy to run: its parameters [D], and mean and standard deviation of its observations, [O] each."""


Measure = Literal["return", "last_reward", "success", "goal_distance"]
"""What selection episodes rank by; the least goal distance ranks by its negative, since higher is better."""
MEASURES: tuple[Measure, ...] = get_args(Measure)


@dataclass(frozen=True)
class Episodes:
    """What is kept of episodes of a policy, whatever the run's `task.fitness` is."""

    return_E: NDArray[np.float64]
    """Sum of the rewards."""
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
        """Environment steps of all episodes."""
        return int(self.steps_E.sum())

    @property
    def count(self) -> int:
        """Number of episodes."""
        return self.return_E.size

    def fitness(self, kind: str) -> NDArray[np.float64]:
        """Fitness of each episode, [E]; `kind` is `task.fitness`."""
        return self.return_E if kind == "sum" else self.last_reward_E

    def mean_fitness(self, kind: str) -> float:
        """Mean of `fitness`."""
        with np.errstate(invalid="ignore", over="ignore"):
            return float(self.fitness(kind).mean())

    @property
    def measures(self) -> dict[Measure, NDArray[Any] | None]:
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
    rounds: tuple[Episodes, ...] = ()

    @property
    def count(self) -> int:
        """Number of its selection episodes."""
        return sum(episodes.count for episodes in self.rounds)

    def mean(self, by: Measure) -> float:
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

    def order(self, by: Measure) -> tuple[float, float]:
        """Key by which the best is the first; a mean that is not finite comes last."""
        means = (self.mean(by), self.mean("return"))
        first, second = (-mean if math.isfinite(mean) else math.inf for mean in means)
        return first, second


def halved(
    engine: Evaluator, given: Sequence[Parameters], seed: int, number: int, keep: int, by: Measure
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
    engine: Evaluator, policies: Sequence[Parameters], episodes: int, seed: int, number: int, ask: int, domain: Domain
) -> list[Episodes]:
    """What is kept of new episodes of each policy; arguments as of `results_of`."""
    return [kept(result) for result in results_of(engine, policies, episodes, seed, number, ask, domain)]


def results_of(
    engine: Evaluator, policies: Sequence[Parameters], episodes: int, seed: int, number: int, ask: int, domain: Domain
) -> list[EpisodesResult]:
    """Results [E] of new episodes of each policy. All policies have the same resets, which the address (seed, domain,
    number, ask) determines."""
    asked = [
        policy_work(
            parameters_D[None],
            (mean_O[None], std_O[None]),
            episodes,
            seed=seed,
            generation=number,
            ask=ask,
            request=request,
            domain=domain,
        )
        for request, (parameters_D, mean_O, std_O) in enumerate(policies)
    ]
    results, _ = completed(episodes_of([(each.work, each.shape) for each in asked]), engine.evaluate)
    return [part_of(result, 0) for result in results]


def kept(result: EpisodesResult) -> Episodes:
    """What is kept of the results [E] of a policy."""
    return Episodes(
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
