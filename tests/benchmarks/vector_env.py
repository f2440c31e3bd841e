"""Steps a second of our tasks as environments of Gymnasium, beside Gymnasium's own ant in MuJoCo, by turns.

    python -m tests.benchmarks.vector_env [--seconds 3] [--rounds 3]

Each round measures every row once; the table has the median of a row's rounds. Actions are random and drawn before,
and no policy is computed. Rates are those of the wall clock with one thread; `async` has a process for each of two
environments, and so uses both cores.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np

OURS = "es_service.gymnasium:es_service/"
ROWS: dict[str, Callable[[], Any]] = {
    **{
        f"{task}, {count} environments": lambda task=task, count=count: gymnasium.make_vec(
            f"{OURS}{task}-v0", num_envs=count
        )
        for task, count in (("AntTrap", 16), ("AntTrap", 64), ("AntTrap", 256), ("AntMaze", 64), ("PointMaze", 1024))
    },
    "gymnasium Ant-v5, sync, 16 environments": lambda: gymnasium.make_vec(
        "Ant-v5", num_envs=16, vectorization_mode="sync"
    ),
    "gymnasium Ant-v5, async, 2 environments": lambda: gymnasium.make_vec(
        "Ant-v5", num_envs=2, vectorization_mode="async"
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    rates: dict[str, list[float]] = {name: [] for name in ROWS}
    for _ in range(given.rounds):
        for name, make in ROWS.items():
            with closing(make()) as envs:
                rates[name].append(steps_per_second(envs, given.seconds))
    print("| environments | steps a second, median | lowest and highest |\n| --- | --- | --- |")
    for name, values in rates.items():
        print(f"| {name} | {statistics.median(values):,.0f} | {min(values):,.0f} to {max(values):,.0f} |")


def steps_per_second(envs: Any, seconds: float) -> float:
    """Steps of all environments a second of the wall clock, after some that are not counted."""
    low, high, shape = envs.single_action_space.low, envs.single_action_space.high, envs.action_space.shape
    actions = list(_drawn(low, high, shape, 50))
    envs.reset(seed=0)
    for action in actions[:10]:
        envs.step(action)
    calls, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        for action in actions:
            envs.step(action)
        calls += len(actions)
    return calls * envs.num_envs / (time.perf_counter() - started)


def _drawn(low: Any, high: Any, shape: tuple[int, ...], count: int) -> Iterator[np.ndarray]:
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield rng.uniform(low, high, shape).astype(np.float32)


if __name__ == "__main__":
    main()
