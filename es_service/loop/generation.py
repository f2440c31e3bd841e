"""Parts of one generation: the chunks that are sent to the workers, and how their results are combined.

The order in which results arrive has no influence: they are taken by chunk id, and partial gradients are added in one
fixed binary tree. Axes: P antithetic pairs, S signs [+, -], E evaluation episodes, D policy parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.config.sections import NoveltyConfig
from es_service.errors import EvaluationError
from es_service.loop.checks import require_columns, require_state
from es_service.loop.contents import PolicyWork
from es_service.loop.state import NO_BEST, Best, RunState, Search, statistics_in_force
from es_service.protocol.episodes import Requests, gathered, moments_in
from es_service.protocol.gradient_tree import tree_sum
from es_service.protocol.messages import (
    EVALUATION_EPISODES_PER_CHUNK,
    NO_CENTRE,
    Centre,
    EpisodesResult,
    FloatArray,
    GradientChunk,
    GradientResult,
    Moments,
    TrainingChunk,
    Work,
    evaluation_chunks,
    with_subject,
)
from es_service.protocol.nearest import archive_entries
from es_service.search.algorithms.base import (
    Algorithm,
    Ask,
    CentreEvaluations,
    CentreState,
    SearchState,
    frozen,
    with_centre,
)
from es_service.search.algorithms.common import first_state
from es_service.search.maps.behaviour_map import empty_map, with_names
from es_service.search.maps.geometry import make_geometry
from es_service.search.novelty import NoveltyArchive
from es_service.search.shaping import weight_of_fitness, weighted
from es_service.search.steps import norm

AnyResult = TypeVar("AnyResult", EpisodesResult, GradientResult)
NOVEL_MEMBERS = 4096
"""Members of a generation from which on workers compute their novelty. It takes a core about 10 microseconds each."""


def initial_state(search: Search) -> RunState:
    """The state before generation 0: nothing has been evaluated."""
    algorithm, (centres, observations) = search.algorithm, search.initial()
    map_ = None
    if search.config.map.enabled:
        map_ = empty_map(make_geometry(search.config.map), counts_samples=algorithm.counts_samples)
    dimensions, settings = len(search.task.descriptor_names), search.config.search
    learned = first_state(centres, dimensions, algorithm.fitness_weight, map_, algorithm.extra, settings)
    for index, (mean_O, std_O) in enumerate(search.statistics()):
        centre = replace(learned.centres[index], own_mean_O=mean_O, own_std_O=std_O)
        learned = with_centre(learned, index, centre)
    return RunState(-1, learned, observations, NO_BEST, env_steps=0, episodes=0, wall_clock_s=0.0)


def make_centre(
    config: RunConfig,
    generation: int,
    centre_D: FloatArray,
    observations: Moments,
    state: CentreState | None = None,
    sigma: float = 0.0,
) -> Centre:
    """The centre as it is sent to the workers: its parameters and the observation statistics that it runs with.

    Args:
        state: it may have statistics of its own; None for those of the whole run.
        sigma: of its population; 0 for an initial centre, which has none.
    """
    mean_O, std_O = statistics_in_force(observations, state, config.policy.observation_normalization)
    return Centre(generation, centre_D, sigma, mean_O, std_O)


def with_archive(
    centres: Sequence[Centre], asks: Sequence[Ask], archive: NoveltyArchive, settings: NoveltyConfig
) -> list[Centre]:
    """The centres of populations, with the novelty archive for those whose members are ranked by novelty, if there are
    so many of these that the driver would hold up the workers. The novelty has the same bits wherever it is computed.

    Args:
        archive: as it was before the generation.
    """
    is_novel = [weight_of_fitness(ask.objective or weighted(ask.fitness_weight)) < 1.0 for ask in asks]
    members = sum(2 * ask.pairs for ask, novel in zip(asks, is_novel, strict=True) if novel)
    if members < NOVEL_MEMBERS or not archive.size:
        return [*centres]
    entries = archive_entries(archive.descriptor_N_B, settings.newest, settings.neighbours, settings.distance)
    return [
        replace(centre, archive=entries) if novel else centre for centre, novel in zip(centres, is_novel, strict=True)
    ]


def evaluate_populations(
    centres: Sequence[Centre],
    pairs: Sequence[int],
    chunk_pairs: int,
    policies: Sequence[PolicyWork] = (),
) -> Requests[tuple[list[EpisodesResult], list[Moments], list[EpisodesResult]]]:
    """Roll out each centre's number of pairs around it, and side by side with them policies.

    Returns:
        The results of each population, with axes [P, S]; the observation moments in the order of the populations and,
        within each, of its chunks; and the results of each ask for policies, with axes [N, E].
    """
    asked = [
        with_subject(
            centre, [TrainingChunk(centre.generation, chunk_id, ask, ask) for chunk_id in range(count // chunk_pairs)]
        )
        for ask, (centre, count) in enumerate(zip(centres, pairs, strict=True))
    ]
    populations = zip(asked, [(count,) for count in pairs], strict=True)
    results, moments = yield from episodes_of([*populations, *((of_ask.work, of_ask.shape) for of_ask in policies)])
    return results[: len(asked)], moments, results[len(asked) :]


def evaluate_centres(
    centres: Sequence[Centre],
    episodes: int,
    *,
    resets: Literal["by_ask", "by_chunk", "same"] = "by_ask",
    first: int = 0,
) -> Requests[list[EpisodesResult]]:
    """Roll out each unperturbed centre: results with axes [1, E].

    Args:
        resets: which random streams the episodes start from. Each centre has its own, addressed by its ask or, in
            generation 0, by its chunk ids; or all have the same.
        first: id of the first chunk.
    """
    asked = []
    for index, centre in enumerate(centres):
        start, ask = first, index if resets == "by_ask" else 0
        if resets == "by_chunk":
            start += first_episode(index, episodes) // EVALUATION_EPISODES_PER_CHUNK
        chunks = evaluation_chunks(centre.generation, episodes, first=start, ask=ask, request=index)
        asked.append((with_subject(centre, chunks), (1, episodes)))
    return (yield from episodes_of(asked))[0]


def first_episode(centre: int, episodes: int) -> int:
    """Number of an initial centre's first evaluation episode: each begins with a chunk of its own."""
    return centre * -(-episodes // EVALUATION_EPISODES_PER_CHUNK) * EVALUATION_EPISODES_PER_CHUNK


def estimate_gradients(generation: int, weights: Sequence[FloatArray], block_pairs: int) -> Requests[list[FloatArray]]:
    """Gradient estimate [D] of each population: (1 / pairs) * sum over pairs of weight * standard normal noise.

    Workers need no centre for this.

    Args:
        weights: those of each population [P].
        block_pairs: pairs whose products a worker sums.
    """
    asked = []
    for ask, weights_P in enumerate(weights):
        chunks = []
        for chunk_id, first in enumerate(range(0, weights_P.size, block_pairs)):
            block_P = weights_P[first : first + block_pairs]
            padded_P = np.pad(block_P, (0, block_pairs - block_P.size))
            chunks.append(GradientChunk(generation, chunk_id, padded_P, ask))
        asked.append(with_subject(NO_CENTRE, chunks))
    work = [subject_chunk for of_ask in asked for subject_chunk in of_ask]
    nodes = iter((yield from _computed(GradientResult, work)))
    return [
        tree_sum(list(islice(nodes, len(of_ask)))) * np.float32(1.0 / weights_P.size)
        for of_ask, weights_P in zip(asked, weights, strict=True)
    ]


def halves(
    generation: int, weights: Sequence[FloatArray], block_pairs: int
) -> Requests[tuple[list[FloatArray], list[float]]]:
    """As `estimate_gradients`, and how well the two halves of each population agree, from 0 to 1.

    Each half's estimate is from its own pairs, of those whose weight is not 0; the agreement is the cosine between
    them, or 0 if that is negative or one of them is 0.
    """
    parts = []
    for is_first in (True, False):
        half = [np.where(_is_in_first_half(weights_P) == is_first, weights_P, np.float32(0.0)) for weights_P in weights]
        parts.append((yield from estimate_gradients(generation, half, block_pairs)))
    pairs = list(zip(*parts, strict=True))
    return [first_D + second_D for first_D, second_D in pairs], [_agreement(*pair) for pair in pairs]


def _is_in_first_half(weights_P: FloatArray) -> NDArray[np.bool_]:
    """Whether each pair is in the first half of those whose weight is not 0."""
    rank_P = np.cumsum(weights_P != 0.0)
    return rank_P <= rank_P[-1] // 2


def _agreement(first_D: FloatArray, second_D: FloatArray) -> float:
    length = norm(first_D) * norm(second_D)
    both = float(np.sum(np.multiply(first_D, second_D, dtype=np.float64)))
    return max(0.0, both / length) if length > 0.0 else 0.0


def episodes_of(
    asked: Sequence[tuple[Sequence[Work], tuple[int, ...]]],
) -> Requests[tuple[list[EpisodesResult], list[Moments]]]:
    """Results of episodes of several requests, side by side, and the moments of their observations in the order of the
    chunks.

    Args:
        asked: the chunks of each request, which have its index, and its leading axes as in `gathered`.
    """
    results = yield from _computed(EpisodesResult, [subject_chunk for work, _ in asked for subject_chunk in work])
    return gathered([shape for _, shape in asked], results), moments_in(results)


def _computed(kind: type[AnyResult], work: Sequence[Work]) -> Requests[list[AnyResult]]:
    results = (yield work) if work else []
    checked = [result for result in results if isinstance(result, kind)]
    assert len(checked) == len(results), f"an evaluator returned a result that is not a {kind.__name__}"
    return checked


def tell(algorithm: Algorithm, state: SearchState, told: CentreEvaluations) -> SearchState:
    """The state after the search is told a generation's evaluations, whose new elites have their names; its arrays are
    read-only from now on."""
    after, generation = algorithm.tell(state, told), told.generation
    require_state(after, "tell", generation)
    require_columns(after, state, generation)
    try:
        if after.map is not None and after.map is not state.map and told.names is not None:
            after = replace(after, map=with_names(after.map, generation, told.centre_N, told.names))
        return frozen(after)
    except ValueError as error:
        text = f"generation {generation}: `tell` returned a state that is none: {error}"
        raise EvaluationError(text, field="search.algorithm") from error


def fittest(told: CentreEvaluations) -> int:
    """Index in `told` of the valid centre with the highest fitness, the first of equal ones; 0 if none is valid."""
    return int(np.where(told.valid_N, told.fitness_N, -math.inf).argmax())


def better(best: Best, told: CentreEvaluations) -> Best:
    """The best centre after more evaluations. An invalid centre, or one of equal fitness, does not replace it; the
    first one is taken in any case."""
    at = fittest(told)
    is_better = told.valid_N[at] and told.fitness_N[at] > best.fitness
    if best is not NO_BEST and not is_better:
        return best
    assert told.names is not None, "the loop has made these evaluations"
    policy_N, _ = told.names([at])
    return Best(told.generation, float(told.fitness_N[at]) if is_better else -math.inf, policy_N[0])


def results_in(told: CentreEvaluations) -> EpisodesResult:
    """The episodes of what the loop has evaluated, [N, E]."""
    assert told.results is not None, "the loop has the results of all episodes"
    return told.results


def steps_of(result: EpisodesResult) -> int:
    """Total number of environment steps of episodes."""
    return int(result.steps.sum(dtype=np.int64))


def highest(fitness: FloatArray) -> float:
    """Highest finite value; NaN if there is none."""
    finite = fitness[np.isfinite(fitness)]
    return float(finite.max()) if finite.size else math.nan
