"""Encoding of state parts and history rows as bytes, and their SHA-256.

Everything here is deterministic: equal values give equal bytes on every machine. Pickle is not used.
"""

from __future__ import annotations

import hashlib
import json
import math
import operator
import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints

from es_service.errors import StoreError
from es_service.loop.history import NO_INTEGER, Column, Row
from es_service.protocol.content import NAME
from es_service.store.facts import Damaged, facts

Part = Mapping[str, NDArray[Any]]
"""A part of the search state, which is stored as a whole: name -> array, e.g. {"centre_D": ..., "step": int64[]}."""
RowValues = tuple[int | float | None, ...]
"""Values of one history row in the order of the run's columns; None stands for no value."""
StateRow = tuple[str, int, str, bytes]
"""A state row: its part, its generation, its SHA-256 and its payload."""
ListedRows = Mapping[str, tuple[int, str]]
"""State rows without their payloads: part -> (generation, SHA-256 or GONE)."""

NO_PAYLOAD = b""
"""Payload of a row that removes its part from the state, from its generation on."""
GONE = ""
"""Stands for the SHA-256 of such a row where the rows of a state are listed."""
_MAGIC = b"ESP1"
_HEADER_LENGTH = struct.Struct("<I")
INTEGER = struct.Struct("<cq")
REAL = struct.Struct("<cd")
_NUMERIC_KINDS = "biufc"
_TYPE = Annotated[str, StringConstraints(pattern=f"^([<|][{_NUMERIC_KINDS}][0-9]{{1,2}}|[|]{NAME.str[1:]})$")]
_SHAPE = Annotated[list[Annotated[int, Field(ge=0, lt=2**48)]], Field(max_length=32)]
_HEADER = list[tuple[str, _TYPE, _SHAPE]]
"""Name, type and shape of each array, as JSON."""


def encode_part(part: Part) -> bytes:
    """A state part as bytes: a magic number, the length of the header, the JSON header [[name, dtype, shape], ...]
    sorted by name, and the values of the arrays in little-endian byte order.

    Raises StoreError if an array has neither bools nor numbers nor names.
    """
    header: list[tuple[str, str, tuple[int, ...]]] = []
    raw: list[bytes] = []
    for name in sorted(part):
        array = np.asarray(part[name])
        if array.dtype.kind not in _NUMERIC_KINDS and array.dtype != NAME:
            raise StoreError(
                f"state array {name!r} has dtype {array.dtype}; only bools, numbers and names can be stored"
            )
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        header.append((name, little.dtype.str, array.shape))
        raw.append(little.tobytes(order="C"))
    return b"".join((_header(tuple(header)), *raw))


@lru_cache(maxsize=1024)
def _header(entries: tuple[tuple[str, str, tuple[int, ...]], ...]) -> bytes:
    """What comes before the values; kept, because many parts have arrays alike."""
    text = json.dumps(entries, separators=(",", ":")).encode()
    return b"".join((_MAGIC, _HEADER_LENGTH.pack(len(text)), text))


def decode_part(payload: bytes) -> dict[str, NDArray[Any]]:
    """The arrays that `encode_part` encoded, writable. Raises ValueError if `payload` is not exactly one such part."""
    if payload[:4] != _MAGIC or len(payload) < 8:
        raise ValueError(f"a state payload begins with {payload[:4]!r} instead of {_MAGIC!r}")
    position = 8 + _HEADER_LENGTH.unpack_from(payload, 4)[0]
    try:
        entries = _entries(payload[8:position])
    except (Damaged, TypeError) as error:
        raise ValueError(f"a state payload has an unreadable header: {error}") from error
    part: dict[str, NDArray[Any]] = {}
    for name, dtype, shape in entries:
        count = math.prod(shape)
        if position + count * dtype.itemsize > len(payload) or name in part:
            raise ValueError(f"a state payload is too short for its array {name!r}, or has it twice")
        flat = np.frombuffer(payload, dtype, count, position)
        part[name] = flat.reshape(shape).astype(dtype.newbyteorder("="), copy=True)
        position += flat.nbytes
    if position != len(payload):
        raise ValueError("a state payload is longer than its header says")
    return part


@lru_cache(maxsize=1024)
def _entries(header: bytes) -> tuple[tuple[str, np.dtype[Any], tuple[int, ...]], ...]:
    """The entries of a header; kept, as `_header`. Raises Damaged, or TypeError for a type that NumPy does not have."""
    entries = facts(header, _HEADER, "it")
    return tuple((name, np.dtype(kind), tuple(shape)) for name, kind, shape in entries)


def part_sha256(part: str, generation: int, payload: bytes) -> str:
    """SHA-256 of a state row. It includes the part's name and the generation, so that rows cannot be exchanged."""
    digest = hashlib.sha256(f"state\0{part}\0{generation}\0".encode())
    digest.update(payload)
    return digest.hexdigest()


