"""Reading a run in short transactions, during writing, after a writer was killed, and after a clean end.

Readers never create, change or repair a run. The state and the history rows that they return match their SHA-256. All
functions that take a folder raise StoreError as `reading` does, and if what they read is damaged or missing.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from es_service.errors import StoreError, WayOut
from es_service.protocol.content import names_in
from es_service.store.codec import RowValues, row_dict
from es_service.store.facts import GENERATION, Damaged, said_by
from es_service.store.folder import COPY, DATABASE, explained, is_network_filesystem, is_no_damage, require_run_folder
from es_service.store.lock import lock_holder
from es_service.store.records import (
    CertifiedRow,
    certified_rows,
    load_start,
    metric_columns,
    metric_values,
    next_certified_number,
    sound_metrics,
    sound_platforms,
)
from es_service.store.rows import Columns, GrowingTable, StoredRow, history_rows, newest_generation, table_rows
from es_service.store.schema import RunMeta, load_meta
from es_service.store.states import (
    KeptRows,
    kept_rows,
    newest_state,
    rows_in_force,
    sound_content,
    sound_part,
    whole_states,
)

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
    return StoreError(f"{folder} {what}: {said_by(error)}", run=folder, ways_out=[way_out])


EvaluatedCentres = list[dict[str, int | float]]
"""The centres that one generation evaluated, as values by column name; NaN stands for no value."""


def read_meta(folder: Path) -> RunMeta:
    """The description of a run."""
    with reading(folder) as (_, meta):
        return meta


def read_generation(folder: Path) -> int | None:
    """Newest committed generation; None if there is none."""
    newest = read_newest(folder)
    return None if newest is None else int(newest["generation"])


def read_newest(folder: Path) -> dict[str, int | float] | None:
    """The newest history row; None if there is none. No other row is read."""
    with reading(folder) as (connection, meta):
        rows = [*_sound_rows(connection, meta, newest_generation(connection) or 0)]
        return _with_metrics(connection, meta, rows)[-1] if rows else None


def read_history(
    folder: Path, since_generation: int | None = None, limit: int | None = None
) -> list[dict[str, int | float]]:
    """History rows in order, as values by column name; NaN stands for no value. For a long history, use
    `read_history_columns`, which needs a tenth of the memory.

    Args:
        since_generation: generation of the first row; None for all rows.
        limit: greatest number of rows; None for all rows.
    """
    with reading(folder) as (connection, meta):
        return _with_metrics(connection, meta, [*_sound_rows(connection, meta, max(since_generation or 0, 0), limit)])


def _with_metrics(
    connection: sqlite3.Connection, meta: RunMeta, rows: Sequence[StoredRow]
) -> list[dict[str, int | float]]:
    """History rows as values by column name, with the metrics that were recorded."""
    if not rows:
        return []
    found = sound_metrics(connection, rows[0].generation, len(rows))
    return [row_dict(meta.columns, stored.row) | metric_values(found.get(stored.generation, {})) for stored in rows]


def read_history_columns(folder: Path, limit: int | None = None) -> Columns:
    """The history from generation 0 on, as columns; `limit` as in `read_history`."""
    with reading(folder) as (connection, meta):
        table = GrowingTable(meta.columns)
        for stored in _sound_rows(connection, meta, 0, limit):
            table.add(stored.row)
        history = table.columns()
        return history | metric_columns(sound_metrics(connection, 0, limit), history["generation"])


def read_metrics(folder: Path, newest: int) -> dict[int, dict[str, float]]:
    """Metrics that were recorded up to generation `newest`, by generation and by name."""
    with reading(folder) as (connection, _):
        return sound_metrics(connection, 0, newest + 1)


def read_evaluations(folder: Path, since_generation: int = 0, limit: int | None = None) -> list[EvaluatedCentres]:
    """The centres that each generation evaluated, in the order of the asks; arguments as in `read_history`."""
    with reading(folder) as (connection, meta):
        columns = meta.evaluation_columns
        tables = (_evaluated(meta, stored) for stored in _sound_rows(connection, meta, since_generation, limit))
        return [[row_dict(columns, row) for row in rows] for rows in tables]


def read_evaluation_columns(folder: Path, limit: int | None = None) -> Columns:
    """The evaluated centres of all generations, as columns, the first of which is `generation`; `limit`: of
    generations."""
    with reading(folder) as (connection, meta):
        table = GrowingTable((GENERATION, *meta.evaluation_columns))
        for stored in _sound_rows(connection, meta, 0, limit):
            for row in _evaluated(meta, stored):
                table.add((stored.generation, *row))
        return table.columns()


def _evaluated(meta: RunMeta, stored: StoredRow) -> list[RowValues]:
    """The centres that a generation evaluated. Raises Damaged if they do not fit the columns."""
    try:
        return table_rows(meta.evaluation_columns, stored.evaluations)
    except ValueError as error:
        raise Damaged(f"the history row of generation {stored.generation} cannot be read: {error}") from error


def read_row(folder: Path, generation: int) -> StoredRow:
    """All that is stored of one generation in the history."""
    with reading(folder) as (connection, meta):
        for stored in _sound_rows(connection, meta, generation, 1):
            return stored
        raise Damaged(f"the history row of generation {generation} is missing")


def _sound_rows(
    connection: sqlite3.Connection, meta: RunMeta, first: int, limit: int | None = None
) -> Iterator[StoredRow]:
    """History rows from generation `first` on. Raises Damaged if a row is missing or does not match its SHA-256."""
    expected = first
    for row, is_sound in history_rows(connection, meta.columns, first, limit):
        if not is_sound or row.generation != expected:
            raise Damaged(f"the history row of generation {expected} is damaged or missing")
        expected += 1
        yield row
    if expected - first != limit:
        _refuse_lost_end(connection, expected - 1)


def _refuse_lost_end(connection: sqlite3.Connection, newest: int) -> None:
    """Raise Damaged if the history ends before the state. Damage can hide the end of a table even from SQLite."""
    last = newest_state(connection)
    if last is not None and last > newest:
        raise Damaged(f"the history after generation {newest} is missing; the state is that of generation {last}")


def read_parts(
    folder: Path,
    generation: int | None = None,
    wanted: Callable[[str], bool] = lambda part: True,
    named: Callable[[int, dict[str, dict[str, NDArray[Any]]]], Iterable[bytes]] = lambda generation, parts: (),
) -> tuple[int, dict[str, dict[str, NDArray[Any]]], dict[bytes, dict[str, NDArray[Any]]]]:
    """A generation (None: the newest), its state: part -> name -> array, of the parts whose names are `wanted`, and the
    contents that `named` names when it sees these, all as of one moment.

    Raises StoreError also if the state of this generation is not kept, or there is no such content.
    """
    with reading(folder) as (connection, _):
        newest = newest_generation(connection)
        if newest is None:
            way_out = WayOut("resume", "continue it", str(folder))
            raise StoreError(f"{folder} has no generation yet", run=folder, ways_out=[way_out])
        _refuse_lost_end(connection, newest)
        asked = newest if generation is None else generation
        kept = kept_rows(connection)
        whole = whole_states(connection, kept)
        if asked == newest and asked not in whole:
            raise Damaged(f"the state of generation {asked} is damaged")
        if asked not in whole:
            raise StoreError(
                f"{folder} does not keep the state of generation {asked}; it keeps the states of generations {whole}, "
                f"and its history ends at generation {newest}",
                field="generation",
                value=asked,
                allowed=str(whole),
                suggestion=max(whole, default=None),
                run=folder,
            )
        rows = rows_in_force(kept, asked)
        parts = {part: sound_part(connection, part, *row) for part, row in rows.items() if wanted(part)}
        try:
            return asked, parts, {name: sound_content(connection, name) for name in named(asked, parts)}
        except KeyError as lacking:
            raise Damaged(f"it has no content {lacking.args[0].hex()}, which its state names") from lacking


def read_kept(folder: Path) -> tuple[KeptRows, list[int]]:
    """Stored state rows (part -> generation -> SHA-256), and the generations whose whole state is stored."""
    with reading(folder) as (connection, _):
        kept = kept_rows(connection)
        return kept, whole_states(connection, kept)


def read_start(folder: Path) -> dict[str, NDArray[Any]] | None:
    """Arrays from which generation 0 of the run starts; None if it was created without them."""
    with reading(folder) as (connection, _):
        return load_start(connection)


def read_platforms(folder: Path) -> list[tuple[int, dict[str, Any]]]:
    """Platforms of a run as (first generation, platform) in order; each applies until the next one."""
    with reading(folder) as (connection, _):
        return sound_platforms(connection)


def next_certification(folder: Path) -> int:
    """Number of the next certification of a run."""
    with reading(folder) as (connection, meta):
        return next_certified_number(connection, meta.parent)


def read_certifications(
    folder: Path, newest: Callable[[Mapping[str, Any]], bool] | None = None, holding: str = ""
) -> list[CertifiedRow]:
    """All certified policies, in the order of certification and rank; with `newest`, those of the last certification
    whose facts are wanted, and with `holding`, those whose facts have this text as JSON."""
    with reading(folder) as (connection, _):
        rows = []
        for (number, rank), row in certified_rows(connection, newest, holding):
            if row is None:
                raise Damaged(f"row {rank} of certification {number} is damaged")
            try:
                contents = {name: sound_content(connection, name) for name in names_in(row.arrays)}
            except KeyError as lacking:
                which = f"row {rank} of certification {number}"
                raise Damaged(f"{which} names the content {lacking.args[0].hex()}, which is missing") from lacking
            rows.append(replace(row, contents=contents))
        return rows
