"""The engine: carries out the scheduler's commands on workers and passes the workers' messages to the scheduler.

It stands between the driver and a transport. The scheduler decides what to do, and the transport sends and receives;
the engine connects the two and puts the results in order.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

from es_service.dispatch import events
from es_service.dispatch.events import Log, no_log
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import (
    initial_state,
    is_waiting,
    loss_text,
    next_deadline,
    note_last_words,
    pending,
    usual_chunk_s,
    workers_with_place,
)
from es_service.dispatch.waits import Computing, Waits
from es_service.errors import EvaluationError, Interrupted
from es_service.logs import logger
from es_service.protocol.child import require_same_process
from es_service.protocol.episodes import DispatchCounts, Wait, pieces_of, together
from es_service.protocol.messages import ChunkResult, Work, WorkItemId

_LOG = logger(__name__)
_RARE = (events.WorkerUp, events.WorkerLost, events.Compiled, events.Failure, events.StopWorker)
"""Events and commands that `logging` reports at level INFO."""
_OF_ITS_PROCESS = "the session of a run", "end this one: the run goes on in the other"
"""What a process that was forked during a session is told; see `require_same_process`."""
CPU_S = 0.05
"""Least time between two looks at the processors' times of all workers."""
POLL_S = 0.1
"""Longest time in seconds until a request to stop is noticed."""


@dataclass(frozen=True)
class Answer:
    """Message that a worker has run the chunks of a work item: the event `Result` with the results."""

    worker: int
    item_id: Hashable
    attempt: int
    results: list[ChunkResult]


Message = (
    events.Placed
    | events.WorkerUp
    | events.WorkerLost
    | events.Compiled
    | events.Progress
    | events.Failure
    | events.Drain
    | events.SetWorkers
    | Answer
)
"""Messages of a transport: events of the scheduler, and answers."""


