"""Parts of one generation: the chunks that are sent to the workers, and how their results are combined.

The order in which results arrive has no influence: they are taken by chunk id, and partial gradients are added in one
fixed binary tree. Axes: P antithetic pairs, S signs [+, -], E evaluation episodes, D policy parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.errors import EvaluationError, WayOut
from es_service.loop.state import Best, statistics_in_force
from es_service.protocol.messages import (
    EVALUATION_EPISODES_PER_CHUNK,
    Centre,
    EpisodesResult,
    EvaluationChunk,
    Evaluator,
    FloatArray,
    GradientChunk,
    GradientResult,
    Moments,
    TrainingChunk,
)
from es_service.search.algorithms.base import CentreEvaluation, CentreState, SearchState
from es_service.search.maps.behaviour_map import Elite, make_elite

Result = TypeVar("Result", EpisodesResult, GradientResult)


def make_centre(
    config: RunConfig, generation: int, centre_D: FloatArray, observations: Moments, state: CentreState | None = None
) -> Centre:
    """The centre as it is sent to the workers: its parameters and the observation statistics that it runs with."""
    mean_O, std_O = statistics_in_force(observations, state, config.policy.observation_normalization)
    return Centre(generation, centre_D, config.search.sigma, mean_O, std_O)


def evaluate_population(
    evaluator: Evaluator, centre: Centre, *, pairs: int, chunk_pairs: int
) -> tuple[EpisodesResult, list[Moments]]:
    """Roll out all pairs around the centre: (results with axes [P, S], observation moments in chunk order)."""
    chunks = [TrainingChunk(centre.generation, chunk_id) for chunk_id in range(pairs // chunk_pairs)]
    results = _all_of(EpisodesResult, evaluator.evaluate(centre, chunks))
    return _concatenate(results, pairs), [result.moments for result in results if result.moments is not None]


def evaluate_centre(evaluator: Evaluator, centre: Centre, episodes: int, index: int = 0) -> EpisodesResult:
    """Roll out the unperturbed centre: results with axis [E]. Episodes beyond the wanted number are discarded.

    Args:
        index: index of this centre among those evaluated in the same generation; each index has its own resets.
    """
    count = -(-episodes // EVALUATION_EPISODES_PER_CHUNK)
    chunks = [EvaluationChunk(centre.generation, chunk_id) for chunk_id in range(index * count, (index + 1) * count)]
    results = evaluator.evaluate(centre, chunks)
    return _concatenate(_all_of(EpisodesResult, results), episodes)


def estimate_gradient(evaluator: Evaluator, centre: Centre, weights_P: FloatArray, block_pairs: int) -> FloatArray:
    """Gradient estimate [D]: (1 / pairs) * sum over pairs of weight * standard normal noise. Workers sum blocks."""
    chunks = []
    for chunk_id, first in enumerate(range(0, weights_P.size, block_pairs)):
        block_P = weights_P[first : first + block_pairs]
        padded_P = np.pad(block_P, (0, block_pairs - block_P.size))
        chunks.append(GradientChunk(centre.generation, chunk_id, padded_P))
    results = _all_of(GradientResult, evaluator.evaluate(centre, chunks))
    return tree_sum([result.sum_D for result in results]) * np.float32(1.0 / weights_P.size)


def tree_sum(blocks: Sequence[FloatArray]) -> FloatArray:
    """Sum by adding neighbours level by level: ((0 + 1) + (2 + 3)) + ...; an odd last one moves up unchanged.

    The tree depends only on the number of blocks, so any of its nodes may be computed anywhere.
    """
    level = list(blocks)
    while len(level) > 1:
        pairs = [level[i] + level[i + 1] for i in range(0, len(level) - 1, 2)]
        level = pairs + level[len(pairs) * 2 :]
    return level[0]


def valid_members(result: EpisodesResult) -> NDArray[np.bool_]:
    """Whether each member (or episode) has a finite fitness and a finite descriptor, with the axes of the fitness."""
    return np.isfinite(result.fitness) & np.isfinite(result.descriptor).all(axis=-1)


def invalidate(population: EpisodesResult, max_invalid_fraction: float, generation: int) -> tuple[EpisodesResult, int]:
    """Set the fitness of every invalid member to NaN, which ranks last: (population, number of invalid members).

    Raises:
        EvaluationError: more than `max_invalid_fraction` of the members are invalid.
    """
    valid_P_S = valid_members(population)
    invalid = int(np.count_nonzero(~valid_P_S))
    if invalid > max_invalid_fraction * valid_P_S.size:
        raise EvaluationError(
            f"generation {generation}: {invalid} of {valid_P_S.size} members returned a fitness or descriptor that is "
            f"not finite, more than search.max_invalid_fraction ({max_invalid_fraction}) allows. Everything up to "
            f"generation {generation - 1} is saved; a smaller search.sigma or search.learning_rate may help.",
            field="search.max_invalid_fraction",
            value=max_invalid_fraction,
        )
    fitness_P_S = np.where(valid_P_S, population.fitness, np.float32(np.nan))
    return replace(population, fitness=fitness_P_S), invalid


def require_some_finite(evaluations: Sequence[EpisodesResult], environment: str) -> None:
    """Raise an EvaluationError if no episode of any initial centre is valid; this is an error of the task."""
    count = sum(evaluation.fitness.size for evaluation in evaluations)
    if any(valid_members(evaluation).any() for evaluation in evaluations):
        return
    finite = {
        "return": any(np.isfinite(evaluation.returns).any() for evaluation in evaluations),
        "descriptor": any(np.isfinite(evaluation.descriptor).any() for evaluation in evaluations),
    }
    wrong = " and ".join(name for name, is_finite in finite.items() if not is_finite) or "fitness or descriptor"
    steps = min(int(evaluation.steps.min()) for evaluation in evaluations)
    raise EvaluationError(
        f"generation 0: the {wrong} is NaN or infinite in each of the {count} episodes of the initial centres; the "
        f"shortest episode has {steps} steps. The run cannot learn from this: look for a division by 0, a root or "
        f"logarithm of a negative number, or physics that diverges, in the task {environment}",
        field="task.environment",
        value=environment,
    )


def require_finite(centre_D: FloatArray, learning_rate: float, generation: int) -> None:
    """Raise an EvaluationError for a centre that is not finite after its update."""
    if not np.isfinite(centre_D).all():
        raise EvaluationError(
            f"generation {generation}: the centre is not finite after its update with search.learning_rate = "
            f"{learning_rate:g}, so it is not kept. Everything up to generation {generation - 1} is saved.",
            field="search.learning_rate",
            value=learning_rate,
            ways_out=[
                WayOut(
                    "fork",
                    "continue from there with a smaller learning rate",
                    settings={"search.learning_rate": learning_rate / 10},
                )
            ],
        )


@np.errstate(invalid="ignore", over="ignore")  # an infinite fitness makes the centre invalid
def centre_evaluation(
    generation: int, centre: int, evaluation: EpisodesResult, population: EpisodesResult | None = None
) -> CentreEvaluation:
    """The evaluation of a centre, from its evaluation episodes and the population that led to it.

    Args:
        population: its invalid members have the fitness NaN; None for an initial centre.
    """
    return CentreEvaluation(
        generation,
        centre,
        bool(valid_members(evaluation).all()),
        float(np.mean(evaluation.fitness, dtype=np.float64)),
        evaluation.descriptor.astype(np.float64).mean(axis=0),
        _highest(population.fitness) if population is not None else math.nan,
    )


def entered(state: SearchState, told: CentreEvaluation, centre: Centre, evaluation: EpisodesResult) -> dict[int, Elite]:
    """The centre just evaluated as an elite, by its cell; empty if it did not enter the map.

    The map decides this and not `CentreState.cell`, which a search of the user need not set.
    """
    if state.map is None or (cell := state.map.cell_of(told.generation, told.centre)) is None:
        return {}
    assert evaluation.trace_T_B is not None, "an evaluation has a trace"
    return {cell: make_elite(centre, evaluation.trace_T_B)}


def better(best: Best, centre: Centre, told: CentreEvaluation) -> Best:
    """The best centre after one more evaluation. An invalid centre, or one of equal fitness, does not replace it."""
    if not told.valid or told.fitness <= best.fitness:
        return best
    mean_O, std_O = centre.observation_mean_O, centre.observation_std_O
    return Best(centre.generation, told.fitness, centre.parameters_D, mean_O, std_O)


def steps_of(result: EpisodesResult) -> int:
    """Total number of environment steps of episodes."""
    return int(result.steps.sum(dtype=np.int64))


def _highest(fitness: FloatArray) -> float:
    """Highest finite value; NaN if there is none."""
    finite = fitness[np.isfinite(fitness)]
    return float(finite.max()) if finite.size else math.nan


def _all_of(kind: type[Result], results: Sequence[object]) -> list[Result]:
    """The same results, checked to be of one kind."""
    checked = [result for result in results if isinstance(result, kind)]
    assert len(checked) == len(results), f"an evaluator returned a result that is not a {kind.__name__}"
    return checked


def _concatenate(results: Sequence[EpisodesResult], count: int) -> EpisodesResult:
    """Join results along the first axis and keep the first `count`; the result has no observation moments."""

    def join(name: str) -> np.ndarray:
        return np.concatenate([getattr(result, name) for result in results])[:count]

    return EpisodesResult(
        fitness=join("fitness"),
        returns=join("returns"),
        descriptor=join("descriptor"),
        steps=join("steps"),
        goal_distance=join("goal_distance"),
        moments=None,
        trace_T_B=results[0].trace_T_B,
    )