def listed(sha256: str, payload: bytes) -> str:
    """A row's entry in a list of rows: its SHA-256, or GONE if it removes its part."""
    return sha256 if payload != NO_PAYLOAD else GONE


def encode_changes(generation: int, parts: Mapping[str, Part | None]) -> list[StateRow]:
    """State rows as they are stored, of the parts that a generation changes; a part that is None is removed."""
    payloads = ((part, NO_PAYLOAD if arrays is None else encode_part(arrays)) for part, arrays in parts.items())
    return [(part, generation, part_sha256(part, generation, payload), payload) for part, payload in payloads]


def rows_listed(rows: Sequence[StateRow]) -> ListedRows:
    """State rows by part, without payloads."""
    return {part: (at, listed(sha256, payload)) for part, at, sha256, payload in rows}


def state_sum(rows: ListedRows) -> int:
    """Number that identifies the whole state of a generation, of which `rows` are the newest row of each part: the sum
    modulo 2^256 of one SHA-256 for each part.

    A generation that changes few of many parts changes few terms of the sum. A part that was removed has no term, so
    that the row that removed it need not be kept when no older row of the part is.
    """
    terms = (f"{part}\0{at}\0{sha256}".encode() for part, (at, sha256) in rows.items() if sha256 != GONE)
    return sum(int.from_bytes(hashlib.sha256(term).digest()) for term in terms) % 2**256


def changed_sum(total: int, old: ListedRows, new: ListedRows) -> int:
    """`state_sum` after the rows `new` have replaced the rows `old` in a state whose sum is `total`."""
    return (total - state_sum(old) + state_sum(new)) % 2**256


def state_sha256(total: int) -> str:
    """Text of a `state_sum`, which is stored with the history row. By it, a missing state row is noticed, also one that
    removes a part; otherwise an older row of the part would be used."""
    return f"{total:064x}"


def text_sha256(key: str, text: str) -> str:
    """SHA-256 of a row that consists of a key and a JSON text."""
    return hashlib.sha256(f"{key}\0{text}".encode()).hexdigest()


def row_values(columns: Sequence[Column], generation: int, history: Row) -> RowValues:
    """Values of a history row as they are stored: NaN becomes None, and -0.0 becomes 0.0, as in SQLite.

    Args:
        history: value of each column; `generation` may be left out.

    Raises:
        StoreError: a column is unknown or missing, a value has the wrong type, or the generation differs.
    """
    given = {"generation": generation, **history}
    names = {column.name for column in columns}
    if given.keys() != names:
        raise StoreError(
            f"history row of generation {generation}: unknown columns {sorted(given.keys() - names)}, "
            f"missing columns {sorted(names - given.keys())}; give all columns of the run and no others, with NaN for "
            "no value"
        )
    if given["generation"] != generation:
        raise StoreError(
            f"history row of generation {generation}: its column generation has the value {given['generation']}"
        )
    return stored_values(columns, given)


def stored_values(columns: Sequence[Column], given: Row) -> RowValues:
    """The values of `columns` as they are stored; a column that is not given has no value. Raises StoreError for a
    value of the wrong type."""
    return tuple(_stored_value(column, given.get(column.name)) for column in columns)


def _stored_value(column: Column, value: Any) -> int | float | None:
    if value is None or value != value:
        return None
    try:
        if column.type == "REAL":
            return float(value) + 0.0
        integer = operator.index(value)
    except TypeError as error:
        raise StoreError(f"history column {column.name} is {column.type} and cannot hold {value!r}") from error
    if not NO_INTEGER < integer < 2**63:
        raise StoreError(f"history column {column.name} cannot hold {value!r}: it does not fit into 64 bits")
    return integer


def row_bytes(row: RowValues) -> bytes:
    """Bytes of the values of a row, for its SHA-256. Raises ValueError for a value that is not a number."""
    parts: list[bytes] = []
    for value in row:
        if value is None:
            parts.append(b"N")
        elif type(value) is int:
            parts.append(INTEGER.pack(b"I", value))
        elif type(value) is float:
            parts.append(REAL.pack(b"R", value))
        else:
            raise ValueError(f"a history row holds {value!r}, which is not a number")
    return b"".join(parts)


def column_bytes(columns: Sequence[Column]) -> bytes:
    """Bytes of the names and types of columns, which are hashed before the values."""
    return json.dumps([[column.name, column.type] for column in columns], separators=(",", ":")).encode()


def row_sha256(columns: bytes, row: RowValues, evaluations: bytes, state: str) -> str:
    """SHA-256 of a history row: of its columns (`column_bytes`), its values, and the `state_sha256` and the evaluated
    centres stored with it."""
    return hashlib.sha256(b"".join((columns, row_bytes(row), state.encode(), evaluations))).hexdigest()


def row_dict(columns: Sequence[Column], row: RowValues) -> dict[str, int | float]:
    """Values of a stored row by column name; NaN stands for no value."""
    return {column.name: math.nan if value is None else value for column, value in zip(columns, row, strict=True)}
