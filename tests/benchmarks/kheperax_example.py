"""What does the example of Kheperax itself find: MAP-Elites of QDax, in the maze and with the policy of `certified`?

    python -m tests.benchmarks.kheperax_example --seeds 0:3

The settings are those of its notebook (batches of 2,048, isoline variation with 0.2 and 0.0, a grid of 50 x 50, a
policy with 8 units), which evaluates 1e6 policies in 250 steps each. Coverage counts all cells. The QD-score is from
the least return that the maze allows on, as ours is. A row for each seed and number of evaluations is in
results/kheperax_example.csv. Needs the extra `kheperax`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd

from es_service.cli.sweep import seeds_of
from es_service.protocol.machine import cpu_kind

RESULTS = Path(__file__).parent / "results" / "kheperax_example.csv"
BATCH, STEPS = 2048, 250
MARKS = (100_000, 1_000_000)
"""Numbers of evaluations: that of our runs of 2.5e7 steps, and that of the example."""
LEAST_RETURN = -2 * 0.025**2 * STEPS
THEIRS = (
    ("kheperax.tasks.config", "KheperaxConfig"),
    ("kheperax.tasks.main", "KheperaxTask"),
    ("qdax.core.containers.mapelites_repertoire", "compute_euclidean_centroids"),
    ("qdax.core.emitters.mutation_operators", "isoline_variation"),
    ("qdax.core.emitters.standard_emitters", "MixingEmitter"),
    ("qdax.core.map_elites", "MAPElites"),
    ("qdax.utils.metrics", "default_qd_metrics"),
)


def rows(seed: int, marks: Sequence[int]) -> list[dict[str, Any]]:
    """What the example has found after so many evaluations."""
    import jax
    import jax.numpy as jnp

    # Kheperax and QDax are no packages of the tests, so no checker of types knows them.
    KheperaxConfig, KheperaxTask, centroids_of, isoline_variation, MixingEmitter, MAPElites, metrics_of = (
        getattr(import_module(module), name) for module, name in THEIRS
    )
    jax.__dict__["tree_leaves"] = jax.tree.leaves  # QDax 0.5.0 calls it by the name that JAX has removed
    config = KheperaxConfig.get_default()
    config.episode_length, config.mlp_policy_hidden_layer_sizes = STEPS, (8,)
    config.robot = config.robot.replace(lasers_return_minus_one_if_out_of_range=True)
    task_key, init_key, first_key, key = jax.random.split(jax.random.key(seed), 4)
    env, network, score = KheperaxTask.create_default_task(config, random_key=task_key)
    emitter = MixingEmitter(
        mutation_fn=lambda genotypes, key: genotypes,
        variation_fn=partial(isoline_variation, iso_sigma=0.2, line_sigma=0.0),
        variation_percentage=1.0,
        batch_size=BATCH,
    )

    def scored(genotypes: Any, key: Any) -> Any:  # as QDax 0.5.0 has it: without a new key
        return score(genotypes, key)[:3]

    search = MAPElites(scored, emitter, partial(metrics_of, qd_offset=-LEAST_RETURN))
    observations = jnp.zeros((BATCH, env.observation_size))
    genotypes = jax.vmap(network.init)(jax.random.split(init_key, BATCH), observations)
    low, high = env.behavior_descriptor_limits
    centroids = centroids_of(grid_shape=(50, 50), minval=low, maxval=high)
    started = time.process_time()
    repertoire, state, metrics = search.init(genotypes, centroids, first_key)
    update, done, found = jax.jit(search.update), BATCH, []
    for mark in marks:
        while done + BATCH <= mark:
            key, own = jax.random.split(key)
            repertoire, state, metrics = update(repertoire, state, own)
            done += BATCH
        row = {"seed": seed, "evaluations": done, "env_steps": done * STEPS}
        row |= {"coverage": float(metrics["coverage"]) / 100, "qd_score": float(metrics["qd_score"])}
        found.append(row | {"cpu_s": round(time.process_time() - started, 1), "cpu": cpu_kind()})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", metavar="A:B", default="0:3")
    given = parser.parse_args()
    table = pd.DataFrame([row for seed in seeds_of(given.seeds) for row in rows(seed, MARKS)])
    table.to_csv(RESULTS, index=False, lineterminator="\n")
    print(table.to_string())


if __name__ == "__main__":
    main()
