"""The state rows of a run: which states are stored, what belongs to each, and which a run keeps.

A part of the state has a row for each generation that changed it. A row belongs to the states from its generation on,
until the next row of the part; a row without payload removes the part.

Kept are the states of the last two generations, and those of generations that were asked for. A row is deleted when no
state to which it belongs is to be kept. A row that removes its part is deleted together with the last of the older
rows, from which it protects the states after it. The contents that rows name, such as policies, are stored once, and
are deleted together with the last row that names them.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from numpy.typing import NDArray

from es_service.protocol.content import name_of, names_in
from es_service.store.codec import (
    GONE,
    NO_PAYLOAD,
    ListedRows,
    Part,
    StateRow,
    changed_sum,
    decode_part,
    encode_part,
    part_sha256,
    state_sha256,
    state_sum,
)
from es_service.store.facts import Damaged
from es_service.store.rows import newest_generation

NamesByRow = Mapping[tuple[str, int], frozenset[bytes]]
"""(part, generation) of a state row -> names of contents in it."""
KeptRows = dict[str, dict[int, str]]
"""Stored state rows: part -> generation -> SHA-256, or GONE for a row that removes the part."""


def insert_state(connection: sqlite3.Connection, rows: Iterable[StateRow]) -> None:
    connection.executemany("INSERT INTO state (part, generation, sha256, payload) VALUES (?, ?, ?, ?)", rows)


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
    """Newest generation of a state row; None if there is none. Every generation has state rows, so if the history ends
    before it, the end of the history is lost."""
    query = "SELECT max(generation) FROM state WHERE typeof(generation) = 'integer'"
    return connection.execute(query).fetchone()[0]


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


def sound_content(connection: sqlite3.Connection, name: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of a content. Raises KeyError if there is none of this name, Damaged if it is none of this name."""
    row = connection.execute("SELECT payload FROM content WHERE name = ?", (name,)).fetchone()
    if row is None:
        raise KeyError(name)
    if (arrays := content_of(name, row[0])) is None:
        raise Damaged(f"the content {name.hex()} does not match its name")
    return arrays


def content_of(name: object, payload: object) -> dict[str, NDArray[Any]] | None:
    """The arrays of a row of the table content; None if they do not match their name."""
    try:
        arrays = decode_part(payload) if isinstance(payload, bytes) else {}
    except ValueError:
        return None
    return arrays if name_of(arrays) == name else None


def insert_contents(connection: sqlite3.Connection, contents: Iterable[tuple[bytes, Part]]) -> None:
    rows = ((name, encode_part(arrays)) for name, arrays in contents)
    connection.executemany("INSERT INTO content VALUES (?, ?)", rows)


def collect_contents(connection: sqlite3.Connection) -> None:
    """Delete the contents that nothing names: no row of the state, and none of a certified policy."""
    tables = (f"SELECT payload FROM {table} WHERE length(payload) > 0" for table in ("state", "certification"))
    payloads = connection.execute(" UNION ALL ".join(tables))
    named = frozenset[bytes]().union(*(names_in(decode_part(payload)) for (payload,) in payloads))
    stored = [name for (name,) in connection.execute("SELECT name FROM content")]
    connection.executemany("DELETE FROM content WHERE name IS ?", [(name,) for name in stored if name not in named])


def sound_part(connection: sqlite3.Connection, part: str, generation: int, sha256: str) -> dict[str, NDArray[Any]]:
    """The arrays of a state row that was found. Raises Damaged if it does not match its SHA-256, or has no arrays."""
    payload = state_payload(connection, part, generation)
    if part_sha256(part, generation, payload) != sha256:
        raise Damaged(f"the state of {part!r} at generation {generation} does not match its SHA-256")
    try:
        return decode_part(payload)
    except ValueError as error:
        raise Damaged(f"the state of {part!r} at generation {generation} cannot be read: {error}") from error


def state_payload(connection: sqlite3.Connection, part: str, generation: int) -> bytes:
    """The payload of a state row that was found. Raises Damaged if it cannot be found again or holds something else."""
    query = "SELECT payload FROM state WHERE part = ? AND generation = ?"
    row = connection.execute(query, (part, generation)).fetchone()
    if row is None or not isinstance(row[0], bytes):
        raise Damaged(f"the state of {part!r} at generation {generation} is missing")
    return row[0]


