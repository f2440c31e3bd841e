"""Which states a run keeps: those of its last two generations, and those of generations that were asked for.

A part of the state has a row for each generation that changed it. A row belongs to the states from its generation on,
until the next row of the part; it is deleted when none of these states is to be kept. A row without payload removes its
part; it is deleted together with the last of the older rows, from which it protects the states after it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence

from es_service.store.codec import GONE, NO_PAYLOAD, changed_sum, part_sha256, state_sha256

KeptRows = dict[str, dict[int, str]]
"""Stored state rows: part -> generation -> SHA-256, or GONE for a row that removes the part."""


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


def newest_state(connection: sqlite3.Connection) -> int | None:
    """Newest generation of a state row; None if there is none."""
    query = "SELECT max(generation) FROM state WHERE typeof(generation) = 'integer'"
    return connection.execute(query).fetchone()[0]


def outdated_rows(
    kept: KeptRows, replaced: Iterable[str], keep_every: int | None, earlier: Sequence[int]
) -> list[tuple[str, int]]:
    """(part, generation) of the rows that the next commit deletes.

    Args:
        kept: rows that are stored.
        replaced: parts with several rows, of which the last but one is considered.
        keep_every: states of generations that are multiples of this are kept; None for none.
        earlier: other generations whose states are kept.
    """
    found = []
    for part in replaced:
        at, until = sorted(kept[part])[-2:]
        is_multiple = keep_every is not None and (until - 1) // keep_every * keep_every >= at
        if not is_multiple and not any(at <= generation < until for generation in earlier):
            found.append((part, at))
            if kept[part][until] == GONE and len(kept[part]) == 2:
                found.append((part, until))
    return found


def earlier_states(connection: sqlite3.Connection, kept: KeptRows, newest: int | None) -> list[int]:
    """Generations before the last two whose whole state is stored; they stay, whatever is kept from now on."""
    return [] if newest is None else [at for at in whole_states(connection, kept) if at < newest - 1]


def whole_states(connection: sqlite3.Connection, kept: KeptRows) -> list[int]:
    """Generations whose whole state is stored, in order. Only their hashes are compared."""
    newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
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


def rows_in_force(kept: KeptRows, generation: int) -> dict[str, tuple[int, str]]:
    """Rows that make up the state at a generation: part -> (generation, sha256) of its newest row up to then. A part
    that this row removes is left out."""
    newest = {part: max((at for at in rows if at <= generation), default=None) for part, rows in kept.items()}
    return {part: (at, kept[part][at]) for part, at in newest.items() if at is not None and kept[part][at] != GONE}
