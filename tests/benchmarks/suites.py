"""Steps a second of one core, by xla and by simd, of environments of suites in JAX that are installed.

    python -m tests.benchmarks.suites                             # those of the guide
    python -m tests.benchmarks.suites jumanji:Snake-v1 --batch 64

Both step the same environments with the same random actions, without a policy, from a reset, which counts as well. They
run by turns, and what counts is processor time, so that other programs make little difference. A row has the median of
the rates, and the processor seconds until the code of each was compiled, that of xla without the time of tracing.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

STEPS, BATCH, TURNS = 100, 128, 5
GUIDE = (
    "gymnax:Acrobot-v1",
    "gymnax:Breakout-MinAtar",
    "gymnax:CartPole-v1",
    "gymnax:MountainCar-v0",
    "gymnax:Pendulum-v1",
    "jumanji:Cleaner-v0",
    "jumanji:Game2048-v1",
    "jumanji:Minesweeper-v0",
    "jumanji:RubiksCube-v0",
    "jumanji:Snake-v1",
    "kheperax:standard",
    "playground:CartpoleBalance",
    "playground:PendulumSwingup",
    "playground:ReacherEasy",
)


def measured(name: str, batch: int) -> dict[str, Any]:
    """The row of a task."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from es_service.protocol.noise import Domain, stream_keys
    from workers.environments import describe_environment, make_environment
    from workers.simd.episodes.kernel import compile_kernel
    from workers.simd.graph.graph import UnsupportedError

    task, environment = describe_environment(name), make_environment(name, {})
    actions_T_A = np.random.default_rng(0).uniform(-1, 1, (STEPS, task.action_size)).astype(np.float32)
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(batch))

    def rewards(key: Any) -> Any:
        def step(state: Any, action_A: Any) -> Any:
            state, reward, _ = environment.step(state, action_A)
            return state, (reward, jnp.sum(environment.observe(state)))

        return jax.lax.scan(step, environment.reset(key), actions_T_A)[1]

    row: dict[str, Any] = {"task": name, "observation": task.observation_size, "action": task.action_size}
    lowered, begin = jax.jit(jax.vmap(rewards)).lower(keys), time.process_time()
    compiled = lowered.compile()
    row["xla_compile_s"] = time.process_time() - begin
    sides: dict[str, Callable[[], Any]] = {"xla": lambda: jax.block_until_ready(compiled(keys))}
    try:
        begin = time.process_time()
        kernel = compile_kernel(rewards, jax.ShapeDtypeStruct(keys.shape[1:], jnp.uint32))
        row["simd_compile_s"] = time.process_time() - begin
        sides["simd"] = lambda: kernel(keys)
    except UnsupportedError as error:
        row["simd_refuses"] = str(error)
    rates: dict[str, list[float]] = {side: [] for side in sides}
    for turn in range(TURNS + 1):
        for side, run in sides.items():
            begin = time.process_time()
            run()
            if turn:  # the first warms up
                rates[side].append(batch * STEPS / (time.process_time() - begin))
    return row | {f"{side}_steps_per_s": statistics.median(found) for side, found in rates.items()}


RATES = ("xla_steps_per_s", "simd_steps_per_s", "xla_compile_s", "simd_compile_s")
COLUMNS: tuple[str, ...] = ("task", "observation", "action", *RATES, "simd_refuses")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=GUIDE)
    parser.add_argument("--batch", type=int, default=BATCH)
    parser.add_argument("--out", type=Path, help="file of comma-separated values to which rows are added")
    arguments = parser.parse_args()
    cache = tempfile.TemporaryDirectory()  # so that simd compiles all
    one_thread = {"PJRT_NPROC": "1", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    os.environ |= one_thread | {"XDG_CACHE_HOME": cache.name}
    with arguments.out.open("a") if arguments.out else sys.stdout as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not arguments.out or not file.tell():
            writer.writeheader()
        for task in arguments.tasks:
            row = measured(task, arguments.batch)
            writer.writerow({key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()})
            file.flush()


if __name__ == "__main__":
    main()
