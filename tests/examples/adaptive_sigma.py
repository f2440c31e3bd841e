"""A search of one's own that remembers something: ES with a sigma that adapts by a success rule (Rechenberg 1973).

es-service run my_config.yaml --set search.algorithm=adaptive_sigma:adaptive_sigma    # where this file lies
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from es_service.config.model import RunConfig
from es_service.search.algorithms.base import Algorithm, Ask, CentreEvaluation, SearchState
from es_service.search.algorithms.common import novelty_search

RISE, FALL = 1.5, 1.5**-0.25
"""Factors of sigma after a success and after a failure: with one success in five generations it stays as it is."""
RANGE = 10.0
"""Sigma stays between the `search.sigma` of the config divided by this and multiplied by it."""


def adaptive_sigma(config: RunConfig) -> Algorithm:
    """ES with one centre. A generation is a success if its new centre has a higher fitness than any before."""
    shared, first = novelty_search(config, fitness_weight=1.0), config.search.sigma

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        return tuple(replace(asked, sigma=float(state.extra["sigma"])) for asked in shared.ask(state, generation))

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        state = shared.tell(state, evaluations)
        sigma, record = float(state.extra["sigma"]), float(state.extra["record"])
        highest = max((one.fitness for one in evaluations if one.valid), default=-np.inf)
        if evaluations[0].generation > 0:  # the initial centre is no success
            sigma = float(np.clip(sigma * (RISE if highest > record else FALL), first / RANGE, first * RANGE))
        extra = {"sigma": np.array(sigma), "record": np.array(max(record, highest))}
        return replace(state, extra=extra)  # arrays of a state are never changed in place

    extra = {"sigma": np.array(first), "record": np.array(-np.inf)}
    return replace(shared, ask=ask, tell=tell, extra=extra)