class Transport(Protocol):
    """Interface to workers, which have ids. It is used from one thread, and no call waits for the work of a worker.

    No call raises because of a worker: any problem with a worker, also at its start, is reported as `WorkerLost`.
    """

    def start(self, worker: int) -> None:
        """Begin to start a worker. `Placed` follows as soon as it has a place, then `WorkerUp` or `WorkerLost`."""
        ...

    def kill(self, worker: int) -> str:
        """Kill a worker and free its resources, and return the last output of its process.

        The text is empty if the output is not available. Nothing happens if the worker is gone already. Messages of a
        killed worker may still be received, including `WorkerLost`; the scheduler ignores them.
        """
        ...

    def last_words(self, worker: int) -> str:
        """The last output of a worker that was lost by itself, if its loss does not say it; this may take seconds."""
        ...

    def send(self, worker: int, item_id: Hashable, attempt: int, work: Sequence[Work]) -> None:
        """Send chunks and their centres to a worker that is up; it runs them after those that it was sent before.

        Before it runs the first chunks of a kind, it compiles for them, and `Compiled` follows.
        """
        ...

    def cpu_s(self) -> float:
        """Seconds of the processors of this process and of its workers so far, also of those that have ended; NaN if
        they are not measured."""
        ...

    def platforms(self) -> frozenset[str]:
        """`machine.platform_text` of each kind of worker that has come up; empty if workers share this machine and its
        packages."""
        ...

    def silent(self) -> tuple[int, ...]:
        """Workers that have no place yet, and workers that may have been gone before they received their work item."""
        ...

    def shortage(self) -> str:
        """Text, without a full stop, on why workers may have no place: what each needs, and what there is."""
        ...

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, or None if none arrives within `timeout_s` seconds; messages of one worker are in order.

        A worker that is reported lost is gone: `kill` is not needed.
        """
        ...

    def close(self) -> None:
        """Kill all workers and wait until they have ended; in a cluster that was joined they end shortly afterwards."""
        ...


AnyTransport = TypeVar("AnyTransport", bound=Transport)


def item_sizes(chunks: int, workers: int, chunk_s: float | None, item_s: float, cores: int = 1) -> list[int]:
    """Number of chunks in each work item.

    A work item takes about `item_s` seconds, sizes differ by at most one, and each worker gets equally many items. An
    item has at least one chunk for each core of a worker, if there are enough.

    Args:
        chunks: number of chunks to divide.
        workers: number of workers.
        chunk_s: seconds of a worker per chunk; None if unknown, which makes one chunk per core in a work item.
        item_s: seconds that a work item should take.
        cores: cores of each worker.
    """
    most = cores if chunk_s is None else cores * max(1, int(item_s / max(chunk_s * cores, 1e-9)))
    rounds = -(-chunks // (most * workers))
    count = min(chunks, rounds * workers)
    return [chunks // count + (item < chunks % count) for item in range(count)]


class Engine(Generic[AnyTransport]):
    """Evaluator that runs chunks on the workers of a transport. As a context manager, it closes itself at the end."""

    def __init__(
        self,
        transport: AnyTransport,
        limits: events.Limits,
        should_stop: Callable[[], int | None] = lambda: None,
        log: Log = no_log,
        on_wait: Callable[[str], None] = lambda shortage: None,
        on_compile: Callable[[str, str], None] = lambda kind, text: None,
    ) -> None:
        """Start `limits.workers` workers. If this raises, which the log can cause, the transport is closed.

        Args:
            transport: the workers. The engine owns the transport and closes it.
            limits: number of workers, deadlines and numbers of attempts.
            should_stop: called at least every POLL_S seconds while waiting. If it returns a signal number, `evaluate`
                raises Interrupted.
            log: called with every event and every command, in their order.
            on_wait, on_compile: as in `Waits`.
        """
        self.transport = transport
        self._maker = os.getpid()
        self._should_stop = should_stop
        self._log = log
        self._waits = Waits(on_wait, on_compile)
        self._state = initial_state(limits)
        self._phase = 0
        self._computing = Computing()
        self._cpu_before_s, self._cpu_known = transport.cpu_s(), (-math.inf, 0.0)
        self.describe: Callable[[Sequence[Work]], str] = lambda work: ""
        """What an error says of a work item whose workers were lost, since these could not name it; a sentence
        without a full stop, or nothing."""
        self._work: dict[Hashable, Sequence[Work]] = {}
        self._results: dict[Hashable, list[ChunkResult]] = {}
        try:
            self._step(events.Tick())
        except BaseException:
            self.close()
            raise

    def last_loss(self, what: str = "") -> str:
        """See `loss_text`."""
        self._note_last_words()
        return loss_text(self._state, what)

    @property
    def platforms(self) -> frozenset[str]:
        """Platforms of the workers so far; see `Transport.platforms`."""
        return self.transport.platforms()

    @property
    def counts(self) -> DispatchCounts:
        """Numbers of workers and of faults so far."""
        state = self._state
        return DispatchCounts(
            retries=state.retries,
            lost_workers=state.lost_workers,
            workers=state.wanted * state.limits.cores,
            rollout_s=self._computing.seconds(time.monotonic()),
            cpu_s=self._cpu_s(),
        )

    def _cpu_s(self) -> float:
        """Seconds of processors so far, looked up at most every CPU_S seconds."""
        if (now := time.monotonic()) >= self._cpu_known[0] + CPU_S:
            self._cpu_known = now, self.transport.cpu_s() - self._cpu_before_s
        return self._cpu_known[1]

    def wait_for_place(self) -> None:
        """Return when a first worker has a place. Work may be given earlier, but then this wait is part of its time.

        Raises:
            EvaluationError: no worker got a place in time, or none starts.
            Interrupted: a stop was requested.
        """
        while is_waiting(self._state):
            self._serve()

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        """Results of chunks in the order of `work`; a work item has neighbouring chunks of one kind. Chunks of episodes
        may have been cut, or put together: their results say by addresses whose they are.

        They do not depend on the number of workers or on faults. After an exception, only `close` may be called.

        Raises:
            EvaluationError: a work item failed in all its attempts, or no worker starts or gets a place.
            Interrupted: a stop was requested. ForkedError: this process was forked from that of the engine.
        """
        results = self.begin(work)(math.inf)
        assert results is not None
        return results

    def begin(self, work: Sequence[Work]) -> Wait:
        """As `evaluate`, but returns when chunks have been sent; the function that it returns waits for the results.

        Results for which nobody waits are dropped when another evaluation begins, and this waits for them first.
        """
        require_same_process(self._maker, *_OF_ITS_PROCESS)
        while pending(self._state):
            self._serve()
        while (message := self.transport.receive(0.0)) is not None:
            # A worker that is known to be lost gets no chunk. One whose loss is not known yet, such as an idle actor,
            # may get one. Only one work item is charged for that, since all other workers are then asked first.
            self._handle(message)
        self._phase += 1
        episodes = self._state.limits.episodes_together
        if episodes is not None:
            work = [piece for subject_chunk in work for piece in pieces_of(subject_chunk, episodes)]
        parts = self._parts(work)
        self._waits.begin((item_id.kind for item_id, _ in parts), time.monotonic())
        policies = self._state.limits.policies_together
        self._work, self._results = {item_id: together(part, policies) for item_id, part in parts}, {}
        self._computing.begin({item_id.kind for item_id, _ in parts}, time.monotonic())
        self._step(events.Submit(tuple(events.WorkItem(item_id, item_id.kind, item_id.chunks) for item_id, _ in parts)))
        self._tell_waits()

        def wait(most_s: float) -> list[ChunkResult] | None:
            until = time.monotonic() + most_s
            while pending(self._state):
                if (left_s := until - time.monotonic()) <= 0.0:
                    return None
                self._serve(left_s)
            return [result for item_id, _ in parts for result in self._results.pop(item_id)]

        return wait

    def close(self) -> None:
        """Kill all workers and wait until they have ended; in a cluster that was joined they end shortly afterwards.

        In a process that was forked, the workers go on: they belong to the other one.
        """
        if os.getpid() == self._maker:
            self.transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _parts(self, work: Sequence[Work]) -> list[tuple[WorkItemId, Sequence[Work]]]:
        """Work items of neighbouring chunks, which may belong to several centres.

        Their sizes depend on measured durations, but results do not.
        """
        state, limits, parts, first = self._state, self._state.limits, [], 0
        # Workers that wait for a place may wait for long, and items for them would be needlessly small.
        workers = workers_with_place(state) or state.wanted
        for kind, chunks in itertools.groupby(type(chunk).__name__ for _, chunk in work):
            count, chunk_s = len(list(chunks)), usual_chunk_s(state, kind)
            for size in item_sizes(count, workers, chunk_s, limits.item_s, limits.cores):
                part = work[first : first + size]
                chunk = part[0][1]
                item_id = WorkItemId(self._phase, first, kind, chunk.generation, chunk.ask, chunk.chunk_id, len(part))
                parts.append((item_id, part))
                first += size
        return parts

    def _serve(self, most_s: float = POLL_S) -> None:
        """Handle the next message, or check the deadlines if none arrives for a short time of at most `most_s`."""
        require_same_process(self._maker, *_OF_ITS_PROCESS)
        if (number := self._should_stop()) is not None:
            raise Interrupted(number)
        wait_s = min(POLL_S, most_s, max(0.0, next_deadline(self._state) - time.monotonic()))
        if (message := self.transport.receive(wait_s)) is not None:
            self._handle(message)
        else:  # check deadlines only if no message waits, or a late check would kill workers that have answered
            self._step(events.Tick(self.transport.silent()))
        self._tell_waits()

    def _tell_waits(self) -> None:
        self._waits.tell(self._state, time.monotonic(), self.transport.shortage)

    def _handle(self, message: Message) -> None:
        if not isinstance(message, Answer):
            self._step(message)
        elif self._step(events.Result(message.worker, message.item_id, message.attempt)):
            self._results[message.item_id] = message.results

    def _step(self, event: events.Event) -> bool:
        """Pass an event to the scheduler and carry out its commands; returns whether it accepted a result."""
        is_late = isinstance(event, events.Tick) and is_waiting(self._state)
        commands = handle(self._state, event, time.monotonic())
        self._computing.note(event, self._state, time.monotonic())
        if commands or not isinstance(event, events.Tick):
            self._tell(event)
        accepted = False
        for command in commands:
            self._tell(command)
            match command:
                case events.Deliver():
                    accepted = True
                case events.StartWorker(worker):
                    self.transport.start(worker)
                case events.StopWorker(worker, _):
                    note_last_words(self._state, worker, self.transport.kill(worker))
                case events.Assign(worker, item_id, attempt):
                    self.transport.send(worker, item_id, attempt, self._work[item_id])
        if self._state.failed is not None:
            if isinstance(event, events.WorkerLost):
                self._note_last_words()
            raise EvaluationError(
                self._state.failed + self._more(event) + (f". {self.transport.shortage()}." if is_late else "")
            )
        return accepted

    def _note_last_words(self) -> None:
        lost = self._state.last_lost
        if lost is not None and not self._state.last_words and (words := self.transport.last_words(lost)):
            note_last_words(self._state, lost, words)

    def _more(self, event: events.Event) -> str:
        """What the error that ends the run says of the work item that was lost too often with `event`."""
        most = self._state.limits.max_attempts
        items = self._state.items
        lost = [work for item, work in self._work.items() if item in items and items[item].faults >= most]
        if isinstance(event, events.Failure) or not lost:
            return ""
        text = self.describe(lost[0])
        return f"\n{text}" if text else ""

    def _tell(self, entry: events.Event | events.Command) -> None:
        """Write an event or a command to the dispatch log and to `logging`, there also a traceback at level DEBUG."""
        self._log(entry)
        _LOG.log(logging.INFO if isinstance(entry, _RARE) else logging.DEBUG, "%s", entry)
        if isinstance(entry, events.Failure | events.WorkerLost) and entry.traceback:
            _LOG.debug("worker %d: %s", entry.worker, entry.traceback)
