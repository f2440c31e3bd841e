"""Everything that a run carries from one generation to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from es_service.errors import StoreError
from es_service.protocol.messages import FloatArray, Moments
from es_service.search.algorithms.base import CentreState, SearchState
from es_service.search.maps.behaviour_map import COLUMNS, BehaviourMap, Elite
from es_service.search.novelty import extends
from es_service.search.observation_statistics import normalisation


@dataclass(frozen=True)
class Best:
    """The centre with the highest mean fitness so far, and the observation statistics used in its evaluation."""

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
    """Environment steps so far, evaluations included; a Python int, since it can exceed 32 bits."""
    episodes: int
    wall_clock_s: float
    """Seconds spent so far in all sessions. They are stored only in the history, because they are not deterministic."""
    elites: Mapping[int, Elite] = field(default_factory=dict)
    """Elites that entered the map in this generation, by cell; older ones are only in the store."""


def require_successor(before: RunState | None, state: RunState) -> None:
    """Raise a StoreError if a state cannot follow `before` (None for the first state).

    A search of the user may return such a state; `SearchState` describes what a search may change.
    """
    wrong = _not_followed(before.search, state.search) if before is not None else _unkept(state.search)
    wrong = wrong or _foreign_elite(before.search.map if before is not None else None, state.search.map, state.elites)
    if wrong:
        saved = f"Everything up to generation {before.generation} is saved." if before is not None else ""
        raise StoreError(
            f"generation {state.generation} cannot be stored: {wrong}; the class SearchState in "
            f"es_service/search/algorithms/base.py describes what a search may change. {saved}".rstrip()
        )


def _not_followed(before: SearchState, after: SearchState) -> str:
    """Why a state cannot follow another; empty if it can. States of the shipped algorithms always can."""
    if len(after.centres) != len(before.centres):
        return f"the search has {len(after.centres)} centres, but it had {len(before.centres)} before"
    if not extends(after.archive, before.archive):
        return "the novelty archive has lost or changed entries"
    if (kinds := _kinds(after)) != (earlier := _kinds(before)):
        return f"the search's own arrays are {kinds}, but they were {earlier} before"
    if (after.map is None) != (before.map is None):
        return "the behaviour map was added or removed"
    if after.map is None or before.map is None or after.map is before.map:
        return ""
    if not np.array_equal(after.map.cell_N[: before.map.size], before.map.cell_N):
        return "the behaviour map has lost cells or changed their order"
    return _malformed(after.map)


def _malformed(map_: BehaviourMap) -> str:
    """Which array of a map has another type or shape than its cells need; empty if none has."""
    for name, type_ in COLUMNS.items():
        array = getattr(map_, name)
        shape = (map_.size, len(map_.geometry.bounds)) if name == "descriptor_N_B" else (map_.size,)
        if not isinstance(array, np.ndarray) or array.dtype != type_ or array.shape != shape:
            now = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            return f"the map's {name} is {now}; it must be {np.dtype(type_)} {shape}"
    return ""


def _unkept(first: SearchState) -> str:
    """Why the store cannot keep the first state as it is: its map, or the arrays of a search's own; empty if it can."""
    wrong = [name for name, array in first.own.items() if getattr(array, "dtype", np.dtype(object)).kind not in "biuf"]
    if wrong:
        return f"its own array {wrong[0]!r} is no NumPy array of bool, integers or floats"
    return _malformed(first.map) if first.map is not None else ""


def _kinds(state: SearchState) -> dict[str, str]:
    """Type of each of the search's own arrays, by name."""
    return {name: str(getattr(array, "dtype", type(array).__name__)) for name, array in sorted(state.own.items())}


def _foreign_elite(before: BehaviourMap | None, after: BehaviourMap | None, elites: Mapping[int, Elite]) -> str:
    """Why the new elites of a map are wrong, if they are not those in `elites`; empty if nothing is wrong."""
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
    """Mean and standard deviation with which a centre's episodes normalise observations, float32 [O] each.

    They are the centre's own if it has any, else those of the whole run; 0 and 1 if observations are not normalised.
    """
    if enabled and centre is not None and centre.own_mean_O is not None and centre.own_std_O is not None:
        return centre.own_mean_O, centre.own_std_O
    return normalisation(observations, enabled)
