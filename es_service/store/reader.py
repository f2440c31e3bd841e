"""Reading a run in short transactions, during writing, after a writer was killed, and after a clean end.

Readers never create, change or repair a run. The state and the history rows that they return match their SHA-256.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from es_service.errors import StoreError, WayOut
from es_service.loop.history import Column
from es_service.store import certifications
from es_service.store.beginning import load_start
from es_service.store.certifications import CertifiedRow
from es_service.store.codec import Row, column_bytes, decode_part, part_sha256, row_dict
from es_service.store.columns import Columns, Table
from es_service.store.connection import reading
from es_service.store.kept import KeptRows, kept_rows, newest_state, rows_in_force, whole_states
from es_service.store.platforms import sound_platforms
from es_service.store.schema import Damaged, RunMeta, history_select
from es_service.store.tables import table_rows
from es_service.store.verify import row_is_sound

GENERATION = Column("generation", "INTEGER", True, "generation that evaluated the centre")
"""The column before those of the evaluated centres."""
EvaluatedCentres = list[dict[str, int | float]]
"""The centres that one generation evaluated, as values by column name; NaN stands for no value."""


class HistoryRow(NamedTuple):
    """A history row whose SHA-256 was checked."""

    row: Row
    """Values in the order of the run's columns."""
    evaluations: bytes
    """The evaluated centres, encoded by `tables.table_bytes`."""
    state: str
    """`codec.state_sha256` of the state after the generation."""


def read_meta(folder: Path) -> RunMeta:
    """The description of a run. Raises StoreError as `reading`, as do all functions here that take a folder."""
    with reading(folder) as (_, meta):
        return meta


def read_generation(folder: Path) -> int | None:
    """Newest committed generation; None if there is none. Raises StoreError if its history row is damaged."""
    newest = read_newest(folder)
    return None if newest is None else int(newest["generation"])


def read_history(
    folder: Path, since_generation: int | None = None, limit: int | None = None
) -> list[dict[str, int | float]]:
    """History rows in order, as values by column name; NaN stands for no value.

    A row takes more than a hundred bytes per value; `read_history_columns` needs eight.

    Args:
        since_generation: generation of the first row; None for all rows.
        limit: greatest number of rows; None for all rows.

    Raises:
        StoreError: a row is missing or does not match its SHA-256.
    """
    with reading(folder) as (connection, meta):
        found = _sound_rows(connection, meta, max(since_generation or 0, 0), limit)
        return [row_dict(meta.columns, one.row) for one in found]


def read_history_columns(folder: Path, limit: int | None = None) -> Columns:
    """The history from generation 0 on, as columns; `limit` and errors as in `read_history`."""
    with reading(folder) as (connection, meta):
        table = Table(meta.columns)
        for one in _sound_rows(connection, meta, 0, limit):
            table.add(one.row)
        return table.columns()


def read_evaluations(folder: Path, since_generation: int = 0, limit: int | None = None) -> list[EvaluatedCentres]:
    """The centres that each generation evaluated, in the order of the asks; arguments and errors as `read_history`."""
    with reading(folder) as (connection, meta):
        columns = meta.evaluation_columns
        found = (table_rows(columns, one.evaluations) for one in _sound_rows(connection, meta, since_generation, limit))
        return [[row_dict(columns, row) for row in rows] for rows in found]


def read_evaluation_columns(folder: Path, limit: int | None = None) -> Columns:
    """The evaluated centres of all generations, as columns, the first of which is `generation`; `limit` (of
    generations) and errors as in `read_history`."""
    with reading(folder) as (connection, meta):
        table = Table((GENERATION, *meta.evaluation_columns))
        for generation, one in enumerate(_sound_rows(connection, meta, 0, limit)):
            for row in table_rows(meta.evaluation_columns, one.evaluations):
                table.add((generation, *row))
        return table.columns()


def read_newest(folder: Path) -> dict[str, int | float] | None:
    """The newest history row; None if there is none. No other row is read.

    Raises:
        StoreError: the row is missing or does not match its SHA-256.
    """
    with reading(folder) as (connection, meta):
        newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
        rows = [row_dict(meta.columns, one.row) for one in _sound_rows(connection, meta, newest or 0)]
        return rows[-1] if rows else None


