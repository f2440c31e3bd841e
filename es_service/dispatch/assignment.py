"""Who gets which task, and by when it must have answered.

Dispatch station, a part of `scheduler.step`. Idle workers come first, then those that have room for another task behind
the one they run. A task that raised waits for another worker rather than go back to the same one, as long as another is
up: a broken worker that raises at once must not use up the attempts of good tasks. The clock of a task starts when its
worker begins it; one that compiles, or whose usual duration is not known, has longer.
"""

from __future__ import annotations

import math

from es_service.dispatch.events import Assign, Command
from es_service.dispatch.scheduler_state import SchedulerState, Slot, Worker, usual_chunk_s


def assign(s: SchedulerState, out: list[Command], now: float) -> SchedulerState:
    """Give queued tasks to workers with room, idle ones first; changes the containers of `s`, which are this step's."""
    retries = s.retries
    for load in range(s.limits.in_flight):
        if not s.queue:
            break
        for worker in [worker for worker, record in s.up.items() if len(record.slots) == load]:
            index = _next_for(s, worker)
            if index is None:
                continue
            key = s.queue[index]
            del s.queue[index]
            waiting, record = s.tasks[key], s.up[worker]
            s.tasks[key] = waiting._replace(holder=worker)
            retries += waiting.task.size if waiting.last_holder is not None else 0
            slot = Slot(waiting.task, waiting.faults + 1)
            record = record._replace(slots=(*record.slots, slot))
            s.up[worker] = begin_first_slot(s, record, now) if load == 0 else record
            out.append(Assign(worker, key, slot.attempt))
    return s if retries == s.retries else s._replace(retries=retries)


def begin_first_slot(state: SchedulerState, worker: Worker, now: float) -> Worker:
    """The worker with the clock of its first slot started, and how long that may take."""
    if not worker.slots:
        return worker._replace(deadline_s=math.inf)
    task, limits = worker.slots[0].task, state.limits
    usual_s = usual_chunk_s(state, task.kind)
    limit, limit_s = "min_deadline_s", max(limits.min_deadline_s, limits.deadline_factor * task.size * (usual_s or 0.0))
    compiles = usual_s is None or task.kind not in worker.warm
    if compiles and limit_s < limits.first_deadline_s:
        limit, limit_s = "first_deadline_s", limits.first_deadline_s
    return worker._replace(started_s=now, deadline_s=now + limit_s, limit=limit)


def _next_for(state: SchedulerState, worker: int) -> int | None:
    """Index of the first queued task that a worker may have."""
    for index, key in enumerate(state.queue):
        if state.tasks[key].last_holder != worker or len(state.up) == 1:
            return index
    return None
