"""What a run stores beside its history and its state: the arrays with which it began, its platforms, metrics that a
program has recorded, and certified policies.

Platforms are a row for each generation from which on another one computes the run. Metrics are numbers by name, of a
generation that is stored already. They are no columns of the table `history`, since their names are known only when
they come, and outside the digest, since the next session may record others. A run gets their table, and a schema
version of its own, with the first ones.

A certification is a few rows that are added together: values of policies in fresh episodes, outside the digest, and the
names of the policies. Rows are never changed, belong to no generation, and are not copied by a fork. A policy that a
row names is stored as long as the row.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import sqlite3
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import StringConstraints

from es_service.loop.history import METRIC
from es_service.protocol.content import Contents
from es_service.protocol.episodes import NAME_OF_METRIC
from es_service.store.codec import Part, decode_part, encode_part, text_sha256
from es_service.store.facts import Damaged, Finite, Natural, Platform, facts, require_form
from es_service.store.rows import Columns
from es_service.store.schema import EXTENDED_SCHEMA, METRICS, SCHEMA, get_meta, put_meta

START = "start"
"""Key of the start in the table `meta`."""
_PLATFORM_LIST = "platforms"
"""Key of the list of the rows' generations in the table `meta`, by which the loss of a row is noticed. Older versions
neither store nor read it."""
_MetricsByName = dict[Annotated[str, StringConstraints(pattern=f"^{NAME_OF_METRIC}$")], Finite]
CERTIFICATIONS = "certifications"
"""Key of a run's `RunMeta.parent`: number of the next certification of the parent when this run began."""
_REMOVED_FACTS = ""
"""Facts of a row that was damaged."""
CertifiedKey = tuple[int, int]
"""(number of a certification of the run, from 0; rank in it)."""


def record_platform(connection: sqlite3.Connection, generation: int, platform: dict[str, Any]) -> bool:
    """Record the platform of a generation and of those after it, in place of the records of these generations.

    Returns:
        Whether the platform differs from that of the generations before, or is the first.
    """
    connection.execute("DELETE FROM platform WHERE generation >= ?", (generation,))
    text = json.dumps(platform, sort_keys=True)
    if json.loads(text) == platform_before(connection, generation):
        return False
    row = (generation, text, text_sha256(f"platform {generation}", text))
    connection.execute("INSERT INTO platform (generation, platform, sha256) VALUES (?, ?, ?)", row)
    return True


def platform_before(connection: sqlite3.Connection, generation: int) -> dict[str, Any] | None:
    """The platform of the generation before this one; None if none is recorded."""
    query = "SELECT platform FROM platform WHERE generation < ? ORDER BY generation DESC LIMIT 1"
    row = connection.execute(query, (generation,)).fetchone()
    return None if row is None else json.loads(row[0])


def store_platform_list(connection: sqlite3.Connection) -> None:
    """Store the list of all rows, together with the first generation of the newest one.

    Not earlier: an older version of es-service may still compute that generation instead, and deletes the row.
    """
    recorded = connection.execute("SELECT generation FROM platform ORDER BY generation")
    put_meta(connection, _PLATFORM_LIST, json.dumps([at for (at,) in recorded]))


def sound_platforms(connection: sqlite3.Connection) -> list[tuple[int, dict[str, Any]]]:
    """Recorded platforms as (first generation, platform), in order. Raises Damaged if a record does not match its
    SHA-256, or is missing."""
    platforms: dict[int, dict[str, Any]] = {}
    for at, text, sha256 in connection.execute("SELECT generation, platform, sha256 FROM platform ORDER BY generation"):
        if text_sha256(f"platform {at}", text) != sha256:
            raise Damaged(f"the platform recorded at generation {at} does not match its SHA-256")
        platforms[at] = facts(text, Platform, f"the platform recorded at generation {at}")
    newest = connection.execute("SELECT max(generation) FROM history").fetchone()[0]
    listed = facts(get_meta(connection, _PLATFORM_LIST) or "[]", list[int], "the list of its platforms")
    for at in [] if newest is None else listed:
        # The row of a generation that was lost, and is not computed again yet, was deleted with it.
        if at <= newest and at not in platforms:
            raise Damaged(f"the platform recorded at generation {at} is missing")
    return [*platforms.items()]


