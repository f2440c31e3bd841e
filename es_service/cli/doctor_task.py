"""The checks of `es-service doctor TASK`: what a task is, whether it repeats itself, and how fast its code steps."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from es_service.cli.doctor import Finding, print_findings
from es_service.config.problems import did_you_mean, one_of
from es_service.config.tasks import TASKS
from es_service.errors import ConfigError
from es_service.protocol.messages import UNBOUNDED, TaskSpec
from es_service.protocol.process_environment import child_environment

"""Level ("ok", "note" or "FAIL") and text of one finding."""
ALONE = "alone"
SECONDS = 1.0
"""Duration of the measurement."""
LONGEST_S = 600.0
"""Longest time of each of the two processes; functions may take long."""


def examine_task(name: str, *, as_json: bool = False) -> bool:
    """Print every finding about a task, at once or as JSON at the end, and return whether no check failed.

    Raises ConfigError if there is no such task, or it cannot be used.
    """
    return print_findings(_findings(name), as_json=as_json)


def _findings(name: str) -> Iterator[Finding]:
    try:
        task = TASKS[name]
    except KeyError:
        raise ConfigError(
            f"{name} is not a known task; must be {one_of(TASKS)}, or the name of another{did_you_mean(name, TASKS)}",
            field="task.environment",
            value=name,
        ) from None
    yield "ok", _what(task)
    bounds = zip(task.descriptor_names, task.descriptor_bounds, strict=True)
    shown = [
        f"{one} without bounds" if pair == UNBOUNDED else f"{one} in [{pair[0]:g}, {pair[1]:g}]" for one, pair in bounds
    ]
    yield "ok", f"its descriptor is {', '.join(shown)}"
    if task.kind == "jax":
        yield "ok", "its steps are pure functions that JAX traces, so they repeat; `bench rollouts` measures them"
        return
    first, second = _examined(name), _examined(name)
    for answer in (first, second):
        if "problem" in answer:
            yield "FAIL", answer["problem"]
            return
    same = {**first["hashes"], "in another process": second["hashes"][ALONE]}
    if other := [where for where, one in same.items() if one != same[ALONE]]:
        yield (
            "note",
            f"it does not repeat: with the same seed and actions it returns other numbers {' and '.join(other)}, so "
            "neither does a run: other workers, a resume and `verify` find other numbers",
        )
    else:
        where = ", ".join(one for one in same if one != ALONE)
        yield "ok", f"it repeats bit for bit with the same seed and actions: {where}"
    unit = "calls" if task.kind == "function" else "steps"
    rate, memory = max(one["steps_per_second"] for one in (first, second)), first["peak_mib"]
    yield "ok", f"{rate:,.0f} {unit}/s on one core without a policy; its process takes {memory:,} MiB"


def _what(task: TaskSpec) -> str:
    if task.parameters is not None:
        return f"{task.name}: {task.summary or 'a function'}; parameters {', '.join(task.parameters.names)}"
    actions = "actions to choose from" if task.discrete_actions else "numbers in an action"
    return (
        f"{task.name}: {task.summary or 'a task'}; {task.observation_size} numbers in an observation, "
        f"{task.action_size} {actions}, {task.episode_steps} steps"
    )


def _examined(name: str) -> dict[str, Any]:
    """What `workers.host.examine` finds in a process of its own."""
    command = [sys.executable, "-m", "workers.host.examine", name, "{}", str(SECONDS)]
    try:
        process = subprocess.run(
            command, env=child_environment(), capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired:
        return {"problem": f"it could not be examined within {LONGEST_S:g} s"}
    lines = process.stdout.splitlines()
    if process.returncode or not lines:
        return {"problem": f"its process ended with exit code {process.returncode}:\n{process.stderr.strip()[-2000:]}"}
    return json.loads(lines[-1])
