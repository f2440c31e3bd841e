"""Changes to the containers of the scheduler's state.

Each function keeps the containers consistent: what it changes in one of them it also changes in the others that depend
on it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable

from es_service.dispatch.events import WorkItem
from es_service.dispatch.scheduler_state import IN_TIME, SchedulerState, Waiting, Worker, next_time


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
