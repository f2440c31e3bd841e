"""`es-service bench rollouts`: how many environment steps a second this machine makes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from es_service.config.resolution import did_you_mean, one_of
from es_service.errors import ConfigError, EvaluationError
from es_service.tasks import Tasks, child_environment
from workers.environments import TASKS

BATCHES = {"point_maze": (64,)}
ANT_BATCHES = (8, 16, 64)
PAPER = {"point_maze": 1_520_000, "ant_maze": 4_480, "ant_trap": 7_470}
"""Steps a second on one CPU, without a policy (Chalumeau et al. 2022): other physics, another machine."""
HIDDEN = {"point_maze": [64, 64]}
ANT_HIDDEN = [256, 256]


def bench_rollouts(
    tasks: Sequence[str] = (),
    *,
    policies: Sequence[bool] = (False, True),
    batches: Sequence[int] = (),
    seconds: float = 3.0,
) -> Iterator[dict[str, Any]]:
    """One row per task, with and without policy, batch, and on one core and on all: as each is measured.

    The hidden layers are the paper's: 64x64 for PointMaze, else 256x256. Each core has a process like a worker's; rates
    on several, measured side by side, are added.

    Raises:
        ConfigError: a task cannot be had. EvaluationError: it cannot be run.
    """
    known = Tasks()
    for task in tasks:
        if task not in known:
            raise ConfigError(
                f"--task {task}: no known task; must be {one_of(known)}, or brax:NAME, or module:Class"
                f"{did_you_mean(task, known)}"
            )
    every = sorted({1, len(os.sched_getaffinity(0))})
    for task in tasks or TASKS:
        for policy in policies:
            for batch in batches or BATCHES.get(task, ANT_BATCHES):
                arguments = {
                    "task": task,
                    "options": {},
                    "hidden": HIDDEN.get(task, ANT_HIDDEN),
                    "policy": policy,
                    "batch": batch,
                    "seconds": seconds,
                }
                for cores in every:
                    yield _row(arguments, cores)


def _row(arguments: Mapping[str, Any], cores: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "workers.measure", json.dumps(arguments)]
    environment = child_environment()
    started = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(cores)
    ]
    found = []
    for process in started:
        printed, errors = process.communicate()
        if process.returncode:
            raise EvaluationError(f"{arguments['task']} cannot be measured:\n{errors.strip()}")
        found.append(json.loads(printed.splitlines()[-1]))
    return {
        "task": arguments["task"],
        "rollout": "xla",
        "policy": "on" if arguments["policy"] else "off",
        "batch": arguments["batch"],
        "cores": cores,
        "steps_per_second": sum(one["steps_per_second"] for one in found),
        "compile_seconds": max(one["compile_seconds"] for one in found),
        "peak_mib": max(one["peak_mib"] for one in found),
    }


HEADER = (
    f"{'task':<12}{'policy':<8}{'batch':>6}{'cores':>7}{'steps/s':>12}{'compile s':>11}{'peak MiB':>10}{'paper':>12}"
)


def line(row: Mapping[str, Any]) -> str:
    """A row under HEADER, with the paper's rate where that is comparable."""
    comparable = row["policy"] == "off" and row["cores"] == 1 and row["task"] in PAPER
    paper = f"{PAPER[row['task']]:,}" if comparable else ""
    return (
        f"{row['task']:<12}{row['policy']:<8}{row['batch']:>6}{row['cores']:>7}{row['steps_per_second']:>12,}"
        f"{row['compile_seconds']:>11}{row['peak_mib']:>10}{paper:>12}"
    )