def load_start(connection: sqlite3.Connection) -> dict[str, NDArray[Any]] | None:
    """`Beginning.start` from a verified database; None if there is none. Raises Damaged if it has no arrays."""
    text = get_meta(connection, START)
    try:
        return None if text is None else decode_part(base64.b64decode(text))
    except ValueError as error:
        raise Damaged(f"the policy from which it started cannot be read: {error}") from error


def record_metrics(connection: sqlite3.Connection, generation: int, named: Mapping[str, float]) -> None:
    """Store the metrics of a generation, in place of those that it has; what is not finite is left out."""
    if not has_metrics(connection):
        connection.execute(METRICS)
        put_meta(connection, SCHEMA, str(EXTENDED_SCHEMA))
    text = json.dumps({name: float(value) for name, value in named.items() if math.isfinite(value)}, sort_keys=True)
    row = (generation, text, text_sha256(f"metric {generation}", text))
    connection.execute("INSERT OR REPLACE INTO metric (generation, named, sha256) VALUES (?, ?, ?)", row)


def stored_metrics(
    connection: sqlite3.Connection, first: int = 0, limit: int | None = None
) -> tuple[dict[int, dict[str, float]], list[int]]:
    """Metrics by generation, in the order of generations, and the generations whose metrics are damaged.

    Args:
        first: generation of the first ones.
        limit: greatest number of generations from it on; None for all.
    """
    found: dict[int, dict[str, float]] = {}
    damaged: list[int] = []
    if not has_metrics(connection):
        return found, damaged
    columns = "generation, CAST(named AS BLOB), CAST(sha256 AS BLOB)"  # a damaged text may be no UTF-8
    query = f"SELECT {columns} FROM metric WHERE generation >= ? AND generation < ? ORDER BY generation"
    for at, named, sha256 in connection.execute(query, (first, 2**62 if limit is None else first + limit)):
        try:
            text = named.decode()
            if text_sha256(f"metric {at}", text).encode() != sha256:
                raise Damaged("they do not match their SHA-256")
            found[at] = facts(text, _MetricsByName, "its metrics")
        except (Damaged, TypeError, AttributeError, UnicodeDecodeError):
            damaged.append(at)
    return found, damaged


def sound_metrics(
    connection: sqlite3.Connection, first: int = 0, limit: int | None = None
) -> dict[int, dict[str, float]]:
    """The first that `stored_metrics` returns. Raises Damaged if some are damaged."""
    found, damaged = stored_metrics(connection, first, limit)
    if damaged:
        raise Damaged(f"the metrics recorded at generation {damaged[0]} are damaged")
    return found


def metric_values(named: Mapping[str, float]) -> dict[str, float]:
    """Metrics of a generation as values by column."""
    return {f"{METRIC}{name}": value for name, value in named.items()}


def metric_columns(found: Mapping[int, Mapping[str, float]], generation_G: np.ndarray) -> Columns:
    """Metrics as columns beside those of a history with these generations; NaN stands for no value."""
    names = sorted({name for named in found.values() for name in named})
    values = [found.get(int(generation), {}) for generation in generation_G] if names else []
    return {f"{METRIC}{name}": np.array([named.get(name, np.nan) for named in values]) for name in names}


def remove_metrics(connection: sqlite3.Connection, newest: int) -> None:
    """Delete damaged metrics, and those of generations after `newest`."""
    if has_metrics(connection):
        connection.execute("DELETE FROM metric WHERE generation > ?", (newest,))
        connection.executemany(
            "DELETE FROM metric WHERE generation = ?", [(at,) for at in stored_metrics(connection)[1]]
        )


