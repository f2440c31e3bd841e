"""The scheduler: a state machine that replaces lost workers, repeats lost work, and decides when the run fails.

It stands between the driver's work items and the engines that own the workers. `handle(state, event, now)` changes the
state and returns the commands that the engine must carry out, in order. It uses no I/O, clock, random numbers or
threads: the same arguments give the same result, so a simulation can try every interleaving.

An engine starts with `initial_state(limits)` of scheduler_state.py and a `Tick`, passes on every message of its workers
as an event, and sends a `Tick` whenever the time `next_deadline(state)` has come. It must pass on all waiting messages
*before* a late `Tick`: otherwise a driver that was busy would kill workers whose answers it had not read yet.

Rules:

* A result is a pure function of its work item, so any result from a known worker for an undelivered item is accepted,
  even from an earlier attempt. A stopped worker is forgotten at once, and its later messages are ignored and counted.
* Only the item that a worker was running is charged with the loss of the worker. An item that waited behind it keeps
  its attempts, and so does an item sent to a worker that was gone already, if the transport reports this. Thus the loss
  of a machine with many workers is one fault, however many of them are tried before all are known to be gone.
* The loss of a draining worker is no fault, nor is a refusal, nor a missing place: a worker that gets none in time is
  replaced, because it may have failed before it could report its place, and does not count as lost.
* Workers that are lost before they come up count as a failed attempt to start workers. They count as another failed
  attempt only if they were started after the first of them was lost.

assignment.py decides which worker gets which item, how long it may take, and which items are sent a second time.
scheduler_state.py keeps the containers of the state consistent.

Cost: an event looks only at the workers and items that it concerns and at those that it stops or assigns
(tests/benchmarks/dispatch_scale.py). Only `SetWorkers`, a failure of the run, and events before a first worker is up
look at all workers. A free worker passes over items that failed on it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable

from es_service.dispatch.assignment import (
    RECENT_DURATIONS,
    assign,
    begin_first_slot,
    missed_deadline,
    note_compiled,
    note_late_workers,
    note_progress,
    plain,
    send_copies,
    start_deadline,
)
from es_service.dispatch.events import (
    Command,
    Compiled,
    Deliver,
    Drain,
    Event,
    Fail,
    Failure,
    Placed,
    Progress,
    Result,
    SetWorkers,
    StartWorker,
    StopWorker,
    Submit,
    Tick,
    WorkerLost,
    WorkerUp,
    because,
    key_of,
)
from es_service.dispatch.scheduler_state import (
    IN_TIME,
    LATE,
    SchedulerState,
    Worker,
    append_items,
    by_progress,
    down_limit,
    drop_item,
    find_slot,
    holds,
    is_down,
    late_workers,
    loss_text,
    next_deadline,
    pop_worker,
    put_worker,
    return_item,
    without,
)


def handle(s: SchedulerState, event: Event, now: float) -> list[Command]:
    """Change the state as an event demands; returns the commands that the engine must carry out.

    Args:
        now: time in seconds of a monotonic clock with any origin.

    Raises:
        ValueError: a submitted id has not been delivered yet, or `SetWorkers` asks for less than 1 worker;
            the state is then of no use.
    """
    out: list[Command] = []
    if s.failed is not None or (isinstance(event, Tick) and now < next_deadline(s)):
        return out
    match event:
        case Result(worker, item_id, attempt):
            _result(s, out, worker, item_id, attempt, now)
        case Submit(items):
            append_items(s, items)
        case Placed(worker):
            if (record := s.starting.get(worker)) is not None:
                put_worker(s, s.starting, worker, start_deadline(s, record._replace(placed=True), now))
        case WorkerUp(worker):
            if pop_worker(s, s.starting, worker) is not None:
                put_worker(s, s.up, worker, Worker(s.next_rank))
                s.start_failures = 0
                s.next_rank += 1
        case WorkerLost(worker, reason, charge_item, refused):
            fault = not refused and worker not in s.draining
            _lose(s, out, worker, reason, now, fault=fault, charge=charge_item)
        case Compiled():
            note_compiled(s, event, now)
        case Progress():
            note_progress(s, event, now)
        case Failure():
            _failure(s, out, event, now)
        case Tick(silent):
            note_late_workers(s, now)
            _expire(s, out, now, silent)
        case Drain(worker):
            _drain(s, out, worker)
        case SetWorkers(wanted):
            if wanted < 1:
                raise ValueError(f"SetWorkers({wanted}): the number of workers must be at least 1")
            s.wanted = wanted
            for worker in by_progress(s)[wanted:]:
                _drain(s, out, worker)
    if s.failed is None:
        _start_workers(s, out, now)
        assign(s, out, now)
        if isinstance(event, Tick):
            send_copies(s, out, now)
        if is_down(s) != (s.down_since_s is not None):
            s.down_since_s = now if s.down_since_s is None else None
    return out


def _result(s: SchedulerState, out: list[Command], worker: int, item_id: Hashable, attempt: int, now: float) -> None:
    record = s.up.get(worker) or s.draining.get(worker)
    if record is None:
        s.duplicates += 1
        return
    if delivered := drop_item(s, item_id):
        out.append(Deliver(item_id))
        s.losses_in_a_row = 0
    else:
        s.duplicates += 1
    index = find_slot(record, item_id, attempt)
    if index is not None:
        item = record.slots[index].item
        pace = record.pace
        # The duration is not known of an answer out of order, nor of a superseded one, which may have been read late.
        if index == 0 and delivered:
            pace = IN_TIME if record.late_s > -math.inf else LATE
            if item.kind in record.warm:  # else it may include compiling
                chunk_s = (now - record.started_s) / item.size
                s.durations_s[item.kind] = (*s.durations_s.get(item.kind, ()), chunk_s)[-RECENT_DURATIONS:]
        record = record._replace(slots=without(record.slots, index), pace=pace, failures_in_a_row=0)
        _close_slot(s, out, worker, record, index, now)


def _failure(s: SchedulerState, out: list[Command], event: Failure, now: float) -> None:
    worker, item_id = event.worker, event.item_id
    record = s.up.get(worker) or s.draining.get(worker)
    index = find_slot(record, item_id, event.attempt) if record is not None else None
    if record is None or index is None:
        s.duplicates += 1
        return
    slots, failures = without(record.slots, index), record.failures_in_a_row + 1
    record = record._replace(slots=slots, failures_in_a_row=failures)
    _close_slot(s, out, worker, record, index, now)
    if worker in s.up and record.failures_in_a_row >= s.limits.max_failures_in_a_row:
        what = f"the last of {record.failures_in_a_row} consecutive work items that raised exceptions"
        reason = because(what, event.message)
        out.append(StopWorker(worker, reason))
        # The item that it has just begun is not charged.
        _lose(s, out, worker, reason, now, charge=False)
    if not holds(s, worker, item_id):
        s.duplicates += 1
        return
    return_item(s, worker, item_id)
    _charge(s, out, item_id, f"it raised an exception on worker {worker}", event.message)


def _close_slot(s: SchedulerState, out: list[Command], worker: int, record: Worker, index: int, now: float) -> None:
    """Store a worker after its slot at `index` was removed; stop a draining one that has no slot left."""
    if index == 0:  # it begins the next slot now
        record = begin_first_slot(s, record, now)
    if worker in s.up:
        put_worker(s, s.up, worker, record)
    elif record.slots:
        put_worker(s, s.draining, worker, record)
    else:
        pop_worker(s, s.draining, worker)
        out.append(StopWorker(worker, "drained"))


def _lose(
    s: SchedulerState,
    out: list[Command],
    worker: int,
    reason: str,
    now: float,
    *,
    fault: bool = True,
    charge: bool = True,
) -> None:
    """Forget a worker, put its items back at the front of the queue and plan its replacement.

    An unknown worker changes nothing.

    Args:
        fault: whether the loss is a fault, which is counted and may delay the replacement.
        charge: whether the work item that the worker was running is charged with the fault.
    """
    starting = pop_worker(s, s.starting, worker) is not None
    record = pop_worker(s, s.up, worker) or pop_worker(s, s.draining, worker)
    if not starting and record is None:
        return
    slots = record.slots if record is not None else ()
    running = slots[0].item.id if slots and holds(s, worker, slots[0].item.id) else None
    for slot in reversed(slots):
        if holds(s, worker, slot.item.id):
            return_item(s, worker, slot.item.id)
    if not fault:
        return
    s.lost_workers += 1
    s.last_lost, s.last_loss, s.last_words = worker, reason, ""
    if s.up or s.draining:
        s.start_failures = 0
    elif starting and worker >= s.tried:
        s.start_failures += 1
        s.tried = s.next_worker
    if now >= s.start_at_s:  # else this replacement waits together with an earlier one
        doublings = min(s.losses_in_a_row - 1, 30)
        wait_s = min(s.limits.max_backoff_s, s.limits.restart_backoff_s * 2**doublings) if doublings >= 0 else 0.0
        s.losses_in_a_row += 1
        s.start_at_s = now + wait_s
    if starting and s.start_failures >= s.limits.max_start_failures and not s.up and not s.draining:
        _fail(s, out, loss_text(s, f"no worker started in {s.start_failures} consecutive attempts; last loss: "))
    elif running is not None and charge:
        _charge(s, out, running, f"worker {worker} was lost while running it", reason)


def _charge(s: SchedulerState, out: list[Command], item_id: Hashable, what: str, reason: str) -> None:
    """Add a fault to a work item; if it now has `max_attempts` faults, the run fails, and says what happened last."""
    waiting = s.items[item_id] = s.items[item_id]._replace(faults=s.items[item_id].faults + 1)
    if waiting.faults >= s.limits.max_attempts:
        what = f"work item {item_id} failed in {waiting.faults} attempts; the last time {what}"
        _fail(s, out, because(what, reason))


def _fail(s: SchedulerState, out: list[Command], message: str) -> None:
    out.append(Fail(message))
    out.extend(StopWorker(worker, "the run failed") for worker in sorted([*s.starting, *s.up, *s.draining]))
    for container in (s.starting, s.up, s.draining, s.deadlines, s.preparing, s.free, s.places):
        container.clear()
    s.failed = message


def _expire(s: SchedulerState, out: list[Command], now: float, silent: tuple[int, ...]) -> None:
    """Stop every worker whose deadline has passed; the run fails if no worker was up for too long."""
    for worker in late_workers(s, now):
        if s.failed is None:
            reason = missed_deadline(s, worker)
            out.append(StopWorker(worker, reason))
            is_silent = worker in silent
            has_no_place = is_silent and worker in s.starting
            _lose(s, out, worker, reason, now, fault=not has_no_place, charge=not is_silent)
    name, limit_s = down_limit(s)
    if s.failed is None and s.down_since_s is not None and now >= s.down_since_s + limit_s:
        for_s = f"for {plain(limit_s)} s ({key_of(name)})"
        text = f"was up {for_s} while {len(s.items)} work items waited" if s.next_rank else f"got a place {for_s}"
        _fail(s, out, loss_text(s, f"no worker {text}; last loss: "))


def _drain(s: SchedulerState, out: list[Command], worker: int) -> None:
    record = pop_worker(s, s.up, worker)
    if record is not None and record.slots:
        put_worker(s, s.draining, worker, record._replace(rank=s.next_rank))
        s.next_rank += 1
    elif record is not None or pop_worker(s, s.starting, worker) is not None:
        out.append(StopWorker(worker, "drained"))


def _start_workers(s: SchedulerState, out: list[Command], now: float) -> None:
    missing = s.wanted - len(s.starting) - len(s.up)
    if missing <= 0 or now < s.start_at_s:
        return
    for worker in range(s.next_worker, s.next_worker + missing):
        put_worker(s, s.starting, worker, start_deadline(s, Worker(worker), now))
        out.append(StartWorker(worker))
    s.next_worker += missing
