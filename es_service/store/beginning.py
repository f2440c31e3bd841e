"""What a run begins with if not with nothing; stored while its folder is made, so that no run is without it.

A fork begins with its parent's history and state. A run that starts from another one's centre keeps that centre, so
that what becomes of the other run changes nothing.
"""

from __future__ import annotations

import base64
import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from es_service.store.codec import (
    Part,
    decode_part,
    encode_part,
    history_row,
    part_sha256,
    state_sha256,
    state_sum,
    text_sha256,
)
from es_service.store.schema import RunMeta, history_insert

_START = "start"
"""Key of the table `meta` under which the start is kept."""


@dataclass(frozen=True)
class Beginning:
    """What to begin with; empty for an ordinary run."""

    history: Iterable[Mapping[str, int | float | None]] = ()
    """A fork's parent's rows of generations 0, 1, ... n, gone through once: they need not fit into memory. Columns this
    run does not have are left out, those that the parent did not have are empty."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """The state of generation n."""
    platforms: Sequence[tuple[int, dict[str, Any]]] = ()
    """(first generation, platform) of the parent, up to n."""
    start: Part | None = None
    """Arrays that generation 0 is to start from; `RunStore.start` gives them back."""
    newest: int = -1
    """n."""


def store_beginning(connection: sqlite3.Connection, meta: RunMeta, beginning: Beginning) -> None:
    """Write `beginning` into the database of a new run, in one transaction."""
    newest = beginning.newest
    connection.execute("BEGIN IMMEDIATE")
    in_force: dict[str, tuple[int, str]] = {}
    for part, arrays in beginning.parts.items():
        payload = encode_part(arrays)
        in_force[part] = (newest, part_sha256(part, newest, payload))
        row = (part, newest, in_force[part][1], payload)
        connection.execute("INSERT INTO state (part, generation, sha256, payload) VALUES (?, ?, ?, ?)", row)
    names = [column.name for column in meta.columns]
    insert = history_insert(meta.columns)
    for generation, given in enumerate(beginning.history):
        # Of all but the newest generation the state is not kept.
        state = state_sha256(state_sum(in_force if generation == newest else {}))
        values = {name: given.get(name) for name in names}
        connection.execute(insert, history_row(meta.columns, generation, values, state))
    for generation, platform in beginning.platforms:
        text = json.dumps(platform, sort_keys=True)
        row = (generation, text, text_sha256(f"platform {generation}", text))
        connection.execute("INSERT INTO platform (generation, platform, sha256) VALUES (?, ?, ?)", row)
    if beginning.start is not None:
        text = base64.b64encode(encode_part(beginning.start)).decode()
        connection.execute("INSERT INTO meta VALUES (?, ?, ?)", (_START, text, text_sha256(_START, text)))
    connection.execute("COMMIT")


def load_start(connection: sqlite3.Connection) -> dict[str, NDArray[Any]] | None:
    """`Beginning.start` of a verified database."""
    row = connection.execute("SELECT value FROM meta WHERE key = ?", (_START,)).fetchone()
    return None if row is None else decode_part(base64.b64decode(row[0]))
