"""A worker with several cores, among which the chunks of each work item are divided.

With simd the cores are threads, because kernels run without the interpreter's lock. With xla each core is a child
process with a JAX of its own, whose thread pool has one thread like that of any other worker. Results do not depend on
the number of cores.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TypeVar

from es_service.protocol.gradient_tree import with_neighbours_added
from es_service.protocol.messages import ChunkResult, Work, WorkerSpec
from es_service.protocol.parent import end_with
from workers.worker import make_worker

PARTS_PER_CORE = 2
"""Parts of a work item for each core, so that a core that finishes early takes over a part of another one."""
AnyWork = TypeVar("AnyWork")
RunChunks = Callable[[Sequence[Work]], list[ChunkResult]]
_run_in_child: RunChunks | None = None
"""Function of a child process, which `_begin_child` sets."""


def make_worker_with_cores(spec: WorkerSpec, cores: int) -> RunChunks:
    """`make_worker` for a worker that may use several cores at a time.

    The environment must already allow each JAX one thread only. If a child process ends, so does this process, since
    the loss of a core is the loss of the worker.
    """
    if cores == 1:
        return make_worker(spec)
    if spec.rollout == "simd":
        return divided(ThreadPoolExecutor(cores), make_worker(spec), cores)
    context = get_context("spawn")  # a forked JAX would not work
    pool = ProcessPoolExecutor(cores, context, _begin_child, (spec, os.getpid()))
    return divided(pool, _run_child, cores)


def divided(pool: Executor, run: RunChunks, cores: int) -> RunChunks:
    """Function that runs the parts of a work item side by side."""

    def run_parts(work: Sequence[Work]) -> list[ChunkResult]:
        try:
            futures = [pool.submit(run, part) for part in parts(work, cores)]
            wait(futures)  # also if one has failed, or the others would compete with the next work item
            return with_neighbours_added(work, [result for future in futures for result in future.result()])
        except BrokenProcessPool as error:
            print(f"a child process of this worker has ended: {error}", file=sys.stderr, flush=True)
            os._exit(1)

    return run_parts


def parts(work: Sequence[AnyWork], cores: int) -> list[Sequence[AnyWork]]:
    """Neighbouring chunks in at most PARTS_PER_CORE parts for each core, in order, of sizes that differ by at most 1.

    There is one part for each core if there are too few chunks for more of at least two chunks.
    """
    count = min(len(work), cores * PARTS_PER_CORE if len(work) >= 2 * cores * PARTS_PER_CORE else cores)
    ends = [len(work) * (index + 1) // count for index in range(count)]
    return [work[start:end] for start, end in zip([0, *ends], ends, strict=False)]


def _begin_child(spec: WorkerSpec, parent: int) -> None:
    """Prepare a child process, which ends with its parent."""
    global _run_in_child
    end_with(parent)
    _run_in_child = make_worker(spec)


def _run_child(work: Sequence[Work]) -> list[ChunkResult]:
    assert _run_in_child is not None, "the pool initialises each child"
    return _run_in_child(work)
