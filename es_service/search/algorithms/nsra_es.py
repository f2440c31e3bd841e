"""NSRA-ES: novelty and fitness, the balance adapted to progress. Conti et al. 2018 (arXiv:1712.06560).

w is the weight of fitness. Each evaluated centre either beats the record, which raises w by `fitness_weight_step` (to 1
at most), or it does not; after `fitness_weight_patience` of those in a row w falls by a step (to 0 at least), and the
count begins again. Record and count belong to the whole meta-population. Initial centres set no record, so the first
centre after them always does, as in the released code.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

from es_service.config.model import RunConfig, SearchConfig
from es_service.search.algorithms.base import Algorithm, CentreEvaluation, FitnessWeight
from es_service.search.algorithms.steps import novelty_search


def nsra_es(config: RunConfig) -> Algorithm:
    """Novelty search with reward, adaptive: more novelty while the best stagnates, more fitness while it improves."""
    return novelty_search(config, config.search.fitness_weight_start, partial(adapted_weight, config.search))


def adapted_weight(search: SearchConfig, weight: FitnessWeight, evaluation: CentreEvaluation) -> FitnessWeight:
    """w after one more evaluated centre. An invalid centre is no improvement."""
    bar = (
        weight.record + search.fitness_weight_min_gain * abs(weight.record)
        if math.isfinite(weight.record)
        else -math.inf
    )
    if evaluation.valid and evaluation.fitness > bar:
        return FitnessWeight(min(1.0, weight.value + search.fitness_weight_step), evaluation.fitness, 0)
    if weight.stagnant + 1 < search.fitness_weight_patience:
        return replace(weight, stagnant=weight.stagnant + 1)
    return replace(weight, value=max(0.0, weight.value - search.fitness_weight_step), stagnant=0)
