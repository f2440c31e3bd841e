"""CMA-ME of pyribs, which evaluates its solutions with this service: policies that end all over the maze of PointMaze.

python tests/examples/pyribs_scheduler.py
"""

from __future__ import annotations

import numpy as np
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter
from ribs.schedulers import Scheduler

from es_service import evaluator

CONFIG = {
    "task": {"environment": "point_maze"},
    "policy": {"hidden": [8, 8], "observation_normalization": False},
}


def search(iterations: int, seed: int = 0) -> GridArchive:
    """An archive of the fittest policy found for each of 20 by 20 places where an episode may end."""
    with evaluator(CONFIG) as evaluate:
        archive = GridArchive(
            solution_dim=evaluate.parameters, dims=[20, 20], ranges=evaluate.task.descriptor_bounds, seed=seed
        )
        emitters = [
            EvolutionStrategyEmitter(
                archive, x0=evaluate.initial(number), sigma0=0.5, ranker="2imp", batch_size=32, seed=seed + number
            )
            for number in range(4)
        ]
        scheduler = Scheduler(archive, emitters)
        for iteration in range(iterations):
            policies = scheduler.ask()
            result = evaluate(policies, episodes=2, seed=seed, generation=iteration)
            fitness, descriptor = result.fitness.mean(axis=1), result.descriptor.mean(axis=1)
            # An archive takes no NaN, which an episode may return in other tasks.
            valid = result.valid.all(axis=1)
            scheduler.tell(np.where(valid, fitness, -1e6), np.where(valid[:, None], descriptor, 0.0))
    return archive


if __name__ == "__main__":
    found = search(200)
    print(f"{len(found)} of {found.cells} cells, best fitness {found.stats.obj_max:.1f}")
