"""The run store's writer: one transaction per generation, so that `kill -9` loses the generation in flight only.

A run is a folder: `config.yaml`, `run.db` (SQLite), `run.lock`, and after a while `run.db.copy`. On a local disk
`run.db` is in WAL mode: a killed process loses nothing that was committed, a power cut at most what was committed since
the last checkpoint. On network file systems there is no WAL: the journal is rolled back, every commit is synchronous,
and readers read the copy. A clean end leaves `run.db` as a single file.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from es_service.errors import StoreError, WayOut
from es_service.logs import logger
from es_service.store.beginning import Beginning, load_start
from es_service.store.codec import (
    Part,
    changed_sum,
    decode_part,
    encode_part,
    history_row,
    part_sha256,
    row_dict,
    state_sha256,
    state_sum,
    text_sha256,
)
from es_service.store.create import create_run_folder
from es_service.store.folder import DATABASE, explained, is_network_filesystem, require_run_folder
from es_service.store.lock import RunLock, acquire_lock
from es_service.store.repair import open_sound
from es_service.store.schema import PAGE_BYTES, RunMeta, history_insert, history_select
from es_service.store.upkeep import Upkeep
from es_service.store.verify import rows_in_force

Values = Mapping[str, int | float | None]
"""One history row by column name; NaN or None for no value."""
_LOG = logger(__name__)
NOTHING = Beginning()
"""The beginning of an ordinary run."""


def no_hook(name: str) -> None:
    """What happens at the store's named instants, unless a test wants otherwise: nothing."""


