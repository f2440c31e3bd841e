"""A worker with several cores, among which the chunks of each work item are divided.

The cores are threads if the rollout runs in threads. With any other each core is a child process, with a JAX of its
own if it has one, whose thread pool has one thread like that of any other worker. Results do not depend on the number
of cores.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from typing import Any, TypeVar

from es_service.protocol.child import end_with
from es_service.protocol.gradient_tree import with_neighbours_added
from es_service.protocol.messages import ChunkResult, Work, WorkerSpec, recipes_in
from es_service.protocol.user_code import sendable
from workers import progress
from workers.compiling import Compilable
from workers.rollouts import BACKENDS
from workers.worker import Made, compiled_before, made_before

PARTS_PER_CORE = 2
"""Parts of a work item for each core, so that a core that finishes early takes over a part of another one."""
AnyWork = TypeVar("AnyWork")


@dataclass
class _Child:
    """What a child process has."""

    barrier: Any
    """Barrier of all children of the worker."""
    before: dict[str, Any] = field(default_factory=dict)
    """See `compiled_before`."""
    worker: Compilable | None = None
    task_code: tuple[str, ...] = ()
    """The name of the task."""


_child: _Child | None = None
"""Set in a child process, by `_begin_child`."""


class Cores:
    """The cores of a worker, which compute for one run after another, all of the same rollout.

    The environment must already allow each JAX one thread only. If a child process ends, so does this process, since
    the loss of a core is the loss of the worker.
    """

    def __init__(self, cores: int) -> None:
        """Start nothing yet."""
        self._cores, self._before = cores, dict[str, Any]()
        self._pool: Executor | None = None

    def made(self, spec: WorkerSpec) -> Made:
        """What computes the chunks of a run, as `make_worker` makes it for one core."""
        if self._cores == 1:
            return compiled_before(self._before, spec)
        if BACKENDS[spec.rollout].runs_in_threads:
            worker, compiled = compiled_before(self._before, spec)
            self._pool = pool = self._pool or ThreadPoolExecutor(self._cores)
            return Made(Compilable(lambda work: divided(pool, worker.run, work, self._cores), worker.compile), compiled)
        self._pool = pool = self._pool or self._children()
        _together(pool, _make_in_child, [(spec,)] * self._cores)  # from now on there is a child for each core

        def run(work: Sequence[Work]) -> list[ChunkResult]:
            with progress.call() as call:
                return divided(pool, partial(_run_child, call), with_made_policies(work), self._cores)

        def compile_in_children(work: Sequence[Work]) -> None:
            with progress.call() as call:
                _together(pool, _compile_in_child, [(call, with_made_policies(work))] * self._cores)

        return Made(Compilable(run, compile_in_children), made_before(self._before, spec, lambda _: set[str]()))

    def _children(self) -> Executor:
        context = get_context("spawn")  # a forked JAX would not work
        given = (os.getpid(), context.Barrier(self._cores), progress.shared_rows(context, self._cores))
        return ProcessPoolExecutor(self._cores, context, _begin_child, given)


def with_made_policies(work: Sequence[Work]) -> list[Work]:
    """A work item with the parameters of policies in the place of their recipes, which need more bytes with the
    parents."""
    made: dict[int, Any] = {}
    for subject, _ in work:
        if id(subject) not in made:
            recipes = recipes_in(subject)
            made[id(subject)] = subject if recipes is None else replace(subject, parameters_N_D=recipes.made())
    return [(made[id(subject)], chunk) for subject, chunk in work]


def divided(pool: Executor, run: Callable[[Any], Any], work: Sequence[Work], cores: int) -> list[ChunkResult]:
    """Run the parts of a work item side by side."""
    results = _together(pool, run, [(part,) for part in parts(work, cores)])
    return with_neighbours_added(work, [result for part in results for result in part])


def _together(pool: Executor, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Results of calls that run side by side, in their order."""
    try:
        futures = [pool.submit(function, *given) for given in arguments]
        wait(futures)  # also if one has failed, or the others would compete with the next work item
        return [future.result() for future in futures]
    except BrokenProcessPool as error:
        print(f"a child process of this worker has ended: {error}", file=sys.stderr, flush=True)
        os._exit(1)


def parts(work: Sequence[AnyWork], cores: int) -> list[Sequence[AnyWork]]:
    """Neighbouring chunks in at most PARTS_PER_CORE parts for each core, in order, of sizes that differ by at most 1.

    There is one part for each core if there are too few chunks for more of at least two chunks.
    """
    count = min(len(work), cores * PARTS_PER_CORE if len(work) >= 2 * cores * PARTS_PER_CORE else cores)
    ends = [len(work) * (index + 1) // count for index in range(count)]
    return [work[start:end] for start, end in zip([0, *ends], ends, strict=False)]


def _begin_child(parent: int, barrier: Any, rows: tuple[Any, Any]) -> None:
    """Prepare a child process, which ends with its parent."""
    global _child
    end_with(parent)
    progress.use_row(*rows)
    _child = _Child(barrier)


def _make_in_child(spec: WorkerSpec) -> None:
    """Make what computes the chunks of a run."""
    assert _child is not None, "the pool initialises each child"
    progress.belongs_to(0)  # to no call, as while the worker starts
    try:
        with sendable(*spec.task_code):
            _child.worker, _child.task_code = compiled_before(_child.before, spec).run_chunks, spec.task_code
    finally:
        _meet()


def _meet() -> None:
    """Wait for the other children, so that each runs one of as many calls as there are children."""
    assert _child is not None, "the pool initialises each child"
    _child.barrier.wait()


def _compile_in_child(call: int, work: Sequence[Work]) -> None:
    assert _child is not None, "the pool initialises each child"
    assert _child.worker is not None, "it is made for each run"
    progress.belongs_to(call)
    try:
        with sendable(*_child.task_code):
            _child.worker.compile(work)
    finally:
        _meet()


def _run_child(call: int, work: Sequence[Work]) -> list[ChunkResult]:
    assert _child is not None, "the pool initialises each child"
    assert _child.worker is not None, "it is made for each run"
    progress.belongs_to(call)
    with sendable(*_child.task_code):
        return _child.worker(work)
