"""How fast are QDax, MuJoCo, gymnasium, EnvPool and evosax on the same cores, by turns with es-service?

    python -m tests.benchmarks.peers --build                # once: an environment for each of them, below runs/peers
    python -m tests.benchmarks.peers --rounds 5             # half an hour on two cores, on which nothing else computes

Each measurement has a process of its own. Before the rounds, QDax's rollouts choose the batch with which they are
fastest (round 0). Every measurement is a row of results/peers.csv, where it takes the place of those of the same
comparison on the same kind of processor; printed are medians, and how many times as fast es-service is.
`peers_theirs` measures the others, by their public interfaces; `peers_environments` has their pins.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pandas as pd

from es_service import api
from es_service.cli.bench import bench_rollouts
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.protocol.machine import cores, cpu_kind, platform_info
from es_service.protocol.process_environment import same_imports
from tests.benchmarks import vector_env
from tests.benchmarks.peers_environments import NAMED, THEIRS, asked, build, python_of, their_versions, there_are
from tests.benchmarks.rollouts_per_second import ANT_STEPS, config_of, measure
from tests.helpers import centre
from workers.environments.ant import SUBSTEPS
from workers.environments.ant_tasks import STEP_S
from workers.policy import initial_parameters

ROOT = Path(__file__).parents[2]
RESULTS = Path(__file__).parent / "results" / "peers.csv"
OURS = "es-service"


class Comparison(NamedTuple):
    """What one of the others and es-service do, and the column that is compared."""

    what: str
    program: str
    theirs: Mapping[str, Any]
    ours: Mapping[str, Any]
    column: str
    batches: tuple[int, ...] = ()
    """Sizes of which theirs takes the fastest."""


def _rollouts(task: str, theirs: str, steps: int, hidden: int, batches: tuple[int, ...]) -> Comparison:
    request = {"kind": "qdax rollouts", "task": theirs, "steps": steps, "hidden": hidden}
    ours = {"kind": "rollouts", "task": task}
    return Comparison(f"{task}: rollouts", "qdax", request, ours, "env_steps_per_second", batches)


def _me_es(pairs: int, generations: int) -> Comparison:
    sizes = {"pairs": pairs, "generations": generations}
    theirs = {"kind": "qdax me_es", "cells": [20, 20], **sizes}
    ours = {"kind": "search", "algorithm": "me_es", "sizes": {"pairs": pairs}, "generations": generations}
    return Comparison(f"point_maze: ME-ES, {pairs} pairs", "qdax", theirs, ours, "ms_per_generation")


def _map_elites(batch: int, generations: int) -> Comparison:
    theirs = {"kind": "qdax map_elites", "cells": [20, 20], "batch": batch, "generations": generations}
    ours = {"kind": "search", "algorithm": "map_elites", "sizes": {"batch": batch}, "generations": generations}
    return Comparison(f"point_maze: MAP-Elites, batch {batch}", "qdax", theirs, ours, "ms_per_generation")


def _physics(integrator: str) -> Comparison:
    theirs = {"kind": "mujoco ant", "integrator": integrator, "cores": cores(), "batch": 64, "control_steps": 200}
    what = f"ant: physics, {integrator} of MuJoCo"
    return Comparison(what, "mujoco", theirs, {"kind": "physics"}, "simulated_s_per_second")


def _environments(what: str, program: str, theirs: Mapping[str, Any], threads: int) -> Comparison:
    """AntTrap as a vector environment beside MuJoCo's ant."""
    ours = {"kind": "environments", "count": 64, "threads": threads}
    return Comparison(f"AntTrap's VectorEnv: {what}", program, theirs, ours, "env_steps_per_second")


