"""State of the scheduler, functions of the state alone, and changes to its containers.

It is the data of `scheduler.handle`, which changes it. The records in its containers are immutable.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Hashable, Iterable
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
    return slots[:index] + slots[index + 1 :]


def holds(state: SchedulerState, worker: int, item_id: Hashable) -> bool:
    """Whether a work item is assigned to a worker and has not been delivered."""
    waiting = state.items.get(item_id)
    return waiting is not None and worker in (waiting.holder, waiting.second)


# Changes to the containers of the scheduler's state.
#
# Each function keeps the containers consistent: what it changes in one of them it also changes in the others that
# depend on it.


def put_worker(s: SchedulerState, group: dict[int, Worker], worker: int, record: Worker) -> None:
    """Store a worker in one of the three groups of `s`; the other containers that depend on it change with it."""
    old = group.get(worker)
    group[worker] = record
    old_s, new_s = math.inf if old is None else next_time(old), next_time(record)
    if old_s != new_s:
        if old_s < math.inf:
            s.deadlines.remove((old_s, worker))
        if new_s < math.inf:
            s.deadlines.add((new_s, worker))
    if record.preparing is not None:
        s.preparing[worker] = record.preparing
    elif old is not None and old.preparing is not None:
        del s.preparing[worker]
    if group is s.up and (old is None or len(old.slots) != len(record.slots) or old.pace != record.pace):
        if old is not None:
            _forget_free(s, worker, old)
        if len(record.slots) < s.limits.in_flight:
            s.free.add((len(record.slots), record.pace, record.rank, worker))
    was_in_time = old is not None and old.pace == IN_TIME
    if group is s.up:
        s.in_time += (record.pace == IN_TIME) - was_in_time
    if record.pace != IN_TIME or (old is not None and not was_in_time):
        for slot in record.slots:
            _update_late(s, slot.item.id)


def pop_worker(s: SchedulerState, group: dict[int, Worker], worker: int) -> Worker | None:
    """Remove a worker from one of the three groups of `s` and return it; None if the group does not have it."""
    old = group.pop(worker, None)
    if old is not None:
        if (at_s := next_time(old)) < math.inf:
            s.deadlines.remove((at_s, worker))
        s.preparing.pop(worker, None)
        if group is s.up:
            _forget_free(s, worker, old)
            s.in_time -= old.pace == IN_TIME
    return old


def _forget_free(s: SchedulerState, worker: int, old: Worker) -> None:
    if len(old.slots) < s.limits.in_flight:
        s.free.remove((len(old.slots), old.pace, old.rank, worker))


def append_items(s: SchedulerState, items: Iterable[WorkItem]) -> None:
    """Store new work items, at the end of the queue.

    Raises:
        ValueError: one has been submitted before and not delivered yet.
    """
    for place, item in enumerate(items, s.places[-1][0] + 1 if s.places else 0):
        if item.id in s.items:
            raise ValueError(f"work item {item.id} was submitted again before it was delivered")
        s.items[item.id] = Waiting(item, place=place)
        s.places.add((place, item.id))


def take_item(s: SchedulerState, waiting: Waiting, worker: int) -> None:
    """Move a work item from the queue to a worker."""
    s.items[waiting.item.id] = Waiting(waiting.item, waiting.faults, holder=worker, last_holder=waiting.last_holder)
    _leave_queue(s, waiting)


def copy_item(s: SchedulerState, item_id: Hashable, worker: int) -> None:
    """Give a worker the second copy of a work item."""
    s.items[item_id] = s.items[item_id]._replace(second=worker)
    _update_late(s, item_id)


def return_item(s: SchedulerState, worker: int, item_id: Hashable) -> None:
    """Take a work item from a worker. If no other worker has a copy, it moves to the front of the queue."""
    waiting = s.items[item_id]
    if waiting.second is not None:
        other = waiting.second if waiting.holder == worker else waiting.holder
        s.items[item_id] = waiting._replace(holder=other, second=None, last_holder=worker)
    else:
        place = s.places[0][0] - 1 if s.places else 0
        s.items[item_id] = waiting._replace(place=place, holder=None, last_holder=worker)
        s.places.add((place, item_id))
    _update_late(s, item_id)


def drop_item(s: SchedulerState, item_id: Hashable) -> bool:
    """Forget a work item, wherever it is; returns whether there was one."""
    waiting = s.items.pop(item_id, None)
    if waiting is not None:
        _leave_queue(s, waiting)
        if waiting.late is not None:
            s.late.remove((waiting.late, item_id))
    return waiting is not None


def _leave_queue(s: SchedulerState, waiting: Waiting) -> None:
    if waiting.place is not None:
        s.places.remove((waiting.place, waiting.item.id))


def _update_late(s: SchedulerState, item_id: Hashable) -> None:
    """Put a work item into `late` if it belongs there, or remove it.

    It belongs there if its first holder, which must be the only one so far, is not IN_TIME. An item that was taken
    from a worker does not, since it may be the reason for the worker's loss.
    """
    waiting = s.items.get(item_id)
    if waiting is None:
        return
    belongs = False
    if waiting.holder is not None and waiting.second is None and waiting.last_holder is None:
        record = s.up.get(waiting.holder) or s.draining.get(waiting.holder)
        belongs = record is not None and record.pace != IN_TIME
    if belongs and waiting.late is None:
        place = s.late[-1][0] + 1 if s.late else 0
        s.late.add((place, item_id))
        s.items[item_id] = waiting._replace(late=place)
    elif not belongs and waiting.late is not None:
        s.late.remove((waiting.late, item_id))
        s.items[item_id] = waiting._replace(late=None)
