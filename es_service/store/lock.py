"""Who writes to a run: an exclusive `flock` on `run.lock`, held for the life of the writer and naming it.

The kernel drops the lock when its process ends, however it ends, so a lock is never stale; what the file says is only
there to be shown.
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
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from es_service.errors import RunLockedError, StoreError, WayOut
from es_service.store.folder import LOCK, explained

_PATIENCE_S = 0.5
"""`lock_holder` takes a shared lock for an instant; a writer that starts just then tries again for this long."""
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
_held: weakref.WeakSet[RunLock] = weakref.WeakSet()


class RunLock:
    """A lock in hand; `release` lets go of it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        _held.add(self)

    def release(self) -> None:
        """Let another writer in. Harmless if done already."""
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, 0)
            self.abandon()

    def abandon(self) -> None:
        """Close our handle; the lock itself lives on while another process holds a handle of the same opening."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def acquire_lock(folder: Path) -> RunLock:
    """Become the only writer of the run in `folder`.

    Raises RunLockedError if another process is, StoreError where the lock file cannot be made or locked.
    """
    try:
        return _acquire(folder, time.monotonic() + _PATIENCE_S)
    except OSError as error:
        if error.errno in _NO_LOCKS:
            raise StoreError(
                f"{folder / LOCK}: this file system does not support file locks ({error}), so two writers could not "
                f"be kept apart. Mount it with locks enabled (`flock`), or choose another folder.",
                run=folder,
            ) from error
        raise explained(error, folder, f"locking {LOCK}") from error


def _acquire(folder: Path, deadline: float) -> RunLock:
    path = folder / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                _write_identity(descriptor)
                return RunLock(descriptor)
        except BlockingIOError:
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise _locked(folder) from None
            time.sleep(0.02)
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _write_identity(descriptor: int) -> None:
    identity = {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    # The lock is what counts: on a full disk it goes without a name.
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps(identity).encode(), 0)


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file still is the one at `path`: a creation that failed takes its lock file away."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def lock_holder(folder: Path) -> dict[str, Any] | None:
    """Host, pid and since (ISO time, UTC) of the process writing to the run in `folder`; None if nobody is.

    Values are None for the instant in which a new writer has the lock but has not yet written its name.
    """
    try:
        descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        # Shared, so that two who ask at once do not take each other for a writer.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return None
    except BlockingIOError:
        return _identity(os.pread(descriptor, 4096, 0))
    except OSError:
        return None
    finally:
        os.close(descriptor)


def _identity(text: bytes) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        found = None
    known = found if isinstance(found, dict) else {}
    return {key: known.get(key) for key in ("host", "pid", "since")}


def _locked(folder: Path) -> RunLockedError:
    holder = lock_holder(folder) or _identity(b"")
    return RunLockedError(
        f"{folder} is being written by process {holder['pid'] or '(unknown)'} on host {holder['host'] or '(unknown)'} "
        f"since {holder['since'] or '(unknown)'}; stop that process first, or leave it at work.",
        run=folder,
        ways_out=[WayOut("watch", "watch it", str(folder))],
    )


def _abandon_in_child() -> None:
    for lock in list(_held):
        lock.abandon()


# A forked child shares our handle: a worker that outlives a killed driver must not keep the run locked.
os.register_at_fork(after_in_child=_abandon_in_child)
