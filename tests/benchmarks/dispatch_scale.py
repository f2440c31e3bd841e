"""What do many work items and many workers cost the driver?

    python -m tests.benchmarks.dispatch_scale
    python -m tests.benchmarks.dispatch_scale --transport       # what a message between two processes costs

Real scheduler and engine; the transport answers at once, in this process, so that what is measured is the driver alone.
Each item is one chunk. A generation is one call of `Engine.evaluate`; the first one finds the workers' first items, so
the seconds are the median of those after it. The scheduler alone is given the answers of a generation one by one, and
its microseconds are per answer; a submitted item is assigned at once if there is a worker for it. One JSON row each.
With --transport, another process sends back what it is sent: over a socket, as the engine inline does, and through
shared memory, for which both sides spin. Microseconds of a round trip by the clock, and of the processor on each side.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import signal
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.events import Assign, Compiled, Limits, Result, Submit, Tick, WorkerUp, WorkItem
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import initial_state, next_deadline, pending
from es_service.protocol.child import socket_pair
from es_service.protocol.messages import NO_CENTRE, GradientResult, TrainingChunk, Work, WorkItemId, with_subject
from es_service.protocol.wire import framed, receive

SIZES = ((10, 10), (100, 100), (1000, 1000), (10_000, 10_000), (10_000, 100))
"""(items, workers)."""
GENERATIONS = 6
ROUND_TRIPS = 3000
_RESULT = GradientResult(np.zeros(0, np.float32))


class AnswersAtOnce:
    """A transport whose workers come up and answer as soon as they are asked."""

    def __init__(self) -> None:
        self._inbox: deque[Message] = deque()

    def start(self, worker: int) -> None:
        self._inbox += [WorkerUp(worker), Compiled(worker, "TrainingChunk", 0.0)]

    def last_words(self, worker: int) -> str:
        return ""

    def kill(self, worker: int) -> str:
        return ""

    def send(self, worker: int, item_id: Hashable, attempt: int, work: Sequence[Work]) -> None:
        self._inbox.append(Answer(worker, item_id, attempt, [_RESULT] * len(work)))

    def cpu_s(self) -> float:
        return math.nan

    def platforms(self) -> frozenset[str]:
        return frozenset()

    def silent(self) -> tuple[int, ...]:
        return ()

    def shortage(self) -> str:
        return ""

    def receive(self, timeout_s: float) -> Message | None:
        return self._inbox.popleft() if self._inbox else None

    def close(self) -> None:
        self._inbox.clear()


def limits_of(workers: int) -> Limits:
    """Limits under which an item is one chunk, however short."""
    return Limits(workers=workers, item_s=0.0)


def engine_seconds(items: int, workers: int) -> list[float]:
    """Seconds of each generation but the first."""
    seconds = []
    with Engine(AnswersAtOnce(), limits_of(workers)) as engine:
        for generation in range(GENERATIONS):
            work = with_subject(NO_CENTRE, [TrainingChunk(generation, chunk_id) for chunk_id in range(items)])
            started = time.perf_counter()
            engine.evaluate(work)
            seconds.append(time.perf_counter() - started)
    return seconds[1:]


def scheduler_seconds(items: int, workers: int) -> tuple[float, float]:
    """Seconds of the scheduler alone: for an item that is submitted, and for one that is answered."""
    state = initial_state(limits_of(workers))
    handle(state, Tick(), 0.0)
    for worker in range(workers):
        for event in (WorkerUp(worker), Compiled(worker, "TrainingChunk", 0.0)):
            handle(state, event, 0.0)
    submit, answer = [], []
    for generation in range(GENERATIONS):
        ids = [WorkItemId(generation, index, "TrainingChunk", generation, 0, index, 1) for index in range(items)]
        event = Submit(tuple(WorkItem(item_id, item_id.kind) for item_id in ids))
        started = time.perf_counter()
        commands = handle(state, event, started)
        submit.append((time.perf_counter() - started) / items)
        waiting, seconds = deque(commands), 0.0
        while waiting:
            command = waiting.popleft()
            if isinstance(command, Assign):
                event = Result(command.worker, command.item_id, command.attempt)
                started = time.perf_counter()
                next_deadline(state)  # the engine asks before each wait
                more = handle(state, event, started)
                seconds += time.perf_counter() - started
                waiting.extend(more)
        answer.append(seconds / items)
        assert pending(state) == 0
    return statistics.median(submit[1:]), statistics.median(answer[1:])


def measure(items: int, workers: int) -> dict[str, Any]:
    seconds = engine_seconds(items, workers)
    submit_s, answer_s = scheduler_seconds(items, workers)
    return {
        "items": items,
        "workers": workers,
        "seconds_per_generation": round(statistics.median(seconds), 5),
        "slowest_generation": round(max(seconds), 5),
        "scheduler_us_per_event": round(answer_s * 1e6, 1),
        "scheduler_us_per_submitted_item": round(submit_s * 1e6, 1),
    }


def transport_us(size: int) -> dict[str, Any]:
    """Round trips of a message of this size over a socket."""
    ours, theirs = socket_pair()

    def there() -> None:
        while True:
            theirs.sendall(framed(receive(theirs)))

    def round_trip(number: int) -> None:
        ours.sendall(framed(message))
        receive(ours)

    message = bytes(size)
    return {"bytes": size, **_measured(there, round_trip)}


def spinning_us() -> dict[str, Any]:
    """Round trips of a number through shared memory."""
    memory = np.frombuffer(mmap.mmap(-1, 4096), np.int64)

    def there() -> None:
        seen = 0
        while True:
            while memory[0] == seen:
                pass
            seen = memory[64] = memory[0]

    def round_trip(number: int) -> None:
        memory[0] = number
        while memory[64] != number:
            pass

    return {"spinning": True, **_measured(there, round_trip)}


def _measured(there: Callable[[], None], round_trip: Callable[[int], None]) -> dict[str, float]:
    if not (child := os.fork()):
        there()
    started, used = time.perf_counter(), time.process_time()
    for number in range(1, ROUND_TRIPS + 1):
        round_trip(number)
    clock_s, here_s = time.perf_counter() - started, time.process_time() - used
    os.kill(child, signal.SIGKILL)
    usage = os.wait4(child, 0)[2]
    seconds = {"clock": clock_s, "processor_here": here_s, "processor_there": usage.ru_utime + usage.ru_stime}
    return {f"{name}_us": round(value / ROUND_TRIPS * 1e6, 1) for name, value in seconds.items()}


def main() -> None:
    if "--transport" in sys.argv[1:]:
        for row in (*map(transport_us, (200, 4_000, 40_000)), spinning_us()):
            print(json.dumps(row), flush=True)
        return
    for items, workers in SIZES:
        print(json.dumps(measure(items, workers)), flush=True)


if __name__ == "__main__":
    main()
