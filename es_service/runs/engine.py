"""The engine that computes the episodes of a config, whoever asks for them: a run, an evaluator, an evaluation, a
certification, a verification; and what it says while its workers compile.

Workers keep compiled code on disk, in caches whose keys only they can compute. So an empty file for each kind of chunk
that workers of this machine have compiled for, named by all that the code depends on, stands beside these caches.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.dispatch.engine import Engine
from es_service.dispatch.events import Compiled, Entry, Limits, Log, no_log
from es_service.dispatch.inline_engine import inline_engine
from es_service.logs import logger
from es_service.protocol.machine import platform_info, platform_text
from es_service.protocol.messages import Report, WorkerSpec
from es_service.protocol.policies import POLICIES_TOGETHER, POLICY_SLOTS
from es_service.protocol.process_environment import require_no_import_of_a_task
from es_service.runs.signals import stop_on_signals
from es_service.runs.worker_count import work_at_once, worker_count
from es_service.store.lock import MOST_LINE, MOST_LINES, RunLock
from workers.actor import WorkerActor
from workers.asked_rows import described
from workers.rollouts import BACKENDS
from workers.simd.backend.cache import cache_folder

# What becomes of the reports of workers: what they print, and why they are replaced by new processes.

_LOG = logger(__name__)
NOTED_S = 1.0
"""Least time in seconds between two changes of what `status` reads."""


def reader_of_reports(
    on_notice: Callable[[str], None], on_output: Callable[[str], None], lock: RunLock | None = None
) -> Callable[[str, Report], None]:
    """Function of a worker's name and a report of it.

    Args:
        on_notice: called with a sentence when a worker is replaced for the first time.
        on_output: called with each line that a worker has printed.
        lock: gets the newest lines, for `status`; None: nobody else reads them.
    """
    newest: deque[str] = deque(maxlen=MOST_LINES)
    noted_s, replaced = 0.0, 0

    def read(worker: str, report: Report) -> None:
        nonlocal noted_s, replaced
        for line in report.printed.splitlines():
            newest.append(f"{worker}: {line}"[:MOST_LINE])
            on_output(f"{worker}: {line}")
        if report.printed and lock is not None:
            is_due = (now_s := time.monotonic()) >= noted_s + NOTED_S
            lock.note_output(newest, write=is_due)
            noted_s = now_s if is_due else noted_s
        if report.spent:
            sentence = f"{worker} is replaced by a new process, since {report.spent}"
            _LOG.info(sentence)
            replaced += 1
            if replaced == 1:
                on_notice(f"{sentence}. Later replacements are in the log (--log-level info)")

    return read


CALLS_S = 60.0
"""Seconds in which the process of a function can be replaced, beside the time of its calls."""
CONTENTS = {
    "TrainingChunk": "training episodes",
    "EvaluationChunk": "evaluation episodes",
    "PolicyChunk": "episodes of policies",
    "GradientChunk": "gradients",
}
"""Class name of a kind of chunk -> what it computes, in words."""
MOST_FILES = 1000


def make_engine(
    config: RunConfig,
    should_stop: Callable[[], int | None] = lambda: None,
    log: Log = no_log,
    on_wait: Callable[[str], None] = lambda shortage: None,
    on_refusal: Callable[[str], None] = lambda refusal: None,
    on_compile: Callable[[str], None] = lambda sentence: None,
    *,
    on_report: Callable[[str, Report], None] = lambda worker, report: None,
    at_once: int | None = None,
    outputs: tuple[str, ...] = (),
    keyed_resets: bool = False,
) -> Engine[Any]:
    """The configured engine, whose workers are starting.

    Args:
        should_stop, log, on_wait: as in `Engine`.
        on_refusal: as in `ray_engine`.
        on_compile: called with a sentence when workers compile, or make environments, for more than two seconds, and
            with "" when they go on.
        on_report: called with a worker's name and its report.
        at_once: number of chunks that can be computed at the same time; None: as in a generation of a run.
        outputs, keyed_resets: see `WorkerSpec`.
    """
    require_no_import_of_a_task()
    task, compute = task_of(config), config.compute
    spec, here = replace(worker_spec(config, task, outputs), keyed_resets=keyed_resets), compute.address is None
    most = work_at_once(config) if at_once is None else at_once
    limits = dispatch_limits(config, most)

    def tell_compiling(kind: str, text: str) -> None:
        on_compile(compiling_sentence(spec, kind, text, here=here))

    log = noting(log, spec) if here else log
    alone = not BACKENDS[spec.rollout].shares_processes
    threads, gpus = compute.inline_workers == "threads", compute.worker_resources.gpu
    engine: Engine[Any]
    if compute.engine == "inline":
        engine = inline_engine(
            spec,
            limits,
            should_stop,
            threads=threads,
            gpus=gpus,
            alone=alone,
            log=log,
            on_compile=tell_compiling,
            on_report=on_report,
        )
    else:
        from es_service.dispatch.ray_engine import ray_engine

        engine = ray_engine(
            spec,
            limits,
            should_stop,
            actor=WorkerActor,
            address=compute.address,
            cpus=None if compute.worker_resources.cpu == "auto" else compute.worker_resources.cpu,
            gpus=gpus,
            most=most,
            grows=compute.workers == "auto",
            alone=alone,
            log=log,
            on_wait=on_wait,
            on_compile=tell_compiling,
            on_refusal=on_refusal,
            on_report=on_report,
        )
    if task.kind in ("python", "function"):  # errors name the episodes or the calls that ended workers
        engine.describe = partial(described, spec, task.parameters)
    return engine


@contextmanager
def engine_here(
    config: RunConfig,
    on_notice: Callable[[str], None] = lambda sentence: None,
    on_output: Callable[[str], None] = lambda line: None,
    *,
    at_once: int | None = None,
    outputs: tuple[str, ...] = (),
    keyed_resets: bool = False,
) -> Iterator[Engine[Any]]:
    """The engine of a config that computes on this machine, until the end of the block or a signal.

    Args:
        on_notice: called with a sentence when workers compile, or make environments, for more than two seconds, and
            when the first one is replaced by a new process.
        on_output: called with the lines that workers print; see `api.run`.
        at_once, outputs, keyed_resets: as for `make_engine`.
    """

    def tell(sentence: str) -> None:
        if sentence:
            on_notice(sentence)

    given = {"at_once": at_once, "outputs": outputs, "keyed_resets": keyed_resets}
    told = {"on_compile": tell, "on_report": reader_of_reports(on_notice, on_output)}
    with stop_on_signals() as should_stop, make_engine(config, should_stop, **told, **given) as engine:
        yield engine


def dispatch_limits(config: RunConfig, most: int | None = None) -> Limits:
    """The engine's number of workers and time limits."""
    compute, task = config.compute, task_of(config)
    rollout = BACKENDS[compute.rollout]
    limit_s = config.task.time_limit_s  # that of the environments of a chunk, which step side by side
    if limit_s is not None and task.kind == "function":  # enough for its calls, which end by themselves
        limit_s = 2 * compute.chunk_pairs * config.task.episodes_per_member * limit_s + CALLS_S
    return Limits(
        workers=worker_count(config, most),
        max_attempts=compute.max_attempts,
        start_timeout_s=compute.no_worker_timeout_s / 2,  # so that two attempts fit into it
        compile_timeout_s=compute.compile_timeout_s,
        first_chunk_timeout_s=compute.first_chunk_timeout_s,
        chunk_timeout_s=compute.chunk_timeout_s,
        place_timeout_s=math.inf if compute.place_timeout_s is None else compute.place_timeout_s,
        no_worker_timeout_s=compute.no_worker_timeout_s,
        items_overlap=not rollout.runs_in_threads,
        late_factor=Limits.late_factor if rollout.copies_late_items else math.inf,
        time_limit_s=limit_s,
        episodes_together=rollout.episodes_together(task),
        policies_together=POLICIES_TOGETHER if rollout.takes_chunks_together else POLICY_SLOTS,
    )


