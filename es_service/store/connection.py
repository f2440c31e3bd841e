"""Read-only connections to a run: to its database, or to the copy beside it."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from es_service.errors import StoreError, WayOut
from es_service.store.facts import Damaged
from es_service.store.folder import COPY, DATABASE, explained, is_network_filesystem, is_no_damage, require_run_folder
from es_service.store.lock import lock_holder
from es_service.store.schema import RunMeta, load_meta

_BUSY_S = 5.0


@contextlib.contextmanager
def reading(folder: Path) -> Iterator[tuple[sqlite3.Connection, RunMeta]]:
    """Context manager with a read-only connection to the run in `folder`, inside a transaction, and its description.

    All reads in it see the same generation. It should be short, because a writer cannot empty SQLite's log meanwhile.

    Raises:
        StoreError: the folder is not a run folder, the run was written by a version with another schema, or it cannot
            be read.
    """
    folder = Path(folder)
    try:
        connection, meta = _connected(folder)
        with contextlib.closing(connection):
            yield connection, meta
    except (sqlite3.Error, Damaged, OSError, UnicodeDecodeError) as error:
        raise _unreadable(folder, error) from error


def _connected(folder: Path) -> tuple[sqlite3.Connection, RunMeta]:
    require_run_folder(folder)
    if not (folder / DATABASE).exists():
        way_out = WayOut("resume", f"restore it from {COPY}", str(folder))
        raise StoreError(f"{folder / DATABASE} is missing", run=folder, ways_out=[way_out])
    if not is_network_filesystem(folder) or not (folder / COPY).exists():
        return connected_to(folder / DATABASE)
    # On a network file system, read the copy while a writer is running.
    if lock_holder(folder) is None:
        try:
            return connected_to(folder / DATABASE)
        except sqlite3.Error as error:
            # A killed writer may have left a transaction that must be rolled back, which readers cannot do.
            if not is_no_damage(error, folder):
                raise
    return connected_to(folder / COPY)


def connected_to(file: Path) -> tuple[sqlite3.Connection, RunMeta]:
    """A read-only connection to a database, inside a transaction, and the description of its run. Raises Damaged,
    StoreError or sqlite3.Error if it cannot be read."""
    uri = f"{file.absolute().as_uri()}?mode=ro"
    connection = sqlite3.connect(uri, uri=True, timeout=_BUSY_S, isolation_level=None)
    try:
        connection.execute("BEGIN")
        # The first read determines the generation that the whole transaction sees.
        return connection, load_meta(connection, file)
    except BaseException:
        connection.close()
        raise


def _unreadable(folder: Path, error: sqlite3.Error | Damaged | OSError | UnicodeDecodeError) -> StoreError:
    if not isinstance(error, Damaged | UnicodeDecodeError) and is_no_damage(error, folder):
        return explained(error, folder, "reading the run", "try again, or read a copy of the folder")
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    is_database = code != sqlite3.SQLITE_NOTADB and "no such table: meta" not in str(error)
    what = "cannot be read" if is_database else "is not a run folder"
    way_out = WayOut("resume", "repair it as far as possible, if it is a run", str(folder))
    return StoreError(f"{folder} {what}: {error}", run=folder, ways_out=[way_out])
