"""Which worker gets which work item, how long it may take, and what is sent a second time. `scheduler.handle` uses it.

**Who gets what.** Idle workers are served first, those that answered their last item in time before others, then
workers that can take another item behind the one they run. A work item that failed on a worker is not assigned to that
worker again while another worker is up: otherwise a broken worker that fails at once would use up the attempts of good
items. If workers begin an item before they have finished another, none is assigned behind another one from a loss until
the next result: the next loss, if it is the cause, would be charged to the other one again.

**How long it may take.** The time of a work item counts from when its worker begins it. A worker first compiles for the
first item of a kind, which has a limit of its own, and the time of that item counts from the end of compiling, so that
its duration is known like that of any other. While no duration of a kind is known, a longer limit applies to its items.
How long episodes last may change from one chunk to the next, when a first policy survives. So a worker that reports
progress is given `chunk_timeout_s` from each report on, or as long as for compiling while it makes or resets
environments; and since not all work can report, every attempt at an item may take twice as long as the one before it.
Only a limit that the config gives to each chunk holds whatever is reported, in every attempt.

**Second copies.** When nothing is in the queue, an idle worker is sent an item that another one is late with, or that
waits behind such an item, so that a phase need not wait for a slow or hanging worker. The first answer counts, and the
other is dropped like any duplicate: an item is answered as a whole, so no part of a gradient is added twice. It never
has more than one copy, and none after a loss or a failure, since it may be the cause. A copy is no retry; if it makes
its worker fail, the item is charged as ever. A worker is late if its item takes much longer than usual, not counting
the time of compiling, and slow until it answers an item in time. The items of a slow worker, or of a new one, which
must compile, are copied as soon as another worker is idle. While a worker is known to be in time, slow and new workers
get no copies, so that the workers of a slow node do not copy each other's items. When there is none, slow workers get
them, and new ones get copies of what a slow worker has. Only a `Tick` does all this. The engine sends one when no
answers wait to be read, so a driver that was busy neither takes its workers for slow nor sends copies of items that are
answered already."""

from __future__ import annotations

import math
from itertools import takewhile

from es_service.dispatch.events import Assign, Command, Compiled, Progress, key_of
from es_service.dispatch.scheduler_state import (
    LATE,
    SchedulerState,
    Slot,
    Waiting,
    Worker,
    copy_item,
    has_idle_worker_for_copies,
    put_worker,
    take_item,
    usual_chunk_s,
)
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


def assign(s: SchedulerState, out: list[Command], now: float) -> None:
    """Assign queued items to workers that can take more, idle workers first."""
    for load in range(1 if s.limits.items_at_once > 1 and s.losses_in_a_row else s.limits.in_flight):
        passed = 0
        while s.places and passed < len(s.free):
            slots, _, _, worker = s.free[passed]
            if slots > load:
                break
            waiting = _next_for(s, worker) if slots == load else None
            if waiting is None:
                passed += 1
                continue
            take_item(s, waiting, worker)  # the worker leaves its place in `free`, and the next one moves up
            s.retries += waiting.item.size if waiting.last_holder is not None else 0
            slot, record = Slot(waiting.item, waiting.faults + 1), s.up[worker]
            record = record._replace(slots=(*record.slots, slot))
            put_worker(s, s.up, worker, begin_first_slot(s, record, now) if load == 0 else record)
            out.append(Assign(worker, waiting.item.id, slot.attempt))


def _next_for(s: SchedulerState, worker: int) -> Waiting | None:
    """The first item in the queue that may be assigned to a worker, or None."""
    for _, item_id in s.places:
        waiting = s.items[item_id]
        if waiting.last_holder != worker or len(s.up) == 1:
            return waiting
    return None


def note_late_workers(s: SchedulerState, now: float) -> None:
    """Mark the workers that have become late with their first slot."""
    for _, worker in list(takewhile(lambda entry: entry[0] <= now, s.deadlines)):
        group = s.up if worker in s.up else s.draining
        record = group.get(worker)
        if record is not None and record.late_s <= now:
            put_worker(s, group, worker, record._replace(late_s=-math.inf, pace=LATE))


def send_copies(s: SchedulerState, out: list[Command], now: float) -> None:
    """Send items of late workers to idle ones, as long as there are both."""
    while has_idle_worker_for_copies(s):
        waiting, worker = s.items[s.late[0][1]], s.free[0][-1]
        copy_item(s, waiting.item.id, worker)
        slot = Slot(waiting.item, waiting.faults + 1)
        put_worker(s, s.up, worker, begin_first_slot(s, s.up[worker]._replace(slots=(slot,)), now))
        out.append(Assign(worker, waiting.item.id, slot.attempt, copy=True))
        s.copies += waiting.item.size
