"""The platforms of a run in its database: a row for each generation from which on another one computes the run."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from typing import Any

from es_service.store.codec import text_sha256
from es_service.store.schema import Damaged

LIST = "platforms"
"""Key of the list of the rows' generations in the table `meta`, by which the loss of a row is noticed. Older versions
neither store nor read it."""
Execute = Callable[..., sqlite3.Cursor]
"""Runs an SQL statement with its values."""


def record(execute: Execute, generation: int, platform: dict[str, Any]) -> bool:
    """Record the platform of a generation and of those after it, in place of the records of these generations.

    Returns:
        Whether the platform differs from that of the generations before, or is the first.
    """
    text = json.dumps(platform, sort_keys=True)
    execute("DELETE FROM platform WHERE generation >= ?", (generation,))
    latest = newest_before(execute, generation)
    differs = latest is None or json.dumps(latest, sort_keys=True) != text
    if differs:
        row = (generation, text, text_sha256(f"platform {generation}", text))
        execute("INSERT INTO platform (generation, platform, sha256) VALUES (?, ?, ?)", row)
    return differs


def store_list(execute: Execute) -> None:
    """Store the list of all rows, together with the first generation of the newest one.

    Not earlier: an older version of es-service may still compute that generation instead, and deletes the row.
    """
    text = json.dumps([at for (at,) in execute("SELECT generation FROM platform ORDER BY generation")])
    execute("INSERT OR REPLACE INTO meta VALUES (?, ?, ?)", (LIST, text, text_sha256(LIST, text)))


def sound_platforms(connection: sqlite3.Connection) -> list[tuple[int, dict[str, Any]]]:
    """Recorded platforms as (first generation, platform), in order.

    Raises:
        Damaged: a record does not match its SHA-256, or is missing.
    """
    found: dict[int, dict[str, Any]] = {}
    for at, text, sha256 in connection.execute("SELECT generation, platform, sha256 FROM platform ORDER BY generation"):
        if text_sha256(f"platform {at}", text) != sha256:
            raise Damaged(f"the platform recorded at generation {at} does not match its SHA-256")
        found[at] = json.loads(text)
    listed = connection.execute("SELECT value FROM meta WHERE key = ?", (LIST,)).fetchone()
    newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
    for at in [] if listed is None or newest is None else json.loads(listed[0]):
        # The row of a generation that was lost, and is not computed again yet, was deleted with it.
        if at <= newest and at not in found:
            raise Damaged(f"the platform recorded at generation {at} is missing")
    return [*found.items()]


def newest_before(execute: Execute, generation: int) -> dict[str, Any] | None:
    """The platform of the generation before this one; None if none is recorded."""
    query = "SELECT platform FROM platform WHERE generation < ? ORDER BY generation DESC LIMIT 1"
    found = execute(query, (generation,)).fetchone()
    return None if found is None else json.loads(found[0])
