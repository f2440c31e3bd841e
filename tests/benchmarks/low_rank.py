"""How much faster are members and gradients with noise of low rank?

    python -m tests.benchmarks.low_rank                          # two minutes, one core

For each task and network, training chunks of 16 pairs and 50 steps and gradient blocks of 64 pairs, with noise of full
rank and of ranks 1 and 4 by turns. Seconds are those of the processor. `low_rank_ant.yaml` is a search with such noise:

    es-service run tests/benchmarks/low_rank_ant.yaml --seed 0 --workers 1 [--set search.noise.kind=full]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.protocol.messages import Centre, Chunk, GradientChunk, TrainingChunk
from es_service.runs.checked_config import load_config
from workers.policy import initial_parameters
from workers.worker import make_worker

CASES = {"point_maze": [64, 64], "ant_maze": [256, 256], "brax:ant": [700, 700, 700]}
"""Task -> widths of the hidden layers."""
RANKS = (0, 1, 4)
PAIRS, STEPS, BLOCK = 16, 50, 64
ROUNDS = 5


def timers(task: str, hidden: list[int], rank: int, rollout: str) -> tuple[Callable[[], float], Callable[[], float]]:
    """Functions that give the steps a second of a training chunk, and the milliseconds of a gradient block."""
    noise = {"kind": "low_rank", "rank": rank} if rank else {"kind": "full"}
    config = load_config(
        {
            "task": {"environment": task, "episode_steps": STEPS},
            "policy": {"hidden": hidden},
            "search": {"algorithm": "es", "pairs": BLOCK, "noise": noise},
            "budget": {"generations": 1},
            "compute": {"rollout": rollout, "chunk_pairs": PAIRS, "gradient_block_pairs": BLOCK},
        }
    )
    spec, size = worker_spec(config, task_of(config)), task_of(config).observation_size
    worker, parameters_D = make_worker(spec), initial_parameters(spec.policy, "unit_columns", 0)
    centre = Centre(1, parameters_D, 0.02, np.zeros(size, np.float32), np.ones(size, np.float32))

    def run(chunk: Chunk) -> tuple[float, object]:
        started = time.process_time()
        (result,) = worker([(centre, chunk)])
        return time.process_time() - started, result

    def steps_per_second() -> float:
        seconds, result = run(TrainingChunk(1, 0))
        return int(result.steps.sum()) / seconds  # type: ignore[attr-defined]

    def milliseconds() -> float:
        return 1e3 * run(GradientChunk(1, 0, np.ones(BLOCK, np.float32)))[0]

    return steps_per_second, milliseconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rollout", default="simd")
    rollout = parser.parse_args().rollout
    print(f"{'task':<12} {'hidden':<16} {'rank':>4} {'steps/s':>10} {'ratio':>6} {'gradient, ms':>13} {'ratio':>6}")
    for task, hidden in CASES.items():
        both = [timers(task, hidden, rank, rollout) for rank in RANKS]
        rounds = np.array([[[timer() for timer in pair] for pair in both] for _ in range(1 + ROUNDS)])
        (rate, block), *_ = medians = np.median(rounds[1:], axis=0)  # the first round compiles
        for rank, (steps, milliseconds) in zip(RANKS, medians, strict=True):
            named = f"{task:<12} {'x'.join(map(str, hidden)):<16} {rank or 'full':>4}"
            print(f"{named} {steps:>10,.0f} {steps / rate:>6.2f} {milliseconds:>13.2f} {block / milliseconds:>6.1f}")


if __name__ == "__main__":
    main()
