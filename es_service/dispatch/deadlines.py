"""How long a worker may take for a work item, and what is said of one that takes longer. `scheduler.handle` uses it.

The time of a work item counts from when its worker begins it. A worker first compiles for the first item of a kind,
which has a limit of its own, and the time of that item counts from the end of compiling, so that its duration is known
like that of any other. While no duration of a kind is known, a longer limit applies to its items.
"""

from __future__ import annotations

import math

from es_service.dispatch.events import Compiled, key_of
from es_service.dispatch.scheduler_changes import put_worker
from es_service.dispatch.scheduler_state import SchedulerState, Worker, usual_chunk_s
from es_service.protocol.messages import GradientChunk

RECENT_DURATIONS = 31
"""Number of durations per kind of work item from which the running median is computed."""


def begin_first_slot(state: SchedulerState, worker: Worker, now: float) -> Worker:
    """The worker with the start time of its first slot, and the times from which it is late with it or stopped."""
    if not worker.slots:
        return worker._replace(deadline_s=math.inf, late_s=math.inf)
    item, limits = worker.slots[0].item, state.limits
    if item.kind not in worker.warm:
        limit, limit_s = "compile_timeout_s", limits.compile_timeout_s
        return worker._replace(started_s=now, deadline_s=now + limit_s, limit=limit, late_s=math.inf)
    usual_s = usual_chunk_s(state, item.kind)
    long_s = limits.deadline_factor * item.size * (usual_s or 0.0)
    limit, limit_s = "chunk_timeout_s", max(limits.chunk_timeout_s, long_s)
    if usual_s is None and limit_s < limits.first_chunk_timeout_s:
        limit, limit_s = "first_chunk_timeout_s", limits.first_chunk_timeout_s
    if limits.time_limit_s is not None and item.kind != GradientChunk.__name__:
        limit, limit_s = "time_limit_s", item.size * limits.time_limit_s
    usual_item_s = math.inf if usual_s is None else item.size * usual_s
    late_s = now + max(limits.late_factor * usual_item_s, usual_item_s + limits.late_by_s)
    return worker._replace(started_s=now, deadline_s=now + limit_s, limit=limit, late_s=late_s)


def note_compiled(s: SchedulerState, event: Compiled, now: float) -> None:
    """Remember that a worker has compiled for a kind.

    If it did so for its first slot, the time of that item counts from the end of compiling, as the worker measured it,
    since the message may have been read later.
    """
    group = s.up if event.worker in s.up else s.draining
    record = group.get(event.worker)
    if record is None or event.kind in record.warm:
        return
    record = record._replace(warm=record.warm | {event.kind})
    if record.slots and record.slots[0].item.kind == event.kind:
        record = begin_first_slot(s, record, min(now, record.started_s + event.seconds))
    put_worker(s, group, event.worker, record)


def missed_deadline(s: SchedulerState, worker: int) -> str:
    """Text that says what a worker has not done in time."""
    record = s.up.get(worker) or s.draining.get(worker)
    if record is None:
        limit_s = s.limits.start_timeout_s
        return f"did not come up within {plain(limit_s)} s ({key_of('start_timeout_s')})"
    item_id, name = record.slots[0].item.id, key_of(record.limit)
    within = f"within {plain(record.deadline_s - record.started_s)} s"
    if record.limit == "compile_timeout_s":
        return f"did not finish compiling for work item {item_id} {within} ({name})"
    return f"no answer to work item {item_id} {within} of computing ({name})"


def plain(seconds: float) -> str:
    """A number of seconds with at most three significant digits, or as a whole number from 100 on; no exponent."""
    return f"{seconds:.0f}" if seconds >= 100.0 else f"{seconds:.3g}"
