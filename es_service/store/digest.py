"""The digest of a run: SHA-256 over what must repeat bit for bit, and nothing else.

Hashed are values, each with its name, type and shape: not payload bytes as stored, row order on disk, seconds, rates,
workers, hosts or paths. It is taken from what the tables contain, without looking at the SHA-256 stored beside it
(`checked_parts` does that first): a flipped bit in a state payload or a deterministic history value gives another
digest, or a StoreError where the value can no longer be read as one.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from es_service.errors import StoreError, WayOut
from es_service.loop.parts import CELL_PREFIX, ELITE_PREFIX, GEOMETRY_PART
from es_service.protocol.machine import is_mixed
from es_service.store.codec import decode_part, row_bytes
from es_service.store.folder import DATABASE
from es_service.store.reader import kept_states, platforms, reading, state_payload
from es_service.store.schema import RunMeta, history_select
from es_service.store.verify import verify

Connection = sqlite3.Connection

NEWEST = 2**62
"""Stands for the newest generation."""


def digest_of(parts: Mapping[str, str]) -> str:
    """The digest of a run whose `digest_parts` are these."""
    lines = (f"{name}\0{sha256}\n" for name, sha256 in sorted(parts.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def digest_parts(folder: Path) -> dict[str, str]:
    """SHA-256 by name: `state/<part>` of each part's newest value, `map` of all its cells and elites, `history`.

    Raises StoreError if the run cannot be read.
    """
    with reading(folder) as (connection, meta):
        return _parts(folder, connection, meta)


def digest_at(folder: Path, generation: int) -> str | None:
    """The digest that the run had after one of its last two generations; None if that state is no longer kept."""
    with reading(folder) as (connection, meta):
        kept = kept_states(connection)
        return digest_of(_parts(folder, connection, meta, generation)) if generation in kept else None


def checked_parts(folder: Path) -> tuple[dict[str, str], bool]:
    """`digest_parts`, and whether the stored generations were computed on more than one platform (versions, CPU or GPU
    kind), by the driver or by workers; of one moment, after everything stored was checked against its SHA-256.

    Raises StoreError that names what is damaged.
    """
    with reading(folder) as (connection, meta):
        if problems := verify(connection, folder / DATABASE).problems:
            raise StoreError(
                f"{folder} is damaged: {'; '.join(problems)}",
                run=folder,
                ways_out=[WayOut("resume", "go on from the newest generation that is sound", str(folder))],
            )
        return _parts(folder, connection, meta), _is_mixed(connection)


def _is_mixed(connection: Connection) -> bool:
    newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
    return is_mixed(at for first, at in platforms(connection) if newest is not None and first <= newest)


def _parts(folder: Path, connection: Connection, meta: RunMeta, until: int = NEWEST) -> dict[str, str]:
    try:
        return {**_state(connection, until), "history": _history(connection, meta, until)}
    except ValueError as error:
        ways_out = [WayOut("resume", "repair what can be repaired", str(folder))]
        raise StoreError(f"{folder} holds what cannot be read: {error}", run=folder, ways_out=ways_out) from error


def _state(connection: Connection, until: int) -> dict[str, str]:
    query = "SELECT part, max(generation) FROM state WHERE generation <= ? GROUP BY part ORDER BY part"
    newest = connection.execute(query, (until,)).fetchall()
    parts = {part: arrays_sha256(decode_part(state_payload(connection, part, at))) for part, at in newest}
    of_map = [part for part in parts if part.startswith((GEOMETRY_PART, CELL_PREFIX, ELITE_PREFIX))]
    together = {"map": hashlib.sha256("".join(f"{part}\0{parts.pop(part)}\n" for part in of_map).encode()).hexdigest()}
    return {f"state/{part}": sha256 for part, sha256 in parts.items()} | (together if of_map else {})


def arrays_sha256(arrays: dict[str, NDArray[Any]]) -> str:
    """Of arrays by name: name, type, shape and little-endian values of each, in the order of the names."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        little = arrays[name].astype(arrays[name].dtype.newbyteorder("<"), copy=False)
        total.update(json.dumps([name, little.dtype.str, list(little.shape)]).encode() + b"\n")
        total.update(little.tobytes(order="C"))
    return total.hexdigest()


def _history(connection: Connection, meta: RunMeta, until: int) -> str:
    columns = sorted((column for column in meta.columns if column.deterministic), key=lambda column: column.name)
    total = hashlib.sha256(json.dumps([[column.name, column.type] for column in columns]).encode() + b"\n")
    query = history_select(columns) + " WHERE history.generation <= ? ORDER BY history.generation"
    for values in connection.execute(query, (until,)):
        total.update(row_bytes(values[:-2]))
    return total.hexdigest()
