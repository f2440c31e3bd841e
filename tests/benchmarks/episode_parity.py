"""Are whole episodes by simd the episodes of xla? Ants part after a few contacts, so their distributions are compared.

    python -m tests.benchmarks.episode_parity        # half an hour on one core: xla's part

For AntMaze and AntTrap: an ES of 40 generations walks a little; then 1,000 pairs around its centre, 2,000 episodes of
full length, with the same seeds by both. Return, length and both descriptors are compared by Kolmogorov-Smirnov, at
0.01 over the number of tests, and by the difference of their means in standard errors. Prints, and writes
results/episode_parity.csv.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import ks_2samp

from es_service import api
from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.protocol.machine import cpu_kind
from es_service.protocol.messages import Centre, EpisodesResult, TrainingChunk, WorkerSpec

RESULTS = Path(__file__).parent / "results" / "episode_parity.csv"
TASKS = ("ant_maze", "ant_trap")
PAIRS, CHUNK_PAIRS = 1000, 8
LEVEL = 0.01
WALKING = 40
"""Generations before."""


def walking_centre(task: str) -> tuple[RunConfig, Centre]:
    """The config of a short ES run, and where it ended."""
    config = {
        "task": {"environment": task},
        "search": {"algorithm": "es", "pairs": 64, "sigma": 0.02, "step": {"learning_rate": 0.02}},
        "map": {"enabled": False},
        "compute": {"engine": "inline", "rollout": "simd", "chunk_pairs": CHUNK_PAIRS},
        "budget": {"generations": WALKING},
    }
    with tempfile.TemporaryDirectory() as folder:
        loaded = api.load_config(config)
        run = api.run(loaded, Path(folder) / "run", on_notice=print).run
        policy = run.policy("centre")
        sigma = loaded.search.sigma
        centre = Centre(1, policy.parameters_D, sigma, policy.observation_mean_O, policy.observation_std_O)
    return loaded, centre


def episodes(spec: WorkerSpec, centre: Centre, pairs: int) -> dict[str, np.ndarray]:
    """Of all members, flat: return, length, descriptor."""
    from workers.worker import make_worker

    worker = make_worker(spec)
    results = []
    for chunk in range(pairs // spec.chunk_pairs):
        result = worker([(centre, TrainingChunk(1, chunk))])[0]
        assert isinstance(result, EpisodesResult)
        results.append(result)
    descriptor = np.concatenate([result.descriptor.reshape(-1, 2) for result in results])
    return {
        "return": np.concatenate([result.returns.ravel() for result in results]),
        "length": np.concatenate([result.steps.ravel() for result in results]),
        "x": descriptor[:, 0],
        "y": descriptor[:, 1],
    }


def compare(task: str, pairs: int) -> list[dict]:
    """A row for each quantity."""
    config, centre = walking_centre(task)
    spec, quantities, seconds = worker_spec(config, task_of(config)), {}, {}
    for rollout in ("simd", "xla"):
        started = time.perf_counter()
        quantities[rollout] = episodes(replace(spec, rollout=rollout), centre, pairs)
        seconds[rollout] = time.perf_counter() - started
    rows = []
    for name, ours in quantities["simd"].items():
        theirs = quantities["xla"][name]
        error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / ours.size)
        test = ks_2samp(ours, theirs)
        rows.append({
            "task": task, "quantity": name, "episodes": ours.size,
            "mean_simd": ours.mean(), "mean_xla": theirs.mean(), "std_xla": theirs.std(ddof=1),
            "difference_in_standard_errors": (ours.mean() - theirs.mean()) / error if error else 0.0,
            "ks_distance": test.statistic, "ks_p": test.pvalue,
            "seconds_simd": round(seconds["simd"], 1), "seconds_xla": round(seconds["xla"], 1), "cpu": cpu_kind(),
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    pairs = parser.parse_args().pairs
    table = pd.DataFrame([row for task in TASKS for row in compare(task, pairs)])
    table["same"] = (table.ks_p > LEVEL / len(table)) & (table.difference_in_standard_errors.abs() <= 2.0)
    print(table.to_string(index=False))
    if pairs == PAIRS:
        table.to_csv(RESULTS, index=False, float_format="%.6g")


if __name__ == "__main__":
    main()
