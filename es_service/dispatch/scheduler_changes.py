"""Changes to the containers of a state that `scheduler.step` builds.

Each function keeps the containers consistent: what it changes in one of them it also changes in the others that depend
on it. `s` is the state that is being built, whose containers no other state has.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable

from es_service.dispatch.cheap_copies import Table
from es_service.dispatch.events import WorkItem
from es_service.dispatch.scheduler_state import SchedulerState, Waiting, Worker


def put_worker(s: SchedulerState, group: Table[int, Worker], worker: int, record: Worker) -> None:
    """Store a worker in one of the three groups of `s`; `deadlines` and `free` change with it."""
    old = group.get(worker)
    group[worker] = record
    if old is None or old.deadline_s != record.deadline_s:
        if old is not None:
            _forget_deadline(s, worker, old)
        if record.deadline_s < math.inf:
            s.deadlines.add((record.deadline_s, worker))
    if group is s.up and (old is None or len(old.slots) != len(record.slots)):
        if old is not None:
            _forget_free(s, worker, old)
        if len(record.slots) < s.limits.in_flight:
            s.free.add((len(record.slots), record.rank, worker))


def pop_worker(s: SchedulerState, group: Table[int, Worker], worker: int) -> Worker | None:
    """Remove a worker from one of the three groups of `s` and return it; None if the group does not have it."""
    old = group.pop(worker)
    if old is not None:
        _forget_deadline(s, worker, old)
        if group is s.up:
            _forget_free(s, worker, old)
    return old


def _forget_deadline(s: SchedulerState, worker: int, old: Worker) -> None:
    if old.deadline_s < math.inf:
        s.deadlines.remove((old.deadline_s, worker))


def _forget_free(s: SchedulerState, worker: int, old: Worker) -> None:
    if len(old.slots) < s.limits.in_flight:
        s.free.remove((len(old.slots), old.rank, worker))


def append_items(s: SchedulerState, items: Iterable[WorkItem]) -> None:
    """Store new work items, at the end of the queue.

    Raises:
        ValueError: one has been submitted before and not delivered yet.
    """
    last = s.places.last()
    places = []
    for place, item in enumerate(items, 0 if last is None else last[0] + 1):
        if item.id in s.items:
            raise ValueError(f"work item {item.id} was submitted again before it was delivered")
        s.items[item.id] = Waiting(item, place=place)
        places.append((place, item.id))
    s.places.extend(places)


def take_item(s: SchedulerState, waiting: Waiting, worker: int) -> None:
    """Move a work item from the queue to a worker."""
    s.items[waiting.item.id] = Waiting(waiting.item, waiting.faults, holder=worker, last_holder=waiting.last_holder)
    _leave_queue(s, waiting)


def return_item(s: SchedulerState, worker: int, item_id: Hashable) -> None:
    """Move a work item from a worker to the front of the queue."""
    first = s.places.first()
    place = 0 if first is None else first[0] - 1
    s.items[item_id] = s.items[item_id]._replace(place=place, holder=None, last_holder=worker)
    s.places.add((place, item_id))


def drop_item(s: SchedulerState, item_id: Hashable) -> bool:
    """Forget a work item, wherever it is; returns whether there was one."""
    waiting = s.items.pop(item_id)
    if waiting is not None:
        _leave_queue(s, waiting)
    return waiting is not None


def _leave_queue(s: SchedulerState, waiting: Waiting) -> None:
    if waiting.place is not None:
        s.places.remove((waiting.place, waiting.item.id))
