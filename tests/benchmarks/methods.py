"""What do ME-ES, MEMES, MAP-Elites and ARS find on PointMaze in 50 million steps? Seeds 0 to 4 of each shipped config.

    python -m tests.benchmarks.methods                 # 20 runs, two at a time: five minutes on two cores

Writes a row for each run to results/point_maze_methods.csv, as `science` does, and prints quartiles. Runs that were
interrupted go on where they were.
"""

from __future__ import annotations

import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from es_service.dispatch.cores import cores
from es_service.protocol.process_environment import worker_environment
from tests.benchmarks.science import RESULTS, RUNS, SEEDS, folder_of, quartiles, run_one, table_of

METHODS = ("me_es", "memes", "map_elites", "ars")
ENV_STEPS = 50_000_000
COLUMNS = [
    *("method", "seed", "generations", "env_steps", "best_return", "best_return_retested", "steps_to_minus_30"),
    *("map_cells", "qd_score", "cpu"),
]
"""Of the rows of `science`, those that mean the same for every method."""
NO_OTHER_LIMIT = ("budget.generations=null",)


def main() -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    cleaned = worker_environment(os.environ)
    os.environ.clear()
    os.environ.update(cleaned)
    wanted = [(method, seed) for method in METHODS for seed in SEEDS]
    with ProcessPoolExecutor(cores(), mp_context=get_context("spawn")) as pool:
        runs = [pool.submit(run_one, method, seed, ENV_STEPS, NO_OTHER_LIMIT, False) for method, seed in wanted]
        table = table_of([run.result() for run in runs])
    table[COLUMNS].to_csv(RESULTS / "point_maze_methods.csv", index=False, lineterminator="\n")
    for method, seed in wanted:
        shutil.rmtree(folder_of(method, seed, ENV_STEPS, NO_OTHER_LIMIT))
    print(quartiles(table).drop(columns=["chamber_1", "chamber_2", "chamber_3"]).to_string())


if __name__ == "__main__":
    main()
