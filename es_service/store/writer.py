"""The writer of the run store: a transaction for a generation, or for some that have ended within a short time, so that
`kill -9` loses at most these and the unfinished one.

A run is a folder with `config.yaml`, `run.db` (SQLite), `run.lock`, and after some minutes `run.db.copy`. On a local
disk `run.db` is in WAL mode: a killed process loses nothing that was committed, and a power cut loses at most the
commits since the last checkpoint. On a network file system `run.db` has a rollback journal instead, every commit is
synchronous, and readers read the copy. After a clean end, `run.db` is a single file.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

from numpy.typing import NDArray

from es_service.errors import StoreError, WayOut
from es_service.logs import logger
from es_service.loop.history import LATER
from es_service.loop.state import Generation
from es_service.protocol.child import require_same_process
from es_service.protocol.content import names_in
from es_service.store.codec import Part, encode_changes, row_dict, rows_listed, state_sha256
from es_service.store.create import Beginning, create_run_folder
from es_service.store.facts import Damaged
from es_service.store.folder import DATABASE, explained, is_network_filesystem, require_run_folder
from es_service.store.lock import RunLock, acquire_lock
from es_service.store.records import (
    insert_certification,
    load_start,
    next_certified_number,
    platform_before,
    record_metrics,
    record_platform,
    row_name,
    store_platform_list,
)
from es_service.store.repair import open_sound, patience
from es_service.store.rows import history_rows, insert_history, row_of_history, table_bytes
from es_service.store.schema import EXTENDED_SCHEMA, SCHEMA, RunMeta, put_meta
from es_service.store.states import KeptStates, insert_contents, insert_state, sound_content, sound_part
from es_service.store.upkeep import Upkeep

_LOG = logger(__name__)
NOTHING = Beginning()
"""Beginning of an ordinary run."""


def no_hook(name: str) -> None:
    """Do nothing. Tests pass another function, which the store calls with the name of each step that it has reached."""


class RunStore:
    """The only writer of a run, from `create` or `open` until `close`; a context manager, for use in one thread."""

    meta: RunMeta
    notices: list[str]
    """Messages for the user about repairs at opening, and about later problems that did not end the run."""
    generation: int | None
    """Newest committed generation; None if there is none."""
    keep_every: int | None = None
    """Generations whose number is a multiple of this keep their states; None keeps only the last two states. States of
    earlier generations that are kept when the run is opened remain."""
    start: Part | None
    """Arrays from which generation 0 starts; None if the run was created without them."""

    def __init__(self, folder: Path, lock: RunLock, hook: Callable[[str], None]) -> None:
        """Open the run in `folder`, whose lock is held and released at the end. Use `create` or `open` instead."""
        self.folder = folder
        self.notices = []
        self.lock = lock
        self._hook = hook
        self._maker = os.getpid()
        self._closed = self._recorded = False
        with contextlib.ExitStack() as closing:
            closing.callback(lock.release)
            self._connection, verdict = open_sound(folder, self.notices)
            closing.callback(self._connection.close)
            self.meta = verdict.meta
            self.generation = verdict.good
            with self._explaining(f"opening {DATABASE}"):
                self.start = load_start(self._connection)
                self._kept = KeptStates(self._connection, verdict.kept, verdict.named, verdict.good)
                self.upkeep = Upkeep(self._connection, folder, is_network_filesystem(folder), hook, self.notices)
            hook("opened")
            closing.callback(self.upkeep.finish)
            self._closing = closing.pop_all()

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
        """Create a run folder and open it.

        Args:
            folder: path that does not exist, or an empty folder; missing parents are created.
            beginning: data with which the run begins; no run folder appears without them.
            hook: function that is called with the name of each step, for tests.

        Raises:
            StoreError: the folder is not empty or cannot be written, or the columns of `meta` cannot be stored.
        """
        folder = Path(folder)
        return cls(folder, create_run_folder(folder, config_yaml, meta, beginning), hook)

    @classmethod
    def open(cls, folder: Path, *, hook: Callable[[str], None] = no_hook) -> RunStore:
        """Open the run in `folder`: take its lock, verify everything, and report repairs in `notices`.

        Raises:
            RunLockedError: another process is writing to the run.
            StoreError: there is no run, it has another schema version, or it is damaged beyond repair.
        """
        folder = Path(folder)
        try:
            require_run_folder(folder)
        except OSError as error:
            raise explained(error, folder, "looking for a run") from error
        return cls(folder, acquire_lock(folder), hook)

    def names(self) -> list[str]:
        """Names of the parts of the newest generation's state."""
        return self._kept.names()

    def load(self) -> dict[str, dict[str, NDArray[Any]]]:
        """State of the newest generation: part -> name -> array; empty before the first commit. Raises as `part`."""
        return {name: self.part(name) for name in self.names()}

    def part(self, name: str) -> dict[str, NDArray[Any]]:
        """One part of the newest generation's state: name -> array.

        Raises:
            KeyError: there is no such part.
            StoreError: the part has been damaged since the run was opened.
        """
        row = self._kept.newest(name)
        with self._loading():
            return sound_part(self._connection, name, *row)

    def contents(self) -> list[bytes]:
        """Names of the contents that the stored states and the certified policies name."""
        return self._kept.contents()

    def content(self, name: bytes) -> dict[str, NDArray[Any]]:
        """A content that is named, such as a policy: name -> array. Raises as `part`."""
        with self._loading():
            return sound_content(self._connection, name)

    @contextlib.contextmanager
    def _loading(self) -> Iterator[None]:
        with self._explaining("loading the state"):
            try:
                yield
            except Damaged as damage:
                raise StoreError(
                    f"{self.folder / DATABASE} was damaged after it was opened: {damage}",
                    run=self.folder,
                    ways_out=[WayOut("resume", "fall back to the newest intact generation", str(self.folder))],
                ) from damage

    def commit(self, generations: Sequence[Generation]) -> None:
        """Store generations in one transaction. If this raises, the store is unchanged and can still be used.

        Raises:
            DatabaseHeldError: another program holds the database. StoreError: the generations are not the next ones, a
                history does not fit the columns, a part names a content that nobody has, or the disk is full.
        """
        next_one = 0 if self.generation is None else self.generation + 1
        numbers = [one.number for one in generations]
        if numbers != [*range(next_one, next_one + len(numbers))] or not numbers:
            said = ", ".join(map(str, numbers)) or "none"
            raise StoreError(f"{self.folder}: cannot store generation {said}; the next generation is {next_one}")
        rows = [encode_changes(one.number, one.parts) for one in generations]
        arrays = {(part, one.number): arrays for one in generations for part, arrays in one.parts.items()}
        change = self._kept.changed_by([*map(rows_listed, rows)], arrays, numbers[-1], self.keep_every)
        contents = ChainMap(*(dict(one.contents) for one in generations))
        which = f"generation {next_one}" if len(numbers) == 1 else f"generations {next_one} to {numbers[-1]}"
        self._require_known(change.new_contents, contents, which)
        history = [self._history_row(*of_one) for of_one in zip(generations, change.totals, strict=True)]
        self._hook("before_begin")
        with self._transaction(f"storing {which}") as connection:
            # Delete first, so that the new rows use the pages of the old ones.
            connection.executemany("DELETE FROM state WHERE part = ? AND generation = ?", change.outdated)
            connection.executemany("DELETE FROM content WHERE name = ?", [(name,) for name in change.unnamed])
            insert_state(connection, (row for of_one in rows for row in of_one if row[:2] in change.added))
            insert_contents(connection, ((name, contents[name]) for name in change.new_contents))
            self._hook("mid_transaction")
            insert_history(connection, history)
            for one in generations:
                if one.recorded:
                    record_metrics(connection, one.number, one.recorded)
            if self._recorded:
                store_platform_list(connection)
            self._hook("before_commit")
        self._recorded = False
        self.generation = numbers[-1]
        self._kept.commit(change)
        self._hook("after_commit")
        _LOG.debug("stored %s: %d parts", which, len(change.added))
        self.upkeep.after_commit()

    def _history_row(self, one: Generation, total: int) -> tuple[Any, ...]:
        """The history row of a generation after which the state has this `state_sum`."""
        lacking = LATER - {column.name for column in self.meta.columns}
        history = {name: value for name, value in one.history.items() if name not in lacking}
        evaluations = table_bytes(self.meta.evaluation_columns, one.evaluations)
        return row_of_history(self.meta, one.number, history, evaluations, state_sha256(total))

    def _require_known(self, added: Sequence[bytes], contents: Mapping[bytes, Part], what: str) -> None:
        """Raise StoreError if a name that is not stored yet is not among the contents."""
        if lacking := [name.hex() for name in added if name not in contents]:
            raise StoreError(f"{self.folder}: {what} names {lacking[0]}, which nobody has")

    def last_history(self) -> dict[str, int | float] | None:
        """History row of the newest generation; NaN stands for no value. None before the first commit."""
        return next(iter(self.newest_history(1)), None)

    def newest_history(self, count: int) -> list[dict[str, int | float]]:
        """History rows of so many newest generations, in order; fewer if there are no more."""
        if self.generation is None:
            return []
        columns, first = self.meta.columns, max(0, self.generation + 1 - count)
        with self._explaining("reading the history"):
            rows = list(history_rows(self._connection, columns, first, check=False))
        return [row_dict(columns, stored.row) for stored, _ in rows]

    def record_platform(self, generation: int, platform: dict[str, Any]) -> bool:
        """Record the platform of a generation that is not stored yet, and of those after it, in place of their records.

        Returns whether it differs from that of the generations before, or is the first; otherwise nothing is recorded.
        Raises StoreError if `generation` is already stored.
        """
        if self.generation is not None and generation <= self.generation:
            raise StoreError(
                f"{self.folder}: generation {generation} is already stored, so its platform cannot be changed"
            )
        with self._transaction("recording the platform") as connection:
            self._recorded = True
            return record_platform(connection, generation, platform)

    def patience(self, seconds: float) -> AbstractContextManager[None]:
        """Context manager in which the store waits so long for another program that holds the database."""
        return patience(self._connection, seconds)

    @property
    def next_certification(self) -> int:
        with self._explaining("reading the certifications"):
            return next_certified_number(self._connection, self.meta.parent)

    def add_certification(
        self, policies: Sequence[tuple[Mapping[str, Any], Part]], contents: Mapping[bytes, Part]
    ) -> None:
        """Store a certification in one transaction: (facts, arrays) of each policy, in the order of rank.

        Args:
            contents: contents by name, among them those that the arrays name and that are not stored yet.

        Raises StoreError if the arrays name what nobody has, or if the database cannot be written.
        """
        number = self.next_certification
        named = {row_name(number, rank): names_in(arrays) for rank, (_, arrays) in enumerate(policies)}
        added = self._kept.lacking(named)
        self._require_known(added, contents, f"certification {number}")
        with self._transaction("storing a certification") as connection:
            put_meta(connection, SCHEMA, str(EXTENDED_SCHEMA))
            insert_contents(connection, ((name, contents[name]) for name in added))
            self._hook("mid_transaction")
            insert_certification(connection, number, policies)
            self._hook("before_commit")
        self._kept.add_certified(named)
        self._hook("after_commit")
        self.upkeep.after_commit()

    def record_metrics(self, generation: int, named: Mapping[str, float]) -> None:
        """Store metrics of a generation that is stored, in one transaction. Raises StoreError if the database cannot be
        written."""
        with self._transaction("recording metrics") as connection:
            record_metrics(connection, generation, named)

    def platform_before(self, generation: int) -> dict[str, Any] | None:
        """The platform recorded for the generation before this one; None if there is none."""
        with self._explaining("reading the platforms"):
            return platform_before(self._connection, generation)

    def close(self) -> None:
        """Make `run.db` a single file and release the lock. This may be called again.

        If a reader still uses the database or the disk is full, SQLite's log remains beside it, and nothing is lost.
        """
        self._closed = True
        if os.getpid() == self._maker:  # else the process that forked this one goes on writing
            self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _explaining(self, doing: str) -> Iterator[None]:
        if self._closed:
            raise StoreError(f"{self.folder}: the store was closed before {doing}")
        require_same_process(self._maker, f"the writer of {self.folder}", "end this one: the run goes on in the other")
        try:
            yield
        except sqlite3.Error as error:
            raise explained(error, self.folder, doing) from error

    @contextlib.contextmanager
    def _transaction(self, doing: str) -> Iterator[sqlite3.Connection]:
        with self._explaining(doing), self._connection as connection:  # which commits, or rolls back
            connection.execute("BEGIN IMMEDIATE")
            yield connection