class KeptStates:
    """The stored state rows, as the writer of a run follows them from commit to commit."""

    def __init__(self, connection: sqlite3.Connection, rows: KeptRows, named: NamesByRow, newest: int | None) -> None:
        """`rows`: all intact rows that are stored; `named`: what they and those of certified policies name; `newest`:
        newest generation, None if there is none."""
        self._rows, self._named = rows, dict(named)
        self._count = Counter[bytes]()
        """By name of a content, in how many runs of successive rows of a part it is named: 0 if nothing names it. A new
        row names nearly the same as the one before, so few of these numbers change with it."""
        before: tuple[str, frozenset[bytes]] = "", frozenset()
        for part, at in sorted({*self._named, *((part, at) for part, of_part in rows.items() for at in of_part)}):
            names = self._named_by(part, at)
            self._count.update(names - (before[1] if before[0] == part else frozenset()))
            before = part, names
        self.total = 0 if newest is None else state_sum(rows_in_force(rows, newest))
        """`codec.state_sum` of the newest state."""
        # Parts of which an older row is stored as well, which the generation before the newest needs.
        self._doubled = [part for part, of_part in rows.items() if len(of_part) > 1]
        # States of earlier generations that are kept now stay, whatever is kept from now on.
        self._earlier = [] if newest is None else [at for at in whole_states(connection, rows) if at < newest - 1]

    def names(self) -> list[str]:
        """Parts of the newest state."""
        return sorted(part for part, of_part in self._rows.items() if of_part[max(of_part)] != GONE)

    def newest(self, part: str) -> tuple[int, str]:
        """(generation, SHA-256) of the newest row of a part. Raises KeyError if the newest state has no such part."""
        at, sha256 = max(self._rows[part].items())
        if sha256 == GONE:
            raise KeyError(part)
        return at, sha256

    def total_after(self, new: ListedRows) -> int:
        """`total` after a commit of these rows."""
        return changed_sum(self.total, {part: max(self._rows[part].items()) for part in new if part in self._rows}, new)

    def outdated(self, keep_every: int | None) -> list[tuple[str, int]]:
        """(part, generation) of the rows that the next commit deletes: the rows that remain make up the states of its
        generation, of the one before it, and of those to keep, such as multiples of `keep_every`."""
        rows = []
        for part in self._doubled:
            at, until = sorted(self._rows[part])[-2:]
            is_multiple = keep_every is not None and (until - 1) // keep_every * keep_every >= at
            if not is_multiple and not any(at <= generation < until for generation in self._earlier):
                rows.append((part, at))
                if self._rows[part][until] == GONE and len(self._rows[part]) == 2:
                    rows.append((part, until))
        return rows

    def contents(self) -> list[bytes]:
        """Names of all contents that are stored."""
        return list(self._count)

    def named_after(self, named: NamesByRow, outdated: Iterable[tuple[str, int]]) -> tuple[list[bytes], list[bytes]]:
        """Names of the contents that a commit adds, and of those that nothing names after it.

        Args:
            named: what its rows name.
            outdated: rows that it deletes.
        """
        change = self._change(named, outdated)
        added = [name for name in change if name not in self._count]
        return added, [name for name, by in change.items() if self._count[name] + by == 0]

    def _named_by(self, part: str, at: int | None) -> frozenset[bytes]:
        return frozenset() if at is None else self._named.get((part, at), frozenset())

    def _change(self, named: NamesByRow, outdated: Iterable[tuple[str, int]]) -> Counter[bytes]:
        """By how much `_count` changes with a commit, where it may change; arguments as of `named_after`."""
        change = Counter[bytes]()
        for (part, _), names in named.items():
            change.update(names - self._named_by(part, max(self._rows.get(part, ()), default=None)))
        for part, at in outdated:
            rows = self._rows[part]
            earlier = self._named_by(part, max((row for row in rows if row < at), default=None))
            later = self._named_by(part, min((row for row in rows if row > at), default=None))
            names = self._named_by(part, at)
            change.subtract((names - earlier - later) | ((earlier & later) - names))
        return change

    def add_named(self, named: NamesByRow, outdated: Iterable[tuple[str, int]] = ()) -> None:
        """Follow what new rows name, of the state or of certified policies; arguments as of `named_after`."""
        for name, by in self._change(named, outdated).items():
            self._count[name] += by
            if not self._count[name]:
                del self._count[name]
        for row in outdated:
            self._named.pop(row, None)
        self._named |= named

    def commit(self, new: ListedRows, named: NamesByRow, outdated: Iterable[tuple[str, int]], total: int) -> None:
        """Follow a commit, with what `total_after` and `outdated` have returned for it."""
        self.total = total
        self.add_named(named, outdated)
        for part, at in outdated:
            del self._rows[part][at]
            if not self._rows[part]:
                del self._rows[part]
        for part, (at, sha256) in new.items():
            self._rows.setdefault(part, {})[at] = sha256
        self._doubled = [part for part in new if len(self._rows[part]) > 1]
