"""The history rows of a run as they are stored, and whether they are sound: whether they match their SHA-256, and have
values of the types of their columns.

All who read a history read it through this file. Readers refuse a row that is not sound (`reader`), reports leave it
out (`sound`), the verification names it (`verify`), and the digest takes the values as they are (`digest`).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from es_service.loop.history import Column
from es_service.store.codec import Row, Values, column_bytes, row_sha256, row_values
from es_service.store.schema import OWN_HISTORY_COLUMNS, RunMeta, quoted


class HistoryRow(NamedTuple):
    """A history row as it is stored; a damaged one may hold values of any type."""

    generation: int
    row: Row
    """Values in the order of the columns."""
    evaluations: bytes
    """The evaluated centres, encoded by `tables.table_bytes`."""
    state: str
    """`codec.state_sha256` of the state after the generation."""
    sha256: str


def insert_history(
    connection: sqlite3.Connection, meta: RunMeta, generation: int, history: Values, evaluations: bytes, state: str
) -> None:
    """Store a history row; the arguments are those of `codec.row_values` and the fields of `HistoryRow`. Raises
    StoreError if the values do not fit the columns."""
    row = row_values(meta.columns, generation, history)
    stored = (*row, evaluations, state, row_sha256(meta.heading, row, evaluations, state))
    connection.execute(f"INSERT INTO history VALUES ({', '.join('?' * len(stored))})", stored)


def history_rows(
    connection: sqlite3.Connection,
    columns: Sequence[Column],
    first: int = 0,
    limit: int | None = None,
    *,
    check: bool = True,
) -> Iterator[tuple[HistoryRow, bool]]:
    """History rows as (row, whether it is sound), in the order of generations.

    Generations may be missing, and damage can show rows again.

    Args:
        columns: those of the run; without `check`, any of them in any order, `generation` included.
        first: generation of the first row.
        limit: greatest number of rows; None for all.
        check: False: no SHA-256 is computed, and every row counts as sound.
    """
    heading, names = column_bytes(columns), [column.name for column in columns]
    types = [(int, type(None)) if column.type == "INTEGER" else (float, type(None)) for column in columns]
    # Names are qualified by the table, because SQLite treats an unqualified quoted name that is no column as a text.
    wanted = ", ".join(f"history.{quoted(name)}" for name in [*names, *OWN_HISTORY_COLUMNS])
    query = f"SELECT {wanted} FROM history WHERE history.generation >= ? ORDER BY history.generation LIMIT ?"
    at = names.index("generation")
    for *values, evaluations, state, sha256 in connection.execute(query, (first, -1 if limit is None else limit)):
        row = HistoryRow(values[at], tuple(values), evaluations, state, sha256)
        yield row, not check or (row_is_sound(heading, row) and all(map(isinstance, values, types)))


def row_is_sound(columns: bytes, row: HistoryRow) -> bool:
    """Whether a history row matches its SHA-256; `columns` comes from `column_bytes`."""
    try:
        is_bytes = isinstance(row.evaluations, bytes)
        return is_bytes and row_sha256(columns, row.row, row.evaluations, str(row.state)) == row.sha256
    except ValueError:
        return False


def newest_generation(connection: sqlite3.Connection) -> int | None:
    """Newest generation of the history; None if it is empty."""
    return connection.execute("SELECT max(generation) FROM history").fetchone()[0]
