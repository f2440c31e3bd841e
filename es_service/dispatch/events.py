"""Data between the scheduler and an engine: work items, limits, events and commands; and the log of all of these."""

from __future__ import annotations

import json
import math
import os
import socket
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from es_service.protocol.policies import POLICY_SLOTS
from es_service.store.folder import explained


@dataclass(frozen=True)
class WorkItem:
    """Chunks of one kind that are sent to a worker together. Items with the same id must have the same result."""

    id: Hashable
    kind: str
    """Work items of one kind use the same compiled functions, and take times in proportion to their sizes."""
    size: int = 1
    """Number of chunks."""


@dataclass(frozen=True)
class Limits:
    """Settings for the assignment of work and the handling of faults. Raises ValueError for a count below 1.

    Those that a config sets have the names of its keys; see `key_of`.
    """

    workers: int
    """Workers wanted at the start; `SetWorkers` changes this number."""
    cores: int = 1
    """Cores of each worker. A work item has at least one chunk for each, as far as there are enough chunks."""
    in_flight: int = 2
    """Work items assigned to one worker at a time: the one that it runs, and those that wait behind it."""
    items_overlap: bool = False
    """Whether a worker with several cores begins the next item as soon as one of them has nothing left to do."""
    item_s: float = 0.03
    """Time that a work item should take. Shorter chunks are sent together, because with Ray a message costs two
    milliseconds of a core. It is short, so that little work is lost with a worker or waited for at the end."""
    max_attempts: int = 4
    """Number of faults of one work item after which the run fails. A fault is an exception, or the loss of the worker
    that ran the item. It should be above `max_failures_in_a_row`, so that a single broken worker is replaced first."""
    start_timeout_s: float = 120.0
    """Longest time in which a worker must come up, counted again from when it has a place."""
    compile_timeout_s: float = 600.0
    """Longest time in which a worker must compile for its first item of a kind, or make or reset one environment."""
    first_chunk_timeout_s: float = 600.0
    """Longest time for an item while no duration of its kind is known, without the time of compiling. If
    `chunk_timeout_s` is longer, that limit applies."""
    late_factor: float = 2.0
    """A worker is late when its item has taken late_factor x size x median of recent durations of its kind. At the end
    of a phase, its items are then sent to an idle worker too; with infinity, no item ever is."""
    late_by_s: float = 0.03
    """Least time by which a late item exceeds its usual duration, since a copy of a very short item saves nothing."""
    chunk_timeout_s: float = 30.0
    """Lower bound of the limit for later items, and longest time without progress of a worker that reports it."""
    deadline_factor: float = 5.0
    """Later items may take max(chunk_timeout_s, deadline_factor x size x median of recent durations of their kind), in
    their first attempt; any item may take twice as long in each attempt as in the one before."""
    time_limit_s: float | None = None
    """Longest time for a chunk of episodes, in the place of the limits for first and later items; None: these."""
    episodes_together: int | None = None
    """Most episodes of an evaluation or policy chunk that are sent together; None: whole chunks."""
    policies_together: int = POLICY_SLOTS
    """Most policies with one episode each that a worker is sent as one chunk."""
    max_failures_in_a_row: int = 3
    """Number of consecutive exceptions after which a worker is killed and replaced."""
    restart_backoff_s: float = 1.0
    """Wait before the second of consecutive losses is replaced; it doubles with each further loss until a result is
    delivered. The first loss is replaced at once, and losses during a wait share it, such as all those of a node."""
    max_backoff_s: float = 60.0
    """Upper bound of this wait."""
    max_start_failures: int = 3
    """Number of consecutive failed attempts to start workers, with no worker up, after which the run fails. All workers
    that were started before the first of them was lost count as one attempt."""
    place_timeout_s: float = math.inf
    """Longest wait for a first place: no worker has come up so far, and none has a place."""
    waits_for_place: bool = True
    """Whether a place may still come, with a machine that joins; else `no_worker_timeout_s` limits this wait, too."""
    no_worker_timeout_s: float = 300.0
    """Longest time in which work items wait and no worker is up, after the first had come up. It only has an effect if
    it is longer than `start_timeout_s`."""

    def __post_init__(self) -> None:
        for name in ("workers", "cores", "in_flight", "max_attempts", "max_failures_in_a_row", "max_start_failures"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} ({getattr(self, name)}) must be at least 1")

    @property
    def items_at_once(self) -> int:
        """Work items that a worker computes side by side."""
        return self.in_flight if self.items_overlap and self.cores > 1 else 1


def key_of(limit: str) -> str:
    """What a user can change of a field of `Limits`, for messages: a key of the config."""
    others = {
        "start_timeout_s": "half of compute.no_worker_timeout_s",
        "chunk_timeout_s": "at least compute.chunk_timeout_s",
        "time_limit_s": "task.time_limit_s",
    }
    return others.get(limit, f"compute.{limit}")


# Events, which an engine reports.


@dataclass(frozen=True)
class Submit:
    """New work items, to be assigned in this order; `scheduler.handle` raises ValueError for an id that is waiting."""

    items: tuple[WorkItem, ...]


@dataclass(frozen=True)
class Placed:
    """A worker has a place and begins to come up."""

    worker: int


@dataclass(frozen=True)
class WorkerUp:
    """A worker has come up and can be assigned work items."""

    worker: int


@dataclass(frozen=True)
class WorkerLost:
    """A worker is gone, whether it had come up or not."""

    worker: int
    reason: str
    charge_item: bool = True
    """Whether its work item is charged with the loss. It is not if the worker was lost together with another one, or
    before it received the item."""
    refused: bool = False
    """Whether its host must not work for this run, and gets no other worker. This is no fault."""
    traceback: str = field(default="", repr=False)
    """If the reason is an exception that it raised, the whole traceback."""


