"""How soon does `make run` reach the goal of PointMaze with more emitters side by side?

    python -m tests.benchmarks.emitters [--emitters 1 4 16] [--pairs 64 32] [--seeds 0 1 2 3 4]

Each run is configs/point_maze_me_es.yaml from the command line, with two workers, until a centre's fitness is at least
-30 or after 300 million steps. Runs of different settings take turns, seed by seed; nothing else should compute. The
rows go to tests/benchmarks/results/point_maze_emitters.csv, in place of earlier ones of the same settings; medians are
printed.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from es_service import api

RESULTS = Path(__file__).parent / "results" / "point_maze_emitters.csv"
CONFIG = Path(__file__).parents[2] / "configs" / "point_maze_me_es.yaml"
GOAL = -30.0
MOST_STEPS = 300_000_000
SETTINGS = ["pairs", "emitters", "engine", "seed"]
"""Columns of which each combination has one row."""


def measure(emitters: int, pairs: int, seed: int, engine: str, folder: Path) -> dict[str, object]:
    """One run until the goal."""
    settings = {
        "search.emitters": emitters,
        "search.pairs": pairs,
        "budget.generations": "null",
        "budget.target_fitness": GOAL,
        "budget.env_steps": MOST_STEPS,
    }
    started = time.perf_counter()
    command = [sys.executable, "-m", "es_service", "run", CONFIG, "--out", folder]
    command += ["--seed", str(seed), "--workers", "2", "--engine", engine]
    for key, value in settings.items():
        command += ["--set", f"{key}={value}"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    process_s = time.perf_counter() - started
    run = api.open_run(folder)
    last = run.history.iloc[-1]
    return {
        "emitters": emitters,
        "pairs": pairs,
        "seed": seed,
        "engine": engine,
        "reached": bool(last["best_fitness"] >= GOAL),
        "generations": int(run.history.index[-1]),
        "env_steps": int(last["env_steps"]),
        "run_s": round(float(last["wall_clock_s"]), 2),
        "process_s": round(process_s, 2),
        "best_fitness": round(float(last["best_fitness"]), 2),
        "cells": int(last["map_cells"]),
        "digest": run.digest()[:16],
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--emitters", nargs="+", type=int, default=[1, 4, 16])
    parser.add_argument("--pairs", nargs="+", type=int, default=[64, 32])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--engine", default="ray")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed, pairs, emitters in itertools.product(arguments.seeds, arguments.pairs, arguments.emitters):
            out = Path(folder) / f"{emitters}_{pairs}_{seed}"
            rows.append(measure(emitters, pairs, seed, arguments.engine, out))
            print(rows[-1], flush=True)
    earlier = [pd.read_csv(RESULTS)] if RESULTS.exists() else []
    table = pd.concat([*earlier, pd.DataFrame(rows)]).drop_duplicates(SETTINGS, keep="last")
    table = table.sort_values(SETTINGS, ascending=[False, True, True, True])
    table.to_csv(RESULTS, index=False)
    print(table.groupby(SETTINGS[:3], sort=False)[["reached", "env_steps", "run_s", "process_s"]].median())


if __name__ == "__main__":
    main()
