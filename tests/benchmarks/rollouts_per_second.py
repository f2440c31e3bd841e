"""How many environment steps a second do the workers make, policy and noise in the loop; simd beside xla, two workers
beside one?

    python -m tests.benchmarks.rollouts_per_second [--tasks ant_maze ...] [--seconds 5] [--rounds 5]

Rounds alternate, so that all see the same machine; the ratios count. Policies are the paper's (64x64, ants 256x256)
with weights of their own per member, action noise and statistics; the inline engine, 4,096 pairs of whole PointMaze
episodes, 64 pairs of ants for 500 steps. xla's batch is its best: a block of pairs whose weights stay in cache. Caches
of compiled code are empty at first: the first engine of each kind shows how long a worker needs from its start to its
first episodes, the second one how long with compiled code on disk.

`--threads` makes the workers of simd threads of one process.

`--policies` compares, with simd, as many explicit policies, whose parameters are sent to the workers in every call,
with the perturbed ones, whose parameters the workers make.

`--looking` measures what it costs to look at observations and results for NaN and infinities: a worker in this process,
one chunk a call, by turns with one that does not look; medians of the rounds' ratios (`--rounds 31 --seconds 1`).
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np

from es_service import api
from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.episodes import Evaluator, gathered
from es_service.protocol.messages import EpisodesResult, EvaluationChunk, TrainingChunk, WorkerSpec, with_subject
from tests.helpers import centre
from workers.environments import Environment
from workers.episode import EpisodeSteps, episode_steps
from workers.policy import initial_parameters
from workers.worker import make_worker

ROUNDS = 5
PAIRS = {"point_maze": 4096}
ANT_PAIRS, ANT_STEPS = 64, 500


def measure(engine: Evaluator, point: Any, chunks: int, seconds: float) -> float:
    """Steps per second over whole populations, at least one, for about `seconds`."""
    steps, start = 0, time.perf_counter()
    while not steps or time.perf_counter() - start < seconds:
        results = engine.evaluate(
            with_subject(point, [TrainingChunk(point.generation, chunk) for chunk in range(chunks)])
        )
        steps += sum(int(result.steps.sum()) for result in results if isinstance(result, EpisodesResult))
    return steps / (time.perf_counter() - start)


def measure_policies(engine: Evaluator, parameters_N_D: Any, observation_size: int, seconds: float) -> float:
    """Steps per second over one episode of each policy, again and again; the messages are made anew each time."""
    steps, generation, start = 0, 0, time.perf_counter()
    statistics = no_statistics(len(parameters_N_D), observation_size)
    while time.perf_counter() - start < seconds or not generation:
        asked = policy_work(parameters_N_D, statistics, 1, seed=0, generation=(generation := generation + 1))
        steps += int(gathered([asked.shape], engine.evaluate(asked.work))[0].steps.sum())
    return steps / (time.perf_counter() - start)


def resident_mib(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def config_of(task: str, hidden: list[int] | None = None) -> RunConfig:
    maze = task == "point_maze"
    if hidden is None:
        hidden = [64, 64] if maze else [256, 256]
    return api.load_config(
        {
            "task": {"environment": task, "episode_steps": None if maze else ANT_STEPS},
            "policy": {"hidden": hidden},
            "search": {"algorithm": "es", "pairs": PAIRS.get(task, ANT_PAIRS)},
            "budget": {"generations": 1},
        }
    )


def compare_policies(task: str, seconds: float, rounds: int) -> dict[str, Any]:
    """A row: medians of the rounds of perturbed and of explicit policies, and the ratio of the medians."""
    config = config_of(task)
    spec = replace(worker_spec(config, task_of(config)), rollout="simd")
    chunks, size = config.search.pairs // spec.chunk_pairs, spec.policy.widths[0]
    first_D = initial_parameters(spec.policy, "unit_columns", 0)
    rng = np.random.default_rng(0)
    policies_N_D = first_D + 0.02 * rng.normal(size=(2 * config.search.pairs, first_D.size)).astype(np.float32)
    point = centre(first_D, sigma=0.02, observation_size=size)
    row: dict[str, Any] = {"task": task, "policies": len(policies_N_D), "bytes_of_each": policies_N_D[0].nbytes}
    for workers in (1, 2):
        rates: dict[str, list[float]] = {"perturbed": [], "explicit": []}
        with inline_engine(spec, Limits(workers)) as engine:
            for length in (0.0, *[seconds] * rounds):  # the first compiles
                rates["perturbed"].append(measure(engine, point, chunks, length))
                rates["explicit"].append(measure_policies(engine, policies_N_D, size, length))
        rate = {kind: statistics.median(values[1:]) for kind, values in rates.items()}
        row |= {f"{kind}_{workers}": round(median) for kind, median in rate.items()}
        row[f"explicit_over_perturbed_{workers}"] = round(rate["explicit"] / rate["perturbed"], 2)
    return row


def compare(task: str, seconds: float, rounds: int, *, threads: bool) -> dict[str, Any]:
    """A row: medians of the rounds, ratios of medians, and the least and greatest ratio of a round."""
    config = config_of(task)
    spec = worker_spec(config, task_of(config))
    chunks = config.search.pairs // spec.chunk_pairs
    size = spec.policy.widths[0]
    point = centre(initial_parameters(spec.policy, "unit_columns", 0), sigma=0.02, observation_size=size)
    rates: dict[tuple[str, int], list[float]] = {}
    ready_s: dict[str, list[float]] = {"xla": [], "simd": []}
    with ExitStack() as stack:
        engines = {}
        for rollout, workers in itertools.product(("xla", "simd"), (1, 2)):
            start, used = time.monotonic(), threads and rollout == "simd"
            made = inline_engine(replace(spec, rollout=rollout), Limits(workers), threads=used)
            engine = engines[rollout, workers] = stack.enter_context(made)
            measure(engine, point, 1, 0.0)
            ready_s[rollout].append(round(time.monotonic() - start, 1))
            measure(engine, point, chunks, 0.0)  # now every worker has compiled
        for _ in range(rounds):
            for kind, engine in engines.items():
                rates.setdefault(kind, []).append(measure(engine, point, chunks, seconds))
        memory = {
            rollout: max(resident_mib(pid) for pid in engines[rollout, 2].transport.process_ids().values())
            for rollout in ("xla", "simd")
        }
    rate = {kind: statistics.median(values) for kind, values in rates.items()}
    ratios = {n: [s / x for s, x in zip(rates["simd", n], rates["xla", n], strict=True)] for n in (1, 2)}
    return {
        "task": task,
        **{f"{rollout}_{workers}": round(median) for (rollout, workers), median in rate.items()},
        "simd_over_xla": [round(rate["simd", workers] / rate["xla", workers], 1) for workers in (1, 2)],
        "simd_over_xla_least_and_greatest": [
            [round(pick(ratios[workers]), 1) for pick in (min, max)] for workers in (1, 2)
        ],
        "two_over_one": {rollout: round(rate[rollout, 2] / rate[rollout, 1], 2) for rollout in ("xla", "simd")},
        "ready_s": ready_s,
        "worker_peak_mib": {rollout: round(mib) for rollout, mib in memory.items()},
    }


@contextmanager
def not_looking() -> Iterator[None]:
    """Inside the block, JAX tasks are compiled and run without a look at what is not finite."""

    def blind_steps(environment: Environment, spec: WorkerSpec, **kind: Any) -> EpisodeSteps:
        steps = episode_steps(environment, spec, **kind | {"finds_faults": False})

        def advance(carry: Any, mean_O: Any, x_O: Any, *others: Any) -> Any:
            return steps.advance(carry, mean_O, jnp.zeros_like(x_O), *others)

        return steps._replace(advance=advance)

    with (
        patch("workers.simd.episodes.program.episode_steps", blind_steps),
        patch("workers.xla.episode_steps", blind_steps),
        patch("workers.simd.episodes.compiled._all_finite", lambda words: True),
        patch("workers.rollouts.jax_tasks.judged", lambda functions, spec: functions),
    ):
        yield


def compare_looking(task: str, hidden: list[int] | None, rollout: str, seconds: float, rounds: int) -> dict[str, Any]:
    """A row: for training and evaluation, the cost of looking in percent, the median of the rounds and the quartiles.

    Each round makes both workers anew, since where their code and memory lie changes their speed by some percent. Calls
    are by turns, in seconds of this process, since xla computes in threads of its own.
    """
    config = config_of(task, hidden)
    spec = replace(worker_spec(config, task_of(config)), rollout=rollout)
    size, blocks = spec.policy.widths[0], {True: nullcontext, False: not_looking}
    point = centre(initial_parameters(spec.policy, "unit_columns", 0), sigma=0.02, observation_size=size)
    chunks = {"training": TrainingChunk(1, 0), "evaluation": EvaluationChunk(1, 0, 16)}
    ratios, unlooked_s = ({kind: [] for kind in chunks} for _ in range(2))
    for _ in range(rounds):
        runs = {}
        for looks, block in blocks.items():
            with block():
                runs[looks] = make_worker(spec)
        for kind, chunk in chunks.items():
            work, durations, end = with_subject(point, [chunk]), {True: [], False: []}, time.perf_counter() + seconds
            while len(durations[True]) < 3 or time.perf_counter() < end:
                for looks, block in blocks.items():
                    with block():
                        start = time.process_time()
                        runs[looks](work)
                        durations[looks].append(time.process_time() - start)
            looked, unlooked = (statistics.median(durations[looks]) for looks in blocks)
            ratios[kind].append(looked / unlooked)
            unlooked_s[kind].append(unlooked)
    row: dict[str, Any] = {"task": task, "hidden": spec.policy.widths[1:-1], "rollout": rollout}
    for kind in chunks:
        row |= {
            f"{kind}_us": round(1e6 * statistics.median(unlooked_s[kind])),
            f"{kind}_percent": round(100 * (statistics.median(ratios[kind]) - 1), 2),
            f"{kind}_quartiles": [round(100 * (x - 1), 2) for x in statistics.quantiles(ratios[kind], n=4)[::2]],
        }
    return row


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", nargs="+", default=["point_maze", "ant_maze", "ant_trap", "brax:ant"])
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each round")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--threads", action="store_true", help="workers of simd are threads of one process")
    parser.add_argument("--policies", action="store_true", help="explicit policies beside perturbed ones, with simd")
    parser.add_argument("--looking", nargs="+", metavar="ROLLOUT", help="what looking costs with these rollouts")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as empty:
        os.environ["XDG_CACHE_HOME"] = empty
        for task in arguments.tasks:
            if arguments.looking:
                for rollout, hidden in itertools.product(arguments.looking, ([], None)):
                    row = compare_looking(task, hidden, rollout, arguments.seconds, arguments.rounds)
                    print(json.dumps(row), flush=True)
                continue
            if arguments.policies:
                row = compare_policies(task, arguments.seconds, arguments.rounds)
            else:
                row = compare(task, arguments.seconds, arguments.rounds, threads=arguments.threads)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
