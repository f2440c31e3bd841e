"""What do ES, NS-ES, NSR-ES, NSRA-ES and ME-ES find on PointMaze? The shipped configs, seeds 0 to 4, all reported.

    python -m tests.benchmarks.science                 # 35 runs of 5 G steps: some five hours on two cores
    python -m tests.benchmarks.science --env-steps 500_000_000            # the same, a tenth as long
    python -m tests.benchmarks.science --methods nsra_es --seeds 100 --env-steps 100_000_000 \\
        --set search.sigma=0.1                         # a trial: printed only

Of runs with the usual seeds, settings and one of the two lengths each finished one becomes a line of
runs/science/NAME_runs.jsonl.gz, NAME as in RECORDED, and a row of results/NAME.csv; those that have a line are not
repeated, those that were interrupted go on where they were. In the end runs/science/NAME.png is drawn. One run
per core, in one process: nothing is sent, which changes no result and saves a quarter of the time (`--engine` runs them
as everybody does).
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service import api
from es_service.config.model import RunConfig, worker_spec
from es_service.config.tasks import task_of
from es_service.protocol.machine import cpu_kind
from es_service.protocol.process_environment import worker_environment
from es_service.runs import session
from es_service.runs.view import Policy, Run
from tests.benchmarks import science_picture

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
BINS = 50
"""Along each side, of the picture of where centres ended."""
CURVE_POINTS = 100


def episodes(policy: Policy, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(returns [count], positions of the first one [T + 1, 2]) of noise-free episodes of a policy."""
    import jax

    from es_service.protocol.noise import Domain, stream_keys
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


@contextmanager
def in_this_process(config: RunConfig, should_stop: Callable[[], int | None], *_: object) -> Iterator[object]:
    """In the place of `session.make_engine`: the one worker is the caller, whose fault would be the end of the run."""
    from tests.helpers import WorkerHere  # imports JAX
    from workers.worker import make_worker

    yield WorkerHere(make_worker(worker_spec(config, task_of(config))), should_stop)


def folder_of(method: str, seed: int, env_steps: int, settings: tuple[str, ...]) -> Path:
    """Of a run that is not finished, or not recorded."""
    return RUNS / "_".join([*method.split(), str(seed), str(env_steps), *settings]).replace("/", "_")


def run_one(method: str, seed: int, env_steps: int, settings: tuple[str, ...], engine: bool) -> dict[str, Any]:
    """One run from its config, or from where it was interrupted, to what is kept of it."""
    if not engine:
        session.make_engine = in_this_process
    budget = [f"budget.env_steps={env_steps}", f"budget.generations={env_steps // STEPS_AT_LEAST}"]
    config = api.load_config(
        CONFIGS / f"point_maze_{method.split()[0]}.yaml",
        [*budget, "compute.engine=inline", "compute.workers=1", f"seed={seed}", *METHODS.get(method, ()), *settings],
    )
    return _read(api.run_or_resume(config, folder_of(method, seed, env_steps, settings)).run, method, seed)