@dataclass(frozen=True)
class Compiled:
    """A worker has compiled for a kind of work items, and begins to compute its first item of this kind."""

    worker: int
    kind: str
    seconds: float
    """How long compiling took, as the worker measured it."""


@dataclass(frozen=True)
class Progress:
    """A worker has done more of what it does first: of its start, or of the first of its work items."""

    worker: int
    doing: str = ""
    """What it does with environments before their first step, "making" or "resetting"; empty while it computes."""
    done: int = 0
    """Environments with which it has done so,"""
    total: int = 0
    """of this number."""

    def __str__(self) -> str:
        environments = "environment" if self.total == 1 else "environments"
        return f"{self.doing} {self.total} {environments}: {self.done} of {self.total}"


@dataclass(frozen=True)
class Result:
    """A worker has answered a work item. The engine keeps the result if the scheduler commands `Deliver`, else
    drops it."""

    worker: int
    item_id: Hashable
    attempt: int


@dataclass(frozen=True)
class Failure:
    """A work item raised an exception; the worker is still alive."""

    worker: int
    item_id: Hashable
    attempt: int
    message: str
    traceback: str = field(default="", repr=False)
    """The whole traceback, of which the message has what the user needs."""


@dataclass(frozen=True)
class Tick:
    """Time has passed and no message waits, so deadlines are checked, and late items are sent a second time."""

    silent: tuple[int, ...] = ()
    """Workers that have no place yet, and workers that may have been gone before they received their work item. If one
    misses a deadline, its work item is not charged; a worker that has no place does not count as lost."""


@dataclass(frozen=True)
class Drain:
    """A worker is to finish its work items, get no others and then be stopped. It is replaced now; this is no fault."""

    worker: int


@dataclass(frozen=True)
class SetWorkers:
    """The wanted number of workers changes. If it shrinks, workers without a place are stopped first, then those that
    have not come up; then the newest are drained. `scheduler.handle` raises ValueError below 1."""

    workers: int


Event = Submit | Placed | WorkerUp | WorkerLost | Compiled | Progress | Result | Failure | Tick | Drain | SetWorkers


# Commands, which an engine must carry out in the order given.


@dataclass(frozen=True)
class StartWorker:
    """Start a worker with this id; ids increase and are never used again."""

    worker: int


@dataclass(frozen=True)
class StopWorker:
    """Kill a worker. It may be reported lost afterwards, which has no effect."""

    worker: int
    reason: str


@dataclass(frozen=True)
class Assign:
    """Send a work item to a worker, behind those it has. `attempt` is 1 + the number of the item's faults so far."""

    worker: int
    item_id: Hashable
    attempt: int
    copy: bool = False
    """Whether it is a second copy of an item that another worker is late with. It is no new attempt."""


@dataclass(frozen=True)
class Deliver:
    """Accept the result that was just reported; this happens once for each submitted item."""

    item_id: Hashable


@dataclass(frozen=True)
class Fail:
    """Stop the run with this error message; only `StopWorker` follows, for each remaining worker."""

    message: str


Command = StartWorker | StopWorker | Assign | Deliver | Fail


def because(what: str, reason: str) -> str:
    """What happened and the reason; one of several lines, such as an exception with its frames, comes first."""
    return f"{reason}\n{what}" if "\n" in reason else f"{what}: {reason}"


def with_last_words(reason: str, last_words: str) -> str:
    """The reason of a loss, followed by the last output of the process if there is any."""
    return f"{reason}; the last output of its process:\n{last_words}" if last_words else reason


# The dispatch log: all events and commands of a run's scheduler, for finding out afterwards what happened.
#
# It is the file `dispatch.jsonl` in the run folder, with one JSON object per line, to which every session of the run
# appends. It is written only with `compute.dispatch_log: true`; a short generation adds about a hundred lines.

FILE = "dispatch.jsonl"


@dataclass(frozen=True)
class Session:
    """Log entry: a driver has started to work on the run."""

    after_generation: int | None
    """Newest committed generation; None if there is none."""
    host: str
    pid: int


@dataclass(frozen=True)
class Committed:
    """Log entry: a generation has been committed to the store."""

    generation: int


Entry = Event | Command | Session | Committed
Log = Callable[[Entry], None]


def no_log(entry: Entry) -> None:
    """Log that keeps nothing."""


@contextmanager
def dispatch_log(folder: Path, after_generation: int | None, *, enabled: bool) -> Iterator[Log]:
    """Context manager with a log that appends to the run folder's file, or one that keeps nothing if not `enabled`.

    The first entry is a `Session`.

    Raises:
        StoreError: the file cannot be opened, or an entry cannot be written, which the log itself raises.
    """
    if not enabled:
        yield no_log
        return
    try:
        file = (folder / FILE).open("ab", buffering=0)
    except OSError as error:
        raise explained(error, folder, f"opening {FILE}") from error
    with file:

        def append(line: bytes) -> None:
            try:
                file.write(line + b"\n")
            except OSError as error:
                raise explained(error, folder, f"writing {FILE}") from error

        def write(entry: Entry) -> None:
            line = {"time": round(time.time(), 4), "is": type(entry).__name__, **vars(entry)}
            append(json.dumps(line, default=_plain).encode())

        if file.tell():
            append(b"")  # end a line that a full disk or a killed process may have left incomplete
        write(Session(after_generation, socket.gethostname(), os.getpid()))
        yield write


def _plain(value: Any) -> Any:
    """Text of a value that JSON cannot represent; a work item is represented by its id."""
    return value.id if isinstance(value, WorkItem) else str(value)
