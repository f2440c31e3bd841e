"""The checks of `es-service doctor TASK`: what a task is, whether it repeats itself, and how fast its code steps."""

from __future__ import annotations

from collections.abc import Iterator

from es_service.config.tasks import TASKS
from es_service.config.text import did_you_mean_task, one_of
from es_service.dispatch.cluster_findings import Finding
from es_service.errors import ConfigError, counted
from es_service.protocol.messages import UNBOUNDED, TaskSpec
from es_service.runs.repeating import compared, examined

SECONDS = 1.0
"""Duration of the measurement."""


def task_findings(name: str) -> Iterator[Finding]:
    """What is found about a task. Raises ConfigError if there is no such task, or it cannot be used."""
    try:
        task = TASKS[name]
    except KeyError:
        hint = did_you_mean_task(name, TASKS)
        raise ConfigError(
            f"{name} is not a known task; must be {one_of(TASKS)}, or the name of another{hint}",
            field="task.environment",
            value=name,
        ) from None
    yield "ok", _what(task)
    bounds = zip(task.descriptor_names, task.descriptor_bounds, strict=True)
    shown = [
        f"{dimension} without bounds" if pair == UNBOUNDED else f"{dimension} in [{pair[0]:g}, {pair[1]:g}]"
        for dimension, pair in bounds
    ]
    yield "ok", f"its descriptor is {', '.join(shown)}"
    for note in task.notes:
        yield "note", note
    for rollout, where in task.hidden.items():
        yield "FAIL", f"{where}; {rollout} computes 0 for such a product, so no run would notice"
    if task.kind == "jax":
        yield "ok", "its steps are pure functions that JAX traces, so they repeat; `bench rollouts` measures them"
        if ":" not in name:  # a shipped task, which tests check
            return
    answers = [examined(name, {}, SECONDS) for _ in range(1 if task.kind == "jax" else 2)]
    for answer in answers:
        if problem := answer.get("problem") or answer["fault"]:
            yield "FAIL", answer.get("problem") or f"an episode of a random policy is invalid {problem}"
            return
    if task.kind == "jax":
        yield "ok", "the observations and rewards of episodes of random policies are finite"
        return
    first, second = answers
    tried, other = compared(first, second)
    if other:
        yield (
            "note",
            f"it does not repeat: with the same seed and actions it returns other numbers {' and '.join(other)}, so "
            "neither does a run: other workers and a resume find other numbers, and `verify` says that it cannot judge",
        )
    else:
        yield "ok", f"it repeats bit for bit with the same seed and actions: {', '.join(tried)}"
    unit = "calls" if task.kind == "function" else "steps"
    rate, memory = max(result["steps_per_second"] for result in (first, second)), first["peak_mib"]
    yield "ok", f"{rate:,.0f} {unit}/s on one core without a policy; its process takes {memory:,} MiB"


def _what(task: TaskSpec) -> str:
    if task.parameters is not None:
        return f"{task.name}: {task.summary or 'a function'}; parameters {', '.join(task.parameters.names)}"
    actions = "actions to choose from" if task.discrete_actions else "numbers in an action"
    return (
        f"{task.name}: {task.summary or 'a task'}; {task.observation_size} numbers in an observation, "
        f"{task.action_size} {actions}, {counted(task.episode_steps, 'step')}"
    )
