"""Certified policies: their values in episodes that no choice has seen, as a run stores them.

Axes: E episodes, D policy parameters, O observation, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import FloatArray
from es_service.runs.intervals import mean_interval, share_interval
from es_service.store.certifications import CertifiedRow
from es_service.store.reader import read_certifications

EPISODES = 256
"""Certification episodes of a policy, unless a call says otherwise."""
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
    def count(self) -> int:
        """Number of episodes."""
        return self.return_E.size

    def values(self) -> dict[str, float | int | None]:
        """Means with their intervals, and successes, by column name; None for what the task does not have."""
        columns: dict[str, float | int | None] = {}
        for name, values_E in (("return", self.return_E), ("last_reward", self.last_reward_E)):
            columns |= _interval(name, values_E)
        columns |= _interval("goal_distance", None if np.isnan(self.goal_distance_E).all() else self.goal_distance_E)
        successes = None if self.success_E is None else int(self.success_E.sum())
        low, high = (None, None) if successes is None else share_interval(successes, self.count)
        return columns | {"successes": successes, "success_low": low, "success_high": high}


@dataclass(frozen=True)
class Certified:
    """A policy with its certification episodes."""

    number: int
    """Number of the certification among those of the run, from 0; for other policies the one that was given."""
    rank: int
    """Place by the selection episodes, from 0."""
    name: str
    """Name of the candidate: "best", "centre", the place of its cell, or the number of a policy of the caller's."""
    generation: int | None
    """Generation in which the run evaluated it."""
    stored_fitness: float | None
    """Fitness that the run stored for it: selected, not certified."""
    selected_by: Measure
    selection_mean: float | None
    """Mean of this measure over its selection episodes; None if it was the only candidate and had none."""
    selection_episodes: int
    candidates: int
    """Number of policies from which it was chosen."""
    selection_steps: int
    """Environment steps of all selection episodes of the certification, which belong to the cost of the result."""
    platform: Mapping[str, Any]
    """Packages, processor and code that computed it; see `runs.identity.changes_since`."""
    episodes: Episodes
    parameters_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray

    def row(self) -> dict[str, Any]:
        """The policy as a row of a table."""
        return {
            "certification": self.number,
            "rank": self.rank,
            "policy": self.name,
            "generation": self.generation,
            "stored_fitness": self.stored_fitness,
            "candidates": self.candidates,
            "selected_by": self.selected_by,
            "selection_mean": self.selection_mean,
            "selection_episodes": self.selection_episodes,
            "selection_steps": self.selection_steps,
            "episodes": self.episodes.count,
            **self.episodes.values(),
        }


def certified_policies(folder: Path) -> list[Certified]:
    """All certified policies of a run, in the order of certification and rank. Raises StoreError if one is damaged."""
    return [_from_row(row) for row in read_certifications(folder)]


def newest_certified(folder: Path) -> Certified | None:
    """The policy that the newest certification of a run has put first; None if there is none, or if damage has removed
    it. No other certification is read. Raises StoreError if it is damaged."""
    return next((_from_row(row) for row in read_certifications(folder, newest=True) if row.rank == 0), None)


def measure_of(fitness: str) -> Measure:
    """What `task.fitness` says of an episode."""
    return "return" if fitness == "sum" else "last_reward"


def target_reached(folder: Path, target: float | None, fitness: str) -> str:
    """Why a run is over whose `budget.target_certified` and `task.fitness` these are, in words; empty if no certified
    policy with EPISODES episodes or more reaches the target, by whatever it was selected."""
    if target is None:
        return ""
    for policy in certified_policies(folder):
        if policy.episodes.count < EPISODES:
            continue
        mean = policy.row()[f"{measure_of(fitness)}_mean"]
        if mean is not None and mean >= target:
            return (
                f"the target {target:g} is reached: a policy of generation {policy.generation} has {mean:.6g} in "
                f"{policy.episodes.count} certified episodes"
            )
    return ""


def arrays_of(episodes: Episodes) -> dict[str, NDArray[Any]]:
    """The arrays of episodes by name, for the store."""
    return {name: array for name, array in vars(episodes).items() if array is not None}


_POLICY = ("parameters_D", "observation_mean_O", "observation_std_O")
_FACTS = [field.name for field in fields(Certified) if field.name not in (*_POLICY, "number", "rank", "episodes")]


def stored(policy: Certified) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """(facts, arrays) of a certified policy, as they are stored."""
    facts = {name: getattr(policy, name) for name in _FACTS}
    return facts, {name: getattr(policy, name) for name in _POLICY} | arrays_of(policy.episodes)


def _from_row(row: CertifiedRow) -> Certified:
    arrays: dict[str, Any] = {"success_E": None, **row.arrays}
    policy = {name: arrays.pop(name) for name in _POLICY}
    return Certified(row.number, row.rank, **row.facts, **policy, episodes=Episodes(**arrays))


def _interval(name: str, values_E: NDArray[np.float64] | None) -> dict[str, float | None]:
    ends = (None, None, None) if values_E is None else mean_interval(values_E)
    return dict(zip((f"{name}_mean", f"{name}_low", f"{name}_high"), ends, strict=True))
