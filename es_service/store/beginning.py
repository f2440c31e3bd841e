"""Data with which a run begins, stored while its folder is created.

A fork begins with the history and the state of its parent. A run that starts from the centre of another run stores this
centre, so later changes of the other run have no effect on it.
"""

from __future__ import annotations

import base64
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from es_service.store import metrics
from es_service.store.codec import (
    Part,
    Values,
    decode_part,
    encode_changes,
    encode_part,
    row_bytes,
    rows_listed,
    state_sha256,
    state_sum,
    stored_values,
)
from es_service.store.facts import Damaged
from es_service.store.platforms import record
from es_service.store.rows import insert_history
from es_service.store.schema import RunMeta, get_meta, put_meta
from es_service.store.states import insert_contents, insert_state

SEVERAL = "centre_K_D"
"""Array of a start from several policies, instead of "centre_D"; "mean_K_O" and "std_K_O" are their statistics."""
_START = "start"
"""Key of the start in the table `meta`."""


@dataclass(frozen=True)
class Beginning:
    """Data with which a run begins; empty for an ordinary run."""

    history: Iterable[Values] = ()
    """History rows of a fork's parent, of generations 0 to `newest`. They are iterated over once and need not fit into
    memory. Columns that this run does not have are left out; columns that the parent does not have get no value."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """State of the parent at generation `newest`."""
    contents: Mapping[bytes, Part] = field(default_factory=dict)
    """Policies and traces that this state names."""
    platforms: Sequence[tuple[int, dict[str, Any]]] = ()
    """(first generation, platform) of the parent, up to generation `newest`."""
    start: Part | None = None
    """Arrays from which generation 0 starts; `RunStore.start` returns them."""
    newest: int = -1
    """Last generation that is taken from the parent; -1 if there is none."""
    metrics: Mapping[int, Mapping[str, float]] = field(default_factory=dict)
    """Metrics that were recorded in the parent, by generation and by name; a column of this run replaces its own."""
    evaluations: Iterable[Sequence[Values]] = ()
    """The centres that each of these generations evaluated, likewise; none if it ends early."""


def store_beginning(connection: sqlite3.Connection, meta: RunMeta, beginning: Beginning) -> None:
    """Write the data with which a run begins into its new database, in one transaction."""
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        in_force: dict[str, tuple[int, str]] = {}
        for part, arrays in beginning.parts.items():
            rows = encode_changes(beginning.newest, {part: arrays})
            insert_state(connection, rows)
            in_force |= rows_listed(rows)
        insert_contents(connection, beginning.contents.items())
        evaluations = iter(beginning.evaluations)
        for generation, given in enumerate(beginning.history):
            recorded = metrics.row(beginning.metrics.get(generation, {}))  # what a program has recorded is no column
            values = {column.name: given.get(column.name) for column in meta.columns if column.name not in recorded}
            evaluated = [row_bytes(stored_values(meta.evaluation_columns, row)) for row in next(evaluations, ())]
            # The state of the newest generation is stored, but not those of the generations before it.
            state = state_sha256(state_sum(in_force if generation == beginning.newest else {}))
            insert_history(connection, meta, generation, values, b"".join(evaluated), state)
        for generation, platform in beginning.platforms:
            record(connection, generation, platform)
        columns = {column.name for column in meta.columns}
        for generation, named in beginning.metrics.items():
            new = {name: value for name, value in named.items() if columns.isdisjoint(metrics.row({name: value}))}
            metrics.record(connection, generation, new)
        if beginning.start is not None:
            put_meta(connection, _START, base64.b64encode(encode_part(beginning.start)).decode())


def load_start(connection: sqlite3.Connection) -> dict[str, NDArray[Any]] | None:
    """`Beginning.start` from a verified database; None if there is none. Raises Damaged if it has no arrays."""
    text = get_meta(connection, _START)
    try:
        return None if text is None else decode_part(base64.b64decode(text))
    except ValueError as error:
        raise Damaged(f"the policy from which it started cannot be read: {error}") from error
