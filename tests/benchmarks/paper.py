"""The tables of the benchmark paper (Chalumeau et al. 2022), as far as evolution strategies can fill them.

    python -m tests.benchmarks.paper                                  # all that is missing: a night on two cores
    python -m tests.benchmarks.paper --task point_maze --seeds 0:2 --env-steps 1_000_000
    python -m tests.benchmarks.paper --config my.yaml --seeds 100:101 --env-steps 100_000_000 --set search.sigma=0.05

Each run is one of configs/paper with a seed, and has the environment steps that its file names. There are as many runs
at a time as cores, each in one process. A finished one becomes a row of results/paper_runs.csv and a curve in
results/paper_curves.csv, and is not computed again unless more steps are asked for; one that is interrupted is listed
with the steps that it has, and goes on from there if its folder is still in runs/paper. The tables of
tests/benchmarks/README.md and the picture of the curves are made from these two files, also if no run is missing. The
third form is a trial: it prints its rows, and adds them to results/paper_trials.csv.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import pandas as pd

from es_service import api
from es_service.cli.sweep import seeds_of
from es_service.errors import Interrupted
from es_service.protocol.machine import cores, cpu_kind
from es_service.protocol.process_environment import worker_environment
from es_service.runs import evaluation
from es_service.runs.view import Run
from tests.benchmarks import paper_picture, paper_tables
from tests.benchmarks.paper_readings import DISTANCE_TASKS, curve, readings
from tests.helpers import workers_in_this_process

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs" / "paper"
RUNS = ROOT / "runs" / "paper"
TRIALS = Path(__file__).parent / "results" / "paper_trials.csv"
PICTURE = TRIALS.with_name("paper.png")
FRESH_EPISODES = 1_000
ONE_ANT = frozenset({"es", "ns_es", "nsr_es", "ars"})
"""Methods with one seed on AntMaze and on AntTrap; all others have five."""


class Wanted(NamedTuple):
    """A run that is to have at least so many steps."""

    config: Path
    seed: int
    env_steps: int
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of its folder."""
        return folder_name(self.config, self.seed, self.settings)


def folder_name(config: Path, seed: int, settings: Sequence[str]) -> str:
    """Name of the folder of a run."""
    return "_".join([config.stem, str(seed), *settings]).replace("/", "_")


class NamedRun(Protocol):
    """A run that is wanted."""

    @property
    def name(self) -> str:
        """Of its folder."""
        ...


WantedRun = TypeVar("WantedRun", bound=NamedRun)
Result = TypeVar("Result")


class Computed(NamedTuple):
    """What is kept of a run: its row in the table, and its curve."""

    row: dict[str, Any]
    curve: pd.DataFrame


def run_one(wanted: Wanted) -> Computed:
    """One run from its config, or from where it was interrupted."""
    limits = (f"budget.env_steps={wanted.env_steps}", "budget.generations=null", f"seed={wanted.seed}")
    chosen = ("compute.engine=inline", "compute.workers=1", *wanted.settings, *limits)
    config, folder = api.load_config(wanted.config, chosen), RUNS / wanted.name
    code = commit()  # a commit that is made meanwhile is not the one that computes
    try:
        with workers_in_this_process():
            api.run_or_resume(config, folder)
    except Interrupted:
        if (api.open_run(folder).generation or 0) < 1:
            raise
    run = api.open_run(folder)
    task, history = run.config["task"]["environment"], run.history
    last, measured = history.iloc[-1], (task, run.evaluations, history)
    row = {
        "task": task,
        "method": run.config["search"]["algorithm"],
        "seed": wanted.seed,
        **({} if wanted.config.parent == CONFIGS else {"settings": " ".join([wanted.config.stem, *wanted.settings])}),
        "env_steps": int(last.env_steps),
        "finished": bool(last.env_steps >= wanted.env_steps),
        "generations": int(history.index[-1]),
        "seconds": round(float(last.wall_clock_s)),
        **readings(*measured),
        "fresh": fresh_fitness(run),
        "cells": int(last.map_cells),
        "cpu": cpu_kind(),
        "digest": run.digest()[:16],
        "commit": code,
    }
    return Computed(row, curve(*measured))


def fresh_fitness(run: Run) -> float | None:
    """Mean fitness of the run's best centre in fresh episodes, which did not choose it; None for a measure of distance.

    The best centre is that of the reading `centre`: the one with the highest mean over its evaluation episodes.
    """
    if run.config["task"]["environment"] in DISTANCE_TASKS:
        return None
    chosen = evaluation.candidates(run, best=True, centre=False, cells=(), every=False)
    [result] = evaluation.evaluate(run, chosen, FRESH_EPISODES, workers=1)
    return round(result.mean, 2)


def commit() -> str:
    """The commit whose files compute, marked if they differ from it."""
    git = ("git", "-C", str(ROOT))
    head = subprocess.run([*git, "rev-parse", "--short=10", "HEAD"], check=True, capture_output=True, text=True).stdout
    files = ("es_service", "workers", "configs")
    changed = subprocess.run([*git, "status", "--porcelain", "--", *files], check=True, capture_output=True).stdout
    return head.strip() + ("+" if changed else "")


def seeds_of_table(task: str, method: str) -> range:
    """Seeds of a row of the tables."""
    return range(1 if task != "point_maze" and method in ONE_ANT else 5)


def missing(wanted: list[Wanted], table: pd.DataFrame, curves: pd.DataFrame) -> list[Wanted]:
    """Those without a curve, or a row that has as many steps; the longest first, so that the cores end together."""
    drawn = {(f"{row.task}_{row.method}", row.seed) for row in curves[list(paper_tables.RUN)].itertuples()}
    steps = {(f"{row.task}_{row.method}", row.seed): row.env_steps for row in table.itertuples()}
    known = {run: steps[run] for run in steps.keys() & drawn}
    left = [
        wanted_run
        for wanted_run in wanted
        if known.get((wanted_run.config.stem, wanted_run.seed), 0) < wanted_run.env_steps
    ]
    return sorted(
        left,
        key=lambda wanted_run: (-wanted_run.env_steps, wanted_run.config.stem.startswith("point"), wanted_run.seed),
    )


def compute(
    wanted: Sequence[WantedRun], run: Callable[[WantedRun], Result], keep: Callable[[Result], bool], folder: Path
) -> None:
    """Compute runs in `folder`, one per core at a time, and `keep` what is kept of each as soon as it is there.

    `run` gives that, and `keep` says whether the run is finished, so that its folder can go.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cleaned = worker_environment(os.environ)
    os.environ.clear()
    os.environ.update(cleaned)  # the processes below import JAX with it
    left, running, stopped = list(wanted), dict[Future, WantedRun](), False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGINT, stop)  # Ctrl-C reaches the runs, too, which end after their generation
    with ProcessPoolExecutor(cores(), mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        while running or (left and not stopped):
            while left and not stopped and len(running) < cores():  # the pool gets no run that would have to wait
                wanted_run = left.pop(0)
                running[pool.submit(run, wanted_run)] = wanted_run
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                wanted_run = running.pop(future)
                if isinstance(future.exception(), Interrupted):
                    continue
                if keep(future.result()):
                    shutil.rmtree(folder / wanted_run.name)


def keep_run(run: Computed) -> bool:
    """Put a run's curve and its row into the csv files, in the place of older ones, and write the tables. One that was
    interrupted takes the place of no longer one."""
    print(json.dumps(run.row), flush=True)
    of_run = {key: run.row[key] for key in paper_tables.RUN}
    known = paper_tables.read()
    if (known[(known[list(of_run)] == pd.Series(of_run)).all(axis="columns")].env_steps > run.row["env_steps"]).any():
        return run.row["finished"]
    paper_tables.write_curves(paper_tables.with_run(paper_tables.read_curves(), of_run, run.curve.assign(**of_run)))
    paper_tables.write(paper_tables.with_run(paper_tables.read(), of_run, pd.DataFrame([run.row])))
    return run.row["finished"]


def keep_trial(run: Computed) -> bool:
    """Add the row of a trial to their table, whose first rows have other columns."""
    print(json.dumps(run.row), flush=True)
    before = [pd.read_csv(TRIALS)] if TRIALS.exists() else []
    pd.concat([*before, pd.DataFrame([run.row])]).to_csv(TRIALS, index=False, lineterminator="\n")
    return run.row["finished"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=list(paper_tables.TASKS), choices=paper_tables.TASKS)
    parser.add_argument("--method", nargs="+", default=list(paper_tables.METHODS), choices=paper_tables.METHODS)
    parser.add_argument("--seeds", metavar="A:B", help="in the place of those of the tables")
    parser.add_argument("--env-steps", type=lambda text: int(float(text.replace("_", ""))))
    parser.add_argument("--config", type=Path, help="a trial: a config of your own, which needs --seeds, --env-steps")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="settings of a trial")
    arguments = parser.parse_args()
    seeds = None if arguments.seeds is None else seeds_of(arguments.seeds)
    if arguments.config is not None:
        if seeds is None or arguments.env_steps is None:
            parser.error("--config needs --seeds and --env-steps")
        settings = tuple(arguments.set)
        compute(
            [Wanted(arguments.config, seed, arguments.env_steps, settings) for seed in seeds], run_one, keep_trial, RUNS
        )
        return
    if arguments.set:
        parser.error("--set needs --config")
    wanted = [
        Wanted(config, seed, arguments.env_steps or api.load_config(config).budget.env_steps)
        for task in arguments.task
        for method in arguments.method
        for config in [CONFIGS / f"{task}_{method}.yaml"]
        for seed in seeds or seeds_of_table(task, method)
    ]
    compute(missing(wanted, paper_tables.read(), paper_tables.read_curves()), run_one, keep_run, RUNS)
    paper_tables.write(paper_tables.read())
    paper_picture.draw(paper_tables.read_curves(), PICTURE)


if __name__ == "__main__":
    main()
