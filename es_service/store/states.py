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
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

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


class Change(NamedTuple):
    """What a commit changes of the stored state rows and contents."""

    totals: Sequence[int]
    """`codec.state_sum` of the state after each generation."""
    parts: Collection[str]
    """Those of which there are new rows."""
    added: Mapping[tuple[str, int], str]
    """(part, generation) -> SHA-256 or GONE of the new rows that are stored. Those of generations whose states are not
    kept are not, where a later row of the part replaces them."""
    outdated: Sequence[tuple[str, int]]
    """The stored rows that are deleted."""
    named: NamesByRow
    """What the added rows name."""
    runs: Mapping[bytes, int]
    """By how much it changes in how many runs of rows a content is named."""
    new_contents: Sequence[bytes]
    """Names of the contents that are stored."""
    unnamed: Sequence[bytes]
    """Names of those that are deleted, since nothing names them any more."""


class KeptStates:
    """The stored state rows, as the writer of a run follows them from commit to commit."""

    def __init__(self, connection: sqlite3.Connection, rows: KeptRows, named: NamesByRow, newest: int | None) -> None:
        """`rows`: all intact rows that are stored; `named`: what they and those of certified policies name; `newest`:
        newest generation, None if there is none."""
        self._rows = {part: dict(sorted(of_part.items())) for part, of_part in rows.items()}
        self._named = dict(named)
        self._count = Counter[bytes]()
        """By name of a content, in how many runs of successive rows of a part it is named: 0 if nothing names it. A new
        row names nearly the same as the one before, so few of these numbers change with it."""
        before: tuple[str, frozenset[bytes]] = "", frozenset()
        for part, at in sorted({*self._named, *((part, at) for part, of_part in rows.items() for at in of_part)}):
            names = self._named.get((part, at), frozenset())
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
        return sorted(part for part, of_part in self._rows.items() if of_part[next(reversed(of_part))] != GONE)

    def newest(self, part: str) -> tuple[int, str]:
        """(generation, SHA-256) of the newest row of a part. Raises KeyError if the newest state has no such part."""
        at, sha256 = next(reversed(self._rows[part].items()))
        if sha256 == GONE:
            raise KeyError(part)
        return at, sha256

    def contents(self) -> list[bytes]:
        """Names of all contents that are stored."""
        return list(self._count)

    def changed_by(
        self,
        generations: Sequence[ListedRows],
        arrays: Mapping[tuple[str, int], Part | None],
        last: int,
        keep_every: int | None,
    ) -> Change:
        """What a commit of generations changes. The rows that remain make up the states of the last generation, of the
        one before it, and of those to keep, such as multiples of `keep_every`.

        Args:
            generations: the new rows of each, in their order.
            arrays: of these rows.
            last: number of the last generation.
        """
        total, totals = self.total, list[int]()
        newest: dict[str, tuple[int, str]] = {}
        new: dict[str, dict[int, str]] = {}
        for rows in generations:
            replaced = {part: next(reversed(self._rows[part].items())) for part in rows if part in self._rows}
            total = changed_sum(total, replaced | {part: newest[part] for part in rows if part in newest}, rows)
            totals.append(total)
            newest |= rows
            for part, (at, sha256) in rows.items():
                new.setdefault(part, {})[at] = sha256
        added: dict[tuple[str, int], str] = {}
        named: dict[tuple[str, int], frozenset[bytes]] = {}
        outdated: list[tuple[str, int]] = []
        count: dict[bytes, int] = {}
        for part in {*self._doubled, *new}:
            stored, of_part = self._rows.get(part, {}), new.get(part, {})
            present = [*islice(reversed(stored), 3)][::-1]  # whether older ones are needed was decided long ago
            before = present.pop(0) if len(present) > 2 else None
            rows = [*present, *of_part]
            wanted = [
                at
                for at, until in zip(rows, [*rows[1:], last + 1], strict=True)
                if until >= last or self._is_kept(at, until, keep_every)
            ]
            while before is None and wanted and of_part.get(wanted[0], stored.get(wanted[0])) == GONE:
                del wanted[0]  # it removes nothing
            added |= {(part, at): of_part[at] for at in wanted if at in of_part}
            named |= {(part, at): names for at in wanted if (names := names_in(arrays.get((part, at)) or {}))}
            outdated += [(part, at) for at in present if at not in wanted]
            for ats, by in ((present, -1), (wanted, 1)):
                earlier = self._named.get((part, before), frozenset[bytes]()) if before is not None else frozenset()
                for at in ats:
                    names = named.get((part, at)) or self._named.get((part, at), frozenset())
                    for name in names - earlier:
                        count[name] = count.get(name, 0) + by
                    earlier = names
        new_contents = [name for name, by in count.items() if by > 0 and name not in self._count]
        unnamed = [name for name, by in count.items() if by < 0 and self._count[name] + by == 0]
        return Change(totals, new, added, outdated, named, count, new_contents, unnamed)

    def _is_kept(self, at: int, until: int, keep_every: int | None) -> bool:
        """Whether a row is in force, from `at` to before `until`, in a state that is to be kept."""
        if keep_every is not None and (until - 1) // keep_every * keep_every >= at:
            return True
        return bisect_left(self._earlier, at) < bisect_left(self._earlier, until)

    def commit(self, change: Change) -> None:
        """Follow a commit."""
        self.total = change.totals[-1]
        for part, at in change.outdated:
            del self._rows[part][at]
            self._named.pop((part, at), None)
        for (part, at), sha256 in change.added.items():
            self._rows.setdefault(part, {})[at] = sha256
        for part in {part for part, _ in change.outdated}:
            if not self._rows[part]:
                del self._rows[part]
        self._doubled = [part for part in change.parts if len(self._rows.get(part, ())) > 1]
        self._add(change.named, change.runs)

    def lacking(self, named: NamesByRow) -> list[bytes]:
        """Names of the contents that are not stored."""
        return [name for name in frozenset[bytes]().union(*named.values()) if name not in self._count]

    def add_certified(self, named: NamesByRow) -> None:
        """Follow what new rows of certified policies name."""
        self._add(named, Counter(name for names in named.values() for name in names))

    def _add(self, named: NamesByRow, count: Mapping[bytes, int]) -> None:
        self._named |= named
        for name, by in count.items():
            self._count[name] += by
            if not self._count[name]:
                del self._count[name]
