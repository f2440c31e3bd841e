"""A search of one's own: novelty search with a minimal criterion (Lehman and Stanley 2010). Start from this file.

es-service run my_config.yaml --set search.algorithm=minimal_criterion:minimal_criterion    # where this file lies
"""

from dataclasses import replace

import numpy as np

from es_service.config.model import RunConfig
from es_service.protocol.messages import EpisodesResult
from es_service.search.algorithms.base import Algorithm, Ask, SearchState
from es_service.search.algorithms.common import novelty_search
from es_service.search.novelty import novelty
from es_service.search.shaping import centred_ranks, pair_weights


def minimal_criterion(config: RunConfig) -> Algorithm:
    """Novelty, but only of members that do at least as well as half of their population."""

    def weights(state: SearchState, asked: Ask, population: EpisodesResult) -> np.ndarray:
        nearest = config.novelty
        novelty_P_S = novelty(
            state.archive, population.descriptor, neighbours=nearest.neighbours, distance=nearest.distance
        )
        # An invalid member has the fitness NaN, which is never enough; NaN shares the lowest rank.
        is_enough_P_S = population.fitness >= np.nanmedian(population.fitness)
        return pair_weights(centred_ranks(np.where(is_enough_P_S, novelty_P_S, np.nan)))

    return replace(novelty_search(config, fitness_weight=0.0), weights=weights)
