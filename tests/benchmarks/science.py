"""What do ES, NS-ES, NSR-ES and NSRA-ES find on PointMaze? The shipped configs, seeds 0 to 4, all reported.

    python -m tests.benchmarks.science                 # 20 runs of 500 M steps: about an hour on two cores
    python -m tests.benchmarks.science --algorithms nsra_es --seeds 100 --env-steps 100_000_000 \\
        --set search.sigma=0.1                         # a trial: printed only

Without --set, writes results/point_maze.csv (a row per run) and results/point_maze.png. One run per core, each with one
worker: the engine and the number of workers change no result.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service import api
from es_service.platform_info import cpu_kind
from es_service.run_view import Policy, Run
from tests.benchmarks import science_picture

RESULTS = Path(__file__).parent / "results"
CONFIGS = Path(__file__).parents[2] / "configs"
ALGORITHMS = ("es", "ns_es", "nsr_es", "nsra_es")
CHAMBER_EDGES = (-0.495, 0.205)
"""y that separates the first chamber (start), the second (dead end) and the third (goal): the middles of the walls."""
SOLVED = -30.0
RETEST_EPISODES = 1000
RETEST_SEED = 1_000_003


@dataclass(frozen=True)
class Found:
    """One run, as far as table and picture need it."""

    row: dict[str, Any]
    ends_N_2: np.ndarray
    """Where the episodes of each evaluated centre ended, on average."""
    curve_N_2: np.ndarray
    """(environment steps, best centre return so far) at each improvement, and at the end."""
    way_T_2: np.ndarray
    """Positions of one episode of the best centre."""


def episodes(policy: Policy, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(returns [count], positions of the first one [T + 1, 2]) of noise-free episodes of a policy."""
    import jax

    from es_service.noise import Domain, stream_keys
    from workers.environments import make_environment

    environment = make_environment("point_maze", {})
    step = jax.jit(jax.vmap(environment.step))
    state = jax.vmap(environment.reset)(stream_keys(seed, Domain.EVALUATION_RESET, 0, np.arange(count)))
    returns, alive = np.zeros(count), np.ones(count, bool)
    way = [np.asarray(state)[0]]
    for _ in range(200):
        state, reward, done = step(state, policy(np.asarray(state)))
        returns += np.where(alive, reward, 0.0)
        if alive[0]:
            way.append(np.asarray(state)[0])
        alive &= ~np.asarray(done)
    return returns, np.array(way)


def chamber_shares(y: np.ndarray) -> list[float]:
    """Percent of evaluated centres whose episodes end in the first, second and third chamber."""
    first, second = y < CHAMBER_EDGES[0], (y >= CHAMBER_EDGES[0]) & (y < CHAMBER_EDGES[1])
    return [round(100 * float(share.mean()), 2) for share in (first, second, ~(first | second))]


def run_one(algorithm: str, seed: int, env_steps: int, settings: tuple[str, ...]) -> Found:
    """One run from its config to its row."""
    budget = [f"budget.env_steps={env_steps}", "budget.generations=100_000_000"]
    config = api.load_config(
        CONFIGS / f"point_maze_{algorithm}.yaml",
        [*budget, "compute.engine=inline", "compute.workers=1", f"seed={seed}", *settings],
    )
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        run = api.run(config, Path(folder) / "run").run
        seconds = time.perf_counter() - started
        return _read(run, algorithm, seed, seconds)


def _read(run: Run, algorithm: str, seed: int, seconds: float) -> Found:
    history, ends = run.history, run.novelty[["x", "y"]].to_numpy()
    best = history["centre_return_mean"].cummax()
    better = best.diff().fillna(1.0) > 0
    better.iloc[-1] = True
    solved = history[history["centre_return_mean"] >= SOLVED]
    returns, way = episodes(run.policy("best"), RETEST_SEED + seed, RETEST_EPISODES)
    shares = chamber_shares(ends[:, 1])
    row = {
        "algorithm": algorithm,
        "seed": seed,
        "generations": len(history) - 1,
        "env_steps": int(history["env_steps"].iloc[-1]),
        "best_return": round(float(best.iloc[-1]), 2),
        "best_return_retested": round(float(returns.mean()), 2),
        "steps_to_minus_30": int(solved["env_steps"].iloc[0]) if len(solved) else None,
        "last_return": round(float(history["centre_return_mean"].iloc[-1]), 2),
        "evaluated_centres": len(ends),
        **{f"chamber_{number}_percent": share for number, share in enumerate(shares, 1)},
        "least_goal_distance": round(float(history["goal_distance"].min()), 3),
        "fitness_weight_median": round(float(history["fitness_weight"].median()), 2),
        "seconds": round(seconds),
        "cpu": cpu_kind(),
    }
    return Found(row, ends, np.column_stack([history["env_steps"][better], best[better]]), way)


def quartiles(table: pd.DataFrame) -> pd.DataFrame:
    """Per algorithm: quartiles of the best return, of the steps to -30, and mean shares of the chambers."""
    rows = {}
    for algorithm, runs in table.groupby("algorithm", sort=False):
        low, median, high = np.quantile(runs["best_return"], [0.25, 0.5, 0.75])
        steps = pd.to_numeric(runs["steps_to_minus_30"]).dropna()
        rows[algorithm] = {
            "best_return_q25": low,
            "best_return_median": median,
            "best_return_q75": high,
            "solved": f"{len(steps)} of {len(runs)}",
            "steps_to_minus_30_median_of_solved": steps.median(),
            **{f"chamber_{number}": runs[f"chamber_{number}_percent"].mean() for number in (1, 2, 3)},
        }
    return pd.DataFrame(rows).T


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--algorithms", nargs="+", default=list(ALGORITHMS), choices=ALGORITHMS)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(5)))
    parser.add_argument("--env-steps", type=int, default=500_000_000)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(cores, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        pending = [
            pool.submit(run_one, algorithm, seed, arguments.env_steps, tuple(arguments.set))
            for algorithm in arguments.algorithms
            for seed in arguments.seeds
        ]
        found = []
        for future in pending:
            found.append(future.result())
            print(json.dumps(found[-1].row), flush=True)
    table = pd.DataFrame([one.row for one in found])
    print(quartiles(table).to_string())
    if not arguments.set:
        table.astype({"steps_to_minus_30": "Int64"}).to_csv(
            RESULTS / "point_maze.csv", index=False, lineterminator="\n"
        )
        science_picture.draw(found, RESULTS / "point_maze.png")


if __name__ == "__main__":
    main()
