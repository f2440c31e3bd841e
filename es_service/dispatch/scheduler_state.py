"""State of the scheduler, and functions of the state alone.

It is the data of `scheduler.handle`, which changes it. The records in its containers are immutable.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Hashable
from dataclasses import dataclass, field
from itertools import takewhile
from typing import NamedTuple

from sortedcontainers import SortedList

from es_service.dispatch.events import Limits, Progress, WorkItem, because, with_last_words

IN_TIME, LATE, NEW = range(3)
"""Values of `Worker.pace`, best first."""


class Waiting(NamedTuple):
    """A work item that has not been delivered."""

    item: WorkItem
    faults: int = 0
    place: int | None = None
    """Its place in the queue, smaller than the places of later items; None while it is assigned to a worker."""
    holder: int | None = None
    """The worker that the item is assigned to; None while it is in the queue."""
    second: int | None = None
    """The worker that has a second copy of the item; None if there is no copy."""
    late: int | None = None
    """Its place in `SchedulerState.late`; None if it is not there."""
    last_holder: int | None = None
    """The worker that last had the item without delivering it; None if there was none."""


class Slot(NamedTuple):
    """A work item that was sent to a worker, with the number of the attempt."""

    item: WorkItem
    attempt: int


class Worker(NamedTuple):
    """A worker."""

    rank: int
    """Position in the order in which workers of its group joined the group; it need not be contiguous."""
    slots: tuple[Slot, ...] = ()
    """Work items that it has not answered yet, in the order in which they were sent; it runs the first."""
    started_s: float = 0.0
    """Time at which it began the first slot, or ended compiling for it."""
    deadline_s: float = math.inf
    """Time by which it must come up, or have compiled for the first slot, or answer it, or report progress with it."""
    allowed_s: float = math.inf
    """Time by which it must do so if it reports no progress."""
    heard_s: float = -math.inf
    """Time of its newest report of progress with this; -infinity if there is none."""
    preparing: Progress | None = None
    """This report, if it makes or resets environments."""
    late_s: float = math.inf
    """Time from which it is late with the first slot; infinity if the usual duration is not known, and -infinity once
    it is known to be late."""
    pace: int = NEW
    """IN_TIME or LATE, as it was with its last item or is known to be with the first slot; NEW before its first answer.
    """
    limit: str = ""
    """Field of `Limits` that determines the deadline for the first slot."""
    warm: frozenset[str] = frozenset()
    """Kinds for which it has compiled."""
    failures_in_a_row: int = 0
    """Consecutive work items that raised an exception."""
    placed: bool = False
    """Whether it is starting and has reported its place."""


@dataclass(slots=True)
class SchedulerState:
    """Complete state of the scheduler, which only `scheduler.handle` changes; times are in seconds, as its `now`."""

    limits: Limits
    wanted: int
    """Number of workers that should run."""
    starting: dict[int, Worker] = field(default_factory=dict)
    """Workers that have not come up yet."""
    up: dict[int, Worker] = field(default_factory=dict)
    """Workers that can be assigned work items."""
    draining: dict[int, Worker] = field(default_factory=dict)
    """Workers that finish their work items and get no others."""
    deadlines: SortedList = field(default_factory=SortedList)
    """(next time at which it is late or must be stopped, worker) of every worker of these three groups that has one."""
    free: SortedList = field(default_factory=SortedList)
    """(number of its slots, pace, rank, worker) of every worker that can be assigned another work item."""
    in_time: int = 0
    """Number of workers that are up and IN_TIME."""
    preparing: dict[int, Progress] = field(default_factory=dict)
    """Report of every worker of these three groups that makes or resets environments."""
    items: dict[Hashable, Waiting] = field(default_factory=dict)
    """Work items that have not been delivered, by id."""
    places: SortedList = field(default_factory=SortedList)
    """(place, id) of every work item in the queue."""
    late: SortedList = field(default_factory=SortedList)
    """(place, id) of every work item that may be sent a second time, see assignment.py."""
    durations_s: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Kind -> recent durations of one chunk, without compiling."""
    next_worker: int = 0
    """Id of the next worker to start."""
    next_rank: int = 0
    """Rank of the next worker that comes up or drains."""
    start_at_s: float = -math.inf
    """Time before which no worker is started."""
    losses_in_a_row: int = 0
    """Losses since the last delivered result, where losses that share a wait count once."""
    start_failures: int = 0
    """Consecutive failed attempts to start workers."""
    tried: int = 0
    """Workers with a lower id were started before the last of these failures was counted, and belong to it."""
    down_since_s: float | None = None
    """Time since which `is_down`; None if this is not so."""
    last_lost: int | None = None
    """The worker that was lost last."""
    last_loss: str = ""
    """The reason of this loss."""
    last_words: str = ""
    """The last output of this worker's process, if it was stopped for a fault and its output is available."""
    failed: str | None = None
    """Message of `Fail`, after which the state never changes; None before that."""
    retries: int = 0
    """Chunks that were assigned again, counted at each assignment of a work item after the first."""
    lost_workers: int = 0
    """Workers that were lost, or stopped because of a fault."""
    copies: int = 0
    """Chunks that were sent a second time because a worker was late with them; these are no retries."""
    duplicates: int = 0
    """Results and failures that were ignored: outdated, repeated, or from an unknown worker."""

    @property
    def queue(self) -> list[Hashable]:
        """Ids of the work items to assign; the next one is first."""
        return [item_id for _, item_id in self.places]