def compiling_sentence(spec: WorkerSpec, kind: str, text: str, *, here: bool) -> str:
    """That workers compile for a kind of chunk, or load what they have compiled before, and about how long it takes.
    That they start, if they compile nothing; or how many environments they have made or reset. Else empty.

    Args:
        kind, text: see `on_compile` in `Waits`.
        here: whether they are on this machine; of others it is not known what they have on disk.
    """
    if text or not kind:
        return f"{text} ({spec.environment})" if text else ""
    first_s, again_s = BACKENDS[spec.rollout].compile_s
    if not first_s:
        return f"starting workers for {spec.environment} ({CONTENTS[kind]})"
    if here and was_compiled(spec, kind):
        return f"loading compiled code for {spec.environment} ({CONTENTS[kind]}, about {again_s} s)"
    how_long = f"first time, about {first_s} s" if here else f"about {first_s} s the first time"
    return f"compiling for {spec.environment} ({CONTENTS[kind]}, {how_long})"


def was_compiled(spec: WorkerSpec, kind: str) -> bool:
    """Whether workers of this machine have compiled for this kind of chunk before."""
    file = _file(spec, kind)
    return file is not None and file.exists()


def note_compiled(spec: WorkerSpec, kind: str) -> None:
    """Remember that workers of this machine have compiled for this kind of chunk."""
    if (file := _file(spec, kind)) is None:
        return
    with contextlib.suppress(OSError):  # nothing but a sentence depends on it
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        file.touch()
        for old in sorted(file.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-MOST_FILES]:
            old.unlink(missing_ok=True)


def noting(log: Log, spec: WorkerSpec) -> Log:
    """The dispatch log of workers on this machine, which also remembers for which kinds they have compiled."""
    noted: set[str] = set()

    def log_and_note(entry: Entry) -> None:
        log(entry)
        if isinstance(entry, Compiled) and entry.kind not in noted:
            noted.add(entry.kind)
            note_compiled(spec, entry.kind)

    return log_and_note


def _file(spec: WorkerSpec, kind: str) -> Path | None:
    kernels = cache_folder()
    if kernels is None:
        return None
    text = f"{kind} {replace(spec, seed=0)} {platform_text(platform_info())}"
    return kernels.with_name("compiled") / hashlib.sha256(text.encode()).hexdigest()
