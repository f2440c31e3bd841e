"""What does a cluster of four hosts with 16 cores each make of its cores, and what does a host that is slow cost?

    python -m tests.benchmarks.hosts

Real are the driver's engine, Ray, its messages between hosts (network namespaces of this machine) and the node actor
that divides a work item among its cores. Only a chunk is not: a core sleeps for as long as it would take, so that two
cores can stand for 64, and answers with a result of the size of AntMaze's. Printed are JSON rows for one core, for all
cores, and for all cores if one host is five times slower, with second copies of late work items and without, when a
generation has many chunks or few. Needs root and iproute2; nothing else should compute.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from es_service.dispatch.events import Limits
from es_service.dispatch.ray_engine import ray_engine
from es_service.protocol.machine import platform_text
from es_service.protocol.messages import (
    NO_CENTRE,
    Centre,
    ChunkResult,
    EpisodesResult,
    GradientChunk,
    GradientResult,
    TrainingChunk,
    Work,
    with_subject,
)
from tests.helpers import SPEC
from tests.system.cluster import Cluster, missing
from workers.actor import WorkerActor
from workers.compiling import Compilable
from workers.cores import divided

HOSTS, CORES = 4, 16
SLOW = 5.0
SLOWNESS = "ES_BENCHMARK_SLOWNESS"
"""Environment variable of a host: how many times as long a core of it takes."""
TRAINING_S, GRADIENT_S = 0.1, 0.01
"""Seconds of a core for a chunk."""
MANY, FEW = 16, 1
"""Training chunks of a generation for each core."""
GENERATIONS = 12
"""The first third does not count: in the first one, durations are not known."""
PAIRS, PARAMETERS = 64, 75_528


class SleepingActor(WorkerActor):
    """The actor of a node, whose cores sleep."""

    def build(self) -> str:
        """As `WorkerActor.build`."""
        pool = ThreadPoolExecutor(self._cores)
        self._run_chunks = Compilable(lambda work: divided(pool, sleep, work, self._cores), lambda work: None)
        return platform_text({})


def sleep(work: Sequence[Work]) -> list[ChunkResult]:
    """Results of chunks, after the time that a core takes for them."""
    slowness = float(os.environ.get(SLOWNESS, "1"))
    time.sleep(slowness * sum(GRADIENT_S if isinstance(chunk, GradientChunk) else TRAINING_S for _, chunk in work))
    return [_GRADIENT if isinstance(chunk, GradientChunk) else _EPISODES for _, chunk in work]


_GRADIENT = GradientResult(np.ones(PARAMETERS, np.float32))
_EPISODES = EpisodesResult(
    fitness=np.zeros((PAIRS, 2), np.float32),
    returns=np.zeros((PAIRS, 2), np.float32),
    descriptor=np.zeros((PAIRS, 2, 2), np.float32),
    steps=np.full((PAIRS, 2), 3000, np.int32),
    goal_distance=np.zeros((PAIRS, 2, 2), np.float32),
    moments=None,
)


class Case(NamedTuple):
    """A run of GENERATIONS."""

    actors: int
    cores: int
    """Cores of each actor."""
    training_chunks: int
    """Training chunks of a generation for each core; there is one gradient chunk for each core."""
    late_factor: float
    """As in `Limits`; infinity: no work item is sent a second time."""


def drive(address: str, case: Case) -> dict[str, Any]:
    """Generations, seen by the driver. `efficiency` is the work divided by the time of all cores, and `driver` the
    share of a core that the driver's process takes."""
    centre = Centre(1, np.zeros(PARAMETERS, np.float32), 0.02, np.zeros(29, np.float32), np.ones(29, np.float32))
    weights_P = np.ones(PAIRS, np.float32)
    workers = case.actors * case.cores
    limits = Limits(workers, late_factor=case.late_factor)
    seconds, driver_s = [], []
    with ray_engine(SPEC, limits, actor=SleepingActor, address=address, cpus=case.cores) as engine:
        for generation in range(GENERATIONS):
            training = [TrainingChunk(generation, i) for i in range(workers * case.training_chunks)]
            gradient = [GradientChunk(generation, i, weights_P) for i in range(workers)]
            began, cpu_s = time.perf_counter(), time.process_time()
            engine.evaluate(with_subject(centre, training))
            engine.evaluate(with_subject(NO_CENTRE, gradient))
            seconds.append(time.perf_counter() - began)
            driver_s.append(time.process_time() - cpu_s)
        counts = engine.counts
    first = GENERATIONS // 3
    generation_s = float(np.median(seconds[first:]))
    work_s = TRAINING_S * len(training) + GRADIENT_S * len(gradient)
    return {
        "seconds_per_generation": round(generation_s, 3),
        "slowest": round(max(seconds[first:]), 3),
        "efficiency": round(work_s / workers / generation_s, 3),
        "driver": round(sum(driver_s[first:]) / sum(seconds[first:]), 3),
        "lost_workers": counts.lost_workers,
    }


def measure(slow: bool, cases: Sequence[Case]) -> None:
    """Print the rows of a new cluster, whose last host is slow or not."""
    with tempfile.TemporaryDirectory() as folder, Cluster(Path(folder)) as cluster:
        for number in range(HOSTS):
            slowness = SLOW if slow and number == HOSTS - 1 else 1.0
            cluster.start(f"host{number}", CORES, **{SLOWNESS: str(slowness)})
        for case in cases:
            load = os.getloadavg()[0]
            drive = [sys.executable, "-m", "tests.benchmarks.hosts", cluster.address, *map(str, case)]
            code, printed = cluster.run("head", *drive, timeout=300.0)
            if code:
                raise SystemExit(printed)
            row = {"slow_hosts": int(slow), **case._asdict(), **json.loads(printed.splitlines()[-1])}
            print(json.dumps(row | {"load_before": round(load, 1)}), flush=True)


def main() -> None:
    if (lacking := missing()) is not None:
        raise SystemExit(lacking)
    measure(False, [Case(1, 1, MANY, 2.0), Case(HOSTS, CORES, MANY, 2.0)])
    measure(True, [Case(HOSTS, CORES, chunks, factor) for chunks in (MANY, FEW) for factor in (2.0, math.inf)])


if __name__ == "__main__":
    if len(sys.argv) > 1:
        where, actors, cores, chunks, factor = sys.argv[1:]
        print(json.dumps(drive(where, Case(int(actors), int(cores), int(chunks), float(factor)))))
    else:
        main()
