"""The table of certified policies: their values in fresh episodes, outside the digest, and the policies themselves.

A certification is a few rows that are added together. Rows are never changed, belong to no generation, and are not
copied by a fork.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from es_service.store.codec import Part, decode_part, encode_part

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


def row_sha256(number: object, rank: object, facts: object, payload: bytes) -> str:
    """SHA-256 of a row, over all of its values."""
    digest = hashlib.sha256(f"certification\0{number}\0{rank}\0{facts}\0".encode())
    digest.update(payload)
    return digest.hexdigest()


def encoded(number: int, policies: Iterable[tuple[Mapping[str, Any], Part]]) -> list[tuple[Any, ...]]:
    """The rows of a certification, of (facts, arrays) of each policy in the order of rank."""
    found = []
    for rank, (facts, arrays) in enumerate(policies):
        text, payload = json.dumps(facts, sort_keys=True), encode_part(arrays)
        found.append((number, rank, text, payload, row_sha256(number, rank, text, payload)))
    return found


def next_number(connection: sqlite3.Connection, parent: Mapping[str, Any] | None) -> int:
    """Number after the greatest one that has been stored, removed rows included.

    That of a fork begins after those of its parent, whose episodes may have decided about it.

    Args:
        parent: `RunMeta.parent`.
    """
    stored = connection.execute("SELECT coalesce(max(number) + 1, 0) FROM certification").fetchone()[0]
    return max(stored, (parent or {}).get(CERTIFICATIONS, 0))


def remove(connection: sqlite3.Connection, keys: Iterable[Key]) -> None:
    """Empty damaged rows. Their numbers remain, since another certification with one would have the same episodes."""
    for number, rank in keys:
        sha256 = row_sha256(number, rank, _REMOVED, b"")
        connection.execute(
            "UPDATE certification SET facts = ?, payload = ?, sha256 = ? WHERE number IS ? AND rank IS ?",
            (_REMOVED, b"", sha256, number, rank),
        )


def damaged_rows(connection: sqlite3.Connection) -> list[Key]:
    """The rows that do not match their SHA-256."""
    return [(number, rank) for number, rank, row in rows(connection) if row is None]


def rows(
    connection: sqlite3.Connection, where: str = "", values: Sequence[Any] = ()
) -> list[tuple[int, int, CertifiedRow | None]]:
    """Number, rank and content of all rows that were not removed, in the order of number and rank; None for the content
    of a damaged one."""
    query = f"SELECT number, rank, facts, payload, sha256 FROM certification {where} ORDER BY number, rank"
    return [(row[0], row[1], _decoded(row)) for row in connection.execute(query, values) if not _is_removed(row)]


def newest_rows(connection: sqlite3.Connection) -> list[tuple[int, int, CertifiedRow | None]]:
    """`rows` of the newest certification of which there are any."""
    numbers = connection.execute("SELECT DISTINCT number FROM certification ORDER BY number DESC").fetchall()
    return next((found for number in numbers if (found := rows(connection, "WHERE number IS ?", number))), [])


def _is_removed(row: Sequence[Any]) -> bool:
    number, rank, facts, payload, sha256 = row
    return facts == _REMOVED and payload == b"" and sha256 == row_sha256(number, rank, _REMOVED, b"")


def _decoded(row: Sequence[Any]) -> CertifiedRow | None:
    number, rank, facts, payload, sha256 = row
    if not isinstance(payload, bytes) or row_sha256(number, rank, facts, payload) != sha256:
        return None
    return CertifiedRow(number, rank, json.loads(facts), decode_part(payload))
