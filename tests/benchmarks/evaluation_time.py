"""What does a worker save by running only the evaluation episodes that are wanted?

    python -m tests.benchmarks.evaluation_time                  # half a minute, one core
    python -m tests.benchmarks.evaluation_time --isa avx2       # code for AVX2, also on processors with AVX-512

For each config, one chunk of each kind, in rounds: its training, an evaluation of a whole chunk of 16 episodes, and one
of as many as the config wants. Seconds are those of the processor, so other programs disturb them little.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np

from es_service import api
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.protocol.messages import Centre, Chunk, EvaluationChunk, TrainingChunk
from workers.policy import initial_parameters
from workers.simd.backend.target import ISAS, host_target
from workers.worker import make_worker

CONFIGS = ("paper/ant_maze_nsra_es", "paper/ant_trap_me_es", "paper/point_maze_me_es")
ROUNDS = 5


def milliseconds(config_file: Path) -> list[float]:
    """Medians of a training chunk, an evaluation chunk of 16 episodes, and one of as many as the config wants."""
    config = api.load_config(config_file)
    task = task_of(config)
    spec = worker_spec(config, task)
    worker, parameters_D = make_worker(spec), initial_parameters(spec.policy, "unit_columns", 0)
    zeros_O = np.zeros(task.observation_size, np.float32)
    centre = Centre(1, parameters_D, config.search.sigma, zeros_O, zeros_O + 1)

    def seconds(chunk: Chunk) -> float:
        started = time.process_time()
        worker([(centre, chunk)])
        return time.process_time() - started

    wanted = config.search.evaluation_episodes
    chunks = (TrainingChunk(1, 0), EvaluationChunk(1, 0), EvaluationChunk(1, 0, episodes=wanted))
    rounds = [[seconds(chunk) for chunk in chunks] for _ in range(1 + ROUNDS)]
    return (1e3 * np.median(rounds[1:], axis=0)).tolist()  # the first one compiles


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--isa", choices=sorted(ISAS), help="instruction set; default: the widest of this processor")
    target = host_target(parser.parse_args().isa)
    print(f"{target.describe()}; milliseconds of a chunk")
    print(f"{'config':<24} {'training':>9} {'16 episodes':>12} {'those wanted':>13}")
    places = ("kernel", "compiled", "rollout")
    patches = [patch(f"workers.simd.episodes.{place}.host_target", lambda: target) for place in places]
    for patcher in patches:
        patcher.start()
    for name in CONFIGS:
        training, whole, wanted = milliseconds(Path(__file__).parents[2] / "configs" / f"{name}.yaml")
        print(f"{name.removeprefix('paper/'):<24} {training:>9.1f} {whole:>12.1f} {wanted:>13.1f}", flush=True)


if __name__ == "__main__":
    main()
