"""The platforms of a run in its database: a row for each generation from which on another one computes the run."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from typing import Any

from es_service.store.codec import text_sha256

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


def newest_before(execute: Execute, generation: int) -> dict[str, Any] | None:
    """The platform of the generation before this one; None if none is recorded."""
    query = "SELECT platform FROM platform WHERE generation < ? ORDER BY generation DESC LIMIT 1"
    found = execute(query, (generation,)).fetchone()
    return None if found is None else json.loads(found[0])
