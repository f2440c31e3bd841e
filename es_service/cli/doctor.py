"""The checks of `es-service doctor`: whether this machine can run searches, and what their results depend on; and
of `doctor TASK`: what a task is, whether it repeats itself, and how fast its code steps.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from es_service.api import load_config
from es_service.cli.common import print_finding, print_json
from es_service.config.tasks import TASKS
from es_service.config.text import did_you_mean_task, one_of
from es_service.config.workload import worker_spec
from es_service.dispatch.cluster_findings import Finding
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import ConfigError, ServiceError, counted
from es_service.loop.state import no_observations, normalisation
from es_service.protocol.machine import cores, memory_bytes, platform_info
from es_service.protocol.messages import UNBOUNDED, Centre, EpisodesResult, TaskSpec, TrainingChunk
from es_service.protocol.noise import TEST_VECTORS, normal_integers, stream_keys
from es_service.runs.session import same_descriptor
from es_service.runs.signals import stop_on_signals
from es_service.runs.verification import compared, examined
from es_service.store.folder import is_network_filesystem
from workers.describe import MOST_STEPS, TRIED
from workers.policy import initial_parameters
from workers.simd.backend.target import NoVectorsError, host_target
from workers.simd.episodes.kernel import compile_kernel

MIN_FREE_BYTES = 1 << 30
MIN_MEMORY_BYTES = 2 << 30
SIGMA = 0.02
"""Standard deviation of the noise with which the speed is measured; it makes no difference."""


def findings() -> Iterator[Finding]:
    """What is found on this machine, check by check."""
    for check in (_software, _ray, _machine, _vectors, _disk, _noise, _rollout):
        yield from _guarded(check)


def print_findings(findings: Iterable[Finding], *, as_json: bool) -> bool:
    """Print each finding when it is there, or all as JSON at the end; return whether no check failed."""
    listed: list[Finding] = []
    for level, text in findings:
        listed.append((level, text))
        if not as_json:
            print_finding(level, text)
    if as_json:
        print_json([{"level": level, "text": text} for level, text in listed])
    return all(level != "FAIL" for level, _ in listed)


def _guarded(check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from check()
    except (OSError, ServiceError) as error:
        yield "FAIL", f"{check.__name__.strip('_')}: {error}"


def _software() -> Iterator[Finding]:
    versions = platform_info()
    cpu = versions.pop("cpu")
    yield "ok", ", ".join(f"{name} {version}" for name, version in versions.items())
    yield "ok", f"processor {cpu}: results repeat bit for bit on this kind of processor with these versions"
    yield "ok", f"SQLite {sqlite3.sqlite_version}, {sys.platform}"


def _ray() -> Iterator[Finding]:
    try:
        version = metadata.version("ray")
    except metadata.PackageNotFoundError:
        yield "note", "Ray is not installed: only --engine inline runs here"
        return
    jobs = "installed" if find_spec("aiohttp") else "not installed"
    yield "ok", f"ray {version}; the extra `cluster`, which Ray's dashboard and `submit` need, is {jobs}"


def _machine() -> Iterator[Finding]:
    usable, present = cores(), os.cpu_count() or 1
    yield "ok", f"{usable} of {counted(present, 'core')} can be used; by default, each runs one worker"
    memory, is_free = memory_bytes()
    level = "ok" if memory >= MIN_MEMORY_BYTES else "note"
    yield level, f"{memory / 2**30:.1f} GiB of memory {'free' if is_free else 'in all'}"


def _vectors() -> Iterator[Finding]:
    """Check that simd supports this processor, by compiling and running a small kernel."""
    try:
        target = host_target()
    except NoVectorsError as error:
        yield "note", f"simd: {error}; rollouts run on xla"
        return
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        kernel = compile_kernel(lambda x: x * x + 1.0, np.zeros((), np.float32), folder=Path(folder))
    result = kernel(np.arange(100, dtype=np.float32))
    if not np.array_equal(result, np.arange(100, dtype=np.float32) ** 2 + 1):
        yield "FAIL", f"simd ({target.describe()}): a compiled kernel gives wrong numbers"
        return
    yield "ok", f"simd: {target.describe()}; a kernel compiles and runs in {time.perf_counter() - started:.2f} s"


def _disk() -> Iterator[Finding]:
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    yield ("ok" if free >= MIN_FREE_BYTES else "note"), f"{free / 2**30:.1f} GiB free under {here}"
    if not os.access(here, os.W_OK):
        yield "FAIL", f"{here} is not writable; run elsewhere or name a folder with --out"
    if is_network_filesystem(here):
        yield "note", f"{here} is on a network file system: runs work there, with a slower journal"


def _noise() -> Iterator[Finding]:
    for (seed, domain, generation, ids), expected in TEST_VECTORS:
        key = stream_keys(seed, domain, generation, *ids)
        noise = normal_integers(np, key, np.arange(len(expected), dtype=np.uint32))
        if noise.tolist() != list(expected):
            yield "FAIL", f"noise of stream {(seed, domain, generation, *ids)} is {noise.tolist()}; expected {expected}"
            return
    yield "ok", f"noise equals its {len(TEST_VECTORS)} test vectors"


def _rollout() -> Iterator[Finding]:
    """Start one worker as a run would, and measure its speed briefly."""
    config = load_config({"task": {"environment": "point_maze"}}, searches=False)
    task = TASKS["point_maze"]
    spec = worker_spec(config, task)
    mean_O, std_O = normalisation(no_observations(task.observation_size), enabled=False)
    centre = Centre(0, initial_parameters(spec.policy, config.policy.init, 0), SIGMA, mean_O, std_O)
    started = time.perf_counter()
    with stop_on_signals() as should_stop, inline_engine(spec, Limits(workers=1), should_stop) as engine:
        engine.evaluate([(centre, TrainingChunk(0, 0))])
        ready = time.perf_counter()
        results = engine.evaluate([(centre, TrainingChunk(1, chunk)) for chunk in range(8)])
        seconds = time.perf_counter() - ready
    steps = sum(int(result.steps.sum()) for result in results if isinstance(result, EpisodesResult))
    yield "ok", f"a worker starts and compiles in {ready - started:.1f} s, then makes {steps / seconds:,.0f} steps/s"


SECONDS = 1.0
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
            yield "FAIL", f"{name}: {problem}" + (_what_was_tried(task) if answer.get("is_lost") else "")
            return
        if fault := answer["fault"]:
            yield "FAIL", f"{name}: an episode of a random policy is invalid {fault}"
            return
    if same_B := answers[0]["same_descriptor_B"]:
        short = f", which have at most {MOST_STEPS} steps" if task.episode_steps > MOST_STEPS else ""
        yield "note", same_descriptor(task, same_B, f"{TRIED} episodes of random policies{short}")
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


def _what_was_tried(task: TaskSpec) -> str:
    """With what a task was tried whose process has ended, so that a user can try it alone."""
    if task.parameters is None:
        return "\nThe resets of its first episodes have the seeds 1 and 2, and their actions are random"
    return f"\nIts calls have {task.parameters.text(task.parameters.first(0, 0))}, with the seeds 1 and 2"


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
        return f"{task.name}: {task.summary.rstrip('.') or 'a function'}; parameters {', '.join(task.parameters.names)}"
    unit, use = ("action", "to choose from") if task.discrete_actions else ("number", "in an action")
    return (
        f"{task.name}: {task.summary.rstrip('.') or 'a task'}; {counted(task.observation_size, 'number')} in an "
        f"observation, {counted(task.action_size, unit)} {use}, {counted(task.episode_steps, 'step')}"
    )
