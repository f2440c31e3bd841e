"""Small runs in memory, of ME-ES unless another search is named, and what was sent to and from their workers."""

from functools import cache

import numpy as np

from es_service.api import load_config
from es_service.config.workload import worker_spec
from es_service.loop import driver
from es_service.loop.state import no_observations
from es_service.protocol.messages import EvaluationChunk, PolicySpec
from es_service.protocol.noise import Domain, normals, stream_keys, uniforms
from es_service.search.algorithms import ALGORITHMS
from tests.helpers import DirectEvaluator, MemoryStore, rows_of
from tests.references.behaviour_map import cell_number
from workers.environments import SHIPPED
from workers.policy import initial_parameters

SHAPE = PolicySpec((2, 8, 8, 2))
CELLS, BLOCK = (20, 15), 3
PRESETS = {
    "literature": {"first_block": "explore", "sampling": "top", "squared": False},
    "uber": {"first_block": "exploit", "sampling": "score", "squared": True},
}


def config_of(preset="literature", generations=30, seed=0, neighbours=3, cells=CELLS, **search):
    known = ALGORITHMS[search.get("algorithm", "me_es")].settings.model_fields
    of_blocks = {
        "block_generations": BLOCK,
        "parent_statistics": "elite" if preset == "literature" else "global",  # both, and one for each preset
    }
    return load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8]},
            "search": {
                "algorithm": "me_es",
                "preset": preset,
                "pairs": 32,
                "sigma": 0.2,
                "step": {"learning_rate": 0.2},
                "evaluation_episodes": 20,
                **{key: value for key, value in of_blocks.items() if key in known},
                **search,
            },
            "novelty": {"neighbours": neighbours},
            "map": {"cells": list(cells)},
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
        self.counts, self.run = compiled(preset).counts, compiled(preset).run
        self.recorded, self.spoiled = [], spoiled

    def evaluate(self, work):
        results = super().evaluate(work)
        for (_, chunk), result in zip(work, results, strict=True):
            if isinstance(chunk, EvaluationChunk) and chunk.generation in self.spoiled:
                result.descriptor[1] = np.nan
        return results


class Remembering(MemoryStore):
    """Keeps the parts as they were after each generation, and its evaluated centres."""

    def __init__(self):
        super().__init__()
        self.after, self.evaluated = [], []

    def commit(self, generations):
        for one in generations:
            super().commit([one])
            self.after.append(dict(self.parts))
            self.evaluated.append(rows_of(one.evaluations))


def first_centres(config):
    return [initial_parameters(SHAPE, config.policy.init, config.seed, i) for i in range(config.search.centres)]


def run_in_memory(config, evaluator=None, store=None, algorithm=None):
    evaluator, store = evaluator or Sharing(config.search.preset), store or Remembering()
    algorithm = algorithm or ALGORITHMS[config.search.algorithm](config)
    search = driver.Search(
        config, algorithm, lambda: (first_centres(config), no_observations(2)), SHIPPED["point_maze"]
    )
    state, _ = driver.drive(driver.run(search, store, driver.stored_state(store), lambda row: None), evaluator)
    return state, store, evaluator


def points(evaluator, kind, generation, ask=0):
    """The centre that all of an ask's chunks of a kind were sent around, and all their results in the order of ids."""
    found = [
        (chunk.chunk_id, point, result)
        for point, chunk, result in evaluator.recorded
        if isinstance(chunk, kind) and chunk.generation == generation
        if (chunk.ask if generation else chunk.chunk_id // 2) == ask  # two chunks for each initial centre
    ]
    found.sort(key=lambda item: item[0])
    assert len({id(point) for _, point, _ in found}) == 1
    results = [result for *_, result in found]
    return found[0][1], np.concatenate([r.fitness for r in results]), np.concatenate([r.descriptor for r in results])


def evaluation(evaluator, generation, ask=0):
    """Mean fitness and descriptor over the 20 episodes of an evaluated centre."""
    _, fitness, descriptor = points(evaluator, EvaluationChunk, generation, ask)
    return fitness[:20].astype(float).mean(), descriptor[:20].astype(float).mean(axis=0)


def noise_of(generation, ask=0, pairs=32):
    """The noise of an ask's pairs; only asks after the first are part of its address."""
    ids = (np.arange(pairs), ask) if ask else (np.arange(pairs),)
    return [normals(key, SHAPE.parameters) for key in stream_keys(0, Domain.PARAMETER_NOISE, generation, *ids)]


def drawn(generation, last, emitter, count):
    """Random numbers for a choice of an emitter; only emitters after the first are part of their address."""
    key = stream_keys(0, Domain.SELECTION, generation, last, *((emitter,) if emitter else ()))
    return uniforms(key, np.arange(count, dtype=np.uint32)).tolist()


def number(index, cells=CELLS):
    return None if index is None else cell_number(cells, index)


def assert_near(ours, theirs):
    assert np.linalg.norm(ours - theirs) < 1e-6 * np.linalg.norm(theirs)