def has_metrics(connection: sqlite3.Connection) -> bool:
    """Whether the run has their table."""
    return connection.execute("SELECT count(*) FROM sqlite_schema WHERE name = 'metric'").fetchone()[0] > 0


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
    contents: Contents = field(default_factory=dict)
    """What the arrays name, where it was read."""


def row_name(number: int, rank: int) -> tuple[str, int]:
    """What a row is called beside rows of the state, in `states.Named`."""
    return f"{CERTIFICATIONS}/{rank}", number


def insert_certification(
    connection: sqlite3.Connection, number: int, policies: Iterable[tuple[Mapping[str, Any], Part]]
) -> None:
    """Store a certification: (facts, arrays) of each policy in the order of rank."""
    for rank, (known, arrays) in enumerate(policies):
        text, payload = json.dumps(known, sort_keys=True), encode_part(arrays)
        row = (number, rank, text, payload, _certified_sha256(number, rank, text, payload))
        connection.execute("INSERT INTO certification VALUES (?, ?, ?, ?, ?)", row)


def next_certified_number(connection: sqlite3.Connection, parent: Mapping[str, Any] | None) -> int:
    """Number after the greatest one that has been stored, removed rows included.

    That of a fork begins after those of its parent, whose episodes may have decided about it.

    Args:
        parent: `RunMeta.parent`.
    """
    stored = connection.execute("SELECT coalesce(max(number) + 1, 0) FROM certification").fetchone()[0]
    return max(stored, (parent or {}).get(CERTIFICATIONS, 0))


def certified_rows(
    connection: sqlite3.Connection, newest: Callable[[Mapping[str, Any]], bool] | None = None, holding: str = ""
) -> list[tuple[CertifiedKey, CertifiedRow | None]]:
    """The rows that were not removed, in the order of number and rank; None for the content of a damaged one.

    Args:
        newest: facts of a row -> whether it is wanted; then only the rows of the newest certification that has wanted
            or damaged ones.
        holding: a text that the facts of a row must have as JSON; the payload of others is not read.
    """
    row_list: list[tuple[CertifiedKey, CertifiedRow | None]] = []
    query = "SELECT number, rank, facts, payload, sha256 FROM certification WHERE ? = '' OR instr(facts, ?)"
    order = f"ORDER BY number {'DESC' if newest else ''}, rank"
    for number, rank, text, payload, sha256 in connection.execute(f"{query} {order}", (holding, holding)):
        if newest and row_list and row_list[0][0][0] != number:
            break
        if not isinstance(payload, bytes) or _certified_sha256(number, rank, text, payload) != sha256:
            row_list.append(((number, rank), None))
        elif text != _REMOVED_FACTS:
            try:
                require_form((number, rank), tuple[Natural, Natural], "its number and rank")
                row = CertifiedRow(number, rank, facts(text, dict[str, Any], "its facts"), decode_part(payload))
            except (Damaged, ValueError):
                row = None
            if row is None or newest is None or newest(row.facts):
                row_list.append(((number, rank), row))
    return row_list


def remove_certified(connection: sqlite3.Connection, keys: Iterable[CertifiedKey]) -> None:
    """Empty damaged rows. Their numbers remain, since another certification with one would have the same episodes."""
    for number, rank in keys:
        connection.execute(
            "UPDATE certification SET facts = ?, payload = ?, sha256 = ? WHERE number IS ? AND rank IS ?",
            (_REMOVED_FACTS, b"", _certified_sha256(number, rank, _REMOVED_FACTS, b""), number, rank),
        )


def _certified_sha256(number: object, rank: object, facts: object, payload: bytes) -> str:
    """SHA-256 of a row, over all of its values."""
    digest = hashlib.sha256(f"certification\0{number}\0{rank}\0{facts}\0".encode())
    digest.update(payload)
    return digest.hexdigest()
