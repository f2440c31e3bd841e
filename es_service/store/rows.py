"""The history rows of a run as they are stored, whether they are sound, and tables of many rows.

A row is sound if it matches its SHA-256, and has values of the types of its columns. All who read a history read it
through this file. Readers refuse a row that is not sound (`reader`), reports leave it out (`sound`), the verification
names it (`verify`), and the digest takes the values as they are (`digest`).

Columns in memory take eight bytes a value, where dictionaries of Python's numbers take more than a hundred. A long run
has millions of generations, so whoever reads a whole history reads columns. The centres that a generation evaluated are
stored as the bytes of `codec.row_bytes` of each, one after another; here they are made of columns, and of a batch of
policies at once.
"""

from __future__ import annotations

import re
import sqlite3
from array import array
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.errors import StoreError
from es_service.loop.history import NO_INTEGER, Column, Row, Table
from es_service.store.codec import INTEGER, REAL, RowValues, column_bytes, row_sha256, row_values
from es_service.store.schema import OWN_HISTORY_COLUMNS, RunMeta, quoted

Columns = dict[str, NDArray[Any]]
"""Column name -> its values, [N]: float64, in which NaN stands for no value, or a masked array of int64."""
_MARKED = np.dtype([("mark", "S1"), ("bits", "<i8")])
"""A value of a row as its bytes are, if there is one."""
_VALUE = b"(?:N|[IR].{8})"
"""Regular expression of a value's bytes."""


class StoredRow(NamedTuple):
    """A history row as it is stored; a damaged one may hold values of any type."""

    generation: int
    row: RowValues
    """Values in the order of the columns."""
    evaluations: bytes
    """The evaluated centres, encoded by `table_bytes`."""
    state: str
    """`codec.state_sha256` of the state after the generation."""
    sha256: str


def row_of_history(
    meta: RunMeta, generation: int, history: Row, evaluations: bytes, state: str
) -> tuple[int | float | str | bytes | None, ...]:
    """A row of the table history, as it is stored; the arguments are those of `codec.row_values` and the fields of
    `StoredRow`. Raises StoreError if the values do not fit the columns."""
    row = row_values(meta.columns, generation, history)
    return (*row, evaluations, state, row_sha256(meta.heading, row, evaluations, state))


def insert_history(connection: sqlite3.Connection, rows: Sequence[tuple[Any, ...]]) -> None:
    """Store rows that `row_of_history` has made."""
    connection.executemany(f"INSERT INTO history VALUES ({', '.join('?' * len(rows[0]))})", rows)


def history_rows(
    connection: sqlite3.Connection,
    columns: Sequence[Column],
    first: int = 0,
    limit: int | None = None,
    *,
    check: bool = True,
) -> Iterator[tuple[StoredRow, bool]]:
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
        row = StoredRow(values[at], tuple(values), evaluations, state, sha256)
        yield row, not check or (row_is_sound(heading, row) and all(map(isinstance, values, types)))


def row_is_sound(columns: bytes, row: StoredRow) -> bool:
    """Whether a history row matches its SHA-256; `columns` comes from `column_bytes`."""
    try:
        is_bytes = isinstance(row.evaluations, bytes)
        return is_bytes and row_sha256(columns, row.row, row.evaluations, str(row.state)) == row.sha256
    except ValueError:
        return False


def newest_generation(connection: sqlite3.Connection) -> int | None:
    """Newest generation of the history; None if it is empty."""
    return connection.execute("SELECT max(generation) FROM history").fetchone()[0]


class GrowingTable:
    """Columns that grow by one row at a time."""

    def __init__(self, columns: Sequence[Column]) -> None:
        """An empty table with the names and types of `columns`."""
        self._columns: list[tuple[str, array[Any], float]] = [
            (column.name, array("q"), NO_INTEGER) if column.type == "INTEGER" else (column.name, array("d"), np.nan)
            for column in columns
        ]

    def add(self, row: RowValues) -> None:
        """Add a row; None stands for no value."""
        for (_, values, nothing), value in zip(self._columns, row, strict=True):
            values.append(nothing if value is None else value)

    def columns(self, *, copy: bool = False) -> Columns:
        """The columns by name. Unless they are copies, nothing can be added to the table afterwards."""
        arrays = {name: np.array(values, copy=copy) for name, values, _ in self._columns}
        return {
            name: np.ma.MaskedArray(values, values == NO_INTEGER) if values.dtype.kind == "i" else values
            for name, values in arrays.items()
        }


