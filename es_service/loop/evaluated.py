"""What a generation proposes and what comes of it, in the order of its asks: centres, populations and policies."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.loop.checks import valid_members
from es_service.loop.generation import first_episode, highest, steps_of
from es_service.loop.history import NO_POLICY, RESETS, Table, doubles, episodes_table, with_gaps
from es_service.loop.policies import PolicyWork, no_statistics, policy_work
from es_service.protocol.content import Arrays
from es_service.protocol.episodes import joined
from es_service.protocol.messages import Centre, EpisodesResult, Moments, TaskSpec
from es_service.protocol.recipes import Recipes, remember
from es_service.search.algorithms.base import Ask, CentreEvaluations, PolicyAsk, SearchState
from es_service.search.maps.behaviour_map import EMPTY
from es_service.search.steps.clipup import norm


@dataclass(frozen=True)
class Evaluated:
    """Centres and policies that have been evaluated, in the order of the asks, as columns. N: each of them."""

    subjects: Sequence[Centre | PolicyWork]
    """Centres and asks for policies, which together are the N."""
    index_N: NDArray[np.int64]
    """Index of the centre; policies count on from the centres."""
    evaluation: EpisodesResult
    """Results of the evaluation episodes [N, E], with traces [N, T, B]."""
    reset_N_4: NDArray[np.int64]
    """Address of the resets of these episodes: the values of `history.RESETS`, of which a centre lacks the last."""
    fitness_weight_N: NDArray[np.float64]
    """Weight of fitness in the utilities of the population; for a policy the weight in the state."""
    population_max_N: NDArray[np.float64]
    """Highest fitness of a valid member of the population that led to the centre; NaN where there is none."""
    update_norm_N: NDArray[np.float64]
    """Euclidean norm of the centre's update; NaN for a policy and for an initial centre."""
    env_steps_N: NDArray[np.int64]
    """Environment steps of the evaluation and of the population."""

    def points(self, rows: Sequence[int]) -> list[Centre]:
        """What was evaluated, with its observation statistics, in arrays that are not parts of others."""
        points: dict[int, Centre] = {}
        first = 0
        for subject in self.subjects:
            end = first + (1 if isinstance(subject, Centre) else len(subject.parameters_N_D))
            here = [row for row in rows if first <= row < end]
            if isinstance(subject, Centre):
                points |= dict.fromkeys(here, subject)
            elif here:
                points |= zip(here, subject.policies([row - first for row in here]), strict=True)
            first = end
        return [points[row] for row in rows]

    def remember(self, rows: Sequence[int], names: Sequence[bytes]) -> None:
        """Remember how those of some rows that were made of recipes were made, by their names."""
        first = 0
        for subject in self.subjects:
            end = first + (1 if isinstance(subject, Centre) else len(subject.parameters_N_D))
            here = [(row - first, name) for row, name in zip(rows, names, strict=True) if first <= row < end]
            if here and isinstance(subject, PolicyWork) and isinstance(subject.parameters_N_D, Recipes):
                remember(subject.parameters_N_D.part([row for row, _ in here]), [name for _, name in here])
            first = end

    def point(self, row: int) -> Centre:
        """One point."""
        return self.points([row])[0]


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
    """Of each population [P, S]; the fitness of invalid and of infeasible members is NaN."""
    policies: Sequence[EpisodesResult]
    """Of each ask for policies [N, E]."""
    members: Sequence[EpisodesResult]
    """The populations, and the policies as if they were one each."""
    observed: Sequence[Moments]
    """Moments of the populations' observations, in the order in which they are merged."""
    infeasible: int = 0
    """Number of members that are infeasible, whose fitness is NaN, too."""


@dataclass(frozen=True)
class Update:
    """What has become of the centres, and the state that has learned from it."""

    search: SearchState
    evaluated: Evaluated
    """New centres and policies, in the order of the asks."""
    told: CentreEvaluations
    """What the search was told of each."""
    novelty_N: NDArray[np.float64]
    """Novelty of each in the archive before the generation; NaN for initial centres."""
    contents: Mapping[bytes, Arrays] = field(default_factory=dict)
    """Policies and traces of the generation that have got a name."""


def policies_asked(
    config: RunConfig, task: TaskSpec, generation: int, asks: Sequence[Ask | PolicyAsk]
) -> list[PolicyWork]:
    """The policies among what a search asks for."""
    policies: list[PolicyWork] = []
    populations = sum(isinstance(asked, Ask) for asked in asks)
    for asked in asks:
        if isinstance(asked, PolicyAsk):
            statistics = no_statistics(len(asked.parameters_N_D), task.observation_size)
            if asked.observation_mean_N_O is not None and asked.observation_std_N_O is not None:
                statistics = asked.observation_mean_N_O, asked.observation_std_N_O
            policies.append(
                policy_work(
                    asked.parameters_N_D,
                    statistics,
                    config.search.evaluation_episodes,
                    seed=config.seed,
                    generation=generation,
                    ask=len(policies),
                    request=populations + len(policies),
                    traces=True,
                )
            )
    return policies


