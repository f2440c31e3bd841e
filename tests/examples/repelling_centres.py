"""A search of one's own that asks for several populations in a generation: centres that keep their behaviours apart.

es-service run my_config.yaml --set search.algorithm=repelling_centres:repelling_centres --set search.centres=2
es-service sweep my_config.yaml --grid search.reach=0.2,0.5 --seeds 0:5 --out runs/reach   # of this search
"""

from dataclasses import replace

import numpy as np
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import FitnessObjective
from es_service.config.search import PopulationConfig
from es_service.protocol.messages import EpisodesResult
from es_service.search.algorithms.base import NO_ENTRY, Algorithm, Ask, SearchState
from es_service.search.algorithms.common import novelty_search, population
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import settings_of
from es_service.search.shaping import centred_ranks, pair_weights


class RepellingSettings(PopulationConfig):
    """The keys of every method that perturbs centres, and one more: `search.reach`."""

    reach: float = Field(
        0.5, ge=0.0, description="Distance between descriptors from which on centres do not repel each other."
    )

    def populations(self) -> int:
        """As many as there are centres, for which so many workers have work."""
        return self.centres


@method(RepellingSettings)
def repelling_centres(config: RunConfig) -> Algorithm:
    """Every centre climbs fitness in every generation, but members that end near another centre rank lower."""

    search = settings_of(config, RepellingSettings)

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        return tuple(
            population(state, index, search, FitnessObjective(), generation) for index in range(len(state.centres))
        )

    def weights(state: SearchState, asked: Ask, results: EpisodesResult) -> np.ndarray:
        utility_P_S = centred_ranks(results.fitness)
        # All populations of a generation are judged in the state before it, so their order does not matter.
        others = [centre.entry for index, centre in enumerate(state.centres) if index != asked.centre]
        for place_B in (state.archive.descriptor_N_B[entry] for entry in others if entry != NO_ENTRY):
            distance_P_S = np.linalg.norm(results.descriptor - place_B, axis=-1)
            # An invalid member has the fitness NaN; NaN shares the lowest rank. Members out of reach share the highest.
            near_P_S = np.where(np.isnan(results.fitness), np.nan, np.minimum(distance_P_S, search.reach))
            utility_P_S = utility_P_S + 2.0 * centred_ranks(near_P_S)
        return pair_weights(utility_P_S)

    return replace(novelty_search(config, fitness_weight=1.0), ask=ask, weights=weights)
