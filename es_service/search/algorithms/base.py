"""What every search algorithm is made of: its state, what it asks for, its functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.search.novelty import NoveltyArchive
from es_service.search.optimizer import Adam, fresh_adam

NO_ENTRY = -1
"""`CentreState.entry` of a centre that has never been valid so far."""
NO_CELL = -1
"""`CentreState.cell` of a centre that is no elite."""


@dataclass(frozen=True)
class CentreState:
    """One centre with its optimiser. NS-ES and its kin search with several side by side (the meta-population of Conti
    et al. 2018), ES and ME-ES with one."""

    centre_D: FloatArray
    adam: Adam
    entry: int = NO_ENTRY
    """Index of its newest entry in the novelty archive."""
    cell: int = NO_CELL
    """Cell of the map whose elite it is."""
    own_mean_O: FloatArray | None = None
    own_std_O: FloatArray | None = None
    """Observation statistics that it runs with instead of the whole run's; None if it does not."""


@dataclass(frozen=True)
class FitnessWeight:
    """How much fitness counts beside novelty, from 0 to 1, and what an adaptive rule remembers to change it."""

    value: float
    record: float = -np.inf
    """The fitness to beat: mean evaluation fitness of the centre that last counted as an improvement."""
    stagnant: int = 0
    """Generations since then, or since the weight was last lowered."""


@dataclass(frozen=True)
class SearchState:
    """All that a search remembers between generations.

    The store writes what a generation has changed, so a search of one's own may replace centres (never add or drop
    one), extend the archive (`novelty.extended`; never take entries out: compare with the newest, if those alone are to
    count) and insert into the map (`behaviour_map.insert`; never empty a cell). Anything else ends the run with a
    StoreError.
    """

    centres: tuple[CentreState, ...]
    archive: NoveltyArchive
    weight: FitnessWeight
    map: BehaviourMap | None = None
    """None where the config switches it off."""


def from_elite(state: SearchState, cell: int, elite: Elite, *, own_statistics: bool = False) -> SearchState:
    """The state with an elite in the place of centre 0: its parameters, a fresh optimiser and, if wanted, the
    observation statistics it came with, which it then keeps."""
    centre = CentreState(
        elite.centre_D,
        fresh_adam(elite.centre_D.size),
        state.centres[0].entry,
        cell,
        elite.observation_mean_O if own_statistics else None,
        elite.observation_std_O if own_statistics else None,
    )
    return replace(state, centres=(centre, *state.centres[1:]))


@dataclass(frozen=True)
class Ask:
    """What to evaluate in this generation: the population around one centre."""

    centre: int
    centre_D: FloatArray
    fitness_weight: float
    """How much fitness counts beside novelty in this generation, from 0 to 1."""


@dataclass(frozen=True)
class CentreEvaluation:
    """What the evaluation episodes say of a centre."""

    generation: int
    """0 for an initial centre."""
    centre: int
    valid: bool
    """Whether fitness and descriptor of every episode are finite."""
    fitness: float
    """Mean over the episodes."""
    descriptor_B: NDArray[np.float64]
    """Mean over the episodes."""
    population_max: float = np.nan
    """Highest fitness of a valid member of the population that led to it; NaN for an initial centre."""


@dataclass(frozen=True)
class Algorithm:
    """The functions of one method. All are pure."""

    ask: Callable[[SearchState, int], Ask]
    """(state, generation) -> what to evaluate in that generation."""
    weights: Callable[[SearchState, Ask, EpisodesResult], NDArray[np.float32]]
    """(state, asked, the whole population's results with axes P, S) -> weight of each pair's noise [P]."""
    step: Callable[[SearchState, Ask, FloatArray], SearchState]
    """(state, asked, gradient estimate [D]) -> state with the planned centre moved."""
    tell: Callable[[SearchState, CentreEvaluation], SearchState]
    """(state, a centre's evaluation) -> state that has learned from it; initial centres come first, in order."""
    fitness_weight: float
    """What the state's `weight` starts with."""
    start_cell: Callable[[SearchState, int], int | None] = lambda state, generation: None
    """(state, generation) -> cell whose elite that generation starts from; None to go on from where it is."""
    restart: Callable[[SearchState, int, Elite], SearchState] = from_elite
    """(state, start cell, its elite) -> state that the generation starts from."""
