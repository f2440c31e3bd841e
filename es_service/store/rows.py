"""The rows of a run as they are stored, and whether they are sound: whether they match their SHA-256.

All who read a run read it through this file. Readers refuse a row that is not sound (`reader`), reports leave it out
(`sound`), the verification names it (`verify`), and the digest takes the values as they are (`digest`).

A part of the state has a row for each generation that changed it. A row belongs to the states from its generation on,
until the next row of the part; a row without payload removes the part.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from numpy.typing import NDArray

from es_service.loop.history import Column
from es_service.store.codec import (
    GONE,
    NO_PAYLOAD,
    Row,
    changed_sum,
    column_bytes,
    decode_part,
    part_sha256,
    row_sha256,
    state_sha256,
)
from es_service.store.schema import Damaged, history_select

KeptRows = dict[str, dict[int, str]]
"""Stored state rows: part -> generation -> SHA-256, or GONE for a row that removes the part."""


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
    heading, at = column_bytes(columns), [column.name for column in columns].index("generation")
    query = history_select(columns) + " WHERE history.generation >= ? ORDER BY history.generation LIMIT ?"
    for *values, evaluations, state, sha256 in connection.execute(query, (first, -1 if limit is None else limit)):
        row = HistoryRow(values[at], tuple(values), evaluations, state, sha256)
        yield row, not check or row_is_sound(heading, row)


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


def newest_state(connection: sqlite3.Connection) -> int | None:
    """Newest generation of a state row; None if there is none. Every generation has state rows, so if the history ends
    before it, the end of the history is lost."""
    query = "SELECT max(generation) FROM state WHERE typeof(generation) = 'integer'"
    return connection.execute(query).fetchone()[0]


def kept_rows(connection: sqlite3.Connection) -> KeptRows:
    """Stored state rows, without their payloads. Those that damage has given values of other types are left out, and
    those that have lost their payload."""
    kept: KeptRows = {}
    typed = "typeof(part) = 'text' AND typeof(generation) = 'integer' AND typeof(sha256) = 'text'"
    query = f"SELECT part, generation, sha256, length(payload) = 0 FROM state WHERE {typed}"
    for part, at, sha256, is_empty in connection.execute(query):
        if not is_empty:
            kept.setdefault(part, {})[at] = sha256
        elif sha256 == part_sha256(part, at, NO_PAYLOAD):
            kept.setdefault(part, {})[at] = GONE
    return kept


def rows_in_force(kept: KeptRows, generation: int) -> dict[str, tuple[int, str]]:
    """Rows that make up the state at a generation, sorted: part -> (generation, sha256) of its newest row up to then. A
    part that this row removes is left out."""
    newest = {part: max((at for at in kept[part] if at <= generation), default=None) for part in sorted(kept)}
    return {part: (at, kept[part][at]) for part, at in newest.items() if at is not None and kept[part][at] != GONE}


def whole_states(connection: sqlite3.Connection, kept: KeptRows) -> list[int]:
    """Generations whose whole state is stored, in order. Only their hashes are compared."""
    newest = newest_generation(connection)
    if newest is None:
        return []
    new: dict[int, dict[str, tuple[int, str]]] = {newest - 1: {}, newest: {}}
    for part, rows in kept.items():
        for at, sha256 in rows.items():
            new.setdefault(at, {})[part] = (at, sha256)
    in_force: dict[str, tuple[int, str]] = {}
    total, whole = 0, []
    for generation, rows in sorted(new.items()):
        total = changed_sum(total, {part: in_force[part] for part in rows if part in in_force}, rows)
        in_force |= rows
        state = connection.execute("SELECT state_sha256 FROM history WHERE generation = ?", (generation,)).fetchone()
        # A fork has the whole history of its parent, but only the newest of the parent's states.
        if in_force and state is not None and state[0] == state_sha256(total):
            whole.append(generation)
    return whole


def sound_part(connection: sqlite3.Connection, part: str, generation: int, sha256: str) -> dict[str, NDArray[Any]]:
    """The arrays of a state row that was found. Raises Damaged if it does not match its SHA-256."""
    payload = state_payload(connection, part, generation)
    if part_sha256(part, generation, payload) != sha256:
        raise Damaged(f"the state of {part!r} at generation {generation} does not match its SHA-256")
    return decode_part(payload)


def state_payload(connection: sqlite3.Connection, part: str, generation: int) -> bytes:
    """The payload of a state row that was found. Raises Damaged if it cannot be found again or holds something else."""
    query = "SELECT payload FROM state WHERE part = ? AND generation = ?"
    row = connection.execute(query, (part, generation)).fetchone()
    if row is None or not isinstance(row[0], bytes):
        raise Damaged(f"the state of {part!r} at generation {generation} is missing")
    return row[0]
