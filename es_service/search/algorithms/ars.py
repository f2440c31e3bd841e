"""ARS: one centre takes plain steps along the pairs with the best members. Mania et al. 2018 (arXiv:1803.07055).

A generation: mirrored rollouts -> the b = `top_pairs` pairs whose better member has the highest fitness -> gradient
estimate sum (f+ - f-) * noise / (b * s), where s is the standard deviation of the 2 b fitness values of these pairs ->
centre + learning_rate * (estimate - l2 * centre).

The paper's versions are settings here. V2 normalises observations, V1 has `policy.observation_normalization: false`;
those with a t have `top_pairs`, while null means all pairs. The paper has linear policies, `policy.hidden: []`, and no
l2.

Our own choices: An invalid member counts with the lowest fitness of the others. Of equally good pairs the first one is
taken (the released code takes all of them). If all fitness values are equal, the centre stays (it divides by 0).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.config.model import RunConfig
from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.search.algorithms.base import Algorithm, Ask, SearchState, with_centre
from es_service.search.algorithms.steps import novelty_search
from es_service.search.optimizer import plain_ascent
from es_service.search.shaping import invalid_lowest, standard_deviation


def ars(config: RunConfig) -> Algorithm:
    """Augmented random search: one centre climbs fitness, without ranks and without Adam."""
    search = config.search

    def weights(state: SearchState, asked: Ask, population: EpisodesResult) -> NDArray[np.float32]:
        return top_pair_weights(population.fitness, search.top_pairs or asked.pairs)

    def step(state: SearchState, asked: Ask, gradient_D: FloatArray) -> SearchState:
        centre = state.centres[asked.centre]
        centre_D = plain_ascent(centre.centre_D, gradient_D, learning_rate=search.learning_rate, l2=search.l2)
        return with_centre(state, asked.centre, replace(centre, centre_D=centre_D))

    return replace(novelty_search(config, fitness_weight=1.0), weights=weights, step=step)


def top_pair_weights(fitness_P_S: ArrayLike, count: int) -> NDArray[np.float32]:
    """Weight of each pair's noise, [P]: (f+ - f-) * P / (count * s) for the best pairs, 0 for the others.

    The gradient estimate is divided by P, all pairs; hence the factor P. Swapping the signs of all pairs negates every
    weight exactly.

    Args:
        fitness_P_S: fitness of every member, with axes P (pairs) and S (signs [+, -]).
        count: number of best pairs, at most P.
    """
    known_P_S = invalid_lowest(fitness_P_S)
    top = np.argsort(-known_P_S.max(axis=1), kind="stable")[:count]
    spread = standard_deviation(known_P_S[top])
    weight_P = np.zeros(len(known_P_S), np.float32)
    if spread:
        weight_P[top] = (known_P_S[top, 0] - known_P_S[top, 1]) * (len(known_P_S) / (count * spread))
    return weight_P
