"""Data with which a run begins, stored while its folder is created.

A fork begins with the history and the state of its parent. A run that starts from the centre of another run stores this
centre, so later changes of the other run have no effect on it.
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
    column_bytes,
    decode_part,
    encode_changes,
    encode_part,
    history_row,
    rows_listed,
    state_sha256,
    state_sum,
    text_sha256,
)
from es_service.store.schema import RunMeta, history_insert
from es_service.store.tables import as_table, table_bytes

SEVERAL = "centre_K_D"
"""Array of a start from several policies, instead of "centre_D"; "mean_K_O" and "std_K_O" are their statistics."""
_START = "start"
"""Key of the start in the table `meta`."""


@dataclass(frozen=True)
class Beginning:
    """Data with which a run begins; empty for an ordinary run."""

    history: Iterable[Mapping[str, int | float | None]] = ()
    """History rows of a fork's parent, of generations 0 to `newest`. They are iterated over once and need not fit into
    memory. Columns that this run does not have are left out; columns that the parent does not have get no value."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """State of the parent at generation `newest`."""
    platforms: Sequence[tuple[int, dict[str, Any]]] = ()
    """(first generation, platform) of the parent, up to generation `newest`."""
    start: Part | None = None
    """Arrays from which generation 0 starts; `RunStore.start` returns them."""
    newest: int = -1
    """Last generation that is taken from the parent; -1 if there is none."""
    evaluations: Iterable[Sequence[Mapping[str, int | float | None]]] = ()
    """The centres that each of these generations evaluated, likewise; none if it ends early."""


def store_beginning(connection: sqlite3.Connection, meta: RunMeta, beginning: Beginning) -> None:
    """Write the data with which a run begins into its new database, in one transaction."""
    newest = beginning.newest
    connection.execute("BEGIN IMMEDIATE")
    in_force: dict[str, tuple[int, str]] = {}
    for part, arrays in beginning.parts.items():  # one at a time, because all elites together may be large
        [row] = rows = encode_changes(newest, {part: arrays})
        in_force |= rows_listed(rows)
        connection.execute("INSERT INTO state (part, generation, sha256, payload) VALUES (?, ?, ?, ?)", row)
    names = [column.name for column in meta.columns]
    insert, heading = history_insert(meta.columns), column_bytes(meta.columns)
    centre_names = [column.name for column in meta.evaluation_columns]
    evaluations = iter(beginning.evaluations)
    for generation, given in enumerate(beginning.history):
        # The state of the newest generation is stored, but not those of the generations before it.
        state = state_sha256(state_sum(in_force if generation == newest else {}))
        values = {name: given.get(name) for name in names}
        rows = [{name: centre.get(name) for name in centre_names} for centre in next(evaluations, ())]
        centres = table_bytes(meta.evaluation_columns, as_table(meta.evaluation_columns, rows))
        connection.execute(insert, history_row(meta.columns, heading, generation, values, centres, state))
    for generation, platform in beginning.platforms:
        text = json.dumps(platform, sort_keys=True)
        row = (generation, text, text_sha256(f"platform {generation}", text))
        connection.execute("INSERT INTO platform (generation, platform, sha256) VALUES (?, ?, ?)", row)
    if beginning.start is not None:
        text = base64.b64encode(encode_part(beginning.start)).decode()
        connection.execute("INSERT INTO meta VALUES (?, ?, ?)", (_START, text, text_sha256(_START, text)))
    connection.execute("COMMIT")


def load_start(connection: sqlite3.Connection) -> dict[str, NDArray[Any]] | None:
    """`Beginning.start` from a verified database; None if there is none."""
    row = connection.execute("SELECT value FROM meta WHERE key = ?", (_START,)).fetchone()
    return None if row is None else decode_part(base64.b64decode(row[0]))
