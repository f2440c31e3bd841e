"""What do ES, NS-ES, NSR-ES, NSRA-ES and ME-ES find on PointMaze? The shipped configs, seeds 0 to 4, all reported.

    python -m tests.benchmarks.science             # what is missing of 35 runs of 5 G steps: five hours on two cores
    python -m tests.benchmarks.science --env-steps 500_000_000        # the same, a tenth as long
    python -m tests.benchmarks.science --methods nsra_es --seeds 100 --env-steps 100_000_000 \\
        --set search.sigma=0.1                         # a trial: printed only

Of runs with the usual seeds, settings and one of the two lengths each finished one becomes a row of results/NAME.csv,
NAME as in RECORDED; those that have a row are not repeated, those that were interrupted go on where they were. One run
per core, in one process: nothing is sent, which changes no result and saves a quarter of the time.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service import api
from es_service.protocol.machine import cpu_kind
from es_service.protocol.process_environment import worker_environment
from es_service.runs.view import Policy, Run
from tests.helpers import workers_in_this_process

RESULTS = Path(__file__).parent / "results"
RUNS = Path(__file__).parents[2] / "runs" / "science"
"""Folder of the run folders that are not finished."""
CONFIGS = Path(__file__).parents[2] / "configs"
METHODS: dict[str, tuple[str, ...]] = {
    "es": (),
    "ns_es": (),
    "nsr_es": (),
    "nsra_es": (),
    "me_es": (),
    "me_es explore": ("search.mode=explore",),
    "me_es exploit": ("search.mode=exploit",),
}
"""Name, of which the first word is that of the algorithm and its config -> settings besides the config's."""
SEEDS = range(5)
RECORDED = {500_000_000: "point_maze", 5_000_000_000: "point_maze_5g"}
"""Environment steps of a run -> name of its results."""
STEPS_AT_LEAST = 25_000
"""Environment steps that a generation counts for when a run is to end; it takes 31,600 until episodes begin to end at
the goal. A search that stays there would need five times the generations of the others."""
CHAMBER_EDGES = (-0.495, 0.205)
"""y that separates the first chamber (start), the second (dead end) and the third (goal): the middles of the walls."""
SOLVED = -30.0
RETEST_EPISODES = 1000
RETEST_SEED = 1_000_003


def episodes(policy: Policy, seed: int, count: int) -> np.ndarray:
    """Returns [count] of noise-free episodes of a policy."""
    import jax

    from es_service.protocol.noise import Domain, stream_keys
    from workers.environments import make_environment

    environment = make_environment("point_maze", {})
    step = jax.jit(jax.vmap(environment.step))
    state = jax.vmap(environment.reset)(stream_keys(seed, Domain.EVALUATION_RESET, 0, np.arange(count)))
    returns, alive = np.zeros(count), np.ones(count, bool)
    for _ in range(200):
        state, reward, done = step(state, policy(np.asarray(state)))
        returns += np.where(alive, reward, 0.0)
        alive &= ~np.asarray(done)
    return returns


def chamber_shares(y: np.ndarray) -> list[float]:
    """Percent of evaluated centres whose episodes end in the first, second and third chamber."""
    first, second = y < CHAMBER_EDGES[0], (y >= CHAMBER_EDGES[0]) & (y < CHAMBER_EDGES[1])
    return [round(100 * float(share.mean()), 2) for share in (first, second, ~(first | second))]


def folder_of(method: str, seed: int, env_steps: int, settings: tuple[str, ...]) -> Path:
    """Of a run that is not finished, or not recorded."""
    return RUNS / "_".join([*method.split(), str(seed), str(env_steps), *settings]).replace("/", "_")


def run_one(method: str, seed: int, env_steps: int, settings: tuple[str, ...]) -> dict[str, Any]:
    """One run from its config, or from where it was interrupted, to its row."""
    budget = [f"budget.env_steps={env_steps}", f"budget.generations={env_steps // STEPS_AT_LEAST}"]
    config = api.load_config(
        CONFIGS / f"point_maze_{method.split()[0]}.yaml",
        [*budget, "compute.engine=inline", "compute.workers=1", f"seed={seed}", *METHODS.get(method, ()), *settings],
    )
    with workers_in_this_process():
        run = api.run_or_resume(config, folder_of(method, seed, env_steps, settings)).run
    return _read(run, method, seed)


