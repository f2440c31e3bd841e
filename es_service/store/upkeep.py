"""Regular maintenance of a run's database while it is written: checkpoints of its log, and verified copies."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

from es_service.errors import StoreError
from es_service.logs import logger
from es_service.store.facts import Damaged
from es_service.store.folder import COPY, DATABASE, LOG, is_disk_full
from es_service.store.repair import make_copy, patience
from es_service.store.schema import PAGE_BYTES

_LOG = logger(__name__)
LOCAL_COPY_INTERVAL_S = 180.0
"""Seconds between copies on a local disk."""
NETWORK_COPY_INTERVAL_S = 10.0
"""Seconds between copies on a network file system, where readers read the copy."""
COPY_TIME_FRACTION = 0.02
"""Greatest fraction of the time that copying takes; the interval becomes longer if copies take long."""
LEAST_LOG_BYTES, MOST_LOG_BYTES = 4 * 2**20, 8 * 2**20
"""A commit makes a checkpoint once the log is as large as the database; if that is smaller or larger than these sizes,
with the first or the second of them. Smaller logs
would make commits slower."""
HELD_BACK = 4
"""A reader that keeps more than so many times that size of the log from the database is told."""
CHECKPOINT_INTERVAL_S = 5.0
"""Seconds after which a commit is followed by a checkpoint in any case. A power cut can lose about this much time."""
_CLOSE_PATIENCE_S = 1.0


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
        self._checkpointed_at = time.monotonic()
        wanted = "delete" if network else "wal"
        journal = connection.execute(f"PRAGMA journal_mode = {wanted}").fetchone()[0]
        file = folder / DATABASE
        if network and journal != wanted:
            raise StoreError(f"{file}: SQLite uses the journal {journal} instead of {wanted}, as it must here")
        if journal != wanted:  # the run is safe with any other journal as well, but commits take longer
            notices.append(f"{file}: SQLite cannot use a write-ahead log on this disk; its journal is {journal}")
        connection.execute(f"PRAGMA synchronous = {'NORMAL' if journal == 'wal' else 'FULL'}")
        # A log that a reader has held back is cut when it can be used from its beginning again.
        connection.execute(f"PRAGMA journal_size_limit = {MOST_LOG_BYTES}")
        self._log_bytes = self._limit_log()
        # Pages of deleted states need not be overwritten with zeros before they are used again.
        connection.execute("PRAGMA secure_delete = OFF")
        # This empty transaction fails at once if the file cannot be written. Moreover, after a quick_check, SQLite
        # refuses checkpoints until there has been a transaction.
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("COMMIT")
        if network and not (folder / COPY).exists():
            self._copy()

    def after_commit(self) -> None:
        """Make a checkpoint and a copy if they are due, after a commit."""
        self._is_copied = False
        now = time.monotonic()
        if now - self._checkpointed_at >= CHECKPOINT_INTERVAL_S and not self._network:
            try:
                if self._checkpoint("PASSIVE") >= HELD_BACK * self._log_bytes:
                    self._tell(
                        f"a program reads {DATABASE} without a pause, so that SQLite cannot empty {LOG} beside it, "
                        "which grows with each generation; close that program"
                    )
                self._log_bytes = self._limit_log()
            except sqlite3.Error as error:
                self._notice(f"could not move the newest generations from SQLite's log into {DATABASE}", error)
        if now - self._copied_at >= max(self.copy_interval_s, self._copy_seconds / COPY_TIME_FRACTION):
            self._copy()

    def finish(self) -> None:
        """Make the database a single file; SQLite's log remains beside it if a reader uses it or the disk is full."""
        if self._network and not self._is_copied:
            self._copy()
        with patience(self._connection, _CLOSE_PATIENCE_S):
            with contextlib.suppress(sqlite3.Error):
                self._checkpoint("TRUNCATE")
            with contextlib.suppress(sqlite3.Error):
                self._connection.execute("PRAGMA journal_mode = DELETE")

    def _limit_log(self) -> int:
        """Let SQLite make a checkpoint in each commit after which the log has this size, in bytes."""
        ((pages,),) = self._connection.execute("PRAGMA page_count")
        size = min(max(pages * PAGE_BYTES, LEAST_LOG_BYTES), MOST_LOG_BYTES)
        self._connection.execute(f"PRAGMA wal_autocheckpoint = {size // PAGE_BYTES}")
        return size

    def _checkpoint(self, mode: str) -> int:
        """Move the log into the database; returns about how many bytes readers have kept from it."""
        self._hook("before_checkpoint")
        # This comes before a possible failure, so that the next commit does not try again at once.
        self._checkpointed_at = time.monotonic()
        _, pages, moved = self._connection.execute(f"PRAGMA wal_checkpoint({mode})").fetchone()
        self._hook("after_checkpoint")
        return (pages - moved) * PAGE_BYTES

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
        self._tell(f"{'disk full: ' if full else ''}{what} ({error})")

    def _tell(self, what: str) -> None:
        """Add a notice, once in a session."""
        if (notice := f"{self._folder}: {what}") not in self._notices:
            self._notices.append(notice)


def _age_s(file: Path, limit: float) -> float:
    """Seconds since a file was written, clipped to [0, limit] in case the clock was changed; 0 if there is no file."""
    try:
        return min(max(time.time() - file.stat().st_mtime, 0.0), limit)
    except OSError:
        return 0.0
