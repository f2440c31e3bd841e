"""What the scheduler and its engines say to each other: work items, limits, events in, commands out."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class WorkItem:
    """What travels to a worker and back: chunks of one kind. Two items with the same id must have the same result."""

    id: Hashable
    kind: str
    """Tasks of one kind compile together and take about equally long, each in proportion to its size."""
    size: int = 1
    """Chunks in it."""


@dataclass(frozen=True)
class Limits:
    """How work is handed out and faults are handled: config data. Raises ValueError for a count below 1."""

    workers: int
    """Workers wanted at the start; `SetWorkers` changes it."""
    in_flight: int = 2
    """Tasks assigned to one worker at a time: the one it runs and those prefetched behind it."""
    item_s: float = 0.03
    """Chunks that take less travel together, as many as take this long: with Ray a message costs two milliseconds of a
    core. What a lost worker had in hand, and what others wait for in the end, remain little."""
    max_attempts: int = 4
    """A work item that raised, or lost the worker running it, this often is poison. Keep above
    `max_failures_in_a_row`, so that a single broken worker is replaced before its item is blamed."""
    start_deadline_s: float = 120.0
    """For a worker to come up, counted anew once it has a place."""
    first_deadline_s: float = 600.0
    """For the first item of a kind on a worker, which compiles, and for any item while no duration is known; or what
    later ones may take, if that is longer."""
    min_deadline_s: float = 30.0
    deadline_factor: float = 5.0
    """Later items may take max(min_deadline_s, deadline_factor x size x median of recent durations of their kind)."""
    max_failures_in_a_row: int = 3
    """A worker that raises this often in a row is killed and replaced."""
    restart_backoff_s: float = 1.0
    max_backoff_s: float = 60.0
    """Wait before replacing the second, third ... loss without a success between: restart_backoff_s, doubling up to
    max_backoff_s. The first replacement is immediate; losses during a wait share it (a node that died, say)."""
    max_start_failures: int = 3
    """This many consecutive attempts to start workers that failed, and none up meanwhile: the environment is broken.
    All workers that were started before the first of them was lost are one attempt."""
    no_worker_timeout_s: float = 300.0
    """Longest time with items waiting and no worker up; longer than `start_deadline_s` to be of any use."""
    names: Mapping[str, str] = field(default_factory=dict)
    """What messages call a limit, so that a user knows what to change: field -> name; others are called as they are."""

    def name_of(self, limit: str) -> str:
        """What messages call a field of this class."""
        return self.names.get(limit, limit)

    def __post_init__(self) -> None:
        for name in ("workers", "in_flight", "max_attempts", "max_failures_in_a_row", "max_start_failures"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} ({getattr(self, name)}) must be at least 1")


# Events: what an engine reports.


@dataclass(frozen=True)
class Submit:
    """New items, to be assigned in this order. Raises ValueError for an id that still waits."""

    items: tuple[WorkItem, ...]


@dataclass(frozen=True)
class Placed:
    """The worker, which had to wait for a place, has one and can begin to come up."""

    worker: int


@dataclass(frozen=True)
class WorkerUp:
    """The worker can take items."""

    worker: int


@dataclass(frozen=True)
class WorkerLost:
    """The worker is gone, whether it ever came up or not."""

    worker: int
    reason: str
    bystander: bool = False
    """Whether it was lost with another, or before it had what it was sent: then that is not to blame."""


@dataclass(frozen=True)
class Result:
    """The worker answered; the engine holds the result until this step says `Deliver` or says nothing."""

    worker: int
    item_id: Hashable
    attempt: int


@dataclass(frozen=True)
class Failure:
    """The item raised; the worker lives."""

    worker: int
    item_id: Hashable
    attempt: int
    message: str


@dataclass(frozen=True)
class Tick:
    """Time has passed."""

    silent: tuple[int, ...] = ()
    """Workers without a place yet, and those that may have been gone already when they were sent what they should be
    doing: if they do not answer in time, neither they nor what they were sent is to blame."""


@dataclass(frozen=True)
class Drain:
    """The worker gets no new item, finishes those it has, and is stopped; it is replaced now, without blame."""

    worker: int


@dataclass(frozen=True)
class SetWorkers:
    """Change the wanted number of workers; shrinking drains the newest. Raises ValueError below 1."""

    workers: int


Event = Submit | Placed | WorkerUp | WorkerLost | Result | Failure | Tick | Drain | SetWorkers


# Commands: what an engine must do, in the order given.


@dataclass(frozen=True)
class StartWorker:
    """Start a worker under this id; ids increase and are never used again."""

    worker: int


@dataclass(frozen=True)
class StopWorker:
    """Kill the worker. Reporting it lost afterwards is allowed and changes nothing."""

    worker: int
    reason: str


@dataclass(frozen=True)
class Assign:
    """Send the item to the worker, behind those it has. `attempt` is 1 + the faults charged to the item so far."""

    worker: int
    item_id: Hashable
    attempt: int


@dataclass(frozen=True)
class Deliver:
    """Accept the result just reported; once per submitted item."""

    item_id: Hashable


@dataclass(frozen=True)
class Fail:
    """The run stops with this error; only `StopWorker` follows, one for every worker left."""

    message: str


Command = StartWorker | StopWorker | Assign | Deliver | Fail


def with_last_words(reason: str, last_words: str) -> str:
    """The reason of a loss, with what the process wrote before it was killed, if anything."""
    return f"{reason}; its process had written:\n{last_words}" if last_words else reason
