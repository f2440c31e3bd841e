"""A strategy of evosax, which evaluates its population with this service: a policy for PointMaze.

python tests/examples/evosax_strategy.py
"""

from __future__ import annotations

import jax
import numpy as np
from evosax.algorithms import Sep_CMA_ES

from es_service import evaluator

CONFIG = {
    "task": {"environment": "point_maze"},
    "policy": {"hidden": [8, 8], "observation_normalization": False},
}


def search(generations: int, seed: int = 0) -> tuple[np.ndarray, float]:
    """(parameters [D] of the strategy's mean, its mean fitness over 32 episodes of its own)."""
    with evaluator(CONFIG) as evaluate:
        strategy = Sep_CMA_ES(population_size=64, solution=evaluate.initial())
        settings = strategy.default_params.replace(std_init=0.5)
        state = strategy.init(jax.random.key(seed), evaluate.initial(), settings)
        for generation in range(generations):
            ask_key, tell_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), generation))
            policies, state = strategy.ask(ask_key, state, settings)
            fitness = evaluate(policies, episodes=4, seed=seed, generation=generation).fitness.mean(axis=1)
            state, _ = strategy.tell(tell_key, policies, -fitness, state, settings)  # evosax minimises
        mean = np.asarray(strategy.get_mean(state))
        return mean, float(evaluate(mean[None], episodes=32, seed=seed, generation=generations).fitness.mean())


if __name__ == "__main__":
    print(f"mean fitness {search(100)[1]:.1f}")
