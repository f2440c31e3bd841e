"""ES: one centre climbs rank-shaped fitness. Salimans et al. 2017 (arXiv:1703.03864), with antithetic pairs and Adam.

A generation: mirrored rollouts -> utilities by centred rank of fitness -> gradient estimate (1 / pairs) * sum (u+ - u-)
* noise -> Adam on -gradient + l2 * centre. The estimate is not divided by sigma, because the step of Adam does not
depend on the scale of its gradient; the division would only change the ratio to l2.
"""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.config.search import PopulationConfig
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.common import novelty_search
from es_service.search.algorithms.method import method


class EsSettings(PopulationConfig):
    """One centre, and no keys of its own."""

    only_centres = 1


@method(EsSettings)
def es(config: RunConfig) -> Algorithm:
    """Plain evolution strategy: one centre climbs fitness. Its novelty archive is kept for comparison only."""
    return novelty_search(config, fitness_weight=1.0)
