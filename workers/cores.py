"""A worker with several cores, among which the chunks of each work item are divided.

The cores are threads if the rollout runs in threads. With any other each core is a child process, with a JAX of its
own if it has one, whose thread pool has one thread like that of any other worker. Results do not depend on the number
of cores.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from es_service.protocol.child import Child, NoAnswerError
from es_service.protocol.gradient_tree import with_neighbours_added
from es_service.protocol.machine import cpu_seconds
from es_service.protocol.messages import ChunkResult, Work, WorkerSpec, recipes_in
from es_service.protocol.process_environment import same_imports
from es_service.protocol.user_code import sendable
from workers import progress
from workers.compiling import Compilable
from workers.rollouts import BACKENDS
from workers.worker import Made, compiled_before, made_before

PARTS_PER_CORE = 2
"""Parts of a work item for each core, so that a core that finishes early takes over a part of another one."""
AnyWork = TypeVar("AnyWork")


class Cores:
    """The cores of a worker, which compute for one run after another, all of the same rollout.

    The environment must already allow each JAX one thread only. If a child process ends, so does this process, since
    the loss of a core is the loss of the worker.
    """

    def __init__(self, cores: int) -> None:
        """Start nothing yet."""
        self._cores, self._before = cores, dict[str, Any]()
        self._pool: Executor | None = None
        self._of_thread, self._turn = threading.local(), threading.Lock()
        self.children: list[Child] = []
        """One for each core, once work has begun that does not run in threads."""
        self._barrier = threading.Barrier(cores)

    def made(self, spec: WorkerSpec) -> Made:
        """What computes the chunks of a run, as `make_worker` makes it for one core."""
        if self._cores == 1:
            return compiled_before(self._before, spec)
        if BACKENDS[spec.rollout].runs_in_threads:
            worker, compiled = compiled_before(self._before, spec)
            self._pool = pool = self._pool or ThreadPoolExecutor(self._cores)
            return Made(Compilable(lambda work: divided(pool, worker.run, work, self._cores), worker.compile), compiled)
        self._pool = pool = self._pool or self._with_children()
        together(pool, partial(self._in_each, "make"), [(spec,)] * self._cores)

        def run(work: Sequence[Work]) -> list[ChunkResult]:
            with progress.call() as call:
                return divided(pool, partial(self._in_one, "run", call), with_made_policies(work), self._cores)

        def compile_in_each(work: Sequence[Work]) -> None:
            with progress.call() as call:
                given = call, with_made_policies(work)
                together(pool, partial(self._in_each, "compile"), [given] * self._cores)

        return Made(Compilable(run, compile_in_each), made_before(self._before, spec, lambda _: set[str]()))

    @property
    def cpu_s(self) -> float:
        """Seconds of processors that this process has used, and those of its children."""
        return cpu_seconds(child.pid for child in self.children)

    def _with_children(self) -> Executor:
        """Threads each of which has a child process."""
        rows = progress.shared_rows(self._cores)

        def begin() -> None:
            with self._turn:
                number = len(self.children)
                # It prints where this process does.
                self._of_thread.child = Child("workers.cores:core", os.environ | same_imports(), output_bytes=None)
                self.children.append(self._of_thread.child)
            self._in_one("", rows, number)

        return ThreadPoolExecutor(self._cores, initializer=begin)

    def _in_one(self, *request: Any) -> Any:
        """The answer of this thread's child."""
        try:
            return self._of_thread.child.call(*request)
        except NoAnswerError as error:
            print(f"a child process of this worker has {error}", file=sys.stderr, flush=True)
            os._exit(1)

    def _in_each(self, *request: Any) -> None:
        """Have one of as many requests as there are children answered: each by another child."""
        try:
            self._in_one(*request)
        finally:
            self._barrier.wait()


def core(name: str, rows: str, number: int) -> Callable[..., Any]:
    """What a child process answers: see `answer_parent`. It has no task of its own before "make"."""
    progress.use_row(rows, number)
    before: dict[str, Any] = {}
    worker: Compilable | None = None
    task_code: tuple[str, ...] = ()

    def answer(what: str, *given: Any) -> Any:
        nonlocal worker, task_code
        if what == "make":
            (spec,) = given
            task_code = spec.task_code
            progress.belongs_to(0)  # to no call, as while the worker starts
            with sendable(*task_code):
                worker = compiled_before(before, spec).run_chunks
            return None
        call, work = given
        assert worker is not None, "it is made for each run"
        progress.belongs_to(call)
        with sendable(*task_code):
            return worker.compile(work) if what == "compile" else worker(work)

    return answer


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
    results = together(pool, run, [(part,) for part in parts(work, cores)])
    return with_neighbours_added(work, [result for part in results for result in part])


def together(pool: Executor, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Results of calls that run side by side, in their order."""
    futures = [pool.submit(function, *given) for given in arguments]
    wait(futures)  # also if one has failed, or the others would compete with the next work item
    return [future.result() for future in futures]


def parts(work: Sequence[AnyWork], cores: int) -> list[Sequence[AnyWork]]:
    """Neighbouring chunks in at most PARTS_PER_CORE parts for each core, in order, of sizes that differ by at most 1.

    There is one part for each core if there are too few chunks for more of at least two chunks.
    """
    count = min(len(work), cores * PARTS_PER_CORE if len(work) >= 2 * cores * PARTS_PER_CORE else cores)
    ends = [len(work) * (index + 1) // count for index in range(count)]
    return [work[start:end] for start, end in zip([0, *ends], ends, strict=False)]