def _read(run: Run, method: str, seed: int) -> dict[str, Any]:
    """{"row": of the table, "ends": where centres ended, "curve": steps, best return, cells, "way": of the best}."""
    history, ends = run.history, run.novelty[["x", "y"]].to_numpy()
    best = history["centre_return_mean"].cummax()
    solved = history[history["centre_return_mean"] >= SOLVED]
    returns, way = episodes(run.policy("best"), RETEST_SEED + seed, RETEST_EPISODES)
    shares = chamber_shares(ends[:, 1])
    row = {
        "method": method,
        "seed": seed,
        "generations": len(history) - 1,
        "env_steps": int(history["env_steps"].iloc[-1]),
        "best_return": round(float(best.iloc[-1]), 2),
        "best_return_retested": round(float(returns.mean()), 2),
        "steps_to_minus_30": int(solved["env_steps"].iloc[0]) if len(solved) else None,
        "last_return": round(float(history["centre_return_mean"].iloc[-1]), 2),
        "map_cells": int(history["map_cells"].iloc[-1]),
        "qd_score": round(float(history["qd_score"].iloc[-1])),
        "evaluated_centres": len(ends),
        **{f"chamber_{number}_percent": share for number, share in enumerate(shares, 1)},
        "least_goal_distance": round(float(history["goal_distance"].min()), 3),
        "fitness_weight_median": round(float(history["fitness_weight"].median()), 2),
        "seconds": round(history["wall_clock_s"].iloc[-1]),
        "cpu": cpu_kind(),
    }
    counts, _, _ = np.histogram2d(*ends.T, bins=BINS, range=((-1, 1), (-1, 1)))
    wanted = np.linspace(0, row["env_steps"], CURVE_POINTS)
    # The last generation that ended by then, and the instant of the solution besides.
    at = np.unique(np.maximum(np.searchsorted(history["env_steps"], wanted, side="right") - 1, 0))
    at = np.union1d(at, solved.index[:1].to_numpy(int))
    curve = np.column_stack([history["env_steps"].iloc[at], best.iloc[at].round(2), history["map_cells"].iloc[at]])
    return {
        "row": row,
        "ends": [[int(i), int(j), int(counts[i, j])] for i, j in np.argwhere(counts)],
        "curve": curve.tolist(),
        "way": way.round(3).tolist(),
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


def table_of(found: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """A row per run."""
    return pd.DataFrame([run["row"] for run in found]).astype({"steps_to_minus_30": "Int64"})


def kept_runs(kept: Path) -> list[dict[str, Any]]:
    """What is known, in the order of METHODS and seeds."""
    lines = gzip.decompress(kept.read_bytes()).splitlines() if kept.exists() else []
    runs = [json.loads(line) for line in lines]
    return sorted(runs, key=lambda run: (list(METHODS).index(run["row"]["method"]), run["row"]["seed"]))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--env-steps", type=int, default=max(RECORDED))
    parser.add_argument("--engine", action="store_true", help="inline, with a worker process for each run")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args()
    name = RECORDED.get(arguments.env_steps)
    trial = bool(arguments.set) or name is None or not set(arguments.seeds) <= set(SEEDS)
    kept = RUNS / f"{name}_runs.jsonl.gz"
    known = set() if trial else {(run["row"]["method"], run["row"]["seed"]) for run in kept_runs(kept)}
    RUNS.mkdir(parents=True, exist_ok=True)
    if not arguments.engine:
        cleaned = worker_environment(os.environ)
        os.environ.clear()
        os.environ.update(cleaned)  # the processes below import JAX with it
    runs = []
    cores = len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(cores, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        settings = tuple(arguments.set)
        pending = {
            pool.submit(run_one, method, seed, arguments.env_steps, settings, arguments.engine): (method, seed)
            for seed in arguments.seeds
            for method in arguments.methods
            if (method, seed) not in known
        }
        try:
            for future in as_completed(pending):
                runs.append(future.result())
                print(json.dumps(runs[-1]["row"]), flush=True)
                if not trial:
                    with gzip.open(kept, "at") as file:
                        file.write(json.dumps(runs[-1], separators=(",", ":")) + "\n")
                    table_of(kept_runs(kept)).to_csv(RESULTS / f"{name}.csv", index=False, lineterminator="\n")
                shutil.rmtree(folder_of(*pending[future], arguments.env_steps, settings))
        except BaseException:  # what runs now is in its folder, to go on from; nothing else begins
            for future in pending:
                future.cancel()
            raise
    runs = runs if trial else kept_runs(kept)
    print(quartiles(table_of(runs)).to_string())
    if not trial:
        table_of(runs).to_csv(RESULTS / f"{name}.csv", index=False, lineterminator="\n")
        science_picture.draw(runs, RUNS / f"{name}.png")


if __name__ == "__main__":
    main()