def in_ask_order(
    asks: Sequence[Ask | PolicyAsk],
    new_centres: Iterable[tuple[Centre, EpisodesResult, EpisodesResult]],
    policies: Iterable[tuple[PolicyWork, EpisodesResult]],
    *,
    seed: int,
    centres: int,
    fitness_weight: float,
) -> Evaluated:
    """Everything that a generation has evaluated.

    Args:
        new_centres: (centre, its evaluation, its population) of each population asked for.
        policies: (policies, their results [N, E]) of each ask for policies.
        centres: number of centres of the search.
        fitness_weight: weight of fitness in the state.
    """
    parts: list[Evaluated] = []
    of_centres, of_policies, index = enumerate(new_centres), enumerate(policies), centres
    for asked in asks:
        if isinstance(asked, Ask):
            number, (point, evaluation, population) = next(of_centres)
            resets = seed, 0, number, NO_POLICY
            update_norm = norm(point.parameters_D - asked.centre_D)
            parts.append(
                _one(asked.centre, point, evaluation, resets, asked.fitness_weight, population, update_norm=update_norm)
            )
            continue
        number, (work, results) = next(of_policies)
        count = len(work.parameters_N_D)
        reset_N_4 = np.full((count, len(RESETS)), (seed, 0, number, 0))
        reset_N_4[:, -1] = np.arange(count)
        index_N, none_N = np.arange(index, index + count), np.full(count, np.nan)
        steps_N = results.steps.sum(axis=1, dtype=np.int64)
        weight_N = np.full(count, float(fitness_weight))
        parts.append(Evaluated((work,), index_N, results, reset_N_4, weight_N, none_N, none_N, steps_N))
        index += count
    return _joined(parts)


def initial_centres(
    points: Iterable[Centre], evaluations: Iterable[EpisodesResult], config: RunConfig, fitness_weight: float
) -> Evaluated:
    """The initial centres, which have no populations; the episodes of each begin with a chunk of its own."""
    episodes, parts = config.search.evaluation_episodes, []
    for index, (point, evaluation) in enumerate(zip(points, evaluations, strict=True)):
        resets = config.seed, first_episode(index, episodes), 0, NO_POLICY
        parts.append(_one(index, point, evaluation, resets, fitness_weight))
    return _joined(parts)


def _one(
    index: int,
    point: Centre,
    evaluation: EpisodesResult,
    resets: tuple[int, ...],
    fitness_weight: float,
    population: EpisodesResult | None = None,
    *,
    update_norm: float = math.nan,
) -> Evaluated:
    """A centre."""
    steps = steps_of(evaluation) + (0 if population is None else steps_of(population))
    population_max = math.nan if population is None else highest(population.fitness)
    return Evaluated(
        (point,),
        np.array([index]),
        evaluation,
        np.array([resets]),
        np.array([float(fitness_weight)]),
        np.array([population_max]),
        np.array([update_norm]),
        np.array([steps]),
    )


def _joined(parts: Sequence[Evaluated]) -> Evaluated:
    """Those of all parts, in order."""
    if len(parts) == 1:
        return parts[0]
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in Evaluated.__dataclass_fields__
        if name not in ("subjects", "evaluation")
    }
    return Evaluated(
        subjects=[subject for part in parts for subject in part.subjects],
        evaluation=joined([part.evaluation for part in parts]),
        **columns,
    )


@np.errstate(invalid="ignore", over="ignore")  # an infinite fitness makes the centre invalid
def told_of(
    evaluated: Evaluated,
    generation: int,
    names: Callable[[Sequence[int]], tuple[NDArray[Any], NDArray[Any]]] | None = None,
) -> CentreEvaluations:
    """What a search is told of a generation's centres and policies.

    Args:
        names: see `CentreEvaluations.names`.
    """
    episodes = evaluated.evaluation
    return CentreEvaluations(
        generation,
        evaluated.index_N,
        np.asarray(valid_members(episodes).all(axis=1)),
        doubles(episodes.fitness).mean(axis=1),
        doubles(episodes.descriptor).mean(axis=1),
        evaluated.population_max_N,
        episodes.fitness.shape[1],
        episodes,
        names,
    )


def evaluated_table(
    evaluated: Evaluated,
    task: TaskSpec,
    cell_N: NDArray[np.int64] | None,
    start_cells: Mapping[int, int],
    novelty_N: NDArray[np.float64],
) -> Table:
    """The rows of a generation in the table of evaluated centres; see `history.evaluated_columns`.

    Args:
        cell_N: cells of which they are the elites, EMPTY for the others; None without a map.
    """
    index_N, episodes = evaluated.index_N, evaluated.evaluation
    cells = {}
    if cell_N is not None:
        start_N = np.full(index_N.shape, EMPTY)
        for index, cell in start_cells.items():
            start_N[index_N == index] = cell
        cells = {"start_cell": with_gaps(start_N), "cell": with_gaps(cell_N)}
    return {
        "centre": index_N,
        "fitness_weight": evaluated.fitness_weight_N,
        **cells,
        **episodes_table(episodes, task),
        "novelty": novelty_N,
        "update_norm": evaluated.update_norm_N,
        "env_steps": evaluated.env_steps_N,
        "fitness_first": episodes.fitness[:, 0],
        **{name: with_gaps(values) for name, values in zip(RESETS, evaluated.reset_N_4.T, strict=True)},
    }
