"""Opening a run's database for writing: verify it, go back a generation, or turn to the verified copy; never silently.

Runs are deterministic: what is lost here is computed again, with the same bits.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

from es_service.errors import StoreError
from es_service.store.folder import COPY, DAMAGED, DATABASE, explained, remove_database, sync_file, sync_folder
from es_service.store.schema import GENERATION_TABLES, Damaged, history_shared, load_meta
from es_service.store.verify import Verdict, check_header, verify

_BUSY_S = 10.0


def connect(file: Path) -> sqlite3.Connection:
    """A connection in autocommit mode to an existing or new database; every transaction is written out."""
    return sqlite3.connect(file, timeout=_BUSY_S, isolation_level=None)


def open_sound(folder: Path, notices: list[str]) -> tuple[sqlite3.Connection, Verdict]:
    """A connection to the folder's `run.db` and what it holds, after repairing what had to be; the lock is held.

    What was done is added to `notices`. Raises StoreError if nothing can be trusted, or if the files cannot be used
    for a reason that is no damage.
    """
    file = folder / DATABASE
    try:
        try:
            return _open_made_sound(file, notices)
        except Damaged as damage:
            _restore_copy(folder, str(damage), notices)
            return _open_made_sound(file, notices)
    except Damaged as damage:
        raise StoreError(f"{file} was restored from {COPY} and is damaged again: {damage}. Check the disk.") from damage
    except (sqlite3.Error, OSError) as error:
        raise explained(error, folder, f"opening {DATABASE}") from error


def _open_made_sound(file: Path, notices: list[str]) -> tuple[sqlite3.Connection, Verdict]:
    if not file.exists():
        raise Damaged("it is missing")
    check_header(file)
    connection = connect(file)
    try:
        return connection, _made_sound(connection, file, notices)
    except BaseException:
        connection.close()
        raise


def _made_sound(connection: sqlite3.Connection, file: Path, notices: list[str]) -> Verdict:
    """Verify, and delete what is not sound if a whole generation remains. Raises Damaged if none does."""
    verdict = verify(connection, file)
    if not verdict.problems:
        return verdict
    if verdict.good is None:
        raise Damaged("; ".join(verdict.problems))
    connection.execute("BEGIN IMMEDIATE")
    for table in GENERATION_TABLES:
        connection.execute(f"DELETE FROM {table} WHERE generation > ?", (verdict.good,))
    connection.executemany("DELETE FROM state WHERE part IS ? AND generation IS ?", verdict.bad_rows)
    connection.execute("COMMIT")
    found = "; ".join(verdict.problems)
    if verdict.good == verdict.newest:
        notices.append(f"{file}: {found}. The newest generation, {verdict.good}, is sound; deleted the rest")
    else:
        notices.append(
            f"{file}: the newest state or history, of generation {verdict.newest}, is damaged ({found}); "
            f"fell back to generation {verdict.good}"
        )
    again = verify(connection, file)
    if again.problems:
        raise Damaged("; ".join(again.problems))
    return again


def _restore_copy(folder: Path, damage: str, notices: list[str]) -> None:
    """Put the verified copy in the place of `run.db`, which is kept aside. Can be killed anywhere and done again."""
    file, copy, restored = folder / DATABASE, folder / COPY, folder / f"{DATABASE}.restored"
    if not copy.exists():
        raise StoreError(
            f"{file} cannot be trusted, and there is no {COPY} to turn to: {damage}. If {folder} is not a run folder, "
            f"name another; if it is, put back a backup of {DATABASE}, or start again in another folder.",
            run=folder,
        )
    remove_database(restored)
    shutil.copyfile(copy, restored)
    try:
        connection, verdict = _open_made_sound(restored, notices)
    except Damaged as error:
        remove_database(restored)
        raise StoreError(
            f"Nothing in {folder} can be trusted. {DATABASE}: {damage}. {COPY}: {error}. "
            f"Put back a backup of {DATABASE}, or start again in another folder.",
            run=folder,
        ) from error
    with closing(connection):
        # One file, so that the rename below moves all of it.
        connection.execute("PRAGMA journal_mode = DELETE")
    sync_file(restored)
    # The database first: without it, being killed here leads back here, and its log cannot be lost before it.
    if file.exists():
        remove_database(folder / DAMAGED)
        os.replace(file, folder / DAMAGED)
    for suffix in ("-journal", "-wal", "-shm"):
        log = folder / (DATABASE + suffix)
        if log.exists():
            os.replace(log, folder / (DAMAGED + suffix))
    os.replace(restored, file)
    sync_folder(folder)
    notices.append(
        f"{file}: {damage}. Restored {COPY}, which reaches generation {verdict.good}"
        + (f"; the damaged file is kept as {DAMAGED}" if (folder / DAMAGED).exists() else "")
    )


def make_copy(connection: sqlite3.Connection, folder: Path) -> None:
    """Replace the folder's verified copy by one of what `connection` has committed.

    The driver waits meanwhile, so rows that are in the former copy as they are here are not checked again.

    Raises Damaged if what was copied cannot be trusted (the former copy then stays), sqlite3.Error and OSError where
    it could not be written.
    """
    temporary = folder / f"{COPY}.new"
    try:
        remove_database(temporary)
        with closing(connect(temporary)) as target:
            target.execute("PRAGMA synchronous = OFF")
            connection.backup(target)
            # The copied header says WAL; a copy is a single file that can be read without writing beside it.
            target.execute("PRAGMA journal_mode = DELETE")
            verdict = verify(target, temporary, _known_rows(target, folder / COPY))
        if verdict.problems:
            raise Damaged("; ".join(verdict.problems))
        sync_file(temporary)
        os.replace(temporary, folder / COPY)
        sync_folder(folder)
    except BaseException:
        remove_database(temporary)
        raise


def _known_rows(connection: sqlite3.Connection, former: Path) -> int:
    """History rows, from generation 0 on, that must be sound: the former verified copy has them all, and no others.

    That both were damaged alike cannot be. To compare them takes a fraction of the time of their SHA-256.
    """
    if not former.exists():
        return 0
    with suppress(sqlite3.Error):  # of the former copy, which may be damaged, or anything at all
        columns = load_meta(connection, former).columns
        connection.execute("ATTACH ? AS former", (str(former),))
        try:
            shared = connection.execute(history_shared(columns, "former")).fetchone()[0]
            all_of_them = connection.execute("SELECT count(*) FROM former.history").fetchone()[0]
        finally:
            connection.execute("DETACH former")
        return shared if shared == all_of_them else 0
    return 0
