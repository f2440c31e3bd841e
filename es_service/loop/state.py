"""All that a run carries from one generation to the next, and how it is kept in the store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from es_service.errors import StoreError
from es_service.protocol.messages import FloatArray, Moments
from es_service.search.algorithms.base import (
    NO_CELL,
    FitnessWeight,
    Member,
    SearchState,
    member_from_arrays,
    member_part,
    member_to_arrays,
    weight_from_arrays,
    weight_to_arrays,
)
from es_service.search.maps.behaviour_map import (
    CELL_PREFIX,
    ELITE_PREFIX,
    BehaviourMap,
    Elite,
    elite_part,
    elite_to_arrays,
    map_from_parts,
    map_to_parts,
)
from es_service.search.novelty import archive_from_parts, archive_to_parts, extends
from es_service.search.observation_statistics import normalisation

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Best:
    """The centre with the highest mean fitness so far, with the statistics it was evaluated with."""

    generation: int
    fitness: float
    centre_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray


@dataclass(frozen=True)
class RunState:
    """State of a run after `generation` generations."""

    generation: int
    search: SearchState
    observations: Moments
    best: Best
    env_steps: int
    """Environment steps so far, evaluations counted; a Python int, it outgrows 32 bits."""
    episodes: int
    wall_clock_s: float
    """Seconds spent so far, all sessions together. Kept in the history, not in the state: it is not deterministic."""
    elites: Mapping[int, Elite] = field(default_factory=dict)
    """Those that entered the map in this generation, by cell; older ones are in the store only."""


def state_parts(state: RunState, before: RunState | None) -> dict[str, Arrays]:
    """The parts of `state` that differ from `before` (all of them for None), as the store keeps them.

    Raises:
        StoreError: the search's state is none that can follow `before`; see `SearchState`.
    """
    wrong = _not_followed(before.search, state.search) if before is not None else ""
    wrong = wrong or _foreign_elite(before.search.map if before is not None else None, state.search.map, state.elites)
    if wrong:
        saved = f"Everything up to generation {before.generation} is saved." if before is not None else ""
        raise StoreError(
            f"generation {state.generation} cannot be kept: {wrong}; es_service/search/algorithms/base.py says of "
            f"SearchState what a search may change. {saved}".rstrip()
        )
    parts = {
        "observations": moments_to_arrays(state.observations),
        "counters": {
            "env_steps": np.asarray(state.env_steps, np.int64),
            "episodes": np.asarray(state.episodes, np.int64),
        },
    }
    for index, member in enumerate(state.search.members):
        if before is None or member is not before.search.members[index]:
            parts[member_part(index)] = member_to_arrays(member)
    if before is None or state.search.weight != before.search.weight:
        parts["weight"] = weight_to_arrays(state.search.weight)
    archive, stored = state.search.archive, before.search.archive.size if before is not None else 0
    if before is None or archive is not before.search.archive:
        parts |= archive_to_parts(archive, stored)
    if state.search.map is not None:
        parts |= map_to_parts(state.search.map, before.search.map if before is not None else None)
        parts |= {elite_part(cell): elite_to_arrays(elite) for cell, elite in state.elites.items()}
    if before is None or state.best is not before.best:
        parts["best"] = _best_to_arrays(state.best)
    return parts


def _not_followed(before: SearchState, after: SearchState) -> str:
    """What is wrong with a state after another; empty if nothing is. Searches of ours are right by construction."""
    if len(after.members) != len(before.members):
        return f"the search has {len(after.members)} members, and had {len(before.members)}"
    if not extends(after.archive, before.archive):
        return "the novelty archive has lost or changed entries"
    if (after.map is None) != (before.map is None):
        return "the map came or went"
    if after.map is None or before.map is None or after.map is before.map:
        return ""
    if not np.array_equal(after.map.cell_N[: before.map.size], before.map.cell_N):
        return "the map has lost cells, or has them in another order"
    return ""


def _foreign_elite(before: BehaviourMap | None, after: BehaviourMap | None, elites: Mapping[int, Elite]) -> str:
    """What is wrong with the elites that a map has and an earlier one had not, when `elites` entered it."""
    if after is None or after is before:
        return ""
    new_N = np.ones(after.size, bool)
    if before is not None:
        known = slice(before.size)
        same_N = (after.generation_N[known] == before.generation_N) & (after.member_N[known] == before.member_N)
        new_N[known] = ~same_N
    foreign = set(after.cell_N[new_N].tolist()) - set(elites)
    return f"the new elite of cell {min(foreign)} is not the centre that was evaluated" if foreign else ""


def state_from_parts(
    parts: Mapping[str, Mapping[str, np.ndarray]], generation: int, wall_clock_s: float, dimensions: int
) -> RunState:
    """Inverse of `state_parts(state, None)`; elites are not needed.

    Args:
        dimensions: of a descriptor, as long as the archive has no entry.
    """
    members = []
    while member_part(len(members)) in parts:
        members.append(member_from_arrays(parts[member_part(len(members))]))
    counters = parts["counters"]
    return RunState(
        generation=generation,
        search=SearchState(
            tuple(members),
            archive_from_parts(parts, dimensions),
            weight_from_arrays(parts["weight"]),
            map_from_parts(parts),
        ),
        observations=moments_from_arrays(parts["observations"]),
        best=best_from_arrays(parts["best"]),
        env_steps=int(counters["env_steps"]),
        episodes=int(counters["episodes"]),
        wall_clock_s=wall_clock_s,
    )


def without_fitness(parts: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, Arrays]:
    """The parts of a state in which no fitness seen so far counts: no best centre, an empty map, no record to beat."""
    kept = {name: dict(part) for name, part in parts.items() if not name.startswith((CELL_PREFIX, ELITE_PREFIX))}
    for name, part in kept.items():
        if name.startswith(member_part("")):
            part["cell"] = np.asarray(NO_CELL, np.int64)
    kept["best"]["fitness"] = np.asarray(-np.inf)
    kept["weight"] = weight_to_arrays(FitnessWeight(weight_from_arrays(parts["weight"]).value))
    return kept


def without_scores(parts: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, Arrays]:
    """The parts of a state in which no elite has a score: the luckiest of a population of another size, or whose
    fitness came about otherwise, is none to compare with."""
    nothing = {"score": np.asarray(np.nan)}
    return {name: {**part, **nothing} if name.startswith(CELL_PREFIX) else dict(part) for name, part in parts.items()}


def statistics_in_force(observations: Moments, member: Member | None, enabled: bool) -> tuple[FloatArray, FloatArray]:
    """(mean, standard deviation) that a member's centres run with: its own if it has any, else the whole run's; 0 and 1
    where observations are not normalised."""
    if enabled and member is not None and member.own_mean_O is not None and member.own_std_O is not None:
        return member.own_mean_O, member.own_std_O
    return normalisation(observations, enabled)


def moments_to_arrays(moments: Moments) -> Arrays:
    """Observation statistics as the store keeps them."""
    return {"count": np.asarray(moments.count, np.float64), "mean_O": moments.mean_O, "m2_O": moments.m2_O}


def moments_from_arrays(arrays: Mapping[str, np.ndarray]) -> Moments:
    """Inverse of `moments_to_arrays`."""
    return Moments(float(arrays["count"]), arrays["mean_O"], arrays["m2_O"])


def _best_to_arrays(best: Best) -> Arrays:
    return {
        "generation": np.asarray(best.generation, np.int64),
        "fitness": np.asarray(best.fitness, np.float64),
        "centre_D": best.centre_D,
        "observation_mean_O": best.observation_mean_O,
        "observation_std_O": best.observation_std_O,
    }


def best_from_arrays(arrays: Mapping[str, np.ndarray]) -> Best:
    """The best centre from the store's part `best`."""
    return Best(
        generation=int(arrays["generation"]),
        fitness=float(arrays["fitness"]),
        centre_D=arrays["centre_D"],
        observation_mean_O=arrays["observation_mean_O"],
        observation_std_O=arrays["observation_std_O"],
    )