class RunStore:
    """The one writer of a run, from `create` or `open` until `close`; a context manager. Not for several threads."""

    meta: RunMeta
    notices: list[str]
    """What opening had to repair, and what later went wrong without ending the run; for the user to read."""
    generation: int | None
    """Newest committed generation; None before the first."""
    start: Part | None
    """What generation 0 is to start from, if the run was created with that."""

    def __init__(self, folder: Path, lock: RunLock, hook: Callable[[str], None]) -> None:
        """Open the run in `folder`, whose lock is held; `create` and `open` are the ways in."""
        self.folder = folder
        self.notices = []
        self._lock = lock
        self._hook = hook
        self._closed = False
        self._connection, verdict = open_sound(folder, self.notices)
        self.meta = verdict.meta
        self.generation = verdict.good
        self._kept = verdict.kept
        # Parts of which the row before the newest is at hand too, for the generation before.
        self._doubled = [part for part, rows in self._kept.items() if len(rows) > 1]
        self._state_sum = 0 if self.generation is None else state_sum(rows_in_force(self._kept, self.generation))
        self._insert_history = history_insert(self.meta.columns)
        try:
            with self._explaining(f"opening {DATABASE}"):
                self.start = load_start(self._connection)
                self.upkeep = Upkeep(self._connection, folder, is_network_filesystem(folder), hook, self.notices)
            hook("opened")
        except BaseException:
            self._connection.close()
            raise

    @classmethod
    def create(
        cls,
        folder: Path,
        config_yaml: str,
        meta: RunMeta,
        beginning: Beginning = NOTHING,
        *,
        hook: Callable[[str], None] = no_hook,
    ) -> RunStore:
        """Start a run in `folder`, which must not exist or be empty; its parent must exist.

        `beginning` is there from the first instant that the run is.

        Raises StoreError if the folder is taken, cannot be written, or the columns of `meta` cannot be stored.
        """
        folder = Path(folder)
        lock = create_run_folder(folder, config_yaml, meta, beginning)
        return cls._holding(lock, folder, hook)

    @classmethod
    def open(cls, folder: Path, *, hook: Callable[[str], None] = no_hook) -> RunStore:
        """Continue the run in `folder`: take its lock, verify everything, repair what must be and say so in `notices`.

        Raises RunLockedError if another process writes to it; StoreError if it is no run, was written by a newer
        version, or holds nothing that can be trusted.
        """
        folder = Path(folder)
        try:
            require_run_folder(folder)
        except OSError as error:
            raise explained(error, folder, "looking for a run") from error
        return cls._holding(acquire_lock(folder), folder, hook)

    @classmethod
    def _holding(cls, lock: RunLock, folder: Path, hook: Callable[[str], None]) -> RunStore:
        try:
            return cls(folder, lock, hook)
        except BaseException:
            lock.release()
            raise

    def load(self, without: str | None = None) -> dict[str, dict[str, NDArray[Any]]]:
        """Every state part as of the newest generation, checked once more; empty before the first commit.

        Args:
            without: how the names of parts begin that are left out.
        """
        names = sorted(self._kept) if self.generation is not None else []
        return {name: self.part(name) for name in names if without is None or not name.startswith(without)}

    def part(self, name: str) -> dict[str, NDArray[Any]]:
        """One state part as of the newest generation, checked once more. Raises KeyError if there is none."""
        at = max(self._kept[name])
        with self._explaining("loading the state"):
            row = self._connection.execute(
                "SELECT payload FROM state WHERE part = ? AND generation = ?", (name, at)
            ).fetchone()
            if row is None or part_sha256(name, at, row[0]) != self._kept[name][at]:
                raise StoreError(
                    f"{self.folder / DATABASE}: state of {name!r} at generation {at} was damaged since it was opened",
                    run=self.folder,
                    ways_out=[WayOut("resume", "fall back to what is sound", str(self.folder))],
                )
            return decode_part(row[0])

    def commit(self, generation: int, parts: Mapping[str, Part], history: Values) -> None:
        """Store a generation: all of it or, if this raises, nothing of it.

        Args:
            generation: the one after `self.generation`, 0 if that is None.
            parts: those that changed; the others keep their value.
            history: a value for every column of the run but perhaps `generation`; NaN or None for no value.

        Raises StoreError for another generation, a row that does not fit the columns, a full disk. After it the store
        is as before and may still be used.
        """
        expected = 0 if self.generation is None else self.generation + 1
        if generation != expected:
            raise StoreError(f"{self.folder}: generation {generation} cannot be stored, the next one is {expected}")
        payloads = {part: encode_part(arrays) for part, arrays in parts.items()}
        new = {part: (generation, part_sha256(part, generation, payload)) for part, payload in payloads.items()}
        old = {part: max(self._kept[part].items()) for part in new if part in self._kept}
        total = changed_sum(self._state_sum, old, new)
        history_values = history_row(self.meta.columns, generation, history, state_sha256(total))
        # Enough stays to put together the newest generation and the one before it.
        outdated = [(part, at) for part in self._doubled for at in self._kept[part] if at < max(self._kept[part])]
        self._hook("before_begin")
        with self._transaction(f"storing generation {generation}") as execute:
            # First, so that the new rows take the pages of the old ones.
            for part, at in outdated:
                execute("DELETE FROM state WHERE part = ? AND generation = ?", (part, at))
            for part, payload in payloads.items():
                row = (part, *new[part], payload)
                execute("INSERT INTO state (part, generation, sha256, payload) VALUES (?, ?, ?, ?)", row)
            self._hook("mid_transaction")
            execute(self._insert_history, history_values)
            self._hook("before_commit")
        self.generation, self._state_sum = generation, total
        for part, at in outdated:
            del self._kept[part][at]
        for part, (at, sha256) in new.items():
            self._kept.setdefault(part, {})[at] = sha256
        self._doubled = list(old)
        self._hook("after_commit")
        _LOG.debug("stored generation %d: %d parts", generation, len(payloads))
        self.upkeep.after_commit(sum(map(len, payloads.values())) + 4 * PAGE_BYTES)

    def last_history(self) -> dict[str, int | float] | None:
        """The newest generation's history row, NaN where it has no value; None before the first commit."""
        if self.generation is None:
            return None
        with self._explaining("reading the history"):
            query = history_select(self.meta.columns) + " WHERE history.generation = ?"
            row = self._connection.execute(query, (self.generation,)).fetchone()
        return row_dict(self.meta.columns, row[:-2])

    def record_platform(self, generation: int, platform: dict[str, Any]) -> bool:
        """Record what the run runs on (versions, CPU kind; JSON-able), in force from `generation` on.

        Replaces what was recorded for `generation` and later, of which nothing is stored. Returns whether it differs
        from the one in force before; if not, nothing is recorded.
        """
        if self.generation is not None and generation <= self.generation:
            raise StoreError(
                f"{self.folder}: generation {generation} is stored already, its platform cannot be changed"
            )
        text = json.dumps(platform, sort_keys=True)
        with self._transaction("recording the platform") as execute:
            execute("DELETE FROM platform WHERE generation >= ?", (generation,))
            latest = execute("SELECT platform FROM platform ORDER BY generation DESC LIMIT 1").fetchone()
            differs = latest is None or latest[0] != text
            if differs:
                row = (generation, text, text_sha256(f"platform {generation}", text))
                execute("INSERT INTO platform (generation, platform, sha256) VALUES (?, ?, ?)", row)
        return differs

    def close(self) -> None:
        """Leave `run.db` as a single file and let go of the run. Harmless if done already; raises nothing of its own.

        A reader that holds on to the database, or a full disk, leaves a WAL beside it, which loses nothing.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self.upkeep.finish()
        finally:
            self._connection.close()
            self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextlib.contextmanager
    def _explaining(self, doing: str) -> Iterator[None]:
        if self._closed:
            raise StoreError(f"{self.folder}: the store was closed before {doing}")
        try:
            yield
        except sqlite3.Error as error:
            raise explained(error, self.folder, doing) from error

    @contextlib.contextmanager
    def _transaction(self, doing: str) -> Iterator[Callable[..., sqlite3.Cursor]]:
        with self._explaining(doing):
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                yield self._connection.execute
                self._connection.execute("COMMIT")
            except BaseException:
                # SQLite has rolled back by itself after some errors.
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise
