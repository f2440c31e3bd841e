"""What does a cluster make of its cores, and what does a host that is slow cost?

    python -m tests.benchmarks.hosts
    python -m tests.benchmarks.hosts --scale     # 4, 8, 16 hosts of 64 cores, beside the prediction of `bench scaling`

Real are the driver's engine, Ray, its messages between hosts (network namespaces of this machine) and the node actor
that divides a work item among its cores. Only a chunk is not: a core sleeps for as long as it would take, so that two
cores can stand for 64, and answers with a result of the size of AntMaze's. Printed are JSON rows for one core; for four
hosts with 16 cores each; and for these if one host is five times slower, with second copies of late work items and
without, when a generation has many chunks or few. With `--scale`, a chunk sleeps for a second, as long as one of
AntMaze takes, and `predicted` is what `bench scaling` expects from these times and the costs of messages that it
measures here. Needs root and iproute2; nothing else should compute.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from es_service.dispatch.events import Limits
from es_service.dispatch.ray_engine import ray_engine
from es_service.dispatch.simulation import Costs, Phase, predict
from es_service.protocol.episodes import addressed
from es_service.protocol.machine import platform_text
from es_service.protocol.messages import (
    NO_CENTRE,
    Centre,
    ChunkResult,
    EpisodesResult,
    GradientChunk,
    GradientResult,
    Moments,
    TrainingChunk,
    Work,
    with_subject,
)
from es_service.protocol.policies import Recipes
from es_service.protocol.sent import Received
from es_service.runs.scaling import longest_part, message_costs
from tests.helpers import SPEC
from tests.system.cluster import Cluster, missing
from workers.actor import WorkerActor
from workers.compiling import Compilable
from workers.cores import divided
from workers.reports import Reports
from workers.worker import Made

HOSTS, CORES = 4, 16
SLOW = 5.0
SLOWNESS, TRAINING_S = "ES_BENCHMARK_SLOWNESS", "ES_BENCHMARK_TRAINING_S"
"""Environment variables of a host: how many times as long a core of it takes, and seconds of a core for a training
chunk."""
GRADIENT_S = 0.01
"""Seconds of a core for a gradient chunk."""
MANY, FEW = 16, 1
"""Training chunks of a generation for each core."""
SCALE = (4, 8, 16), 64
"""Numbers of hosts, and cores of each, of `--scale`."""
GENERATIONS = 12
"""The first third does not count: in the first one, durations are not known."""
PAIRS, PARAMETERS = 64, 75_528


class SleepingActor(WorkerActor):
    """The actor of a node, whose cores sleep."""

    def build(self, given: bytes | None = None) -> str:
        """As `WorkerActor.build`, without the code of a task."""
        pool, spec = ThreadPoolExecutor(self._cores), pickle.loads(given or self._spec)
        self._received, self._reports = Received(spec.parent_cache_bytes, Recipes.made), Reports(spec, self._cores)
        asleep = Compilable(lambda work: divided(pool, sleep, work, self._cores), lambda work: None)
        self._made = Made(asleep, set())
        return platform_text({})


def sleep(work: Sequence[Work]) -> list[ChunkResult]:
    """Results of chunks, after the time that a core takes for them."""
    slowness, training_s = float(os.environ.get(SLOWNESS, "1")), float(os.environ[TRAINING_S])
    time.sleep(slowness * sum(GRADIENT_S if isinstance(chunk, GradientChunk) else training_s for _, chunk in work))
    return [_GRADIENT if isinstance(one[1], GradientChunk) else addressed(one, _EPISODES) for one in work]


_GRADIENT = GradientResult(np.ones(PARAMETERS, np.float32))
_EPISODES = EpisodesResult(
    fitness=np.zeros((PAIRS, 2), np.float32),
    returns=np.zeros((PAIRS, 2), np.float32),
    descriptor=np.zeros((PAIRS, 2, 2), np.float32),
    steps=np.full((PAIRS, 2), 3000, np.int32),
    goal_distance=np.zeros((PAIRS, 2, 2), np.float32),
    moments=Moments(1.0, np.zeros(29), np.zeros(29)),
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
    training_s: float = 0.1
    """Seconds of a core for a training chunk."""

    @property
    def workers(self) -> int:
        return self.actors * self.cores


def phases(case: Case, generation: int) -> tuple[list[Work], list[Work]]:
    """The work of a generation: its training chunks, and its gradient chunks."""
    parameters_D = np.zeros(PARAMETERS, np.float32)
    parameters_D.setflags(write=False)  # as in a run
    centre = Centre(1, parameters_D, 0.02, np.zeros(29, np.float32), np.ones(29, np.float32))
    weights_P = np.ones(PAIRS, np.float32)
    training = [TrainingChunk(generation, i) for i in range(case.workers * case.training_chunks)]
    gradient = [GradientChunk(generation, i, weights_P) for i in range(case.workers)]
    return with_subject(centre, training), with_subject(NO_CENTRE, gradient)


def predicted(case: Case) -> float:
    """Seconds of a generation, as `bench scaling` predicts them for a driver that only sends and receives."""
    work = phases(case, 1)
    answers = {"TrainingChunk": _EPISODES, "GradientChunk": _GRADIENT}
    message_s, way_s, chunk_message_s = message_costs(SPEC, work, answers)
    chunk_s = {"TrainingChunk": case.training_s, "GradientChunk": GRADIENT_S}
    costs = Costs(chunk_s, message_s, way_s, driver_s=0.0, chunk_message_s=chunk_message_s)
    parts = [Phase(kind, kind, len(chunks)) for kind, chunks in zip(answers, work, strict=True)]
    return predict(parts, costs, case.actors, case.cores, partial(longest_part, cores=case.cores)).seconds


def drive(address: str, case: Case) -> dict[str, Any]:
    """Generations, seen by the driver. `efficiency` is the work divided by the time of all cores, and `driver` the
    share of a core that the driver's process takes."""
    limits = Limits(case.workers, late_factor=case.late_factor)
    seconds, driver_s = [], []
    with ray_engine(SPEC, limits, actor=SleepingActor, address=address, cpus=case.cores) as engine:
        for generation in range(GENERATIONS):
            training, gradient = phases(case, generation)
            began, cpu_s = time.perf_counter(), time.process_time()
            engine.evaluate(training)
            engine.evaluate(gradient)
            seconds.append(time.perf_counter() - began)
            driver_s.append(time.process_time() - cpu_s)
        counts = engine.counts
    first = GENERATIONS // 3
    generation_s = float(np.median(seconds[first:]))
    work_s = case.workers * (case.training_s * case.training_chunks + GRADIENT_S)
    return {
        "seconds_per_generation": round(generation_s, 3),
        "slowest": round(max(seconds[first:]), 3),
        "efficiency": round(work_s / case.workers / generation_s, 3),
        "driver": round(sum(driver_s[first:]) / sum(seconds[first:]), 3),
        "lost_workers": counts.lost_workers,
    }


def measure(hosts: int, slow: bool, cases: Sequence[Case], **more: Any) -> None:
    """Print the rows of a new cluster, whose last host is slow or not."""
    with tempfile.TemporaryDirectory() as folder, Cluster(Path(folder)) as cluster:
        for number in range(hosts):
            slowness = SLOW if slow and number == hosts - 1 else 1.0
            own = {SLOWNESS: str(slowness), TRAINING_S: str(cases[0].training_s)}
            cluster.start(f"host{number}", cases[-1].cores, **own)
        for case in cases:
            load = os.getloadavg()[0]
            drive = [sys.executable, "-m", "tests.benchmarks.hosts", "--drive", cluster.address, *map(str, case)]
            code, printed = cluster.run("head", *drive, timeout=300.0)
            if code:
                raise SystemExit(printed)
            row = {"slow_hosts": int(slow), **case._asdict(), **json.loads(printed.splitlines()[-1]), **more}
            print(json.dumps(row | {"load_before": round(load, 1)}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", action="store_true", help="hosts with 64 cores each, beside the prediction")
    parser.add_argument("--drive", nargs=6, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.drive:
        where, actors, cores, chunks, *times = given.drive
        print(json.dumps(drive(where, Case(int(actors), int(cores), int(chunks), *map(float, times)))))
        return
    if (lacking := missing()) is not None:
        raise SystemExit(lacking)
    if given.scale:
        counts, cores = SCALE
        for case in (Case(hosts, cores, 4, 2.0, 1.0) for hosts in counts):
            measure(case.actors, False, [case], predicted_seconds=round(predicted(case), 3))
        return
    measure(HOSTS, False, [Case(1, 1, MANY, 2.0), Case(HOSTS, CORES, MANY, 2.0)])
    measure(HOSTS, True, [Case(HOSTS, CORES, chunks, factor) for chunks in (MANY, FEW) for factor in (2.0, math.inf)])


if __name__ == "__main__":
    main()
