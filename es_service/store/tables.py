"""Encoding of the rows that a generation has of each centre that it evaluated, all of them in one blob.

The bytes are those of `codec.row_bytes` of each row, one after another; here they are made of columns, and of a batch
of policies at once.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.errors import StoreError
from es_service.loop.history import NO_INTEGER, Column, Table
from es_service.store.codec import INTEGER, REAL, Row, stored_value

_MARKED = np.dtype([("mark", "S1"), ("bits", "<i8")])
"""A value of a row as its bytes are, if there is one."""


def table_bytes(columns: Sequence[Column], table: Table) -> bytes:
    """Bytes of rows with the same columns, such as the centres that one generation evaluated: those of `row_bytes` of
    each, one after another. Values are converted as by `row_values`.

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


def as_table(columns: Sequence[Column], rows: Sequence[Mapping[str, int | float | None]]) -> dict[str, NDArray[Any]]:
    """Rows as a table, for `table_bytes`.

    Raises:
        StoreError: a row lacks a column, or a value has the wrong type.
    """
    names = {column.name for column in columns}
    for row in rows:
        if missing := names - row.keys():
            raise StoreError(f"a row has the columns {sorted(row)}; it lacks {sorted(missing)}")
    table: dict[str, NDArray[Any]] = {}
    for column in columns if rows else ():
        values = [stored_value(column, row[column.name]) for row in rows]
        kind, none = ("f8", np.nan) if column.type == "REAL" else ("i8", NO_INTEGER)
        table[column.name] = np.array([none if value is None else value for value in values], kind)
    return table


def table_rows(columns: Sequence[Column], payload: bytes) -> list[Row]:
    """The rows that `table_bytes` encoded, with values in the order of `columns`.

    Raises:
        ValueError: `payload` does not consist of such rows.
    """
    values: list[int | float | None] = []
    position = 0
    try:
        while position < len(payload):
            mark = payload[position : position + 1]
            if mark == b"N":
                values.append(None)
                position += 1
            else:
                kind = {b"I": INTEGER, b"R": REAL}[mark]
                values.append(kind.unpack_from(payload, position)[1])
                position += kind.size
    except (KeyError, struct.error) as error:
        raise ValueError(f"the evaluated centres are unreadable: {error!r}") from error
    if columns and len(values) % len(columns):
        raise ValueError(f"the evaluated centres have {len(values)} values, which {len(columns)} columns do not fit")
    return [tuple(values[i : i + len(columns)]) for i in range(0, len(values), len(columns) or 1)]


def leading_values(payload: bytes, count: int, columns: int) -> bytes:
    """The bytes of the first `count` values of each row that `table_bytes` encoded, of `columns` values each.

    Raises:
        ValueError: `payload` does not consist of such rows.
    """
    value = b"(?:N|[IR].{8})"
    rows = re.compile(b"(%b{%d})%b{%d}" % (value, count, value, columns - count), re.DOTALL)
    found, end = [], 0
    while end < len(payload):
        row = rows.match(payload, end)
        if row is None:
            raise ValueError(f"the evaluated centres are unreadable from byte {end} on")
        found.append(row[1])
        end = row.end()
    return b"".join(found)
