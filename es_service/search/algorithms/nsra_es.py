"""The family of Conti et al. 2018 (arXiv:1712.06560): several centres (a meta-population) climb novelty and fitness.

NS-ES climbs novelty alone, NSR-ES both in equal parts, and NSRA-ES both with a weight that adapts to progress: w is the
weight of fitness. If an evaluated centre beats the record, w rises by `fitness_weight_step` (to at most 1).
After `fitness_weight_patience` consecutive generations without such a centre, w falls by one step (to at least 0), and
the count starts again. All centres share one record and one count. Initial centres set no record, so the first valid
centre after them always does, as in the released code.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import Count, Fraction, NotNegative
from es_service.config.search import PresetRow
from es_service.search.algorithms.base import Algorithm, CentreEvaluation, FitnessWeight
from es_service.search.algorithms.common import novelty_search
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import CentresSettings, settings_of


@method(CentresSettings)
def ns_es(config: RunConfig) -> Algorithm:
    """Novelty search: utilities are ranks of novelty; fitness has no influence."""
    return novelty_search(config, fitness_weight=0.0)


@method(CentresSettings)
def nsr_es(config: RunConfig) -> Algorithm:
    """Novelty search with reward: utilities are the mean of the ranks of novelty and of fitness."""
    return novelty_search(config, fitness_weight=0.5)


class NsraSettings(CentresSettings):
    """Several centres, and how the weight of fitness adapts."""

    fitness_weight_start: Fraction = Field(description="Weight of fitness beside novelty at the start.")
    fitness_weight_step: Fraction = Field(
        0.05, description="How much the weight of fitness rises after an improvement or falls in stagnation."
    )
    fitness_weight_patience: Count = Field(
        description="Generations without improvement before the weight of fitness falls."
    )
    fitness_weight_min_gain: NotNegative = Field(
        description="A centre is an improvement if its fitness exceeds the record by more than this fraction of the "
        "record's absolute value."
    )

    presets = (
        PresetRow("search.fitness_weight_start", 1.0, 0.5, "literature: estorch and MEMES. uber: ME-ES."),
        PresetRow("search.fitness_weight_patience", 50, 20, "literature: estorch and MEMES. uber: ME-ES."),
        PresetRow("search.fitness_weight_min_gain", 0.0, 0.1, "literature: any gain counts. uber: ME-ES."),
    )


@method(NsraSettings)
def nsra_es(config: RunConfig) -> Algorithm:
    """Adaptive novelty search with reward: more weight on fitness after progress, more on novelty in stagnation."""
    search = settings_of(config, NsraSettings)
    return novelty_search(config, search.fitness_weight_start, partial(adapted_weight, search))


def adapted_weight(
    search: NsraSettings, weight: FitnessWeight, evaluations: Sequence[CentreEvaluation]
) -> FitnessWeight:
    """The weight of fitness after the centres evaluated in one more generation, in the order of the asks.

    A centre is an improvement if it is valid and its fitness exceeds record + fitness_weight_min_gain * |record|; a
    fitness equal to this is not. Its fitness is then the record for the next one.
    """
    before = weight
    for evaluation in evaluations:
        gain = search.fitness_weight_min_gain * abs(weight.record) if math.isfinite(weight.record) else 0.0
        if evaluation.valid and evaluation.fitness > weight.record + gain:
            weight = FitnessWeight(min(1.0, weight.value + search.fitness_weight_step), evaluation.fitness, 0)
    if weight is not before:
        return weight
    if weight.stagnant + 1 < search.fitness_weight_patience:
        return replace(weight, stagnant=weight.stagnant + 1)
    return replace(weight, value=max(0.0, weight.value - search.fitness_weight_step), stagnant=0)
