"""The platforms of a run in its database: a row for each generation from which on another one computes the run."""

from __future__ import annotations

import json
import sqlite3
from typing import Any

from es_service.store.codec import text_sha256
from es_service.store.facts import Damaged, Platform, facts
from es_service.store.schema import get_meta, put_meta

LIST = "platforms"
"""Key of the list of the rows' generations in the table `meta`, by which the loss of a row is noticed. Older versions
neither store nor read it."""


def record(connection: sqlite3.Connection, generation: int, platform: dict[str, Any]) -> bool:
    """Record the platform of a generation and of those after it, in place of the records of these generations.

    Returns:
        Whether the platform differs from that of the generations before, or is the first.
    """
    connection.execute("DELETE FROM platform WHERE generation >= ?", (generation,))
    text = json.dumps(platform, sort_keys=True)
    if json.loads(text) == newest_before(connection, generation):
        return False
    row = (generation, text, text_sha256(f"platform {generation}", text))
    connection.execute("INSERT INTO platform (generation, platform, sha256) VALUES (?, ?, ?)", row)
    return True


def newest_before(connection: sqlite3.Connection, generation: int) -> dict[str, Any] | None:
    """The platform of the generation before this one; None if none is recorded."""
    query = "SELECT platform FROM platform WHERE generation < ? ORDER BY generation DESC LIMIT 1"
    row = connection.execute(query, (generation,)).fetchone()
    return None if row is None else json.loads(row[0])


def store_list(connection: sqlite3.Connection) -> None:
    """Store the list of all rows, together with the first generation of the newest one.

    Not earlier: an older version of es-service may still compute that generation instead, and deletes the row.
    """
    recorded = connection.execute("SELECT generation FROM platform ORDER BY generation")
    put_meta(connection, LIST, json.dumps([at for (at,) in recorded]))


def sound_platforms(connection: sqlite3.Connection) -> list[tuple[int, dict[str, Any]]]:
    """Recorded platforms as (first generation, platform), in order. Raises Damaged if a record does not match its
    SHA-256, or is missing."""
    platforms: dict[int, dict[str, Any]] = {}
    for at, text, sha256 in connection.execute("SELECT generation, platform, sha256 FROM platform ORDER BY generation"):
        if text_sha256(f"platform {at}", text) != sha256:
            raise Damaged(f"the platform recorded at generation {at} does not match its SHA-256")
        platforms[at] = facts(text, Platform, f"the platform recorded at generation {at}")
    newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
    listed = facts(get_meta(connection, LIST) or "[]", list[int], "the list of its platforms")
    for at in [] if newest is None else listed:
        # The row of a generation that was lost, and is not computed again yet, was deleted with it.
        if at <= newest and at not in platforms:
            raise Damaged(f"the platform recorded at generation {at} is missing")
    return [*platforms.items()]