_ROLLOUT = {"kind": "mujoco ant", "integrator": "RK4", "cores": cores(), "batch": 64, "control_steps": 200}
COMPARISONS = (
    _rollouts("ant_maze", "antmaze", ANT_STEPS, 256, (8, 32, 128)),
    _rollouts("ant_trap", "anttrap", ANT_STEPS, 256, (8, 32, 128)),
    _rollouts("point_maze", "pointmaze", 200, 64, (4, 16, 64)),
    _me_es(64, 400),
    _me_es(512, 50),
    _map_elites(64, 400),
    _map_elites(256, 150),
    _physics("RK4"),
    _physics("EULER"),
    _environments("Ant-v5, sync", "mujoco", {"kind": "gymnasium steps", "mode": "sync", "count": 16}, 1),
    _environments("Ant-v5, async", "mujoco", {"kind": "gymnasium steps", "mode": "async", "count": cores()}, cores()),
    _environments("mujoco.rollout", "mujoco", _ROLLOUT, cores()),
    _environments("EnvPool", "envpool", {"kind": "envpool steps", "cores": cores(), "count": 64}, cores()),
    Comparison(
        "point_maze: ES without episodes, 64 pairs",
        "evosax",
        {"kind": "evosax es", "pairs": 64, "parameters": 4482, "generations": 200},
        {"kind": "search", "algorithm": "es", "sizes": {"pairs": 64}, "generations": 400, "whole": False},
        "ms_per_generation",
    ),
)
COLUMNS = (
    *("round", "program", "what", "env_steps_per_second", "simulated_s_per_second", "physics_steps_per_second"),
    *("ms_per_generation", "settings", "cpu", "versions"),
)
RATES = COLUMNS[3:7]


def our_rollouts(task: str, seconds: float) -> dict[str, Any]:
    """Environment steps per second of whole populations, with all cores; what is compiled is so before."""
    config = config_of(task)
    spec = replace(worker_spec(config, task_of(config)), rollout="simd")
    start_D = initial_parameters(spec.policy, "unit_columns", 0)
    point = centre(start_D, sigma=0.02, observation_size=spec.policy.widths[0])
    with inline_engine(spec, Limits(cores())) as engine:
        chunks = config.search.pairs // spec.chunk_pairs
        measure(engine, point, chunks, 0.1)  # compiles
        rate = measure(engine, point, chunks, seconds)
    ant = task != "point_maze"
    return {
        "env_steps_per_second": rate,
        "physics_steps_per_second": rate * SUBSTEPS if ant else None,
        "simulated_s_per_second": rate * STEP_S if ant else None,
        "settings": f"{cores()} workers, {config.search.pairs} pairs",
    }


def our_physics(seconds: float) -> dict[str, Any]:
    """Steps per second of Brax's ant without a policy, whose control step is as long as that of the mazes' ants."""
    rows = bench_rollouts(["brax:ant"], policies=[False], rollouts=["simd"], batches=[64], seconds=seconds)
    rate = next(row["steps_per_second"] for row in rows if row["cores"] == cores())
    return {
        "env_steps_per_second": rate,
        "physics_steps_per_second": rate * SUBSTEPS,
        "simulated_s_per_second": rate * STEP_S,
        "settings": f"{cores()} processes, batch 64, spring, steps of {STEP_S / SUBSTEPS} s",
    }


def our_search(algorithm: str, sizes: Mapping[str, int], generations: int, whole: bool = True) -> dict[str, Any]:
    """Milliseconds per generation of a run on PointMaze, one evaluation episode; the first ten do not count.

    Args:
        sizes: keys of `search` that say how many policies or pairs a generation has.
        whole: everything between two generations by the clock, the store too; else only the gradient and the driver.
    """
    config = api.load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [64, 64]},
            "search": {"algorithm": algorithm, "evaluation_episodes": 1, **sizes},
            "budget": {"generations": 10 + generations},
            "compute": {"workers": cores(), "engine": "inline"},
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        history = api.run(config, Path(folder) / "run").run.history
    counted = history.iloc[10:]
    taken = float(history["wall_clock_s"].iloc[-1] - history["wall_clock_s"].iloc[9])
    if not whole:
        seconds = counted["seconds_gradient"] + counted["seconds_driver"]
        return {"ms_per_generation": 1000 * float(seconds.mean()), "settings": "gradient and driver"}
    return {
        "env_steps_per_second": float(counted["env_steps"].iloc[-1] - history["env_steps"].iloc[9]) / taken,
        "ms_per_generation": 1000 * taken / generations,
        "settings": f"{sizes}, {generations} generations, {cores()} workers",
    }


def our_environments(count: int, threads: int, seconds: float) -> dict[str, Any]:
    """Steps per second of AntTrap as a vector environment of Gymnasium, with random actions."""
    with closing(gymnasium.make_vec(f"{vector_env.OURS}AntTrap-v0", num_envs=count, threads=threads)) as envs:
        rate = vector_env.steps_per_second(envs, seconds)
    return {
        "env_steps_per_second": rate,
        "physics_steps_per_second": rate * SUBSTEPS,
        "simulated_s_per_second": rate * STEP_S,
        "settings": f"{threads} threads, {count} environments",
    }


