"""The dispatch log: everything a run's scheduler was told and has ordered, for finding out what happened in a night.

One JSON object per line in `dispatch.jsonl` of the run folder, appended by every session of the run. Written with
`compute.dispatch_log: true` only; a short generation makes about a hundred lines.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from es_service.dispatch.events import Command, Event, WorkItem
from es_service.store.folder import explained

FILE = "dispatch.jsonl"


@dataclass(frozen=True)
class Session:
    """A driver has begun to work on the run."""

    after_generation: int | None
    """Newest committed generation; None before the first."""
    host: str
    pid: int


@dataclass(frozen=True)
class Committed:
    """A generation is safe in the store."""

    generation: int


Log = Callable[[Event | Command | Session | Committed], None]


def no_log(entry: Event | Command | Session | Committed) -> None:
    """Keep nothing."""


@contextmanager
def dispatch_log(folder: Path, after_generation: int | None, *, enabled: bool) -> Iterator[Log]:
    """A log that appends to the run folder's file, beginning with a `Session`; or one that keeps nothing.

    Raises StoreError, here or when it is told something, if that cannot be written.
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

        def write(entry: Event | Command | Session | Committed) -> None:
            line = {"time": round(time.time(), 4), "is": type(entry).__name__, **vars(entry)}
            append(json.dumps(line, default=_plain).encode())

        if file.tell():
            append(b"")  # ends a line that a full disk or a kill cut short
        write(Session(after_generation, socket.gethostname(), os.getpid()))
        yield write


def _plain(value: Any) -> Any:
    """What JSON has no form for: a work item is its id."""
    return value.id if isinstance(value, WorkItem) else str(value)
