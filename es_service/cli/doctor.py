"""The checks of `es-service doctor`: whether this machine can run searches, and what their results depend on."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from es_service.api import load_config
from es_service.cli.data import print_json
from es_service.cli.options import print_finding
from es_service.config.tasks import TASKS
from es_service.config.workload import worker_spec
from es_service.dispatch.cluster_findings import Finding
from es_service.dispatch.cores import cores
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import ServiceError, counted
from es_service.protocol.machine import platform_info
from es_service.protocol.messages import Centre, EpisodesResult, TrainingChunk
from es_service.protocol.noise import TEST_VECTORS, normal_integers, stream_keys
from es_service.protocol.system import memory_bytes
from es_service.runs.signals import stop_on_signals
from es_service.search.observation_statistics import no_observations, normalisation
from es_service.store.folder import is_network_filesystem
from workers.policies.policy import initial_parameters
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
