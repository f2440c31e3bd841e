"""How fast is the noise, beside JAX's own normal generator, on one core?

    PJRT_NPROC=1 python -m tests.benchmarks.noise_per_second

Both sides fill the same [pairs, parameters] float32 array and, in the second table, sum it with weights over the pairs.
"""

from __future__ import annotations

import os

os.environ.setdefault("PJRT_NPROC", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import json
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, normals, stream_keys
from workers.simd.episodes import rollout as simd
from workers.xla import make_gradient_sum

PAIRS = 64
UNIT = np.float32(1 / NORMAL_STD)


def best_seconds(function: Callable, *arguments: object) -> float:
    """Least of thirty timed calls, after one that compiles."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(30):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    rows = []
    for parameters in (4_482, 75_528):
        coordinates = np.arange(parameters, dtype=np.uint32)
        keys = stream_keys(0, Domain.PARAMETER_NOISE, 1, np.arange(PAIRS))
        weights = np.linspace(-1, 1, PAIRS, dtype=np.float32)
        jax_keys = jax.random.split(jax.random.key(0), PAIRS)

        def ours(keys, coordinates=coordinates):
            return jax.vmap(lambda key: normal_integers(jnp, key, coordinates).astype(jnp.float32) * UNIT)(keys)

        def threefry(keys, parameters=parameters):
            return jax.vmap(lambda key: jax.random.normal(key, (parameters,)))(keys)

        count = PAIRS * parameters
        rates = {
            "ours_fill": count / best_seconds(jax.jit(ours), keys),
            "ours_weighted_sum": count / best_seconds(make_gradient_sum(parameters), weights, keys),
            "ours_numpy": parameters / best_seconds(normals, keys[0], parameters),
            "simd_weighted_sum": count / best_seconds(simd.make_gradient_sum(parameters), weights, keys),
            "jax_threefry_fill": count / best_seconds(jax.jit(threefry), jax_keys),
        }
        row: dict[str, object] = {name: f"{rate / 1e6:.0f} M/s" for name, rate in rates.items()}
        row |= {"parameters": parameters, "fill_ratio": round(rates["ours_fill"] / rates["jax_threefry_fill"], 1)}
        rows.append(row)
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
