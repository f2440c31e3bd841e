"""Types of all search algorithms: their state, what they ask for, what they are told, and their functions.

Axes: D policy parameters, O observation, B descriptor dimensions, P antithetic pairs, S signs [+, -].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from es_service.config.parts import Objective
from es_service.protocol.content import Policy
from es_service.protocol.episodes import part_of
from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.protocol.policies import Recipes
from es_service.search.arrays import freeze, read_only
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.novelty import NoveltyArchive, sound_archive
from es_service.search.steps import StepState, restarted

NO_ENTRY = -1
"""Value of `CentreState.entry` for a centre without a valid evaluation so far."""
NO_CELL = -1
"""Value of `CentreState.cell` for a centre that is not an elite."""


@dataclass(frozen=True)
class CentreState:
    """One centre with the state of its step.

    NS-ES, NSR-ES and NSRA-ES search with several centres side by side (the meta-population of Conti et al. 2018), ME-ES
    with one centre per emitter, ES with one.
    """

    centre_D: FloatArray
    step: StepState
    """What its step remembers, such as the moments of Adam; empty for a search without steps."""
    entry: int = NO_ENTRY
    """Index of the centre's newest entry in the novelty archive, or NO_ENTRY."""
    cell: int = NO_CELL
    """Cell of the behaviour map whose elite this centre is, or NO_CELL."""
    own_mean_O: FloatArray | None = None
    own_std_O: FloatArray | None = None
    """Mean and standard deviation with which its episodes normalise observations; None for those of the whole run."""


@dataclass(frozen=True)
class FitnessWeight:
    """Weight of fitness relative to novelty, and what an adaptive rule remembers to change it."""

    value: float
    """From 0 (novelty alone) to 1 (fitness alone)."""
    record: float = -np.inf
    """The fitness to beat: mean evaluation fitness of the centre that last counted as an improvement."""
    stagnant: int = 0
    """Generations since the record was set or the weight was last lowered, whichever is later."""


@dataclass(frozen=True)
class SearchState:
    """Everything that a search remembers between generations.

    A search of your own may change all of it in any way: the store compares contents with the state before and writes
    what differs. Centres may be replaced, added and removed (one must remain), the novelty archive may lose entries
    (`novelty.archive_of` makes one of any), and entries of the behaviour map may change, move and leave
    (`behaviour_map.changed`, `moved`, `removed`). An entry has the name of its policy, which is stored as long as
    anything in a state names it. All arrays of a state are read-only.
    """

    centres: tuple[CentreState, ...]
    archive: NoveltyArchive
    weight: FitnessWeight
    map: BehaviourMap | None = None
    """The behaviour map; None if `map.enabled` is false."""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """What else the search remembers, by name: arrays, and mappings of such (`search.arrays`)."""


def frozen(state: SearchState) -> SearchState:
    """The same state, all of whose arrays are read-only from now on."""
    for centre in state.centres:
        freeze([*vars(centre).values(), *centre.step.values()])
    archive = sound_archive(state.archive)
    for values in (archive.descriptor_N_B, archive.generation_N, archive.centre_N):
        values.flags.writeable = False  # but not the arrays of which they are the first part
    if state.map is not None:
        freeze([*vars(state.map).values(), *vars(state.map.geometry).values()])
    return replace(state, archive=archive, extra=read_only(state.extra))


def from_elite(
    state: SearchState, index: int, cell: int, elite: Policy, *, elite_statistics: bool = False
) -> SearchState:
    """The state in which an elite replaces a centre, whose step begins anew.

    Args:
        index: index of the centre.
        cell: cell of the elite.
        elite_statistics: whether the centre keeps the observation statistics with which the elite was evaluated; else
            it uses those of the whole run.
    """
    before = state.centres[index]
    centre = CentreState(
        elite.parameters_D,
        restarted(before.step),
        before.entry,
        cell,
        elite.observation_mean_O if elite_statistics else None,
        elite.observation_std_O if elite_statistics else None,
    )
    return with_centre(state, index, centre)


def with_centre(state: SearchState, index: int, centre: CentreState) -> SearchState:
    return replace(state, centres=(*state.centres[:index], centre, *state.centres[index + 1 :]))


@dataclass(frozen=True)
class Ask:
    """A population to evaluate in a generation: mirrored pairs around one centre."""

    centre: int
    """Index of the centre. A generation asks for each centre at most once."""
    centre_D: FloatArray
    sigma: float
    """Standard deviation of the parameter noise, in parameter units."""
    pairs: int
    """Number of antithetic pairs: a multiple of `compute.chunk_pairs`."""
    fitness_weight: float
    """Weight of fitness relative to novelty in this generation, from 0 to 1."""
    objective: Objective | None = None
    """What members are ranked by; None: fitness and novelty by `fitness_weight`."""
    rate: float = 1.0
    """Factor of the learning rate in this generation."""


