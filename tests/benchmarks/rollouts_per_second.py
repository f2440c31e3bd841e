"""How many environment steps a second do the workers make, policy and noise in the loop, and what does a second add?

    python -m tests.benchmarks.rollouts_per_second [--seconds 5]

Rounds of one worker and of two alternate, so that both see the same machine; the ratio is what counts. Full 200-step
PointMaze episodes, 64x64 policy with its own weights per member, action noise, 512 pairs in chunks of 64.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

from es_service import api
from es_service.config.model import worker_spec
from es_service.dispatch.inline_engine import inline_engine
from es_service.dispatch.messages import Policy
from es_service.protocol import EpisodesResult, Evaluator, TrainingChunk
from tests.helpers import centre
from workers.environments import TASKS
from workers.policy import initial_parameters


def measure(engine: Evaluator, point, seconds: float) -> float:
    """Steps per second over whole populations for about `seconds`."""
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        results = engine.evaluate(point, [TrainingChunk(point.generation, chunk) for chunk in range(8)])
        steps += sum(int(result.steps.sum()) for result in results if isinstance(result, EpisodesResult))
    return steps / (time.perf_counter() - start)


def resident_mib(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each of three rounds per worker count")
    seconds = parser.parse_args().seconds
    config = api.load_config(
        {
            "task": {"environment": "point_maze"},
            "search": {"algorithm": "es"},
            "budget": {"generations": 1},
        }
    )
    spec = worker_spec(config, TASKS["point_maze"])
    point = centre(initial_parameters(spec.policy, "unit_columns", 0), sigma=0.02)
    rates: dict[int, list[float]] = {1: [], 2: []}
    with inline_engine(spec, Policy(1)) as one, inline_engine(spec, Policy(2)) as two:
        for engine in (one, two):
            measure(engine, point, 1.0)  # compiles
        for _ in range(3):
            for workers, engine in ((1, one), (2, two)):
                rates[workers].append(measure(engine, point, seconds))
        memory = max(resident_mib(pid) for pid in two.transport.process_ids().values())
    one_rate, two_rate = (statistics.median(rates[workers]) for workers in (1, 2))
    row = {
        "task": "point_maze",
        "policy": "64x64",
        "steps_per_second_1_worker": round(one_rate),
        "steps_per_second_2_workers": round(two_rate),
        "ratio": round(two_rate / one_rate, 2),
        "worker_peak_mib": round(memory),
    }
    print(json.dumps(row, indent=1))


if __name__ == "__main__":
    main()
