"""The digest of a run: a SHA-256 over everything that must repeat bit for bit, and nothing else.

It is computed from values with their names, types and shapes. It does not depend on the stored bytes of payloads, the
order of rows on disk, seconds, rates, workers, hosts or paths, nor on the stored SHA-256s, which only `checked_parts`
compares. A changed bit in a state payload or a deterministic history value gives another digest, or a StoreError if the
value cannot be read any more.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path

from es_service.errors import StoreError, WayOut
from es_service.loop.blocks import BLOCK, MAP
from es_service.protocol.content import name_of
from es_service.protocol.machine import is_mixed
from es_service.store.codec import column_bytes, decode_part, row_bytes
from es_service.store.folder import DATABASE
from es_service.store.reader import reading
from es_service.store.records import sound_platforms
from es_service.store.rows import history_rows, leading_values, newest_generation
from es_service.store.schema import RunMeta
from es_service.store.states import kept_rows, rows_in_force, state_payload, whole_states
from es_service.store.verify import verify


def digest_of(parts: Mapping[str, str]) -> str:
    lines = (f"{name}\0{sha256}\n" for name, sha256 in sorted(parts.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def digest_parts(folder: Path) -> dict[str, str]:
    """The SHA-256s of which the digest is made, by name. Raises StoreError if the run cannot be read.

    `state/<path>` is that of the arrays of a node of the state, `map` that of the behaviour map; policies are in them
    by their names, which are SHA-256s, too. `history` is that of the deterministic columns of the history,
    `evaluations` that of the evaluated centres.
    """
    with reading(folder) as (connection, meta):
        return _parts(folder, connection, meta)


def digest_at(folder: Path, generation: int) -> str | None:
    """Digest of the run after a generation; None if the state of that generation is not kept."""
    with reading(folder) as (connection, meta):
        kept = generation in whole_states(connection, kept_rows(connection))
        return digest_of(_parts(folder, connection, meta, generation)) if kept else None


def checked_parts(folder: Path) -> tuple[dict[str, str], bool]:
    """`digest_parts`, and whether the generations were computed on more than one platform, by the driver or by workers:
    both of one transaction, in which everything that is stored was checked against its SHA-256 before.

    Raises StoreError if the run cannot be read, or is damaged; the message names the damaged data.
    """
    with reading(folder) as (connection, meta):
        if damage := verify(connection, folder / DATABASE).damage:
            raise StoreError(
                f"{folder} is damaged: {damage}",
                run=folder,
                ways_out=[WayOut("resume", "continue from the newest intact generation", str(folder))],
            )
        newest = newest_generation(connection)
        platforms = [at for first, at in sound_platforms(connection) if newest is not None and first <= newest]
        return _parts(folder, connection, meta), is_mixed(platforms)


def _parts(folder: Path, connection: sqlite3.Connection, meta: RunMeta, until: int | None = None) -> dict[str, str]:
    """The parts as of a generation; None: of all that is stored."""
    try:
        history, evaluations = _history(connection, meta, until)
        return {**_state(connection, until), "history": history, "evaluations": evaluations}
    except ValueError as error:
        ways_out = [WayOut("resume", "repair it as far as possible", str(folder))]
        raise StoreError(f"{folder} has data that cannot be read: {error}", run=folder, ways_out=ways_out) from error


def _state(connection: sqlite3.Connection, until: int | None) -> dict[str, str]:
    newest = rows_in_force(kept_rows(connection), 2**63 if until is None else until)
    payloads = ((part, state_payload(connection, part, at)) for part, (at, _) in newest.items())
    parts = {part: name_of(decode_part(payload)).hex() for part, payload in payloads}
    of_map = {part: parts.pop(part) for part in [*parts] if part.startswith(MAP)}
    digests = {
        f"state/{path}": _together({block: parts[block] for block in blocks})
        for path, blocks in groupby(parts, lambda block: block.partition(BLOCK)[0])
    }
    return digests | ({"map": _together(of_map)} if of_map else {})


def _together(parts: Mapping[str, str]) -> str:
    """SHA-256 of several parts, from theirs."""
    return hashlib.sha256("".join(f"{part}\0{sha256}\n" for part, sha256 in parts.items()).encode()).hexdigest()


def _history(connection: sqlite3.Connection, meta: RunMeta, until: int | None) -> tuple[str, str]:
    """SHA-256s of the deterministic columns of the history, and of the evaluated centres."""
    columns = sorted((column for column in meta.columns if column.deterministic), key=lambda column: column.name)
    # Columns of the evaluated centres that do not count are the last ones.
    all_of_centre = meta.evaluation_columns
    of_centre = [column for column in all_of_centre if column.deterministic]
    total = hashlib.sha256(json.dumps([[column.name, column.type] for column in columns]).encode() + b"\n")
    centres = hashlib.sha256(column_bytes(of_centre) + b"\n")
    for row, _ in history_rows(connection, columns, check=False):
        if until is not None and row.generation > until:
            break
        total.update(row_bytes(row.row))
        evaluations = row.evaluations
        if len(of_centre) < len(all_of_centre):
            evaluations = leading_values(evaluations, len(of_centre), len(all_of_centre))
        centres.update(len(evaluations).to_bytes(8, "little") + evaluations)
    return total.hexdigest(), centres.hexdigest()
