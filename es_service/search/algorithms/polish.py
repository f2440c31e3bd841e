"""Polish: evolution strategies that climb from policies of another run until these hold in new episodes.

The elites of a map are the best of many noisy evaluations. From the best centre and from elites of another run
(`init_from`, `screened`, `candidate_choice`), a search begins whose populations average over perturbed policies, so
that it finds those that succeed again and again. Source: ARIA, Grillotti et al. 2023 (arXiv:2304.03672), which polishes
each elite of a map for its cell, and sequential halving, Karnin et al. 2013, between candidates.

Generation 0 evaluates all policies, and the `candidates` best of them remain. Then each generation moves every
candidate that is left by one step. After every `round_generations` generations, the worse half of the candidates
leaves, until one is left, which continues alone. Candidates are compared in the second half of a round: in each
generation the episodes of all their evaluations are ranked together by the objective, and a candidate scores the mean
rank of its own. These episodes are new ones in every generation, and no population trains on them. Of equal candidates
the earlier one stays.

Each candidate keeps the observation statistics with which the other run evaluated it. The map and the novelty archive
are those of this run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import Count
from es_service.config.search import CandidatesConfig, same
from es_service.protocol.episodes import each
from es_service.protocol.messages import EpisodesResult
from es_service.search.algorithms.base import Algorithm, Ask, CentreEvaluation, SearchState, read_only
from es_service.search.algorithms.common import novelty_search, population
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import settings_of
from es_service.search.shaping import centred_ranks, values, weight_of_fitness

LEFT, SCORE = "left", "score"
"""Names of the search's own arrays [screened]: whether each policy is still a candidate, and its score in the round."""


class PolishSettings(CandidatesConfig):
    """Candidates, and how long a round lasts; the parts are those of augmented random search."""

    round_generations: Count = Field(
        40, description="Generations after which the worse half of the candidates leaves, as long as several are left."
    )

    presets = (
        same("search.step.kind", "plain", "Mania et al. 2018"),
        same("search.step.l2", 0.0, "Mania et al. 2018, which has no weight decay"),
        same("search.shaping.kind", "top_pairs", "Mania et al. 2018"),
        same("policy.action_noise", 0.0, "Mania et al. 2018, which adds no noise to actions"),
        same("search.sigma", 0.025, "Mania et al. 2018, for the ant"),
        same("search.step.learning_rate", 0.015, "Mania et al. 2018, for the ant"),
        same("search.pairs", 32, "our choice, sized for one machine"),
        same("search.evaluation_episodes", 16, "our choice: one chunk"),
    )


@method(PolishSettings)
def polish(config: RunConfig) -> Algorithm:
    """Augmented random search from several policies of another run, of which the worse half leaves after each round."""
    search = settings_of(config, PolishSettings)
    shared = novelty_search(config, fitness_weight=weight_of_fitness(search.objective))

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        left = np.flatnonzero(state.extra[LEFT][: len(state.centres)])
        return tuple(population(state, int(index), search, search.objective, generation) for index in left)

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        extra, generation = state.extra, evaluations[0].generation
        in_round = (generation - 1) % search.round_generations + 1
        remain = search.candidates if generation == 0 else -(-len(evaluations) // 2)
        if len(evaluations) > remain and (generation == 0 or in_round > search.round_generations // 2):
            index = np.array([evaluation.centre for evaluation in evaluations])
            score = extra[SCORE].copy()
            score[index] += mean_ranks(
                [evaluation.results for evaluation in evaluations if evaluation.results is not None], search
            )
            if generation == 0 or in_round == search.round_generations:
                best = index[np.argsort(-score[index], kind="stable")[:remain]]
                extra = {**extra, LEFT: np.isin(np.arange(score.size), best), SCORE: np.zeros_like(score)}
            else:
                extra = {**extra, SCORE: score}
        return replace(shared.tell(state, evaluations), extra=read_only(extra))

    extra = {LEFT: np.ones(search.screened, bool), SCORE: np.zeros(search.screened)}
    return replace(shared, ask=ask, tell=tell, extra=extra)


def mean_ranks(results: list[EpisodesResult], search: CandidatesConfig) -> NDArray[np.float64]:
    """Mean rank, from -0.5 to 0.5, of each candidate's episodes among those of all, [N]; higher is better.

    Args:
        results: results of each candidate's evaluation [E].
        search: its objective; of novelty and of a mixture, fitness counts. Invalid episodes rank last.
    """
    together = each(lambda *arrays: np.stack(arrays), *results)
    is_valid = np.isfinite(together.fitness) & np.isfinite(together.descriptor).all(axis=-1)
    together = replace(together, fitness=np.where(is_valid, together.fitness, np.float32(np.nan)))
    return centred_ranks(values(search.objective, together)).mean(axis=1)
