"""Requests: generators that yield work and receive its results, and the interface of what computes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from es_service.protocol.messages import ChunkResult, Work

Value = TypeVar("Value")
Evaluate = Callable[[Sequence[Work]], list[ChunkResult]]
"""Function from chunks to their results, in the order of the chunks."""
Requests = Generator[Sequence[Work], list[ChunkResult], Value]
"""Yields chunks, each time receives their results in the order of the chunks, and returns what it makes of them.

Whoever drives it decides where the chunks are computed: an engine, the caller of `ask_tell`, or a test with a list.
"""

Session = Generator[Sequence[Work] | None, list[ChunkResult] | None, Value]
"""As `Requests`, but in two steps, so that the driver need not wait: it yields chunks to be sent, stores the generation
before once it is resumed, yields None, and receives the results."""


@dataclass(frozen=True)
class DispatchCounts:
    """Numbers of workers and of faults of an evaluator since it was made."""

    retries: int = 0
    """Chunks that were sent again after a fault, including those that a lost worker had not begun. Second copies of
    chunks that a worker was late with do not count."""
    lost_workers: int = 0
    """Workers that were lost, or stopped because of a fault."""
    workers: int = 0
    """Workers that the evaluator is to keep running."""
    rollout_s: float = math.nan
    """Seconds in which workers have computed; NaN if they are not measured."""
    cpu_s: float = math.nan
    """Seconds of the processors of this process and of all its workers; NaN if they are not measured."""


class Evaluator(Protocol):
    """Interface of what computes chunks. Results do not depend on where, in what order or how often."""

    @property
    def counts(self) -> DispatchCounts:
        """Numbers of workers and of faults so far."""
        ...

    def begin(self, work: Sequence[Work]) -> Callable[[], list[ChunkResult]]:
        """Have chunks run, and return the function that waits for their results, which `evaluate` returns."""
        ...

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        """Results of chunks in the order of `work`.

        Raises:
            EvaluationError: the chunks cannot be computed.
            Interrupted: a stop was requested.
        """
        ...


def completed(requests: Requests[Value], evaluate: Evaluate) -> Value:
    """What a generator of work returns, all of whose work is computed by one function."""
    results: Any = None
    while True:
        try:
            work = requests.send(results)
        except StopIteration as end:
            return end.value
        results = evaluate(work)
