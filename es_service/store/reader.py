"""Reading a run in short transactions, during writing, after a writer was killed, and after a clean end.

Readers never create, change or repair a run. The state and the history rows that they return match their SHA-256.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from es_service.errors import StoreError, WayOut
from es_service.store.beginning import load_start
from es_service.store.codec import column_bytes, decode_part, part_sha256, row_dict, table_rows
from es_service.store.folder import COPY, DATABASE, explained, is_network_filesystem, require_run_folder
from es_service.store.kept import whole_states
from es_service.store.lock import lock_holder
from es_service.store.schema import Damaged, RunMeta, history_select, load_meta, quoted
from es_service.store.verify import KeptRows, is_no_damage, row_is_sound, rows_in_force, sound_platforms

_BUSY_S = 5.0
EvaluatedCentres = list[dict[str, int | float]]
"""The centres that one generation evaluated, as values by column name; NaN stands for no value."""


class HistoryRow(NamedTuple):
    """A history row whose SHA-256 was checked."""

    values: dict[str, int | float]
    evaluations: bytes
    state: str
    """`codec.state_sha256` of the state after the generation."""


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
    except (sqlite3.Error, Damaged, OSError) as error:
        raise _unreadable(folder, error) from error
    with contextlib.closing(connection):
        try:
            yield connection, meta
        except (sqlite3.Error, Damaged) as error:
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
        # This fails if a killed writer left a transaction that must be rolled back, which readers cannot do.
        with contextlib.suppress(sqlite3.Error):
            return connected_to(folder / DATABASE)
    return connected_to(folder / COPY)


def connected_to(file: Path) -> tuple[sqlite3.Connection, RunMeta]:
    """A read-only connection to a database, inside a transaction, and the description of its run.

    Raises Damaged, StoreError or sqlite3.Error if it cannot be read.
    """
    uri = f"{file.absolute().as_uri()}?mode=ro"
    connection = sqlite3.connect(uri, uri=True, timeout=_BUSY_S, isolation_level=None)
    try:
        connection.execute("BEGIN")
        # The first read determines the generation that the whole transaction sees.
        return connection, load_meta(connection, file)
    except BaseException:
        connection.close()
        raise


def _unreadable(folder: Path, error: sqlite3.Error | Damaged | OSError) -> StoreError:
    if not isinstance(error, Damaged) and is_no_damage(error, folder):
        return explained(error, folder, "reading the run", "try again, or read a copy of the folder")
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    is_database = code != sqlite3.SQLITE_NOTADB and "no such table: meta" not in str(error)
    what = "cannot be read" if is_database else "is not a run folder"
    way_out = WayOut("resume", "repair it as far as possible, if it is a run", str(folder))
    return StoreError(f"{folder} {what}: {error}", run=folder, ways_out=[way_out])


def read_meta(folder: Path) -> RunMeta:
    """The description of a run. Raises StoreError as `reading`, as do all functions here that take a folder."""
    with reading(folder) as (_, meta):
        return meta


def read_generation(folder: Path) -> int | None:
    """Newest committed generation; None if there is none."""
    with reading(folder) as (connection, _):
        return connection.execute("SELECT max(generation) FROM history").fetchone()[0]


def read_history(
    folder: Path, since_generation: int | None = None, limit: int | None = None
) -> list[dict[str, int | float]]:
    """History rows in order, as values by column name; NaN stands for no value.

    Args:
        since_generation: generation of the first row; None for all rows.
        limit: greatest number of rows; None for all rows.

    Raises:
        StoreError: a row is missing or does not match its SHA-256.
    """
    with reading(folder) as (connection, meta):
        return [row.values for row in _sound_rows(connection, meta, max(since_generation or 0, 0), limit)]


def read_evaluations(folder: Path, since_generation: int = 0, limit: int | None = None) -> list[EvaluatedCentres]:
    """The centres that each generation evaluated, in the order of the asks; arguments and errors as `read_history`."""
    with reading(folder) as (connection, meta):
        found = _sound_rows(connection, meta, since_generation, limit)
        try:
            return [table_rows(meta.evaluation_columns, row.evaluations) for row in found]
        except ValueError as error:
            raise Damaged(str(error)) from error


def read_newest(folder: Path) -> dict[str, int | float] | None:
    """The newest history row; None if there is none. No other row is read.

    Raises:
        StoreError: the row is missing or does not match its SHA-256.
    """
    with reading(folder) as (connection, meta):
        newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
        rows = _sound_rows(connection, meta, newest or 0)
        return rows[-1].values if rows else None


def read_row(folder: Path, generation: int) -> HistoryRow:
    """All that is stored of one generation in the history.

    Raises:
        StoreError: the row is missing or does not match its SHA-256.
    """
    with reading(folder) as (connection, meta):
        if not (rows := _sound_rows(connection, meta, generation, 1)):
            raise Damaged(f"the history row of generation {generation} is missing")
        return rows[0]


def read_start(folder: Path) -> dict[str, NDArray[Any]] | None:
    """Arrays from which generation 0 of the run starts; None if it was created without them."""
    with reading(folder) as (connection, _):
        return load_start(connection)


def read_totals(folder: Path, names: Sequence[str]) -> list[int | float]:
    """Sums of columns over the whole history, in the order of `names`. Rows are not checked against their SHA-256."""
    sums = ", ".join(f"coalesce(sum(history.{quoted(name)}), 0)" for name in names)
    with reading(folder) as (connection, _):
        return list(connection.execute(f"SELECT {sums} FROM history").fetchone())


def _sound_rows(
    connection: sqlite3.Connection, meta: RunMeta, first: int, limit: int | None = None
) -> list[HistoryRow]:
    """History rows from generation `first` on. Raises Damaged if a row is missing or does not match its SHA-256."""
    query = history_select(meta.columns) + " WHERE history.generation >= ? ORDER BY history.generation LIMIT ?"
    columns = column_bytes(meta.columns)
    rows: list[HistoryRow] = []
    for *values, evaluations, state, sha256 in connection.execute(query, (first, -1 if limit is None else limit)):
        row = tuple(values)
        named = row_dict(meta.columns, row)
        if not row_is_sound(columns, row, evaluations, state, sha256) or named["generation"] != first + len(rows):
            raise Damaged(f"the history row of generation {first + len(rows)} is damaged or missing")
        rows.append(HistoryRow(named, evaluations, state))
    # Damage can hide the end of a table even from SQLite. The state shows it, since every generation has state rows.
    newest = connection.execute("SELECT max(generation) FROM state").fetchone()[0]
    if newest is not None and newest >= first + len(rows) and len(rows) != limit:
        at = first + len(rows) - 1
        raise Damaged(f"the history after generation {at} is missing; the state is that of generation {newest}")
    return rows


def read_parts(
    folder: Path, generation: int | None = None, wanted: Callable[[str], bool] = lambda part: True
) -> tuple[int, dict[str, dict[str, NDArray[Any]]]]:
    """A generation and its state, as (generation, arrays by name for each part).

    Args:
        generation: generation of the state; None for the newest.
        wanted: function that tells from a part's name whether to read this part.

    Raises:
        StoreError: the state of this generation is not stored, or does not match its SHA-256.
    """
    with reading(folder) as (connection, _):
        newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
        if newest is None:
            way_out = WayOut("resume", "continue it", str(folder))
            raise StoreError(f"{folder} has no generation yet", run=folder, ways_out=[way_out])
        asked = newest if generation is None else generation
        kept = _kept_rows(connection)
        whole = whole_states(connection, kept)
        if asked not in whole:
            if asked == newest:
                raise Damaged(f"the state of generation {asked} is damaged")
            raise StoreError(
                f"{folder} does not keep the state of generation {asked}; it keeps the states of generations {whole}, "
                f"and its history ends at generation {newest}",
                field="generation",
                value=asked,
                allowed=str(whole),
                suggestion=max(whole, default=None),
                run=folder,
            )
        parts: dict[str, dict[str, NDArray[Any]]] = {}
        for part, (at, sha256) in sorted(rows_in_force(kept, asked).items()):
            if not wanted(part):
                continue
            payload = state_payload(connection, part, at)
            if part_sha256(part, at, payload) != sha256:
                raise Damaged(f"the state of {part!r} at generation {at} does not match its SHA-256")
            parts[part] = decode_part(payload)
        return asked, parts


def read_kept(folder: Path) -> tuple[KeptRows, list[int]]:
    """Stored state rows (part -> generation -> SHA-256), and the generations whose whole state is stored."""
    with reading(folder) as (connection, _):
        kept = _kept_rows(connection)
        return kept, whole_states(connection, kept)


def kept_states(connection: sqlite3.Connection) -> list[int]:
    """Generations whose whole state is stored: at most the last two, unless the run keeps others."""
    return whole_states(connection, _kept_rows(connection))


def _kept_rows(connection: sqlite3.Connection) -> KeptRows:
    kept: KeptRows = {}
    for part, at, sha256 in connection.execute("SELECT part, generation, sha256 FROM state"):
        kept.setdefault(part, {})[at] = sha256
    return kept


def state_payload(connection: sqlite3.Connection, part: str, generation: int) -> bytes:
    """The payload of an existing state row."""
    query = "SELECT payload FROM state WHERE part = ? AND generation = ?"
    return connection.execute(query, (part, generation)).fetchone()[0]


def read_platforms(folder: Path) -> list[tuple[int, dict[str, Any]]]:
    """Platforms of a run as (first generation, platform) in order; each applies until the next one."""
    with reading(folder) as (connection, _):
        return platforms(connection)


def platforms(connection: sqlite3.Connection) -> list[tuple[int, dict[str, Any]]]:
    """`read_platforms` for a connection of `reading`."""
    return [(at, json.loads(text)) for at, text in sound_platforms(connection)]
