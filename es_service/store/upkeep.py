"""Regular maintenance of a run's database while it is written: checkpoints of its log, and verified copies."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

from es_service.errors import StoreError
from es_service.logs import logger
from es_service.store.folder import COPY, DATABASE, is_disk_full
from es_service.store.repair import make_copy
from es_service.store.schema import Damaged

_LOG = logger(__name__)
LOCAL_COPY_INTERVAL_S = 180.0
"""Seconds between copies on a local disk."""
NETWORK_COPY_INTERVAL_S = 10.0
"""Seconds between copies on a network file system, where readers read the copy."""
COPY_TIME_FRACTION = 0.02
"""Greatest fraction of the time that copying takes; the interval becomes longer if copies take long."""
CHECKPOINT_BYTES = 8 * 1024 * 1024
"""Approximate growth of the log, in bytes, after which a commit is followed by a checkpoint."""
CHECKPOINT_INTERVAL_S = 5.0
"""Seconds after which a commit is followed by a checkpoint in any case. A power cut can lose about this much time."""
_CLOSE_PATIENCE_MS = 1000


class Upkeep:
    """Maintenance of the database of `connection` in `folder`; after the start, failures become notices, not errors."""

    def __init__(
        self,
        connection: sqlite3.Connection,
        folder: Path,
        network: bool,
        hook: Callable[[str], None],
        notices: list[str],
    ) -> None:
        """Set the journal: WAL on a local disk; where that is impossible, and on a network file system, a synchronous
        rollback journal. Raises StoreError if SQLite keeps another journal on a network file system."""
        self._connection, self._folder, self._network = connection, folder, network
        self._hook, self._notices = hook, notices
        self.copy_interval_s = NETWORK_COPY_INTERVAL_S if network else LOCAL_COPY_INTERVAL_S
        self._copied_at = time.monotonic() - _age_s(folder / COPY, self.copy_interval_s)
        self._copy_seconds = 0.0
        self._is_copied = False
        self._pending_bytes = 0
        self._checkpointed_at = time.monotonic()
        wanted = "delete" if network else "wal"
        journal = connection.execute(f"PRAGMA journal_mode = {wanted}").fetchone()[0]
        file = folder / DATABASE
        if network and journal != wanted:
            raise StoreError(f"{file}: SQLite uses the journal {journal} instead of {wanted}, as it must here")
        if journal != wanted:  # the run is safe with any other journal as well, but commits take longer
            notices.append(f"{file}: SQLite cannot use a write-ahead log on this disk; its journal is {journal}")
        connection.execute(f"PRAGMA synchronous = {'NORMAL' if journal == 'wal' else 'FULL'}")
        # This class makes the checkpoints, so that the cost of a commit is known and tests can kill it around them.
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        # Pages of deleted states need not be overwritten with zeros before they are used again.
        connection.execute("PRAGMA secure_delete = OFF")
        # This empty transaction fails at once if the file cannot be written. Moreover, after a quick_check, SQLite
        # refuses checkpoints until there has been a transaction.
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("COMMIT")
        if network and not (folder / COPY).exists():
            self._copy()

    def after_commit(self, log_bytes: int) -> None:
        """Make a checkpoint and a copy if they are due, after a commit that added about `log_bytes` to the log."""
        self._is_copied = False
        self._pending_bytes += log_bytes
        now = time.monotonic()
        due = self._pending_bytes >= CHECKPOINT_BYTES or now - self._checkpointed_at >= CHECKPOINT_INTERVAL_S
        if due and not self._network:
            try:
                self._checkpoint("PASSIVE")
            except sqlite3.Error as error:
                self._notice(f"could not move the newest generations from SQLite's log into {DATABASE}", error)
        if now - self._copied_at >= max(self.copy_interval_s, self._copy_seconds / COPY_TIME_FRACTION):
            self._copy()

    def finish(self) -> None:
        """Make the database a single file; SQLite's log remains beside it if a reader uses it or the disk is full."""
        if self._network and not self._is_copied:
            self._copy()
        with contextlib.suppress(sqlite3.Error):
            self._connection.execute(f"PRAGMA busy_timeout = {_CLOSE_PATIENCE_MS}")
            self._checkpoint("TRUNCATE")
        with contextlib.suppress(sqlite3.Error):
            self._connection.execute("PRAGMA journal_mode = DELETE")

    def _checkpoint(self, mode: str) -> None:
        self._hook("before_checkpoint")
        # This comes before a possible failure, so that the next commit does not try again at once.
        self._checkpointed_at, self._pending_bytes = time.monotonic(), 0
        self._connection.execute(f"PRAGMA wal_checkpoint({mode})").fetchall()
        self._hook("after_checkpoint")

    def _copy(self) -> None:
        start = time.monotonic()
        try:
            make_copy(self._connection, self._folder)
            self._is_copied = True
        except (sqlite3.Error, OSError, Damaged) as error:
            self._notice(f"could not refresh {COPY}; the former copy, if there is one, remains", error)
        self._copied_at = time.monotonic()
        self._copy_seconds = self._copied_at - start
        _LOG.debug("%s: copying took %.3f s", self._folder / COPY, self._copy_seconds)

    def _notice(self, what: str, error: Exception) -> None:
        full = not isinstance(error, Damaged) and is_disk_full(error, self._folder)
        notice = f"{self._folder}: {'disk full: ' if full else ''}{what} ({error})"
        if notice not in self._notices:
            self._notices.append(notice)


def _age_s(file: Path, limit: float) -> float:
    """Seconds since a file was written, clipped to [0, limit] in case the clock was changed; 0 if there is no file."""
    try:
        return min(max(time.time() - file.stat().st_mtime, 0.0), limit)
    except OSError:
        return 0.0
