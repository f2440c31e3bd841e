"""Small runs in memory, of ES unless another search is named."""

from es_service.api import load_config
from es_service.config.workload import policy_spec, worker_spec
from es_service.loop import driver
from es_service.loop.state import no_observations
from es_service.protocol.messages import EpisodesResult, PolicySpec
from es_service.search.algorithms import ALGORITHMS
from tests.helpers import DirectEvaluator, MemoryStore
from workers.environments import SHIPPED
from workers.policy import initial_parameters

SHAPE = PolicySpec((2, 8, 8, 2))


class Tampering(DirectEvaluator):
    """Makes some members' results not finite."""

    def __init__(self, worker_spec, spoil):
        super().__init__(worker_spec)
        self.spoil = spoil

    def evaluate(self, work):
        found = zip(work, super().evaluate(work), strict=True)
        return [self.spoil(c, r) if isinstance(r, EpisodesResult) else r for (_, c), r in found]


def small_config(policy=None, **changes):
    mapping = {
        "task": {"environment": "point_maze"},
        "policy": {"hidden": [8, 8], **(policy or {})},
        "search": {"algorithm": "es", "pairs": 48, "sigma": 0.1, "evaluation_episodes": 20, **changes},
        "budget": {"generations": 20},
        "compute": {"chunk_pairs": 16, "gradient_block_pairs": 20},
    }
    return load_config(mapping)


def run_in_memory(config, evaluator=None, store=None):
    evaluator = evaluator or DirectEvaluator(worker_spec(config, SHIPPED["point_maze"]))
    first = initial_parameters(policy_spec(config, SHIPPED["point_maze"]), config.policy.init, config.seed)
    search = driver.Search(
        config,
        ALGORITHMS[config.search.algorithm](config),
        lambda: ([first], no_observations(2)),
        SHIPPED["point_maze"],
    )
    store = store or MemoryStore()
    state, reason = driver.drive(driver.run(search, store, None, lambda row: None), evaluator)
    return state, store, evaluator, reason
