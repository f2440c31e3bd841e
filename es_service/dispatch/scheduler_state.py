"""What the scheduler remembers, and what follows from it without an event.

Dispatch station, the data of `scheduler.step`. The records are frozen and shared between states.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

from es_service.dispatch.events import Limits, WorkItem, with_last_words


class Waiting(NamedTuple):
    """A work item that has not been delivered."""

    item: WorkItem
    faults: int = 0
    holder: int | None = None
    """The worker it is assigned to; None while it is in the queue."""
    last_holder: int | None = None
    """The worker it came back from; None before that."""


class Slot(NamedTuple):
    item: WorkItem
    attempt: int


class Worker(NamedTuple):
    """A worker that came up. `slots` is what it has not answered yet, in the order sent; it runs the first."""

    slots: tuple[Slot, ...] = ()
    started_s: float = 0.0
    """When it began the first slot."""
    deadline_s: float = math.inf
    """When it must have answered the first slot."""
    limit: str = ""
    """Field of the limits that this comes from."""
    warm: frozenset[str] = frozenset()
    """Kinds it has finished a work item of, hence compiled."""
    failures_in_a_row: int = 0


class SchedulerState(NamedTuple):
    """Everything the scheduler remembers. Treat the containers as read-only; times are in the seconds of `now`."""

    limits: Limits
    wanted: int
    starting: dict[int, float]
    """Deadline of each worker that has not come up yet."""
    up: dict[int, Worker]
    draining: dict[int, Worker]
    items: dict[Hashable, Waiting]
    queue: deque[Hashable]
    """Keys to assign, next first."""
    durations_s: dict[str, tuple[float, ...]]
    """Recent durations of a chunk per kind, without those that include compiling."""
    next_worker: int = 0
    start_at_s: float = -math.inf
    """No worker is started before this."""
    losses_in_a_row: int = 0
    start_failures: int = 0
    """Tries in a row to start workers that failed."""
    tried: int = 0
    """Workers below this had been started when the last such failure was counted: they are part of it."""
    down_since_s: float | None = None
    """Since when work items wait and no worker is up."""
    last_lost: int | None = None
    """The worker that was lost last, and why:"""
    last_loss: str = "none was ever lost"
    failed: str | None = None
    """The message of `Fail`; the state is then terminal."""
    retries: int = 0
    """Chunks assigned again: of each assignment of a work item beyond its first."""
    lost_workers: int = 0
    """Workers lost, or stopped for a fault."""
    duplicates: int = 0
    """Results and failures that were dropped: stale, repeated, or of an unknown worker."""


def initial_state(limits: Limits) -> SchedulerState:
    """No item and no worker yet; the first step, whatever its event, starts the workers."""
    return SchedulerState(limits, limits.workers, {}, {}, {}, {}, deque(), {})


def pending(state: SchedulerState) -> int:
    """Number of items submitted and not delivered."""
    return len(state.items)


def usual_chunk_s(state: SchedulerState, kind: str) -> float | None:
    """How long a chunk of this kind takes in the median; None while that is not known."""
    durations_s = state.durations_s.get(kind)
    return statistics.median(durations_s) if durations_s else None


def next_deadline(state: SchedulerState) -> float:
    """When the next `Tick` will do something, in the seconds of `now`; infinity if only a message can."""
    if state.failed is not None:
        return math.inf
    times = [worker.deadline_s for group in (state.up, state.draining) for worker in group.values()]
    times.extend(state.starting.values())
    if len(state.starting) + len(state.up) < state.wanted:
        times.append(state.start_at_s)
    if state.down_since_s is not None:
        times.append(state.down_since_s + state.limits.no_worker_timeout_s)
    return min(times, default=math.inf)


def told_last_words(state: SchedulerState, worker: int, last_words: str) -> SchedulerState:
    """The state when it is known what the process of a worker just stopped had written. That is told of the last loss,
    and of the failure of the run if it came of this loss."""
    if worker != state.last_lost:
        return state
    failed = None if state.failed is None else with_last_words(state.failed, last_words)
    return state._replace(last_loss=with_last_words(state.last_loss, last_words), failed=failed)


def find_slot(worker: Worker, item_id: Hashable, attempt: int) -> int | None:
    """Index of what a worker has not answered yet; None if it was sent no such thing, or has answered it."""
    for index, slot in enumerate(worker.slots):
        if slot.attempt == attempt and slot.item.id == item_id:
            return index
    return None


def holds(state: SchedulerState, worker: int, item_id: Hashable) -> bool:
    """Whether a work item waits for the answer of this worker."""
    waiting = state.items.get(item_id)
    return waiting is not None and waiting.holder == worker
