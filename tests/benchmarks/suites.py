"""Steps a second of one core, by xla and by simd, of environments of suites in JAX that are installed.

    python -m tests.benchmarks.suites                             # those of the guide
    python -m tests.benchmarks.suites jumanji:Snake-v1 --batch 64

Both step the same environments with the same random actions, without a policy, from states after a reset. They run by
turns, and what counts is processor time, so that other programs make little difference. A row has the median of the
rates, and the processor seconds in which the code of each was traced and compiled, that of the resets apart.
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
    "craftax:Craftax-Classic-Symbolic-v1",
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

    from workers.environments import describe_environment
    from workers.rollouts.jax_tasks import random_steps
    from workers.simd.episodes.kernel import compile_kernel
    from workers.simd.graph.graph import UnsupportedError

    task = describe_environment(name)
    row: dict[str, Any] = {"task": name, "observation": task.observation_size, "action": task.action_size}

    def by_xla(episode: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
        batched = jax.tree.map(lambda x: jax.ShapeDtypeStruct((batch, *x.shape), x.dtype), shapes)
        return jax.jit(jax.vmap(episode)).lower(*batched).compile()

    def timed(side: str, compiler: Callable[..., Any]) -> Callable[..., Any]:
        def compiled(*arguments: Any) -> Any:
            begin = time.process_time()
            code = compiler(*arguments)
            row[f"{side}_compile_s"] = time.process_time() - begin
            return code

        return compiled

    sides: dict[str, Callable[[int], int]] = {}
    for side, compiler in ("xla", by_xla), ("simd", compile_kernel):
        try:
            sides[side] = random_steps(timed(side, compiler), task, {}, batch, STEPS)
        except UnsupportedError as error:
            row["simd_refuses"] = str(error)
    rates: dict[str, list[float]] = {side: [] for side in sides}
    for turn in range(TURNS + 1):
        for side, run in sides.items():
            begin = time.process_time()
            steps = run(turn)
            if turn:  # the first warms up
                rates[side].append(steps / (time.process_time() - begin))
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
    os.environ |= one_thread | {"XDG_CACHE_HOME": cache.name, "JAX_COMPILATION_CACHE_DIR": cache.name}
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