def read_row(folder: Path, generation: int) -> HistoryRow:
    """All that is stored of one generation in the history.

    Raises:
        StoreError: the row is missing or does not match its SHA-256.
    """
    with reading(folder) as (connection, meta):
        for one in _sound_rows(connection, meta, generation, 1):
            return one
        raise Damaged(f"the history row of generation {generation} is missing")


def read_start(folder: Path) -> dict[str, NDArray[Any]] | None:
    """Arrays from which generation 0 of the run starts; None if it was created without them."""
    with reading(folder) as (connection, _):
        return load_start(connection)


def _sound_rows(
    connection: sqlite3.Connection, meta: RunMeta, first: int, limit: int | None = None
) -> Iterator[HistoryRow]:
    """History rows from generation `first` on. Raises Damaged if a row is missing or does not match its SHA-256."""
    query = history_select(meta.columns) + " WHERE history.generation >= ? ORDER BY history.generation LIMIT ?"
    columns, at = column_bytes(meta.columns), [column.name for column in meta.columns].index("generation")
    expected = first
    for *values, evaluations, state, sha256 in connection.execute(query, (first, -1 if limit is None else limit)):
        row = tuple(values)
        if not row_is_sound(columns, row, evaluations, state, sha256) or row[at] != expected:
            raise Damaged(f"the history row of generation {expected} is damaged or missing")
        expected += 1
        yield HistoryRow(row, evaluations, state)
    # Damage can hide the end of a table even from SQLite. The state shows it, since every generation has state rows.
    newest = newest_state(connection)
    if newest is not None and newest >= expected and expected - first != limit:
        raise Damaged(
            f"the history after generation {expected - 1} is missing; the state is that of generation {newest}"
        )


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
        if (last := newest_state(connection) or 0) > newest:
            raise Damaged(f"the history after generation {newest} is missing; the state is that of generation {last}")
        asked = newest if generation is None else generation
        kept = kept_rows(connection)
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


def next_certification(folder: Path) -> int:
    """Number of the next certification of a run."""
    with reading(folder) as (connection, meta):
        return certifications.next_number(connection, meta.parent)


def read_certifications(folder: Path) -> list[CertifiedRow]:
    """All certified policies, in the order of certification and rank.

    Raises:
        StoreError: a row does not match its SHA-256.
    """
    with reading(folder) as (connection, _):
        found = []
        for number, rank, row in certifications.rows(connection):
            if row is None:
                raise Damaged(f"row {rank} of certification {number} does not match its SHA-256")
            found.append(row)
        return found


def read_kept(folder: Path) -> tuple[KeptRows, list[int]]:
    """Stored state rows (part -> generation -> SHA-256), and the generations whose whole state is stored."""
    with reading(folder) as (connection, _):
        kept = kept_rows(connection)
        return kept, whole_states(connection, kept)


def kept_states(connection: sqlite3.Connection) -> list[int]:
    """Generations whose whole state is stored: at most the last two, unless the run keeps others."""
    return whole_states(connection, kept_rows(connection))


def state_payload(connection: sqlite3.Connection, part: str, generation: int) -> bytes:
    """The payload of a state row that was found. Raises Damaged if it cannot be found again or holds something else."""
    query = "SELECT payload FROM state WHERE part = ? AND generation = ?"
    row = connection.execute(query, (part, generation)).fetchone()
    if row is None or not isinstance(row[0], bytes):
        raise Damaged(f"the state of {part!r} at generation {generation} is missing")
    return row[0]


def read_platforms(folder: Path) -> list[tuple[int, dict[str, Any]]]:
    """Platforms of a run as (first generation, platform) in order; each applies until the next one."""
    with reading(folder) as (connection, _):
        return platforms(connection)


def platforms(connection: sqlite3.Connection) -> list[tuple[int, dict[str, Any]]]:
    """`read_platforms` for a connection of `reading`."""
    return [(at, json.loads(text)) for at, text in sound_platforms(connection)]
