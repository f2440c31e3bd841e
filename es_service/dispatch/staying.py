"""Workers that stay: what waits for the next run of this program, processes of workers or a Ray with its actors."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from threading import Lock
from typing import Any, Protocol

from es_service.protocol.machine import cores
from es_service.protocol.messages import WorkerSpec

IDLE_PER_CORE = 2
"""Most processes that wait, for each core: those of two kinds of runs that take turns."""


class CanWait(Protocol):
    """What can wait: the process of a worker, or a Ray with its actors."""

    @property
    def is_running(self) -> bool:
        """Whether it is still there."""
        ...

    def kill(self) -> None:
        """Begin to end it."""
        ...

    def end(self) -> object:
        """End it, and wait for that."""
        ...


class Staying:
    """What waits in this program."""

    def __init__(self) -> None:
        self._idle: list[tuple[Hashable, CanWait]] = []
        """What something can be used for, and the thing; the one that has waited longest is first."""
        self._blocks, self._turn, self._maker = 0, Lock(), os.getpid()

    def take(self, use: Hashable) -> Any | None:
        """What waits and can be used for this, the newest of it; None if there is nothing."""
        with self._turn:
            fitting = [entry for entry in self._idle if entry[0] == use]
            self._idle = [entry for entry in self._idle if entry[0] != use]
            while fitting:
                _, waiting = fitting.pop()
                if waiting.is_running:
                    self._idle += fitting
                    return waiting
                waiting.end()
        return None

    def give(self, use: Hashable, waiting: CanWait) -> None:
        """Let something that has nothing left to do wait, inside a block of `workers`; elsewhere end it."""
        with self._turn:
            self._idle += [(use, waiting)]
            most = IDLE_PER_CORE * cores() if self._blocks else 0
            ended = [self._idle.pop(0) for _ in range(len(self._idle) - most)]
        _end(ended)

    def end(self, waiting: CanWait) -> None:
        """End something, if it still waits."""
        with self._turn:
            ended = [entry for entry in self._idle if entry[1] is waiting]
            self._idle = [entry for entry in self._idle if entry[1] is not waiting]
        _end(ended)

    def enter(self) -> None:
        """A block of `workers` begins."""
        with self._turn:
            self._blocks += 1

    def leave(self) -> None:
        """A block ends, and with the last one what waits. That of a process that was forked is the other one's."""
        if os.getpid() != self._maker:
            return
        with self._turn:
            self._blocks -= 1
            ended, self._idle = ([], self._idle) if self._blocks else (self._idle, [])
        _end(ended)


def _end(entries: list[tuple[Hashable, CanWait]]) -> None:
    for _, waiting in entries:
        waiting.kill()  # all before waiting for one, since each takes some time to free its memory
    for _, waiting in entries:
        waiting.end()


def staying() -> Staying:
    """What waits in this program."""
    return _of(os.getpid())


@cache
def _of(process: int) -> Staying:
    return Staying()


def use_of(spec: WorkerSpec, *, alone: bool) -> Hashable:
    """What the process of a worker can be used for after a run: for others with the same rollout and code.

    Args:
        alone: whether only for runs with the same constants, whatever their seed.
    """
    return repr(replace(spec, seed=0)) if alone else (spec.rollout, spec.output_bytes, *spec.sources.items())


@contextmanager
def workers() -> Iterator[None]:
    """Inside the block, workers stay when a run or an evaluator ends, and serve the next ones.

        with es_service.workers():
            for sigma in (0.02, 0.05, 0.1):
                es_service.run(load_config("point_maze_es", [f"search.sigma={sigma}"]), f"runs/{sigma}")

    The next `run`, `resume`, `fork`, `evaluator`, `certify_run` or `verify` of this program, in whatever thread, takes
    over the processes that wait, if the code of its task, its rollout and the environment variables are the same. They
    have loaded JAX, and have compiled whatever they have computed before: only another task, policy, number of episodes
    or size of chunks is compiled anew. An environment of Python objects or a function has a process only for runs with
    the same task and policy. All results have the bits that they have without the block.

    With the engine `ray`, this program stays connected to the cluster, or to its own Ray on this machine, and actors
    with the same cores and GPUs are taken over. They keep the cores of the cluster until the block ends, or until this
    program computes something for which they cannot be used, joins another cluster or calls `ray.shutdown()`.

    A worker that was lost, or was computing when its run ended, does not stay; nor does an actor that no longer
    answers. On this machine, two processes wait for each core at most. What the code of a task has read from a file or
    changed in its modules stays, too. Blocks can be nested: nothing is left running after the last one. Runs of
    `ask_tell` have no workers.
    """
    here = staying()
    here.enter()
    try:
        yield
    finally:
        here.leave()
