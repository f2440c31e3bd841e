"""Assignment of work items to workers, and the deadlines of these items. `scheduler.step` uses it.

Idle workers are served first, then workers that can take another item behind the one they run. A work item that failed
on a worker is not assigned to that worker again while another worker is up: otherwise a broken worker that fails at
once would use up the attempts of good items. The time of a work item counts from when its worker begins it. A longer
limit applies if the worker must compile for it, or if its usual duration is not known yet.
"""

from __future__ import annotations

import math

from es_service.dispatch.events import Assign, Command
from es_service.dispatch.scheduler_state import SchedulerState, Slot, Worker, usual_chunk_s


def assign(s: SchedulerState, out: list[Command], now: float) -> SchedulerState:
    """Assign queued items to workers that can take more, idle workers first; this changes the containers of `s`."""
    retries = s.retries
    for load in range(s.limits.in_flight):
        if not s.queue:
            break
        for worker in [worker for worker, record in s.up.items() if len(record.slots) == load]:
            index = _next_for(s, worker)
            if index is None:
                continue
            item_id = s.queue[index]
            del s.queue[index]
            waiting, record = s.items[item_id], s.up[worker]
            s.items[item_id] = waiting._replace(holder=worker)
            retries += waiting.item.size if waiting.last_holder is not None else 0
            slot = Slot(waiting.item, waiting.faults + 1)
            record = record._replace(slots=(*record.slots, slot))
            s.up[worker] = begin_first_slot(s, record, now) if load == 0 else record
            out.append(Assign(worker, item_id, slot.attempt))
    return s if retries == s.retries else s._replace(retries=retries)


def begin_first_slot(state: SchedulerState, worker: Worker, now: float) -> Worker:
    """The worker with the start time and the deadline of its first slot."""
    if not worker.slots:
        return worker._replace(deadline_s=math.inf)
    item, limits = worker.slots[0].item, state.limits
    usual_s = usual_chunk_s(state, item.kind)
    limit, limit_s = "min_deadline_s", max(limits.min_deadline_s, limits.deadline_factor * item.size * (usual_s or 0.0))
    compiles = usual_s is None or item.kind not in worker.warm
    if compiles and limit_s < limits.first_deadline_s:
        limit, limit_s = "first_deadline_s", limits.first_deadline_s
    return worker._replace(started_s=now, deadline_s=now + limit_s, limit=limit)


def _next_for(state: SchedulerState, worker: int) -> int | None:
    """Index in the queue of the first item that may be assigned to a worker, or None."""
    for index, item_id in enumerate(state.queue):
        if state.items[item_id].last_holder != worker or len(state.up) == 1:
            return index
    return None
