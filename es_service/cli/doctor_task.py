"""The checks of `es-service doctor TASK`: what a task is, whether it repeats itself, and how fast its code steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from es_service.config.tasks import TASKS
from es_service.config.text import did_you_mean_task, one_of
from es_service.dispatch.cluster_findings import Finding
from es_service.errors import ConfigError, counted
from es_service.protocol.messages import UNBOUNDED, TaskSpec
from es_service.runs.repeating import compared, examined

SECONDS = 1.0
"""Duration of the measurement."""
NEW_OBJECTS = "new_objects"
"""Setting of `settings_of_description`."""
FAR_FROM_C = 1e-3
"""Relative error of velocities after one control step above which the physics is another one."""


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
    for rollout, why in task.unsupported.items():
        yield "note", f"{rollout} cannot compute it, so compute.rollout: auto is another: {why}"
    if task.kind == "jax":
        yield "ok", "its steps are pure functions that JAX traces, so they repeat; `bench rollouts` measures them"
        if ":" not in name:  # a shipped task, which tests check
            return
    answers = [examined(name, {}, SECONDS) for _ in range(1 if task.kind == "jax" else 2)]
    for answer in answers:
        if problem := answer.get("problem"):
            yield "FAIL", f"{name}: {problem}"
            return
        if fault := answer["fault"]:
            yield "FAIL", f"{name}: an episode of a random policy is invalid {fault}"
            return
    if task.kind == "jax":
        yield "ok", "the observations and rewards of episodes of random policies are finite"
        yield from step_findings(task, answers[0]["step"])
        return
    first, second = answers
    tried, other = compared(first, second)
    if other:
        yield (
            "note",
            f"it does not repeat: with the same seed and actions it returns other numbers {' and '.join(other)}, so "
            "neither does a run: other workers and a resume find other numbers, and `verify` says that it cannot judge",
        )
        if task.kind == "python":
            yield from _with_new_objects(name)
    else:
        yield "ok", f"it repeats bit for bit with the same seed and actions: {', '.join(tried)}"
    unit = "calls" if task.kind == "function" else "steps"
    rate, memory = max(result["steps_per_second"] for result in (first, second)), first["peak_mib"]
    yield "ok", f"{rate:,.0f} {unit}/s on one core without a policy; its process takes {memory:,} MiB"


def _with_new_objects(name: str) -> Iterator[Finding]:
    """Whether a task repeats itself if each episode has a new object."""
    answers = [examined(name, {NEW_OBJECTS: True}, SECONDS) for _ in range(2)]
    if any("problem" in answer for answer in answers) or compared(*answers)[1]:
        yield "note", "nor does it repeat if each episode has a new object"
        return
    rate = max(answer["steps_per_second"] for answer in answers)
    yield (
        "note",
        "its objects carry something over from one episode to the next. With task.new_object_each_episode=true each "
        f"episode has a new object, and it repeats bit for bit, at {rate:,.0f} steps/s on one core",
    )


def step_findings(task: TaskSpec, cost: Mapping[str, Any]) -> Iterator[Finding]:
    """What a control step of a task in JAX costs, where its descriptor goes, and how far it is from C MuJoCo."""
    code = "computed by XLA"
    if cost["operations"]:
        code = f"compiled to {cost['operations']:,} operations and {cost['code_bytes'] / 1000:,.0f} kB of code"
    yield "ok", f"a control step is {code}: {cost['steps_per_second']:,.0f} a second on one core without a policy"
    ranges = zip(task.descriptor_names, task.descriptor_bounds, cost["lowest_B"], cost["greatest_B"], strict=True)
    for name, (low, high), least, greatest in ranges:
        if least < low or greatest > high:
            yield (
                "note",
                f"with random actions, its descriptor {name} was in [{least:.3g}, {greatest:.3g}], beyond its bounds "
                f"[{low:g}, {high:g}]; wider bounds of the task, or map.bounds, keep such places apart in a map",
            )
    if error := cost["from_c"]:
        yield (
            "ok" if error["p99"] <= max(FAR_FROM_C, 8.0 * error["ulp_p99"]) else "note",
            f"after one control step from {error['states']} states of random actions ({error['contacts']} in contact), "
            f"velocities differ from those of C MuJoCo by {error['p99']:.1e} of the greatest (99 %), by "
            f"{error['max']:.1e} at most; C MuJoCo's own by {error['ulp_p99']:.1e} (99 %) if its state moves by one "
            "float32 ulp",
        )


def _what(task: TaskSpec) -> str:
    if task.parameters is not None:
        return f"{task.name}: {task.summary or 'a function'}; parameters {', '.join(task.parameters.names)}"
    actions = "actions to choose from" if task.discrete_actions else "numbers in an action"
    return (
        f"{task.name}: {task.summary or 'a task'}; {task.observation_size} numbers in an observation, "
        f"{task.action_size} {actions}, {counted(task.episode_steps, 'step')}"
    )