def _read(run: Run, method: str, seed: int) -> dict[str, Any]:
    """The row of a run."""
    history, ends_y = run.history, run.novelty["y"].to_numpy()
    solved = history[history["centre_return_mean"] >= SOLVED]
    returns = episodes(run.policy("best"), RETEST_SEED + seed, RETEST_EPISODES)
    shares = chamber_shares(ends_y)
    return {
        "method": method,
        "seed": seed,
        "generations": len(history) - 1,
        "env_steps": int(history["env_steps"].iloc[-1]),
        "best_return": round(float(history["centre_return_mean"].max()), 2),
        "best_return_retested": round(float(returns.mean()), 2),
        "steps_to_minus_30": int(solved["env_steps"].iloc[0]) if len(solved) else None,
        "last_return": round(float(history["centre_return_mean"].iloc[-1]), 2),
        "map_cells": int(history["map_cells"].iloc[-1]),
        "qd_score": round(float(history["qd_score"].iloc[-1])),
        "evaluated_centres": len(ends_y),
        **{f"chamber_{number}_percent": share for number, share in enumerate(shares, 1)},
        "least_goal_distance": round(float(history["goal_distance"].min()), 3),
        "fitness_weight_median": round(float(history["fitness_weight"].median()), 2),
        "seconds": round(history["wall_clock_s"].iloc[-1]),
        "cpu": cpu_kind(),
    }


def quartiles(table: pd.DataFrame) -> pd.DataFrame:
    """Per method: quartiles of the best return and of the filled cells, steps to -30, mean shares of the chambers."""
    rows = {}
    for method, runs in table.groupby("method", sort=False):
        low, median, high = np.quantile(runs["best_return"], [0.25, 0.5, 0.75])
        cells = np.quantile(runs["map_cells"], [0.25, 0.5, 0.75])
        steps = pd.to_numeric(runs["steps_to_minus_30"]).dropna()
        rows[method] = {
            "best_return_q25": low,
            "best_return_median": median,
            "best_return_q75": high,
            "solved": f"{len(steps)} of {len(runs)}",
            "steps_to_minus_30_median_of_solved": steps.median(),
            **dict(zip(("cells_q25", "cells_median", "cells_q75"), cells, strict=True)),
            **{f"chamber_{number}": runs[f"chamber_{number}_percent"].mean() for number in (1, 2, 3)},
        }
    return pd.DataFrame(rows).T


def table_of(rows: Sequence[Mapping[Any, Any]]) -> pd.DataFrame:
    """A row per run, in the order of METHODS and seeds."""
    table = pd.DataFrame(rows).astype({"steps_to_minus_30": "Int64"})
    number = {method: number for number, method in enumerate(METHODS)}
    return table.sort_values(["method", "seed"], key=lambda column: column.replace(number))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--env-steps", type=int, default=max(RECORDED))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args()
    name = RECORDED.get(arguments.env_steps)
    trial = bool(arguments.set) or name is None or not set(arguments.seeds) <= set(SEEDS)
    table = RESULTS / f"{name}.csv"
    rows = pd.read_csv(table).to_dict("records") if table.exists() and not trial else []
    known = {(row["method"], row["seed"]) for row in rows}
    RUNS.mkdir(parents=True, exist_ok=True)
    cleaned = worker_environment(os.environ)
    os.environ.clear()
    os.environ.update(cleaned)  # the processes below import JAX with it
    cores = len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(cores, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        settings = tuple(arguments.set)
        pending = {
            pool.submit(run_one, method, seed, arguments.env_steps, settings): (method, seed)
            for seed in arguments.seeds
            for method in arguments.methods
            if (method, seed) not in known
        }
        try:
            for future in as_completed(pending):
                rows.append(row := future.result())
                print(json.dumps(row), flush=True)
                if not trial:
                    table_of(rows).to_csv(table, index=False, lineterminator="\n")
                shutil.rmtree(folder_of(*pending[future], arguments.env_steps, settings))
        except BaseException:  # what runs now is in its folder, to go on from; nothing else begins
            for future in pending:
                future.cancel()
            raise
    print(quartiles(table_of(rows)).to_string())


if __name__ == "__main__":
    main()
