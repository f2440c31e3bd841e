"""ES: one centre climbs the rank-shaped return. Salimans et al. 2017, with antithetic pairs and Adam.

Loop: mirrored rollouts -> utilities by centred rank of fitness -> gradient estimate (1 / pairs) * sum (u+ - u-) * noise
-> Adam on -gradient + l2 * centre. No division by sigma: Adam is scale-free, only the ratio to l2 would change.
"""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.steps import novelty_search


def es(config: RunConfig) -> Algorithm:
    """Plain evolution strategy: fitness alone, one centre. Its archive is kept for comparison and steers nothing."""
    return novelty_search(config, fitness_weight=1.0)
