"""How fast are Gymnasium's MuJoCo tasks beside what else computes them, and how far are fewer iterations from C MuJoCo?

    python -m tests.benchmarks.peers --build                       # once: EnvPool's environment, below runs/peers
    python -m tests.benchmarks.mujoco_tasks [--tasks Ant-v5 ...]   # a row for each task, into results/mujoco_tasks.csv
    python -m tests.benchmarks.mujoco_tasks --iterations 1 2 4 8   # into results/mujoco_iterations.csv
    python -m tests.benchmarks.mujoco_tasks --table                # both tables, for the guides

Rates are control steps a second of one core by turns, in processor time: of the functions by which `bench rollouts`
measures `mujoco:ID` with simd and `gymnasium:ID` with host, both with random actions, resets, observations, rewards and
ends; of `mujoco.rollout`, which has physics only; and of EnvPool with one thread, in a process of its own, which is
left out where it cannot be imported.

Errors are those of the velocities after one control step, relative to the greatest of them, from 1,000 states of robots
that fall, are pushed, touch or are at limits, against C MuJoCo with the settings of Gymnasium's file.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service.protocol.machine import cpu_kind, platform_info
from tests import mujoco_models as models
from tests.benchmarks.mujoco import HORIZON, WORLDS, _c_rollout
from tests.benchmarks.peers import ROOT
from tests.benchmarks.peers_environments import THEIRS, asked, python_of, there_are
from workers.environments import describe_environment, mujoco_gym, mujoco_parts
from workers.environments.mujoco_gym_tasks import TASKS
from workers.rollouts import BACKENDS
from workers.simd.episodes.kernel import compile_kernel

RESULTS = Path(__file__).parent / "results"
RATES, ITERATIONS = RESULTS / "mujoco_tasks.csv", RESULTS / "mujoco_iterations.csv"
STEPS, SECONDS, STATES = 50, 0.5, 1000
BATCHES = {"simd": 128, "host": 16, "envpool": 16}
"""Environments side by side."""
SIDES = {"host": "`gymnasium:ID`, host", "rollout": "`mujoco.rollout`", "envpool": "EnvPool"}
Steps = Callable[[int], float]
"""Function from a number to how many control steps it did."""


def rate(call: Steps) -> float:
    """Control steps a second of processor time."""
    started, steps, calls = time.process_time(), 0.0, 0
    while (taken := time.process_time() - started) < SECONDS:
        steps, calls = steps + call(calls), calls + 1
    return steps / taken


def ours(name: str, prefix: str, rollout: str) -> Callable[[], float]:
    task = describe_environment(f"{prefix}:{name}")
    call = BACKENDS[rollout].random_steps(task, {}, BATCHES[rollout], STEPS)
    call(0)
    return lambda: rate(call)


def by_rollout(name: str) -> Callable[[], float]:
    model, substeps = mujoco_gym.load(TASKS[name]), TASKS[name].frame_skip
    call = _c_rollout(models, model, substeps, models.c_states(model, substeps, 512, seed=1))

    def steps(_: int) -> int:
        call()
        return WORLDS * HORIZON

    steps(0)
    return lambda: rate(steps)


def by_envpool(name: str, folder: Path) -> Callable[[], float]:
    request = {"kind": "envpool steps", "task": name, "cores": 1, "count": BATCHES["envpool"], "seconds": SECONDS}
    command = [python_of(folder, "envpool"), "-I", THEIRS]
    return lambda: asked(command, request | {"of_processor": True})["env_steps_per_second"]


def measured(name: str, rounds: int, folder: Path | None) -> dict[str, Any]:
    """A row of the table of rates.

    Args:
        folder: where EnvPool's environment is; None leaves it out.
    """
    sides = {
        "simd": ours(name, "mujoco", "simd"),
        "host": ours(name, "gymnasium", "host"),
        "rollout": by_rollout(name),
    } | ({"envpool": by_envpool(name, folder)} if folder else {})
    found: dict[str, list[float]] = {side: [] for side in sides}
    for number in range(rounds):
        for side in list(sides)[:: 1 if number % 2 else -1]:
            found[side].append(sides[side]())
    row: dict[str, Any] = {"task": name, "rounds": rounds}
    row |= {side: statistics.median(rates) for side, rates in found.items()}
    for side in list(sides)[1:]:
        times = [mine / its for mine, its in zip(found["simd"], found[side], strict=True)]
        row |= {f"times_{side}": statistics.median(times), f"least_{side}": min(times), f"most_{side}": max(times)}
    return row


def distances(name: str, iterations: int) -> dict[str, Any]:
    """A row of the table of iterations."""
    own, (model, mx, substeps, _) = mujoco_gym.load(TASKS[name]), mujoco_gym.build(name, None, iterations).simulated
    states = models.c_states(own, substeps, STATES)
    ctrl = models.random_ctrl(own, STATES, np.random.default_rng(0))
    with tempfile.TemporaryDirectory() as cache:
        kernel = compile_kernel(
            lambda state, ctrl: mujoco_parts.step(mx, state, ctrl, substeps),
            mujoco_parts.start(mx),
            np.zeros(model.nu, np.float32),
            folder=Path(cache),
        )
    truth = models.c_step(own, substeps, states, ctrl)
    moved = models.c_step(own, substeps, models.one_ulp(states), ctrl)
    use = truth.comparable()
    error, ulp = (models.relative_error(of.qvel, truth.qvel)[use] for of in (kernel(states, ctrl), moved))
    return {
        "task": name,
        "iterations": iterations,
        **models.quantiles(error),
        "beyond": float((error > 1e-4).mean()),
        "ulp_p99": models.quantiles(ulp)["p99"],
    }


def add(row: dict[str, Any], to: Path, same: Sequence[str]) -> None:
    """Append a row to a table, in place of the row that has the same values of some columns."""
    new = pd.DataFrame([row | {"cpu": cpu_kind(), "es-service": platform_info()["es-service"]}])
    if to.exists():
        old = pd.read_csv(to)
        old = old[~(old[[*same]] == new[[*same]].iloc[0]).all(axis=1)]
        new = pd.concat([old, new]) if len(old) else new
    new.to_csv(to, index=False, float_format="%.4g", lineterminator="\n")
    print(row, flush=True)


def table() -> str:
    """The tables of the guides."""
    lines = [f"| task | simd, control steps/s | {' | '.join(f'/ {side}' for side in SIDES.values())} |"]
    lines.append("|" + " --- |" * (2 + len(SIDES)))
    for row in pd.read_csv(RATES).sort_values("cpu", ascending=False, kind="stable").to_dict("records"):
        parts = [[row.get(f"{part}_{side}", np.nan) for part in ("times", "least", "most")] for side in SIDES]
        cells = ["-" if np.isnan(times[0]) else "{:.3g} ({:.3g} to {:.3g})".format(*times) for times in parts]
        title = f"{row['task']}, AVX2" if row["cpu"].endswith("avx2") else row["task"]
        lines.append(f"| {title} | {row['simd']:,.0f} | {' | '.join(cells)} |")
    found = pd.read_csv(ITERATIONS)
    numbers = sorted(set(found["iterations"]))
    lines += [
        "",
        f"| task | {' | '.join(map(str, numbers))} | C MuJoCo after one ulp |",
        "|" + " --- |" * (len(numbers) + 2),
    ]
    for name, rows in found.groupby("task", sort=False):
        of = rows.set_index("iterations")
        cells = [
            f"{of['p99'][k]:.1e}, {of['max'][k]:.1e}, {of['beyond'][k]:.1%}" if k in of.index else "-" for k in numbers
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {rows['ulp_p99'].iloc[-1]:.1e} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS, metavar="ID")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--iterations", nargs="+", type=int, help="compare these numbers with C MuJoCo, and no rates")
    parser.add_argument("--environments", type=Path, default=ROOT / "runs" / "peers", help="folder of EnvPool's")
    parser.add_argument("--table", action="store_true", help="print the tables of the guides, and measure nothing")
    given = parser.parse_args()
    if given.table:
        print(table())
        return
    folder = None if given.iterations else given.environments.absolute()
    folder = folder if folder and there_are(folder, "envpool") else None
    for name in given.tasks:
        for iterations in given.iterations or ():
            add(distances(name, iterations), ITERATIONS, ("task", "iterations"))
        if not given.iterations:
            add(measured(name, given.rounds, folder), RATES, ("task", "cpu"))


if __name__ == "__main__":
    main()
