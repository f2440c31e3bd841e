"""Tables of numbers: as columns in memory, and as the bytes of the centres that a generation evaluated.

Columns take eight bytes a value, where dictionaries of Python's numbers take more than a hundred. A long run has
millions of generations, so whoever reads a whole history reads columns. The bytes are those of `codec.row_bytes` of
each row, one after another; here they are made of columns, and of a batch of policies at once.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.errors import StoreError
from es_service.loop.history import NO_INTEGER, Column, Table
from es_service.store.codec import INTEGER, REAL, Row

Columns = dict[str, NDArray[Any]]
"""Column name -> its values, [N]: float64, in which NaN stands for no value, or a masked array of int64."""
_MARKED = np.dtype([("mark", "S1"), ("bits", "<i8")])
"""A value of a row as its bytes are, if there is one."""
_VALUE = b"(?:N|[IR].{8})"
"""Regular expression of a value's bytes."""


class GrowingTable:
    """Columns that grow by one row at a time."""

    def __init__(self, columns: Sequence[Column]) -> None:
        """An empty table with the names and types of `columns`."""
        self._columns: list[tuple[str, array[Any], float]] = [
            (column.name, array("q"), NO_INTEGER) if column.type == "INTEGER" else (column.name, array("d"), np.nan)
            for column in columns
        ]

    def add(self, row: Row) -> None:
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


def table_rows(columns: Sequence[Column], payload: bytes) -> list[Row]:
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