def initial_state(limits: Limits) -> SchedulerState:
    """State without work items and workers; the first event starts the workers, whichever it is."""
    return SchedulerState(limits, limits.workers)


def pending(state: SchedulerState) -> int:
    """Number of work items that have been submitted but not delivered."""
    return len(state.items)


def usual_chunk_s(state: SchedulerState, kind: str) -> float | None:
    """Median of the recent durations in seconds of a chunk of a kind; None if there are none yet."""
    durations_s = state.durations_s.get(kind)
    return statistics.median(durations_s) if durations_s else None


def is_down(state: SchedulerState) -> bool:
    """Whether work items wait and no worker is up; before the first has come up, whether none has a place.

    The time in which one that has a place comes up is limited by `start_timeout_s`.
    """
    if state.up or state.draining:
        return False
    if state.next_rank:
        return bool(state.items)
    return not any(record.placed for record in state.starting.values())


def is_waiting(state: SchedulerState) -> bool:
    """Whether the run waits for its first place: `is_down`, and no worker has come up so far."""
    return state.down_since_s is not None and not state.next_rank


def down_limit(state: SchedulerState) -> tuple[str, float]:
    """Field of `Limits` that limits the time for which the state `is_down`, and its value in seconds."""
    for_place = not state.next_rank and state.limits.waits_for_place
    name = "place_timeout_s" if for_place else "no_worker_timeout_s"
    return name, getattr(state.limits, name)


def workers_with_place(state: SchedulerState) -> int:
    """Number of workers that can be assigned work items, now or when they have come up."""
    return len(state.up) + sum(record.placed for record in state.starting.values())


def by_progress(state: SchedulerState) -> list[int]:
    """Workers that are up, then those that start and have a place, then those that wait for one; each oldest first."""
    return [*sorted(state.up), *sorted(state.starting, key=lambda worker: (not state.starting[worker].placed, worker))]


def next_deadline(state: SchedulerState) -> float:
    """Time of the next deadline, at which a `Tick` has an effect; infinity if there is none."""
    if state.failed is not None:
        return math.inf
    if state.late and has_idle_worker_for_copies(state):
        return -math.inf
    at_s = state.deadlines[0][0] if state.deadlines else math.inf
    if len(state.starting) + len(state.up) < state.wanted:
        at_s = min(at_s, state.start_at_s)
    if state.down_since_s is not None:
        at_s = min(at_s, state.down_since_s + down_limit(state)[1])
    return at_s


def next_time(worker: Worker) -> float:
    """Next time at which a worker is late or must be stopped; infinity if there is none."""
    late_s, deadline_s = worker.late_s, worker.deadline_s
    return late_s if -math.inf < late_s < deadline_s else deadline_s


def has_idle_worker_for_copies(state: SchedulerState) -> bool:
    """Whether the queue is empty, and an idle worker can take an item of another one, as assignment.py explains."""
    if not state.late or state.places or state.limits.late_factor == math.inf:
        return False
    slots, pace, *_ = state.free[0] if state.free else (1, NEW)
    if slots or pace == IN_TIME or state.in_time:
        return not slots and pace == IN_TIME
    return pace == LATE or _first_late_pace(state) == LATE


def _first_late_pace(state: SchedulerState) -> int:
    """Pace of the worker that has the first item in `late`."""
    holder = state.items[state.late[0][1]].holder
    assert holder is not None
    return (state.up.get(holder) or state.draining[holder]).pace


def late_workers(state: SchedulerState, now: float) -> list[int]:
    """Workers whose deadline has passed: first those that start, then those that are up, then those that drain."""
    late = []
    for _, worker in takewhile(lambda entry: entry[0] <= now, state.deadlines):
        position = next(
            (number, group[worker].rank)
            for number, group in enumerate((state.starting, state.up, state.draining))
            if worker in group
        )
        late.append((position, worker))
    return [worker for _, worker in sorted(late)]


def note_last_words(state: SchedulerState, worker: int, last_words: str) -> None:
    """Remember the last output of a stopped worker's process, also in the message of `Fail` if its loss made the run
    fail."""
    if worker == state.last_lost:
        state.last_words = last_words
        state.failed = None if state.failed is None else with_last_words(state.failed, last_words)


def loss_text(state: SchedulerState, what: str = "") -> str:
    """Text that names the worker lost last and the reason, after what it is said for."""
    if state.last_lost is None:
        return f"{what}no worker was lost"
    return with_last_words(because(f"{what}worker {state.last_lost}", state.last_loss), state.last_words)


def find_slot(worker: Worker, item_id: Hashable, attempt: int) -> int | None:
    """Index of the slot with an attempt at a work item; None if the worker was not sent it or has answered it."""
    for index, slot in enumerate(worker.slots):
        if slot.attempt == attempt and slot.item.id == item_id:
            return index
    return None


def without(slots: tuple[Slot, ...], index: int) -> tuple[Slot, ...]:
    """Slots without the one at an index."""
    return slots[:index] + slots[index + 1 :]


def holds(state: SchedulerState, worker: int, item_id: Hashable) -> bool:
    """Whether a work item is assigned to a worker and has not been delivered."""
    waiting = state.items.get(item_id)
    return waiting is not None and worker in (waiting.holder, waiting.second)
