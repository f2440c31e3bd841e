"""A search of one's own that asks for several populations in a generation: centres that keep their behaviours apart.

es-service run my_config.yaml --set search.algorithm=repelling_centres:repelling_centres --set search.centres=2
es-service sweep my_config.yaml --grid search.options.reach=0.2,0.5 --seeds 0:5 --out runs/reach   # of this search
"""

from dataclasses import replace

import numpy as np

from es_service.config.model import RunConfig
from es_service.protocol.messages import EpisodesResult
from es_service.protocol.options import Option, has_options
from es_service.search.algorithms.base import NO_ENTRY, Algorithm, Ask, SearchState
from es_service.search.algorithms.steps import novelty_search, population
from es_service.search.shaping import centred_ranks, pair_weights


# Distance between descriptors, in their units, from which on centres do not repel each other.
@has_options(reach=Option(0.5, low=0.0))
def repelling_centres(config: RunConfig) -> Algorithm:
    """Every centre climbs fitness in every generation, but members that end near another centre rank lower."""

    reach = config.search.options["reach"]

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        return tuple(population(state, index, config.search, 1.0) for index in range(len(state.centres)))

    def weights(state: SearchState, asked: Ask, results: EpisodesResult) -> np.ndarray:
        utility_P_S = centred_ranks(results.fitness)
        # All populations of a generation are judged in the state before it, so their order does not matter.
        others = [centre.entry for index, centre in enumerate(state.centres) if index != asked.centre]
        for place_B in (state.archive.descriptor_N_B[entry] for entry in others if entry != NO_ENTRY):
            distance_P_S = np.linalg.norm(results.descriptor - place_B, axis=-1)
            # An invalid member has the fitness NaN; NaN shares the lowest rank. Members out of reach share the highest.
            near_P_S = np.where(np.isnan(results.fitness), np.nan, np.minimum(distance_P_S, reach))
            utility_P_S = utility_P_S + 2.0 * centred_ranks(near_P_S)
        return pair_weights(utility_P_S)

    return replace(novelty_search(config, fitness_weight=1.0), ask=ask, weights=weights)