@dataclass(frozen=True)
class PolicyAsk:
    """Policies to evaluate as they are in a generation, with `search.evaluation_episodes` episodes each.

    They run without noise and do not update the observation statistics. The reset of an episode depends on the
    generation, the number of the policy in this ask, the number of the episode, and the number of this ask among those
    of the generation that are for policies.
    """

    parameters_N_D: FloatArray | Recipes | NDArray[Any]
    """Parameters of each policy; or recipes by which workers make them; or names of stored policies [N], which are
    evaluated with the observation statistics that they have."""
    observation_mean_N_O: FloatArray | None = None
    observation_std_N_O: FloatArray | None = None
    """Mean and standard deviation with which each policy's episodes normalise observations; None: 0 and 1."""


@dataclass(frozen=True)
class CentreEvaluation:
    """Result of the evaluation episodes of a centre, or of a policy that was asked for."""

    generation: int
    """Generation that produced the centre; 0 for an initial centre."""
    centre: int
    """Index of the centre. Policies count on: number of centres + number of the policy in its generation."""
    valid: bool
    """Whether fitness and descriptor of every episode are finite."""
    fitness: float
    """Mean fitness over the episodes."""
    descriptor_B: NDArray[np.float64]
    """Mean descriptor over the episodes."""
    population_max: float = np.nan
    """Highest fitness of a valid member of the population that led to it; NaN for an initial centre."""
    episodes: int = 1
    results: EpisodesResult | None = None
    """Results of each episode, [E]."""


@dataclass(frozen=True, eq=False)
class CentreEvaluations(Sequence[CentreEvaluation]):
    """The evaluations of a generation's centres and policies, in the order of the asks: a sequence, and its columns.

    Axis N: the evaluations.
    """

    generation: int
    centre_N: NDArray[np.int64]
    valid_N: NDArray[np.bool_]
    fitness_N: NDArray[np.float64]
    descriptor_N_B: NDArray[np.float64]
    population_max_N: NDArray[np.float64]
    episodes: int = 1
    results: EpisodesResult | None = None
    """Results of each episode, [N, E]."""
    names: Callable[[Sequence[int]], tuple[NDArray[Any], NDArray[Any]]] | None = None
    """Function from indices on axis N to the names of the policies that were evaluated, and of their traces. What a
    state names is stored."""
    columns: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """What else the run's table of evaluated centres has of each, [N], by the name of the column."""

    def __len__(self) -> int:
        return len(self.centre_N)

    @overload
    def __getitem__(self, index: int) -> CentreEvaluation: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[CentreEvaluation, ...]: ...
    def __getitem__(self, index: int | slice) -> CentreEvaluation | tuple[CentreEvaluation, ...]:
        if isinstance(index, slice):
            return tuple(self[row] for row in range(*index.indices(len(self))))
        return CentreEvaluation(
            self.generation,
            int(self.centre_N[index]),
            bool(self.valid_N[index]),
            float(self.fitness_N[index]),
            self.descriptor_N_B[index],
            float(self.population_max_N[index]),
            self.episodes,
            None if self.results is None else part_of(self.results, index),
        )


def in_columns(evaluations: Sequence[CentreEvaluation]) -> CentreEvaluations:
    """The evaluations of a generation, of which there is at least one, as columns."""
    if isinstance(evaluations, CentreEvaluations):
        return evaluations
    names = "centre", "valid", "fitness", "descriptor_B", "population_max"
    centre_N, *columns = (np.array([getattr(evaluation, name) for evaluation in evaluations]) for name in names)
    return CentreEvaluations(evaluations[0].generation, centre_N, *columns, episodes=evaluations[0].episodes)


def _without_populations(*arguments: object) -> Any:
    raise TypeError("a search that asks for populations needs the functions `weights` and `step`")


@dataclass(frozen=True)
class Algorithm:
    """The functions of one method. All are pure."""

    ask: Callable[[SearchState, int], tuple[Ask | PolicyAsk, ...]]
    """(state, generation) -> populations and policies to evaluate in that generation, side by side."""
    tell: Callable[[SearchState, Sequence[CentreEvaluation]], SearchState]
    """(state, evaluations of a generation's centres and policies in the order of the asks) -> state updated with them.
    The first call has all initial centres."""
    weights: Callable[[SearchState, Ask, EpisodesResult], NDArray[np.float32]] = _without_populations
    """(state, asked, the whole population's results with axes P, S) -> weight of each pair's noise [P]."""
    step: Callable[[SearchState, Ask, FloatArray], SearchState] = _without_populations
    """(state, asked, gradient estimate [D]) -> state with the asked centre moved up the gradient. Called for each
    population asked for, in order."""
    fitness_weight: float = 1.0
    """Initial value of the state's `weight`."""
    start_cells: Callable[[SearchState, int], Mapping[int, int]] = lambda state, generation: {}
    """(state, generation) -> index of a centre -> cell whose elite takes its place at the start of the generation; the
    other centres continue."""
    restart: Callable[[SearchState, int, int, Policy], SearchState] = from_elite
    """(state, index of a centre, start cell, its elite) -> state in which that centre has restarted."""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """What else the search remembers, by name, at first: arrays, and mappings of such (`search.arrays`)."""
    metrics: Mapping[str, Callable[[SearchState], float]] = field(default_factory=dict)
    """Numbers that the history records, by name: state after a generation -> its value; NaN for none."""
    counts_samples: bool = False
    """Whether the entries of the map count the episodes of which their values are the mean."""
