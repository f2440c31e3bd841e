"""The engine: carries scheduler commands to workers and their messages back, over whatever transport.

Dispatch station, between the driver and a transport. The scheduler decides, the transport moves bytes; this loop only
introduces them to each other and puts the results in order.
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

from es_service.dispatch import events
from es_service.dispatch.dispatch_log import Log, no_log
from es_service.dispatch.scheduler import step
from es_service.dispatch.scheduler_state import initial_state, next_deadline, pending, told_last_words, usual_chunk_s
from es_service.errors import EvaluationError, Interrupted
from es_service.logs import logger
from es_service.protocol.messages import Centre, Chunk, ChunkResult, DispatchCounts, WorkItemId

_LOG = logger(__name__)
POLL_S = 0.1
"""Longest wait before a request to stop is noticed."""


@dataclass(frozen=True)
class Answer:
    """A worker has run the chunks of a work item: the event `Result` with what it stands for."""

    worker: int
    item_id: Hashable
    attempt: int
    results: list[ChunkResult]


Message = (
    events.Placed | events.WorkerUp | events.WorkerLost | events.Failure | events.Drain | events.SetWorkers | Answer
)
"""What a transport reports: the scheduler's own events, and answers."""


class Transport(Protocol):
    """Workers somewhere, by id. Called from one thread; no call waits for what a worker is doing.

    No call raises because of a worker: whatever goes wrong with one, starting it included, is a `WorkerLost`.
    """

    def start(self, worker: int) -> None:
        """Begin to start a worker; `WorkerUp` or `WorkerLost` follows, and before that, if it has to wait for a place,
        `Placed`."""
        ...

    def kill(self, worker: int) -> str:
        """Kill a worker for good and free what it held; nothing happens if it is gone. What its process wrote last,
        where that is at hand; else an empty text.

        Messages of a killed worker may still be received (that it is lost, too): the scheduler has forgotten it and
        drops them, so a transport need not look for them.
        """
        ...

    def send(self, worker: int, centre: Centre, item_id: Hashable, attempt: int, chunks: Sequence[Chunk]) -> None:
        """Have a worker that is up run the chunks around the centre, behind those it was sent before."""
        ...

    def platforms(self) -> frozenset[str]:
        """`machine.platform_text` of each kind of worker that has come up; of none that is this process's own."""
        ...

    def silent(self) -> tuple[int, ...]:
        """Workers without a place yet, and those that may have been gone when they were sent what they should run."""
        ...

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, each worker's in order; None if none comes in `timeout_s` (0: if none is there).

        A worker reported lost is gone for good: no `kill` need follow.
        """
        ...

    def close(self) -> None:
        """Kill all workers and wait for them to end; those in a cluster that was joined end soon after."""
        ...


AnyTransport = TypeVar("AnyTransport", bound=Transport)


def item_sizes(chunks: int, workers: int, chunk_s: float | None, item_s: float) -> list[int]:
    """How many neighbouring chunks make each item: about as many as take `item_s`, one while `chunk_s`, what one takes,
    is not known; equal numbers, and of items as many for each worker."""
    most = 1 if chunk_s is None else max(1, int(item_s / max(chunk_s, 1e-9)))
    rounds = -(-chunks // (most * workers))
    count = min(chunks, rounds * workers)
    return [chunks // count + (item < chunks % count) for item in range(count)]


class Engine(Generic[AnyTransport]):
    """An Evaluator. Use as a context manager: leaving it closes it, and the workers hold nothing."""

    def __init__(
        self,
        transport: AnyTransport,
        limits: events.Limits,
        should_stop: Callable[[], int | None] = lambda: None,
        log: Log = no_log,
    ) -> None:
        """Start `limits.workers` workers; if that raises, as the log may, the transport is closed.

        Args:
            transport: belongs to the engine from now on, which closes it.
            should_stop: asked at least every POLL_S while waiting; a signal number makes `evaluate` raise Interrupted.
            log: told every event and every command, in the order in which they happen.
        """
        self.transport = transport
        self._should_stop = should_stop
        self._log = log
        self._state = initial_state(limits)
        self._centre: Centre | None = None
        self._phase = 0
        self._chunks: dict[Hashable, Sequence[Chunk]] = {}
        self._results: dict[Hashable, list[ChunkResult]] = {}
        try:
            self._step(events.Tick())
        except BaseException:
            self.close()
            raise

    @property
    def last_loss(self) -> str:
        """Which worker was lost last, and why."""
        return self._state.last_loss

    @property
    def platforms(self) -> frozenset[str]:
        """Kinds of workers so far; see `Transport.platforms`."""
        return self.transport.platforms()

    @property
    def counts(self) -> DispatchCounts:
        """Faults survived so far."""
        state = self._state
        return DispatchCounts(retries=state.retries, lost_workers=state.lost_workers, workers=state.wanted)

    def evaluate(self, centre: Centre, chunks: Sequence[Chunk]) -> list[ChunkResult]:
        """Results in the order of `chunks`, however many workers there are and whatever happens to them.

        Raises:
            EvaluationError: a chunk that fails everywhere, workers that do not start. Interrupted: asked to stop.
                After either, `close` is all that is left to do.
        """
        while (message := self.transport.receive(0.0)) is not None:
            # A worker known to be lost gets no chunk. One lost unseen, as idle actors are, may: that is blamed on a
            # chunk once, since all the others are then asked first.
            self._handle(message)
        self._phase += 1
        parts = self._parts(chunks)
        self._centre, self._chunks, self._results = centre, dict(parts), {}
        self._step(events.Submit(tuple(events.WorkItem(item_id, item_id.kind, item_id.chunks) for item_id, _ in parts)))
        while pending(self._state):
            if (number := self._should_stop()) is not None:
                raise Interrupted(number)
            wait_s = min(POLL_S, max(0.0, next_deadline(self._state) - time.monotonic()))
            if (message := self.transport.receive(wait_s)) is not None:
                self._handle(message)
            else:  # only now: a late look at the clock must not kill workers whose answers were waiting
                self._step(events.Tick(self.transport.silent()))
        return [result for item_id, _ in parts for result in self._results.pop(item_id)]

    def close(self) -> None:
        """Kill all workers and wait for them to end; those in a cluster that was joined end soon after."""
        self.transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _parts(self, chunks: Sequence[Chunk]) -> list[tuple[WorkItemId, Sequence[Chunk]]]:
        """Chunks, all of one kind, as they are to travel. What is known of their duration never changes a result."""
        if not chunks:
            return []
        kind, limits = type(chunks[0]).__name__, self._state.limits
        sizes = item_sizes(len(chunks), self._state.wanted, usual_chunk_s(self._state, kind), limits.item_s)
        ends = list(itertools.accumulate(sizes))
        parts = [chunks[end - size : end] for end, size in zip(ends, sizes, strict=True)]
        return [
            (WorkItemId(self._phase, kind, part[0].generation, part[0].chunk_id, len(part)), part) for part in parts
        ]

    def _handle(self, message: Message) -> None:
        if not isinstance(message, Answer):
            self._step(message)
        elif self._step(events.Result(message.worker, message.item_id, message.attempt)):
            self._results[message.item_id] = message.results

    def _step(self, event: events.Event) -> bool:
        """Feed the scheduler and do as it says; whether it accepted a result."""
        self._state, commands = step(self._state, event, time.monotonic())
        if commands or not isinstance(event, events.Tick):
            self._tell(event)
        for command in commands:
            self._tell(command)
            match command:
                case events.StartWorker(worker):
                    self.transport.start(worker)
                case events.StopWorker(worker, _):
                    self._state = told_last_words(self._state, worker, self.transport.kill(worker))
                case events.Assign(worker, item_id, attempt):
                    assert self._centre is not None
                    self.transport.send(worker, self._centre, item_id, attempt, self._chunks[item_id])
        if self._state.failed is not None:
            raise EvaluationError(self._state.failed)
        return any(isinstance(command, events.Deliver) for command in commands)

    def _tell(self, entry: events.Event | events.Command) -> None:
        """Write an event or a command to the dispatch log and to `logging`, faults and losses at level INFO."""
        self._log(entry)
        is_rare = isinstance(entry, events.WorkerUp | events.WorkerLost | events.Failure | events.StopWorker)
        _LOG.log(logging.INFO if is_rare else logging.DEBUG, "%s", entry)