def table_bytes(columns: Sequence[Column], table: Table) -> bytes:
    """Bytes of rows with the same columns, such as the centres that one generation evaluated. Values are converted as
    by `codec.row_values`.

    A run of an older version may have fewer columns than the table, whose other columns are then left out.

    Args:
        table: its columns; empty if there are no rows.

    Raises:
        StoreError: the table lacks a column, or one has the wrong type or another length than the others.
    """
    if not table or not columns:
        return b""
    if missing := {column.name for column in columns} - table.keys():
        raise StoreError(f"a table has the columns {sorted(table)}; it lacks {sorted(missing)}")
    rows = len(table[columns[0].name])
    bits_C_N = np.empty((len(columns), rows), "<i8")
    float_C_N = bits_C_N.view("<f8")
    for at, column in enumerate(columns):
        value_N = np.asarray(table[column.name])
        if value_N.shape != (rows,):
            raise StoreError(f"column {column.name} has the shape {value_N.shape}, and others have {rows} rows")
        if value_N.dtype.kind not in ("iu" if column.type == "INTEGER" else "iuf"):
            raise StoreError(f"column {column.name} is {column.type} and cannot hold {value_N.dtype}")
        (bits_C_N if column.type == "INTEGER" else float_C_N)[at] = value_N
    is_real_C = np.array([column.type == "REAL" for column in columns])
    float_C_N[is_real_C] += 0.0  # -0.0 becomes 0.0
    is_missing_C_N = np.where(is_real_C[:, None], np.isnan(float_C_N), bits_C_N == NO_INTEGER)
    value_N_C = np.empty((rows, len(columns)), _MARKED)
    value_N_C["bits"] = bits_C_N.T
    value_N_C["mark"] = np.where(is_missing_C_N, b"N", np.where(is_real_C, b"R", b"I")[:, None]).T
    is_byte_N_C_9 = np.ones((rows, len(columns), _MARKED.itemsize), bool)
    is_byte_N_C_9[..., 1:] = ~is_missing_C_N.T[..., None]
    return value_N_C.view(np.uint8).reshape(is_byte_N_C_9.shape)[is_byte_N_C_9].tobytes()


def table_rows(columns: Sequence[Column], payload: bytes) -> list[RowValues]:
    """The rows that `table_bytes` encoded, with values in the order of `columns`. Raises ValueError if `payload` does
    not consist of such rows."""
    _require_rows(payload, b"".join(b"(?:N|%b.{8})" % column.type[:1].encode() for column in columns))
    values = [_value(stored) for stored in re.findall(_VALUE, payload, re.DOTALL)]
    return [tuple(values[at : at + len(columns)]) for at in range(0, len(values), len(columns) or 1)]


def leading_values(payload: bytes, count: int, columns: int) -> bytes:
    """The bytes of the first `count` values of each row that `table_bytes` encoded, of `columns` values each. Raises
    ValueError if `payload` does not consist of such rows."""
    _require_rows(payload, _VALUE * columns)
    rows = b"(%b{%d})%b{%d}" % (_VALUE, count, _VALUE, columns - count)
    return b"".join(re.findall(rows, payload, re.DOTALL))


def _require_rows(payload: bytes, row: bytes) -> None:
    """Raise ValueError unless a payload consists of rows; `row` is the regular expression of one."""
    rows = re.match(b"(?:%b)*+" % row, payload, re.DOTALL)
    if rows is None or rows.end() < len(payload):
        at = 0 if rows is None else rows.end()
        raise ValueError(f"the evaluated centres are unreadable from byte {at} on")


def _value(stored: bytes) -> int | float | None:
    if stored == b"N":
        return None
    return (INTEGER if stored[:1] == b"I" else REAL).unpack(stored)[1]
