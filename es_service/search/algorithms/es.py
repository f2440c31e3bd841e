"""ES: one centre climbs rank-shaped fitness. Salimans et al. 2017 (arXiv:1703.03864), with antithetic pairs and Adam.

A generation: mirrored rollouts -> utilities by centred rank of fitness -> gradient estimate (1 / pairs) * sum (u+ - u-)
* noise -> Adam on -gradient + l2 * centre. The estimate is not divided by sigma, because the step of Adam does not
depend on the scale of its gradient; the division would only change the ratio to l2.

ARS: one centre takes plain steps along the pairs with the best members. Mania et al. 2018 (arXiv:1803.07055).

A generation: mirrored rollouts -> the b = `shaping.count` pairs whose better member has the highest fitness -> gradient
estimate sum (f+ - f-) * noise / (b * s), where s is the standard deviation of the 2 b fitness values of these pairs ->
centre + learning_rate * (estimate - l2 * centre). So it is ES with another step and another shaping.

The paper's versions are settings here. V2 normalises observations, V1 has `policy.observation_normalization: false`;
those with a t have `shaping.count`, while null means all pairs. The paper has linear policies, `policy.hidden: []`, and
no l2.
"""

from __future__ import annotations

from es_service.config.model import RunConfig
from es_service.config.search import PopulationConfig, same
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


class ArsSettings(PopulationConfig):
    """One centre, with values of the parts that are those of the paper."""

    presets = (
        same("search.step.kind", "plain", "Mania et al. 2018"),
        same("search.step.l2", 0.0, "Mania et al. 2018, which has no weight decay"),
        same("search.shaping.kind", "top_pairs", "Mania et al. 2018"),
        same("policy.action_noise", 0.0, "Mania et al. 2018, which adds no noise to actions"),
    )
    only_centres = 1


@method(ArsSettings)
def ars(config: RunConfig) -> Algorithm:
    """Augmented random search: one centre climbs fitness, without ranks and without Adam."""
    return novelty_search(config, fitness_weight=1.0)
