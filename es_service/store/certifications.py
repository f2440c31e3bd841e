"""The table of certified policies: their values in fresh episodes, outside the digest, and the names of the policies.

A certification is a few rows that are added together. Rows are never changed, belong to no generation, and are not
copied by a fork. A policy that a row names is stored as long as the row.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from es_service.protocol.content import Contents
from es_service.store.codec import Part, decode_part, encode_part
from es_service.store.facts import Count, Damaged, facts, require_form

CERTIFICATIONS = "certifications"
"""Key of a run's `RunMeta.parent`: number of the next certification of the parent when this run began."""
_REMOVED = ""
"""Facts of a row that was damaged."""
Key = tuple[int, int]
"""(number of a certification of the run, from 0; rank in it)."""


@dataclass(frozen=True)
class CertifiedRow:
    """One policy of a certification, as it is stored."""

    number: int
    """Number of the certification among those of the run, from 0."""
    rank: int
    """Place among the policies of the certification, from 0."""
    facts: Mapping[str, Any]
    """Values that JSON can represent."""
    arrays: Mapping[str, NDArray[Any]]
    contents: Contents = field(default_factory=dict)
    """What the arrays name, where it was read."""


def row_name(number: int, rank: int) -> tuple[str, int]:
    """What a row is called beside rows of the state, in `states.Named`."""
    return f"{CERTIFICATIONS}/{rank}", number


def insert(connection: sqlite3.Connection, number: int, policies: Iterable[tuple[Mapping[str, Any], Part]]) -> None:
    """Store a certification: (facts, arrays) of each policy in the order of rank."""
    for rank, (known, arrays) in enumerate(policies):
        text, payload = json.dumps(known, sort_keys=True), encode_part(arrays)
        row = (number, rank, text, payload, _sha256(number, rank, text, payload))
        connection.execute("INSERT INTO certification VALUES (?, ?, ?, ?, ?)", row)


def next_number(connection: sqlite3.Connection, parent: Mapping[str, Any] | None) -> int:
    """Number after the greatest one that has been stored, removed rows included.

    That of a fork begins after those of its parent, whose episodes may have decided about it.

    Args:
        parent: `RunMeta.parent`.
    """
    stored = connection.execute("SELECT coalesce(max(number) + 1, 0) FROM certification").fetchone()[0]
    return max(stored, (parent or {}).get(CERTIFICATIONS, 0))


def rows(
    connection: sqlite3.Connection, newest: Callable[[Mapping[str, Any]], bool] | None = None, holding: str = ""
) -> list[tuple[Key, CertifiedRow | None]]:
    """The rows that were not removed, in the order of number and rank; None for the content of a damaged one.

    Args:
        newest: facts of a row -> whether it is wanted; then only the rows of the newest certification that has wanted
            or damaged ones.
        holding: a text that the facts of a row must have as JSON; the payload of others is not read.
    """
    row_list: list[tuple[Key, CertifiedRow | None]] = []
    query = "SELECT number, rank, facts, payload, sha256 FROM certification WHERE ? = '' OR instr(facts, ?)"
    order = f"ORDER BY number {'DESC' if newest else ''}, rank"
    for number, rank, text, payload, sha256 in connection.execute(f"{query} {order}", (holding, holding)):
        if newest and row_list and row_list[0][0][0] != number:
            break
        if not isinstance(payload, bytes) or _sha256(number, rank, text, payload) != sha256:
            row_list.append(((number, rank), None))
        elif text != _REMOVED:
            try:
                require_form((number, rank), tuple[Count, Count], "its number and rank")
                row = CertifiedRow(number, rank, facts(text, dict[str, Any], "its facts"), decode_part(payload))
            except (Damaged, ValueError):
                row = None
            if row is None or newest is None or newest(row.facts):
                row_list.append(((number, rank), row))
    return row_list


def remove(connection: sqlite3.Connection, keys: Iterable[Key]) -> None:
    """Empty damaged rows. Their numbers remain, since another certification with one would have the same episodes."""
    for number, rank in keys:
        connection.execute(
            "UPDATE certification SET facts = ?, payload = ?, sha256 = ? WHERE number IS ? AND rank IS ?",
            (_REMOVED, b"", _sha256(number, rank, _REMOVED, b""), number, rank),
        )


def _sha256(number: object, rank: object, facts: object, payload: bytes) -> str:
    """SHA-256 of a row, over all of its values."""
    digest = hashlib.sha256(f"certification\0{number}\0{rank}\0{facts}\0".encode())
    digest.update(payload)
    return digest.hexdigest()
