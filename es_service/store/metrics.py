"""Metrics that the program which runs a session records: numbers by name, of a generation that is stored already.

They are no columns of the table `history`, since their names are known only when they come, and outside the digest,
since the next session may record others. A run gets their table, and a schema version of its own, with the first ones.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import StringConstraints

from es_service.loop.history import METRIC
from es_service.protocol.outputs import NAME_OF_METRIC
from es_service.store.codec import text_sha256
from es_service.store.facts import Damaged, Finite, facts
from es_service.store.schema import EXTENDED_SCHEMA, METRICS, SCHEMA, put_meta
from es_service.store.tables import Columns

_Named = dict[Annotated[str, StringConstraints(pattern=f"^{NAME_OF_METRIC}$")], Finite]


def record(connection: sqlite3.Connection, generation: int, named: Mapping[str, float]) -> None:
    """Store the metrics of a generation, in place of those that it has; what is not finite is left out."""
    if not are_there(connection):
        connection.execute(METRICS)
        put_meta(connection, SCHEMA, str(EXTENDED_SCHEMA))
    text = json.dumps({name: float(value) for name, value in named.items() if math.isfinite(value)}, sort_keys=True)
    row = (generation, text, text_sha256(f"metric {generation}", text))
    connection.execute("INSERT OR REPLACE INTO metric (generation, named, sha256) VALUES (?, ?, ?)", row)


def recorded(
    connection: sqlite3.Connection, first: int = 0, limit: int | None = None
) -> tuple[dict[int, dict[str, float]], list[int]]:
    """Metrics by generation, in the order of generations, and the generations whose metrics are damaged.

    Args:
        first: generation of the first ones.
        limit: greatest number of generations from it on; None for all.
    """
    found: dict[int, dict[str, float]] = {}
    damaged: list[int] = []
    if not are_there(connection):
        return found, damaged
    columns = "generation, CAST(named AS BLOB), CAST(sha256 AS BLOB)"  # a damaged text may be no UTF-8
    query = f"SELECT {columns} FROM metric WHERE generation >= ? AND generation < ? ORDER BY generation"
    for at, named, sha256 in connection.execute(query, (first, 2**62 if limit is None else first + limit)):
        try:
            text = named.decode()
            if text_sha256(f"metric {at}", text).encode() != sha256:
                raise Damaged("they do not match their SHA-256")
            found[at] = facts(text, _Named, "its metrics")
        except (Damaged, TypeError, AttributeError, UnicodeDecodeError):
            damaged.append(at)
    return found, damaged


def sound(connection: sqlite3.Connection, first: int = 0, limit: int | None = None) -> dict[int, dict[str, float]]:
    """The first that `recorded` returns. Raises Damaged if some are damaged."""
    found, damaged = recorded(connection, first, limit)
    if damaged:
        raise Damaged(f"the metrics recorded at generation {damaged[0]} are damaged")
    return found


def row(named: Mapping[str, float]) -> dict[str, float]:
    """Metrics of a generation as values by column."""
    return {f"{METRIC}{name}": value for name, value in named.items()}


def columns(found: Mapping[int, Mapping[str, float]], generation_G: np.ndarray) -> Columns:
    """Metrics as columns beside those of a history with these generations; NaN stands for no value."""
    names = sorted({name for named in found.values() for name in named})
    values = [found.get(int(generation), {}) for generation in generation_G] if names else []
    return {f"{METRIC}{name}": np.array([named.get(name, np.nan) for named in values]) for name in names}


def remove(connection: sqlite3.Connection, newest: int) -> None:
    """Delete damaged metrics, and those of generations after `newest`."""
    if are_there(connection):
        connection.execute("DELETE FROM metric WHERE generation > ?", (newest,))
        connection.executemany("DELETE FROM metric WHERE generation = ?", [(at,) for at in recorded(connection)[1]])


def are_there(connection: sqlite3.Connection) -> bool:
    """Whether the run has their table."""
    return connection.execute("SELECT count(*) FROM sqlite_schema WHERE name = 'metric'").fetchone()[0] > 0
