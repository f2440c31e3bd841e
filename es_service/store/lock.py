"""The lock of a run: an exclusive `flock` on `run.lock`, which its writer holds and whose file names the writer.

The kernel releases the lock when the process ends in any way, so a lock is never stale. The content of the file is only
for messages: who holds the lock or, if it is free, how the last session of the run ended.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import time
import weakref
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from es_service.errors import RunLockedError, StoreError, WayOut
from es_service.store.facts import Damaged, facts
from es_service.store.folder import LOCK, explained

_PATIENCE_S = 0.5
"""Seconds for which a writer tries to take the lock, because `lock_holder` holds a shared lock for an instant."""
_MOST, _MOST_WORDS = 16384, 500
"""Bytes of the file that are read, and characters of the words about an end, each of which takes at most six bytes."""
MOST_LINES, MOST_LINE = 8, 160
"""Lines of what workers print that the file has, and characters of each."""
_OF_HOLDER = ("host", "pid", "since", "waiting_since", "doing")
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
_held: weakref.WeakSet[RunLock] = weakref.WeakSet()


class RunLock:
    """A lock that this process holds until `release`."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._end = _content(os.pread(descriptor, _MOST, 0))
        self._output, self._said = "", {}
        self._identity = {"host": socket.gethostname(), "pid": os.getpid(), "since": _now()}
        self.say()
        _held.add(self)

    def say(self, *, waiting: bool = False, doing: str = "") -> None:
        """Write who holds the lock into its file, since when the run has been waiting for a worker, if it is, and what
        it is doing if that takes long and nothing else shows it."""
        self._said = {"waiting_since": _now() if waiting else None, "doing": doing}
        self._write(self._identity | self._said)

    def note_output(self, lines: Iterable[str], *, write: bool = True) -> None:
        """Keep the newest lines that workers have printed, for `last_output`; write them into the file now, or with
        what is said next."""
        self._output = "\n".join(lines)
        if write:
            self._write(self._identity | self._said)

    def note_end(self, how: str) -> None:
        """Keep how the session ends, in words, for `last_end`."""
        self._end = self._identity | {"ended": _now(), "how": how[:_MOST_WORDS]}

    def release(self) -> None:
        """Release the lock, so that another writer can take it. This may be called again."""
        if self._descriptor >= 0:
            self._write(self._end)  # of a holder that noted no end: what the previous holder left
            self.abandon()

    def _write(self, content: Mapping[str, Any]) -> None:
        # The lock itself is enough; on a full disk its file does not name the writer.
        with contextlib.suppress(OSError):
            # Half of a surrogate pair, which a file's name may have, is no UTF-8: it is escaped as JSON does it.
            content = {**content, "output": self._output} if self._output else content
            text = json.dumps(content, ensure_ascii=False).encode(errors="backslashreplace")
            # Spaces, so that a reader at this moment finds no end of a longer text, and no empty file.
            os.pwrite(self._descriptor, text.ljust(os.fstat(self._descriptor).st_size), 0)

    def abandon(self) -> None:
        """Close the file of the lock. The lock remains while another process has inherited the same open file."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def acquire_lock(folder: Path) -> RunLock:
    """Take the lock of the run in `folder`, whose only writer is then the caller.

    Raises:
        RunLockedError: another process holds the lock.
        StoreError: the lock file cannot be created or locked.
    """
    deadline = time.monotonic() + _PATIENCE_S
    try:
        while True:
            with contextlib.ExitStack() as closing:
                descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
                closing.callback(os.close, descriptor)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    if time.monotonic() > deadline:
                        raise _locked(folder) from None
                    time.sleep(0.02)
                    continue
                if _is_at(descriptor, folder / LOCK):
                    lock = RunLock(descriptor)
                    closing.pop_all()
                    return lock
    except OSError as error:
        if error.errno in _NO_LOCKS:
            raise StoreError(
                f"{folder / LOCK}: this file system does not support file locks ({error}), so two processes could "
                f"write to the run at the same time. Mount it with locks enabled (`flock`), or choose another folder.",
                run=folder,
            ) from error
        raise explained(error, folder, f"locking {LOCK}") from error


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file is still the one at `path`; the creation of a run deletes its lock file if it fails."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def lock_holder(folder: Path) -> dict[str, Any] | None:
    """The process that holds the lock of the run in `folder`: "host", "pid" and "since" (ISO time, UTC), and
    "waiting_since" and "doing" of `RunLock.say`. All are None if the writer has not written them yet.

    None if no process holds the lock.
    """
    try:
        descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        # A shared lock, so that two calls at the same time do not see each other as a writer.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return None
    except BlockingIOError:
        known = _content(os.pread(descriptor, _MOST, 0))
        return {key: known.get(key) for key in _OF_HOLDER}
    except OSError:
        return None
    finally:
        os.close(descriptor)


def require_unlocked(folder: Path) -> None:
    """Raise RunLockedError if a process is writing to the run in `folder`."""
    if lock_holder(folder) is not None:
        raise _locked(folder)


def last_end(folder: Path) -> str:
    """How the last session of a run whose lock is free ended, in words; empty if the session has not said it, as before
    version 0.17, or if there was none."""
    try:
        content = _content((folder / LOCK).read_bytes()[:_MOST])
    except OSError:
        return ""
    if "ended" in content:
        return str(content.get("how", ""))
    if "pid" not in content:
        return ""
    return f"its driver on {content.get('host')}, pid {content['pid']}, was killed, or its host failed"


def last_output(folder: Path) -> tuple[str, ...]:
    """The newest lines that the workers of a run's present or last session have printed, each after its worker."""
    try:
        content = _content((folder / LOCK).read_bytes()[:_MOST])
    except OSError:
        return ()
    return tuple(str(content.get("output") or "").splitlines())


def _content(text: bytes) -> dict[str, Any]:
    try:
        return facts(text, dict[str, str | int | None], LOCK, has_paths=True)
    except Damaged:
        return {}


def _locked(folder: Path) -> RunLockedError:
    holder = lock_holder(folder) or {}
    pid, host, since = (holder.get(key) or "(unknown)" for key in ("pid", "host", "since"))
    if (pid, host) == (os.getpid(), socket.gethostname()):
        end = "that is this process itself: leave its block of `ask_tell`, or wait until its call that writes ends"
    else:
        end = "stop that process first, or wait until it ends"
    return RunLockedError(
        f"{folder} is being written by process {pid} on host {host} since {since}; {end}.",
        run=folder,
        ways_out=[WayOut("watch", "watch it", str(folder))],
    )


def _abandon_in_child() -> None:
    for lock in list(_held):
        lock.abandon()


# A forked child inherits the open file of the lock. A worker that outlives a killed driver must not keep the lock.
os.register_at_fork(after_in_child=_abandon_in_child)
