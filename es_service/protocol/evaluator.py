"""The interface by which the driver has chunks run; engines implement it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from es_service.protocol.messages import ChunkResult, Work


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


class Evaluator(Protocol):
    """Interface by which the driver has chunks run. Results do not depend on where, in what order or how often."""

    @property
    def counts(self) -> DispatchCounts:
        """Numbers of workers and of faults so far."""
        ...

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        """Results of chunks in the order of `work`.

        Raises:
            EvaluationError: the chunks cannot be computed.
            Interrupted: a stop was requested.
        """
        ...


@runtime_checkable
class Beginning(Protocol):
    """Interface of an evaluator that computes while the driver does something else."""

    def begin(self, work: Sequence[Work]) -> Callable[[], list[ChunkResult]]:
        """Have chunks run, and return the function that waits for their results, with what `evaluate` returns."""
        ...


def evaluate_beside(evaluator: Evaluator, work: Sequence[Work], meanwhile: Callable[[], object]) -> list[ChunkResult]:
    """`evaluator.evaluate(work)`, and something that the driver does meanwhile, or before if that is not possible."""
    if isinstance(evaluator, Beginning):
        wait = evaluator.begin(work)
        meanwhile()
        return wait()
    meanwhile()
    return evaluator.evaluate(work)
