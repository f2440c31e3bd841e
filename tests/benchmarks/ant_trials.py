"""Which settings take the ant of AntMaze round the walls, and to the goal? Short runs of ME-ES and NSRA-ES, one each.

    python -m tests.benchmarks.ant_trials [--workers 2]       # a run per core at a time
    python -m tests.benchmarks.ant_trials --config ant_maze_me_es --set search.sigma=0.1 --seed 101

Those of TRIALS, in their order, with seed 100, or what is asked for, beside the usual settings. A finished one becomes
a row of results/ant_maze_trials.csv, and one that has a row is not repeated. What is interrupted begins again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pandas as pd

from es_service import api
from es_service.protocol.process_environment import worker_environment
from tests.benchmarks.ants import USUAL, summary
from tests.benchmarks.science import CONFIGS
from tests.helpers import workers_in_this_process

TABLE = Path(__file__).parent / "results" / "ant_maze_trials.csv"
RUNS = Path(__file__).parents[2] / "runs" / "ant_trials"
ENV_STEPS = 150_000_000
SEED = 100
TRIALS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("ant_maze_me_es", ()),  # sigma 0.02, learning rate 0.01
    ("ant_maze_me_es", ("search.sigma=0.05", "search.step.learning_rate=0.03")),
    ("ant_maze_me_es", ("search.sigma=0.02", "search.step.learning_rate=0.03")),
    # Larger steps were worse, so what follows has the usual ones, or smaller ones.
    ("ant_maze_me_es", ("search.step.learning_rate=0.005",)),
    ("ant_maze_me_es", ("search.pairs=32",)),
    ("ant_maze_me_es", ("task.fitness=final",)),
    ("ant_maze_me_es", ("search.cell_sampling=score",)),
    ("ant_maze_nsra_es", ()),
    ("ant_maze_me_es", ("search.block_generations=20",)),
    ("ant_maze_me_es", ("search.common_random_numbers=false",)),
    ("ant_maze_me_es", ("policy.observation_normalization=false",)),
)
"""(config, settings), in the order in which they were thought of."""
KEPT = (
    "env_steps",
    "hours",
    "generations",
    "best_return",
    "best_centre_ends_at",
    "steps_to_behind_the_wall",
    "centres_behind_the_wall_percent",
    "least_goal_distance_at_the_end_m",
    "steps_to_ending_at_goal",
    "cells",
    "cpu",
)


def run_one(config: str, seed: int, settings: tuple[str, ...]) -> dict[str, Any]:
    """One run in this process -> its row."""
    folder = RUNS / "_".join([config, str(seed), *settings])
    shutil.rmtree(folder, ignore_errors=True)
    budget = (f"budget.env_steps={ENV_STEPS}", "budget.generations=null", f"seed={seed}")
    chosen = ("compute.engine=inline", "compute.workers=1", *budget, *USUAL, *settings)
    with workers_in_this_process():
        run = api.run(api.load_config(CONFIGS / f"{config}.yaml", chosen), folder).run
    row = summary(config, run)
    shutil.rmtree(folder)
    return {"config": config, "settings": " ".join(settings), "seed": seed, **{key: row[key] for key in KEPT}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", choices=sorted({config for config, _ in TRIALS}))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    arguments = parser.parse_args()
    asked = ((arguments.config, tuple(arguments.set)),) if arguments.config else TRIALS
    table = pd.read_csv(TABLE, keep_default_na=False) if TABLE.exists() else pd.DataFrame()
    known = set(zip(table.config, table.settings, table.seed, strict=True)) if len(table) else set()
    RUNS.mkdir(parents=True, exist_ok=True)
    cleaned = worker_environment(os.environ)
    os.environ.clear()
    os.environ.update(cleaned)  # the processes below import JAX with it
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        pending = [
            pool.submit(run_one, config, arguments.seed, settings)
            for config, settings in asked
            if (config, " ".join(settings), arguments.seed) not in known
        ]
        for future in as_completed(pending):
            print(json.dumps(row := future.result()), flush=True)
            header = not TABLE.exists()
            pd.DataFrame([row]).to_csv(TABLE, mode="a", header=header, index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
