"""Assignment of work items to workers, and the deadlines of these items. `scheduler.step` uses it.

Idle workers are served first, those that answered their last item in time before others, then workers that can take
another item behind the one they run. A work item that failed on a worker is not assigned to that worker again while
another worker is up: otherwise a broken worker that fails at once would use up the attempts of good items. The time of
a work item counts from when its worker begins it. A longer limit applies if the worker must compile for it, or if its
usual duration is not known yet.
"""

from __future__ import annotations

import math

from es_service.dispatch.events import Assign, Command
from es_service.dispatch.scheduler_changes import put_worker, take_item
from es_service.dispatch.scheduler_state import SchedulerState, Slot, Waiting, Worker, usual_chunk_s

RECENT_DURATIONS = 31
"""Number of durations per kind of work item from which the running median is computed."""


def assign(s: SchedulerState, out: list[Command], now: float) -> SchedulerState:
    """Assign queued items to workers that can take more, idle workers first; this changes the containers of `s`."""
    retries = s.retries
    for load in range(s.limits.in_flight):
        for slots, _, _, worker in s.free:  # as they are before this round
            if slots > load or not s.places:
                break
            waiting = _next_for(s, worker) if slots == load else None
            if waiting is None:
                continue
            take_item(s, waiting, worker)
            retries += waiting.item.size if waiting.last_holder is not None else 0
            slot, record = Slot(waiting.item, waiting.faults + 1), s.up[worker]
            record = record._replace(slots=(*record.slots, slot))
            put_worker(s, s.up, worker, begin_first_slot(s, record, now) if load == 0 else record)
            out.append(Assign(worker, waiting.item.id, slot.attempt))
    return s if retries == s.retries else s._replace(retries=retries)


def begin_first_slot(state: SchedulerState, worker: Worker, now: float) -> Worker:
    """The worker with the start time of its first slot, and the times from which it is late with it or stopped."""
    if not worker.slots:
        return worker._replace(deadline_s=math.inf, late_s=math.inf)
    item, limits = worker.slots[0].item, state.limits
    usual_s = usual_chunk_s(state, item.kind)
    limit, limit_s = "min_deadline_s", max(limits.min_deadline_s, limits.deadline_factor * item.size * (usual_s or 0.0))
    compiles = usual_s is None or item.kind not in worker.warm
    if compiles and limit_s < limits.first_deadline_s:
        limit, limit_s = "first_deadline_s", limits.first_deadline_s
    usual_item_s = math.inf if usual_s is None else item.size * usual_s
    late_s = now + max(limits.late_factor * usual_item_s, usual_item_s + limits.late_by_s)
    return worker._replace(started_s=now, deadline_s=now + limit_s, limit=limit, late_s=late_s)


def add_duration(s: SchedulerState, kind: str, chunk_s: float) -> None:
    """Remember how long a chunk of a kind took, in seconds, and forget the oldest duration if there are many."""
    s.durations_s[kind] = (*s.durations_s.get(kind, ()), chunk_s)[-RECENT_DURATIONS:]


def _next_for(s: SchedulerState, worker: int) -> Waiting | None:
    """The first item in the queue that may be assigned to a worker, or None."""
    for _, item_id in s.places:
        waiting = s.items[item_id]
        if waiting.last_holder != worker or len(s.up) == 1:
            return waiting
    return None
