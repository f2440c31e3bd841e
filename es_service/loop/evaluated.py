"""What a generation proposes and what comes of it, in the order of its asks: centres, populations and policies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from es_service.config.model import RunConfig
from es_service.loop.generation import first_episode, steps_of
from es_service.loop.history import HistoryRow, Resets, evaluated_row, norm
from es_service.loop.policies import PolicyWork, each_policy, no_statistics, policy_work
from es_service.protocol.messages import Centre, EpisodesResult, FloatArray, Moments, TaskSpec
from es_service.search.algorithms.base import Ask, CentreEvaluation, PolicyAsk, SearchState
from es_service.search.maps.behaviour_map import BehaviourMap


@dataclass(frozen=True)
class Evaluated:
    """A centre or a policy that has been evaluated."""

    index: int
    """Index of the centre; policies count on from the centres."""
    point: Centre
    """What was evaluated, with its observation statistics."""
    evaluation: EpisodesResult
    """Results of its evaluation episodes [E]."""
    resets: Resets
    """Address of the resets of these episodes."""
    fitness_weight: float
    """Weight of fitness in the utilities of its population; for a policy the weight in the state."""
    population: EpisodesResult | None = None
    """The population that led to the centre; None for a policy."""
    before_D: FloatArray | None = None
    """The centre before its update; None for a policy."""

    @property
    def update_norm(self) -> float | None:
        """Euclidean norm of the update; None for a policy."""
        return None if self.before_D is None else norm(self.point.parameters_D - self.before_D)

    @property
    def env_steps(self) -> int:
        """Environment steps of the evaluation and of the population."""
        return steps_of(self.evaluation) + (0 if self.population is None else steps_of(self.population))


@dataclass(frozen=True)
class Proposal:
    """What a generation evaluates, and the state that asks for it."""

    generation: int
    search: SearchState
    """State in which some centres may have restarted from elites."""
    start_cells: Mapping[int, int]
    """Index of a centre -> cell of the elite from which it has restarted."""
    asked: Sequence[Ask | PolicyAsk]
    """What the search asks for; nothing in generation 0."""
    centres: Sequence[Centre]
    """The centre of each population asked for; in generation 0 the initial centres, which have no populations."""
    policies: Sequence[PolicyWork]

    @property
    def asks(self) -> list[Ask]:
        """The populations asked for."""
        return [ask for ask in self.asked if isinstance(ask, Ask)]


@dataclass(frozen=True)
class Evaluations:
    """Results of what was proposed."""

    populations: Sequence[EpisodesResult]
    """Of each population [P, S]; the fitness of invalid members is NaN."""
    policies: Sequence[EpisodesResult]
    """Of each ask for policies [N, E]."""
    members: Sequence[EpisodesResult]
    """The populations, and the policies as if they were one each."""
    observed: Sequence[Moments]
    """Moments of the populations' observations, in the order in which they are merged."""


@dataclass(frozen=True)
class Update:
    """What has become of the centres, and the state that has learned from it."""

    search: SearchState
    evaluated: Sequence[Evaluated]
    """New centres and policies, in the order of the asks."""
    told: tuple[CentreEvaluation, ...]
    """What the search was told of each."""
    novelties: Sequence[float | None]
    """Novelty of each in the archive before the generation; None for initial centres."""


def policies_asked(
    config: RunConfig, task: TaskSpec, generation: int, asks: Iterable[Ask | PolicyAsk]
) -> list[PolicyWork]:
    """The policies among what a search asks for."""
    found: list[PolicyWork] = []
    for asked in asks:
        if isinstance(asked, PolicyAsk):
            statistics = no_statistics(len(asked.parameters_N_D), task.observation_size)
            if asked.observation_mean_N_O is not None and asked.observation_std_N_O is not None:
                statistics = asked.observation_mean_N_O, asked.observation_std_N_O
            found.append(
                policy_work(
                    asked.parameters_N_D,
                    statistics,
                    config.search.evaluation_episodes,
                    seed=config.seed,
                    generation=generation,
                    ask=len(found),
                    traces=True,
                )
            )
    return found


def in_ask_order(
    asks: Sequence[Ask | PolicyAsk],
    new_centres: Iterable[tuple[Centre, EpisodesResult, EpisodesResult]],
    policies: Iterable[tuple[PolicyWork, EpisodesResult]],
    *,
    seed: int,
    generation: int,
    centres: int,
    fitness_weight: float,
) -> list[Evaluated]:
    """Everything that a generation has evaluated.

    Args:
        new_centres: (centre, its evaluation, its population) of each population asked for.
        policies: (policies, their results [N, E]) of each ask for policies.
        centres: number of centres of the search.
        fitness_weight: weight of fitness in the state.
    """
    found: list[Evaluated] = []
    of_centres, of_policies, index = enumerate(new_centres), enumerate(policies), centres
    for asked in asks:
        if isinstance(asked, Ask):
            number, (point, evaluation, population) = next(of_centres)
            resets, weight = Resets(seed, ask=number), asked.fitness_weight
            found.append(Evaluated(asked.centre, point, evaluation, resets, weight, population, asked.centre_D))
            continue
        number, (work, results) = next(of_policies)
        given = work.parameters_N_D, work.observation_mean_N_O, work.observation_std_N_O
        for policy, (parameters_D, mean_O, std_O, evaluation) in enumerate(
            zip(*given, each_policy(results), strict=True)
        ):
            point, resets = Centre(generation, parameters_D, 0.0, mean_O, std_O), Resets(seed, 0, number, policy)
            found.append(Evaluated(index, point, evaluation, resets, fitness_weight))
            index += 1
    return found


def initial_centres(
    points: Iterable[Centre], evaluations: Iterable[EpisodesResult], config: RunConfig, fitness_weight: float
) -> list[Evaluated]:
    """The initial centres, which have no populations; the episodes of each begin with a chunk of its own."""
    episodes = config.search.evaluation_episodes
    return [
        Evaluated(index, point, evaluation, Resets(config.seed, first_episode(index, episodes)), fitness_weight)
        for index, (point, evaluation) in enumerate(zip(points, evaluations, strict=True))
    ]


def evaluated_rows(
    evaluated: Sequence[Evaluated],
    task: TaskSpec,
    map_: BehaviourMap | None,
    generation: int,
    start_cells: Mapping[int, int],
    novelties: Sequence[float | None],
) -> list[HistoryRow]:
    """The rows of a generation in the table of evaluated centres."""
    return [
        evaluated_row(
            one.evaluation,
            task,
            map_,
            resets=one.resets,
            generation=generation,
            centre=one.index,
            fitness_weight=one.fitness_weight,
            start_cell=start_cells.get(one.index),
            novelty=its_novelty,
            update_norm=one.update_norm,
            env_steps=one.env_steps,
        )
        for one, its_novelty in zip(evaluated, novelties, strict=True)
    ]
