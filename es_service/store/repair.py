"""Opening a run's database for writing: it is verified, and a damaged one is repaired or replaced by the verified copy.

Every repair is reported. Since runs are deterministic, lost generations are computed again with the same bits.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from es_service.errors import StoreError
from es_service.store.facts import Damaged
from es_service.store.folder import COPY, DAMAGED, DATABASE, explained, remove_database, sync_file
from es_service.store.reader import connected_to
from es_service.store.records import remove_certified, remove_metrics
from es_service.store.schema import GENERATION_TABLES, OWN_HISTORY_COLUMNS, load_meta, quoted
from es_service.store.states import collect_contents
from es_service.store.verify import Verdict, verify

PATIENCE_S = 10.0
"""Seconds for which a connection waits for another program that holds the database."""


def connect(file: Path) -> sqlite3.Connection:
    """A connection in autocommit mode to an existing or new database; all transactions are explicit."""
    return sqlite3.connect(file, timeout=PATIENCE_S, isolation_level=None)


@contextmanager
def patience(connection: sqlite3.Connection, seconds: float) -> Iterator[None]:
    """Let a connection wait so long for other programs, instead of PATIENCE_S, inside the block."""
    connection.execute(f"PRAGMA busy_timeout = {round(1000 * seconds)}")
    try:
        yield
    finally:
        connection.execute(f"PRAGMA busy_timeout = {round(1000 * PATIENCE_S)}")


def open_sound(folder: Path, notices: list[str]) -> tuple[sqlite3.Connection, Verdict]:
    """A connection to the folder's `run.db` and the result of its verification, after any necessary repair, about which
    messages are added to `notices`. The caller must hold the lock.

    Raises:
        StoreError: neither the database nor its copy can be used, or a file cannot be accessed.
    """
    file = folder / DATABASE
    try:
        try:
            return _open_made_sound(file, notices, copy=folder / COPY)
        except Damaged as damage:
            _restore_copy(folder, str(damage), notices)
            return _open_made_sound(file, notices)
    except Damaged as damage:
        raise StoreError(f"{file} was restored from {COPY} and is damaged again: {damage}. Check the disk.") from damage
    except (sqlite3.Error, OSError) as error:
        raise explained(error, folder, f"opening {DATABASE}") from error


def _open_made_sound(file: Path, notices: list[str], copy: Path | None = None) -> tuple[sqlite3.Connection, Verdict]:
    if not file.exists():
        raise Damaged("it is missing")
    _check_header(file)
    connection = connect(file)
    try:
        return connection, _made_sound(connection, file, notices, copy)
    except BaseException:
        connection.close()
        raise


def _check_header(file: Path) -> None:
    """Raise Damaged if the header of a database is wrong. No connection of this process may have the file open."""
    with file.open("rb") as stream:
        header = stream.read(100)
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        raise Damaged("it is not an SQLite database")
    # Write and read version: 1 is a rollback journal, 2 is WAL. SQLite treats a file with others as read-only.
    if header[18] != header[19] or header[18] not in (1, 2):
        raise Damaged("its header names an unknown file format")


def _made_sound(connection: sqlite3.Connection, file: Path, notices: list[str], copy: Path | None) -> Verdict:
    """Verify a database and delete damaged rows and what is newer than the newest intact state; returns the new result.

    If more than one generation is deleted, the database as it was is kept under another name. Otherwise little is lost,
    and the state before the newest is the one that a run always stores for this purpose.

    Raises:
        Damaged: no generation is intact, or fewer generations are lost with `copy`.
    """
    verdict = verify(connection, file)
    if not verdict.problems:
        return verdict
    damage = verdict.damage
    if verdict.good is None or (copy is not None and _reach(copy) > verdict.good):
        raise Damaged(damage)
    kept = ""
    if verdict.newest is not None and verdict.good < verdict.newest - 1:
        old = file.with_name(f"{file.name}.damaged")  # DAMAGED, except for a damaged copy that is being restored
        remove_database(old)
        with _new_copy(connection, old):
            kept = f"; the damaged database, with all generations, is kept as {old.name}"
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        for table in GENERATION_TABLES:
            connection.execute(f"DELETE FROM {table} WHERE generation > ?", (verdict.good,))
        connection.executemany("DELETE FROM state WHERE part IS ? AND generation IS ?", verdict.bad_rows)
        connection.execute("REINDEX content")
        remove_certified(connection, verdict.bad_certifications)
        remove_metrics(connection, verdict.good)
        collect_contents(connection)
    if verdict.good == verdict.newest:
        notices.append(
            f"{file}: {damage}. The newest generation, {verdict.good}, is intact; the damaged rows were deleted"
        )
    else:
        notices.append(
            f"{file}: the state or the history of the newest generation, {verdict.newest}, is damaged ({damage}); "
            f"the run fell back to generation {verdict.good}, the newest whose state is stored and intact{kept}"
        )
    again = verify(connection, file)
    if again.problems:
        raise Damaged(again.damage)
    return again


def _reach(copy: Path) -> int:
    """The newest intact generation of a copy; -1 if there is none, or if the copy cannot be read."""
    with suppress(sqlite3.Error, OSError, Damaged, StoreError):
        _check_header(copy)
        with closing(connected_to(copy)[0]) as connection:
            good = verify(connection, copy).good
        return -1 if good is None else good
    return -1


def _restore_copy(folder: Path, damage: str, notices: list[str]) -> None:
    """Replace `run.db`, which is kept under another name, by the verified copy. If this process is killed at any point,
    this function can be called again."""
    file, copy, restored = folder / DATABASE, folder / COPY, folder / f"{DATABASE}.restored"
    if not copy.exists():
        raise StoreError(
            f"{file} cannot be used: {damage}. There is no {COPY} from which to restore it. If {folder} is not a run "
            f"folder, choose another folder; if it is, restore {DATABASE} from a backup, or start a new run in another "
            "folder.",
            run=folder,
        )
    remove_database(restored)
    shutil.copyfile(copy, restored)
    try:
        connection, verdict = _open_made_sound(restored, notices)
    except Damaged as error:
        remove_database(restored)
        raise StoreError(
            f"Neither {DATABASE} nor {COPY} in {folder} can be used. {DATABASE}: {damage}. {COPY}: {error}. "
            f"Restore {DATABASE} from a backup, or start a new run in another folder.",
            run=folder,
        ) from error
    with closing(connection):
        # The database must be a single file, so that the rename below moves all of it.
        connection.execute("PRAGMA journal_mode = DELETE")
    sync_file(restored)
    # Move the database before its log, which it needs. If this process is killed in between, the next opening finds no
    # database and restores the copy again.
    if file.exists():
        remove_database(folder / DAMAGED)
        os.replace(file, folder / DAMAGED)
    for suffix in ("-journal", "-wal", "-shm"):
        log = folder / (DATABASE + suffix)
        if log.exists():
            os.replace(log, folder / (DAMAGED + suffix))
    os.replace(restored, file)
    sync_file(folder)
    notices.append(
        f"{file}: {damage}. Restored {COPY}, which reaches generation {verdict.good}"
        + (f"; the damaged file is kept as {DAMAGED}" if (folder / DAMAGED).exists() else "")
    )


def make_copy(connection: sqlite3.Connection, folder: Path) -> None:
    """Replace the folder's verified copy by a new copy of the database of `connection`.

    The driver waits meanwhile, so rows that are the same in the former copy are not checked again. If this raises, the
    former copy remains.

    Raises:
        Damaged: the new copy is damaged.
        sqlite3.Error, OSError: the new copy cannot be written.
    """
    with _new_copy(connection, folder / COPY) as copy:
        verdict = verify(copy, folder / COPY, _known_rows(copy, folder / COPY))
        if verdict.problems:
            raise Damaged(verdict.damage)


@contextmanager
def _new_copy(connection: sqlite3.Connection, file: Path) -> Iterator[sqlite3.Connection]:
    """A connection to a new copy of the database of `connection`, with what is in its log.

    The copy becomes `file`, a single file, when the block ends. If anything raises, the former `file` remains.
    """
    temporary = file.with_name(f"{file.name}.new")
    try:
        remove_database(temporary)
        with closing(connect(temporary)) as copy:
            copy.execute("PRAGMA synchronous = OFF")
            connection.backup(copy, progress=_refuse_to_wait)
            # The header was copied from a WAL database. Without WAL, readers of the copy write no files beside it.
            copy.execute("PRAGMA journal_mode = DELETE")
            yield copy
        sync_file(temporary)
        os.replace(temporary, file)
        sync_file(file.parent)
    except BaseException:
        remove_database(temporary)
        raise


def _refuse_to_wait(status: int, remaining: int, total: int) -> None:
    """Raise sqlite3.OperationalError if another program holds the database, for which Python would wait without end."""
    if status in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        error = sqlite3.OperationalError("database is locked")
        error.sqlite_errorcode = status
        raise error


def _known_rows(connection: sqlite3.Connection, former: Path) -> int:
    """Number of history rows, from generation 0 on, that equal those of the former verified copy; 0 if any row differs.

    These rows are intact, since both files cannot have the same damage. Comparing them is much faster than SHA-256.
    """
    if not former.exists():
        return 0
    # The former copy may be damaged, also the statements that SQLite's messages quote, or may be another file.
    with suppress(sqlite3.Error, UnicodeDecodeError):
        names = [*(column.name for column in load_meta(connection, former).columns), *OWN_HISTORY_COLUMNS]
        same = " AND ".join(f"ours.{quoted(name)} IS theirs.{quoted(name)}" for name in names)
        shared = f"SELECT count(*) FROM former.history AS theirs JOIN main.history AS ours ON {same}"
        connection.execute("ATTACH ? AS former", (str(former),))
        try:
            known, stored = connection.execute(f"SELECT ({shared}), (SELECT count(*) FROM former.history)").fetchone()
        finally:
            connection.execute("DETACH former")
        return known if known == stored else 0
    return 0