KINDS = {"rollouts": our_rollouts, "physics": our_physics, "search": our_search, "environments": our_environments}


def take_turns(folder: Path, rounds: int, seconds: float, chosen: Sequence[Comparison], to: Path) -> list[dict]:
    """Rows of all measurements, written to a table after each."""
    programs = [name for name in dict.fromkeys(choice.program for choice in chosen) if there_are(folder, name)]
    chosen = [choice for choice in chosen if choice.program in programs]
    named = {name: their_versions(folder, name) for name in programs}
    theirs = {name: ", ".join(f"{key} {version_of[key]}" for key in NAMED[name]) for name, version_of in named.items()}
    ours = f"{OURS} {platform_info()['es-service']}, jax {platform_info()['jax']}"
    kept = pd.read_csv(to) if to.exists() else pd.DataFrame(columns=list(COLUMNS))
    kept = kept[(kept["cpu"] != cpu_kind()) | ~kept["what"].isin([choice.what for choice in chosen])]
    rows: list[dict[str, Any]] = []

    def measured(number: int, comparison: Comparison, program: str, request: Mapping[str, Any]) -> dict[str, Any]:
        if program == OURS:
            result = asked([sys.executable, "-m", "tests.benchmarks.peers", "--measure"], request, **same_imports())
        else:
            result = asked([python_of(folder, program), "-I", THEIRS], request)
        versions = ours if program == OURS else theirs[program]
        row = {"round": number, "program": program, "what": comparison.what, **result}
        rows.append(row | {"cpu": cpu_kind(), "versions": versions})
        tables = [table for table in (kept, pd.DataFrame(rows, columns=list(COLUMNS))) if len(table)]
        pd.concat(tables).to_csv(to, index=False, float_format="%.6g", lineterminator="\n")
        print(json.dumps(row), flush=True)
        return row

    def timed(request: Mapping[str, Any]) -> dict[str, Any]:
        return {**request} if "generations" in request else {**request, "seconds": seconds}

    requests = []
    for choice in chosen:
        request = timed(choice.theirs)
        if choice.batches:
            tried = [request | {"batch": batch} for batch in choice.batches]
            request = max(tried, key=lambda asking: measured(0, choice, choice.program, asking)["env_steps_per_second"])
        requests.append((choice, request))
    for number in range(1, rounds + 1):
        for choice, request in requests:
            sides = [(choice.program, request), (OURS, timed(choice.ours))]
            for program, asking in sides if number % 2 else sides[::-1]:
                measured(number, choice, program, asking)
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Medians over the rounds, and by the column that is compared how many times as fast es-service is."""
    table = pd.DataFrame(rows, columns=list(COLUMNS)).query("round > 0")
    median = table.assign(ours=table["program"] == OURS).groupby(["what", "ours"])[list(RATES)].median()
    lines = [f"{'what':<44}{'column':<26}{'theirs':>14}{'ours':>14}{'times as fast':>15}"]
    for comparison in COMPARISONS:
        for column in RATES if comparison.what in median.index else ():
            theirs, ours = median[column][comparison.what, False], median[column][comparison.what, True]
            ratio = theirs / ours if column == "ms_per_generation" else ours / theirs
            times = f"{ratio:.2f}" if column == comparison.column else ""
            if not np.isnan([theirs, ours]).any():
                lines.append(f"{comparison.what:<44}{column:<26}{theirs:>14,.1f}{ours:>14,.1f}{times:>15}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--build", action="store_true", help="make the environments, and measure nothing")
    parser.add_argument("--environments", type=Path, default=ROOT / "runs" / "peers", help="folder of the environments")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a measurement that has no other length")
    parser.add_argument("--only", default="", help="compare only what has this text in its name")
    parser.add_argument("--results", type=Path, default=RESULTS, help="the table that is written")
    parser.add_argument("--measure", type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    folder = arguments.environments.absolute()
    if arguments.measure:
        print(json.dumps(KINDS[arguments.measure.pop("kind")](**arguments.measure)))
    elif arguments.build:
        build(folder)
    else:
        chosen = [comparison for comparison in COMPARISONS if arguments.only in comparison.what]
        if not chosen:
            names = "; ".join(comparison.what for comparison in COMPARISONS)
            parser.error(f"--only {arguments.only!r}: no comparison has this in its name; there are: {names}")
        print(summary(take_turns(folder, arguments.rounds, arguments.seconds, chosen, arguments.results)))


if __name__ == "__main__":
    main()
