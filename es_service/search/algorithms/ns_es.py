"""NS-ES: several centres climb novelty alone (a meta-population). Conti et al. 2018 (arXiv:1712.06560)."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.common import novelty_search
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import CentresSettings


@method(CentresSettings)
def ns_es(config: RunConfig) -> Algorithm:
    """Novelty search: utilities are ranks of novelty; fitness has no influence."""
    return novelty_search(config, fitness_weight=0.0)
