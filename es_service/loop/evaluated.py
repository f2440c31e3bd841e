"""What a generation has evaluated, in the order of its asks: new centres with their populations, and policies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from es_service.config.model import RunConfig
from es_service.loop.generation import steps_of
from es_service.loop.history import HistoryRow, Resets, evaluated_row, norm
from es_service.loop.policies import PolicyWork, each_policy, no_statistics, policy_work
from es_service.protocol.messages import Centre, EpisodesResult, FloatArray, TaskSpec
from es_service.search.algorithms.base import Ask, PolicyAsk
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


def evaluated_rows(
    evaluated: Sequence[Evaluated],
    task: TaskSpec,
    map_: BehaviourMap | None,
    generation: int,
    start_cells: Mapping[int, int],
    novelties: Sequence[float],
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
