"""What do contacts and walls cost an ant? Control steps a second of one core, batch 16, zero actions.

    PJRT_NPROC=1 JAX_PLATFORMS=cpu python -m tests.benchmarks.ant_shares

The variants take turns; medians of five rounds. Without contacts the ant falls through the floor at the same speed.
"""

from __future__ import annotations

import json
import statistics
import time
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.noise import Domain, stream_keys
from workers.environments import ant
from workers.environments.ant import make_ant
from workers.environments.brax_task import Motion, collisions

BATCH, STEPS, ROUNDS = 16, 60, 5
ACTION = jnp.zeros((BATCH, 8))


def compiled(walls) -> tuple[Any, Any]:
    """(compiled control step of a batch, its first state)."""
    ant = make_ant(walls)
    keys = stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(BATCH))
    state = jax.jit(jax.vmap(lambda key: ant.reset(key, (0.0, 0.0))))(keys)
    return jax.jit(jax.vmap(ant.step)).lower(state, ACTION).compile(), state


def main() -> None:
    variants = {
        "floor": compiled(()),
        "floor and trap": compiled(ant.TRAP_WALLS),
        "floor and maze": compiled(ant.MAZE_WALLS),
    }
    with mock.patch.object(collisions, "resolve", lambda system, state: Motion.zero((system.num_links(),))):
        variants["no contacts"] = compiled(())
    rates: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(ROUNDS):
        for name, (step, state) in variants.items():
            started = time.perf_counter()
            for _ in range(STEPS):
                state = step(state, ACTION)
            jax.block_until_ready(state)
            rates[name].append(BATCH * STEPS / (time.perf_counter() - started))
    print(json.dumps({name: round(statistics.median(values)) for name, values in rates.items()}))


if __name__ == "__main__":
    main()
