"""NS-ES: several centres climb novelty alone (a meta-population). Conti et al. 2018 (arXiv:1712.06560)."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.steps import novelty_search


def ns_es(config: RunConfig) -> Algorithm:
    """Novelty search: utilities are ranks of novelty; fitness has no influence."""
    return novelty_search(config, fitness_weight=0.0)
