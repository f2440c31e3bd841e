"""ES: one centre climbs the rank-shaped return. Salimans et al. 2017, with antithetic pairs and Adam.

Loop: mirrored rollouts -> utilities by centred rank of fitness -> gradient estimate (1 / pairs) * sum (u+ - u-) * noise
-> Adam on -gradient + l2 * centre. No division by sigma: Adam is scale-free, only the ratio to l2 would change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from es_service.algorithms.base import Algorithm, Member, Plan, SearchState
from es_service.config.model import SearchConfig
from es_service.optimizer import adam_ascent, fresh_adam
from es_service.protocol import EpisodesResult, FloatArray
from es_service.shaping import centred_ranks, pair_weights


def es(search: SearchConfig) -> Algorithm:
    """Plain evolution strategy with the settings of `search`."""

    def start(centre_D: FloatArray) -> SearchState:
        return SearchState((Member(centre_D, fresh_adam(centre_D.size)),))

    def plan(state: SearchState) -> Plan:
        return Plan(0, state.members[0].centre_D)

    def weights(state: SearchState, population: EpisodesResult) -> NDArray[np.float32]:
        return pair_weights(centred_ranks(population.fitness))

    def step(state: SearchState, plan: Plan, gradient_D: FloatArray) -> SearchState:
        member = state.members[plan.member]
        adam, centre_D = adam_ascent(
            member.adam, member.centre_D, gradient_D, learning_rate=search.learning_rate, l2=search.l2
        )
        return replace(state, members=(Member(centre_D, adam),))

    return Algorithm(start, plan, weights, step)
