"""The dispatch log: all events and commands of a run's scheduler, for finding out afterwards what happened.

It is the file `dispatch.jsonl` in the run folder, with one JSON object per line, to which every session of the run
appends. It is written only with `compute.dispatch_log: true`; a short generation adds about a hundred lines.
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
