"""Small ME-ES runs in memory, and what was sent to and from their workers."""

from functools import cache

import numpy as np

from es_service.api import load_config
from es_service.config.model import worker_spec
from es_service.loop import driver
from es_service.protocol.messages import EvaluationChunk, PolicyShape
from es_service.search.algorithms import ALGORITHMS
from es_service.search.observation_statistics import no_observations
from tests.helpers import DirectEvaluator, MemoryStore
from tests.twins.behaviour_map import cell_number
from workers.environments import SHIPPED
from workers.policy import initial_parameters

SHAPE = PolicyShape((2, 8, 8, 2))
CELLS, BLOCK = (20, 15), 3
PRESETS = {
    "literature": {"first_block": "explore", "sampling": "top", "squared": False},
    "uber": {"first_block": "exploit", "sampling": "score", "squared": True},
}


def config_of(preset="literature", generations=30, seed=0, neighbours=3, **search):
    return load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8]},
            "search": {
                "algorithm": "me_es",
                "preset": preset,
                "pairs": 32,
                "sigma": 0.2,
                "learning_rate": 0.2,
                "evaluation_episodes": 20,
                "block_generations": BLOCK,
                "parent_statistics": "elite" if preset == "literature" else "global",  # both, and one for each preset
                **search,
            },
            "novelty": {"neighbours": neighbours},
            "map": {"cells": list(CELLS)},
            "budget": {"generations": generations},
            "compute": {"chunk_pairs": 16},
            "seed": seed,
        }
    )


@cache
def compiled(preset):
    return DirectEvaluator(worker_spec(config_of(preset), SHIPPED["point_maze"]))


class Sharing(DirectEvaluator):
    """Runs the functions that were compiled for its preset; evaluations of some generations end nowhere."""

    def __init__(self, preset="literature", spoiled=()):
        self.counts, self._run_chunk = compiled(preset).counts, compiled(preset)._run_chunk
        self.recorded, self.spoiled = [], spoiled

    def evaluate(self, work):
        results = super().evaluate(work)
        for (_, chunk), result in zip(work, results, strict=True):
            if isinstance(chunk, EvaluationChunk) and chunk.generation in self.spoiled:
                result.descriptor[1] = np.nan
        return results


class Remembering(MemoryStore):
    """Keeps the parts as they were after each generation."""

    def __init__(self):
        super().__init__()
        self.after = []

    def commit(self, generation, parts, history, evaluations=()):
        super().commit(generation, parts, history, evaluations)
        self.after.append(dict(self.parts))


def run_in_memory(config, evaluator=None, store=None):
    evaluator, store = evaluator or Sharing(config.search.preset), store or Remembering()
    first = initial_parameters(SHAPE, config.policy.init, config.seed, 0)
    search = driver.Search(
        config, ALGORITHMS["me_es"](config), lambda: ([first], no_observations(2)), SHIPPED["point_maze"]
    )
    state, _ = driver.run(search, evaluator, store, driver.stored_state(store, search.task), lambda row: None)
    return state, store, evaluator


def points(evaluator, kind, generation):
    """The centre that all chunks of a kind were sent around, and all their results in the order of their ids."""
    found = [
        (chunk.chunk_id, point, result)
        for point, chunk, result in evaluator.recorded
        if isinstance(chunk, kind) and chunk.generation == generation
    ]
    found.sort(key=lambda item: item[0])
    assert len({id(point) for _, point, _ in found}) == 1
    results = [result for *_, result in found]
    return found[0][1], np.concatenate([r.fitness for r in results]), np.concatenate([r.descriptor for r in results])


def evaluation(evaluator, generation):
    """Mean fitness and descriptor over the 20 episodes of an evaluated centre."""
    _, fitness, descriptor = points(evaluator, EvaluationChunk, generation)
    return fitness[:20].astype(float).mean(), descriptor[:20].astype(float).mean(axis=0)


def number(index):
    return None if index is None else cell_number(CELLS, index)


def assert_near(ours, theirs):
    assert np.linalg.norm(ours - theirs) < 1e-6 * np.linalg.norm(theirs)
