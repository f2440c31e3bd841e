"""How long a worker may take for a work item, and what is said of one that takes longer. `scheduler.handle` uses it.

The time of a work item counts from when its worker begins it. A worker first compiles for the first item of a kind,
which has a limit of its own, and the time of that item counts from the end of compiling, so that its duration is known
like that of any other. While no duration of a kind is known, a longer limit applies to its items.

How long episodes last may change from one chunk to the next, when a first policy survives. So a worker that reports
progress is given `chunk_timeout_s` from each report on, or as long as for compiling while it makes or resets
environments; and since not all work can report, every attempt at an item may take twice as long as the one before it.
Only a limit that the config gives to each chunk holds whatever is reported, in every attempt.
"""

from __future__ import annotations

import math

from es_service.dispatch.events import Compiled, Progress, key_of
from es_service.dispatch.scheduler_changes import put_worker
from es_service.dispatch.scheduler_state import SchedulerState, Worker, usual_chunk_s
from es_service.protocol.messages import GradientChunk

RECENT_DURATIONS = 31
"""Number of durations per kind of work item from which the running median is computed."""
MOST_DOUBLINGS = 10
"""Attempts after which the time for a work item no longer doubles."""


def start_deadline(state: SchedulerState, worker: Worker, now: float) -> Worker:
    """The starting worker with the time by which it must come up."""
    at_s = now + state.limits.start_timeout_s
    return worker._replace(started_s=now, deadline_s=at_s, allowed_s=at_s, limit="start_timeout_s")


def begin_first_slot(state: SchedulerState, worker: Worker, now: float) -> Worker:
    """The worker with the start time of its first slot, and the times from which it is late with it or stopped."""
    worker = worker._replace(heard_s=-math.inf, preparing=None)
    if not worker.slots:
        return worker._replace(deadline_s=math.inf, late_s=math.inf)
    item, limits, times = worker.slots[0].item, state.limits, _times(worker)
    if item.kind not in worker.warm:
        limit, at_s = "compile_timeout_s", now + times * limits.compile_timeout_s
        return worker._replace(started_s=now, deadline_s=at_s, allowed_s=at_s, limit=limit, late_s=math.inf)
    usual_s = usual_chunk_s(state, item.kind)
    long_s = limits.deadline_factor * item.size * (usual_s or 0.0)
    limit, limit_s = "chunk_timeout_s", times * max(limits.chunk_timeout_s, long_s)
    if usual_s is None and limit_s < times * limits.first_chunk_timeout_s:
        limit, limit_s = "first_chunk_timeout_s", times * limits.first_chunk_timeout_s
    if limits.time_limit_s is not None and item.kind != GradientChunk.__name__:
        limit, limit_s = "time_limit_s", item.size * limits.time_limit_s
    usual_item_s = math.inf if usual_s is None else item.size * usual_s
    late_s = now + max(limits.late_factor * usual_item_s, usual_item_s + limits.late_by_s)
    at_s = now + limit_s
    return worker._replace(started_s=now, deadline_s=at_s, allowed_s=at_s, limit=limit, late_s=late_s)


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


def note_progress(s: SchedulerState, event: Progress, now: float) -> None:
    """Give a worker that has done more of what it does first at least its time without progress from now on."""
    group = next((group for group in (s.starting, s.up, s.draining) if event.worker in group), None)
    if group is None or (group is not s.starting and not group[event.worker].slots):
        return
    record = group[event.worker]._replace(heard_s=now, preparing=event if event.doing else None)
    if record.limit != "time_limit_s":
        until_s = now + _times(record) * getattr(s.limits, _limit_of_silence(record))
        record = record._replace(deadline_s=max(record.allowed_s, until_s))
    put_worker(s, group, event.worker, record)


def missed_deadline(s: SchedulerState, worker: int) -> str:
    """Text that says what a worker has not done in time."""
    record = s.starting.get(worker) or s.up.get(worker) or s.draining[worker]
    item = f" work item {record.slots[0].item.id}" if record.slots else ""
    if record.deadline_s > record.allowed_s:
        doing = f" while {record.preparing}" if record.preparing else ""
        silent_for = f"for {plain(record.deadline_s - record.heard_s)} s ({_key(record, _limit_of_silence(record))})"
        return f"no progress{' with' if item else ''}{item} {silent_for}{doing}"
    within, key = f"within {plain(record.deadline_s - record.started_s)} s", _key(record, record.limit)
    if not record.slots:
        return f"did not come up {within} ({key})"
    if record.limit == "compile_timeout_s":
        return f"did not finish compiling for{item} {within} ({key})"
    return f"no answer to{item} {within} of computing ({key})"


def _limit_of_silence(worker: Worker) -> str:
    """Field of `Limits` with the longest time without progress, in the first attempt."""
    computes = worker.slots and worker.slots[0].item.kind in worker.warm and worker.preparing is None
    return "chunk_timeout_s" if computes else "compile_timeout_s"


def _times(worker: Worker) -> int:
    """How many times as long as the first attempt the present one may take."""
    return 2 ** min(worker.slots[0].attempt - 1, MOST_DOUBLINGS) if worker.slots else 1


def _key(worker: Worker, limit: str) -> str:
    """What a user can change of a limit, and whether it has doubled."""
    times = _times(worker) if limit != "time_limit_s" else 1
    return key_of(limit) + (f", {times} times as long in attempt {worker.slots[0].attempt}" if times > 1 else "")


def plain(seconds: float) -> str:
    """A number of seconds with at most three significant digits, or as a whole number from 100 on; no exponent."""
    return f"{seconds:.0f}" if seconds >= 100.0 else f"{seconds:.3g}"
