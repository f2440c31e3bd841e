"""NSR-ES: several centres climb novelty and fitness in equal parts. Conti et al. 2018 (arXiv:1712.06560)."""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.common import novelty_search
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import CentresSettings


@method(CentresSettings)
def nsr_es(config: RunConfig) -> Algorithm:
    """Novelty search with reward: utilities are the mean of the ranks of novelty and of fitness."""
    return novelty_search(config, fitness_weight=0.5)
