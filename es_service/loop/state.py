"""All that a run carries from one generation to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from es_service.errors import StoreError
from es_service.protocol.messages import FloatArray, Moments
from es_service.search.algorithms.base import CentreState, SearchState
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.search.novelty import extends
from es_service.search.observation_statistics import normalisation


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


def require_successor(before: RunState | None, state: RunState) -> None:
    """Raise a StoreError for a state that cannot follow `before` (None: the first), as a search of one's own may make;
    `SearchState` says what a search may change."""
    wrong = _not_followed(before.search, state.search) if before is not None else ""
    wrong = wrong or _foreign_elite(before.search.map if before is not None else None, state.search.map, state.elites)
    if wrong:
        saved = f"Everything up to generation {before.generation} is saved." if before is not None else ""
        raise StoreError(
            f"generation {state.generation} cannot be kept: {wrong}; es_service/search/algorithms/base.py says of "
            f"SearchState what a search may change. {saved}".rstrip()
        )


def _not_followed(before: SearchState, after: SearchState) -> str:
    """What is wrong with a state after another; empty if nothing is. Searches of ours are right by construction."""
    if len(after.centres) != len(before.centres):
        return f"the search has {len(after.centres)} centres, and had {len(before.centres)}"
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
        same_N = (after.generation_N[known] == before.generation_N) & (after.centre_N[known] == before.centre_N)
        new_N[known] = ~same_N
    foreign = set(after.cell_N[new_N].tolist()) - set(elites)
    return f"the new elite of cell {min(foreign)} is not the centre that was evaluated" if foreign else ""


def statistics_in_force(
    observations: Moments, centre: CentreState | None, enabled: bool
) -> tuple[FloatArray, FloatArray]:
    """(mean, standard deviation) that a centre's episodes run with: its own if it has any, else the whole run's; 0 and
    1 where observations are not normalised."""
    if enabled and centre is not None and centre.own_mean_O is not None and centre.own_std_O is not None:
        return centre.own_mean_O, centre.own_std_O
    return normalisation(observations, enabled)
