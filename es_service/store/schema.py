"""Tables of `run.db` and the record of what the run is. The table `meta` keeps its shape in every schema version."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from es_service.errors import StoreError
from es_service.loop.history import Column
from es_service.store.codec import text_sha256

SCHEMA_VERSION = 4
READ_BY = {1: "0.1", 2: "0.1", 3: "0.5.0"}
"""Older versions of the schema -> the newest es-service that reads them."""
APPLICATION_ID = 0x45535256
"""In the file's header, for tools that tell database files apart."""
PAGE_BYTES = 8192
GENERATION_TABLES = ("state", "history", "platform")
"""Tables whose rows carry a generation: falling back deletes the newer rows of each. Later tables go here; what they
gain in a generation must be hashed into its history row, as the state is, or a lost row goes unnoticed."""

_META = "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, sha256 TEXT NOT NULL) WITHOUT ROWID"
_STATE = (
    "CREATE TABLE state (part TEXT NOT NULL, generation INTEGER NOT NULL, sha256 TEXT NOT NULL, "
    "payload BLOB NOT NULL, PRIMARY KEY (part, generation)) WITHOUT ROWID"
)
_PLATFORM = "CREATE TABLE platform (generation INTEGER PRIMARY KEY, platform TEXT NOT NULL, sha256 TEXT NOT NULL)"
_OWN_HISTORY_COLUMNS = ("state_sha256", "sha256")


class Damaged(Exception):  # noqa: N818 (caught inside the store, which then says what it did about it)
    """A database file that cannot be trusted; the message says what is wrong with it."""


@dataclass(frozen=True)
class RunMeta:
    """What a run is. Written once, when it is created; comes back with lists for tuples inside the dicts."""

    run_id: str
    created: str
    """ISO time, UTC."""
    config: dict[str, Any]
    """The resolved config, JSON-able."""
    constants: dict[str, Any]
    """What may not change on resume, JSON-able."""
    task: dict[str, Any]
    """The task's `TaskSpec` as a dict, so that a run can be read where its task is not installed."""
    columns: tuple[Column, ...]
    """Of the history, `generation` among them."""
    parent: dict[str, Any] | None = None
    """The run this one was forked from, or took its first centre from: run id, folder, generation, digest."""


def meta_text(meta: RunMeta) -> str:
    """`meta` as JSON. Raises StoreError if its columns cannot be a table's."""
    names = [column.name.casefold() for column in meta.columns]
    twice = sorted({name for name in names if names.count(name) > 1})
    reserved = sorted(set(names) & set(_OWN_HISTORY_COLUMNS))
    if twice or reserved or ("generation", "INTEGER") not in [(column.name, column.type) for column in meta.columns]:
        raise StoreError(
            f"history columns: given twice {twice}, reserved {reserved}; an INTEGER column `generation` is needed"
        )
    return json.dumps(asdict(meta), sort_keys=True)


def meta_from_text(text: str) -> RunMeta:
    """The inverse of `meta_text`."""
    fields = json.loads(text)
    return RunMeta(**{**fields, "columns": tuple(Column(**column) for column in fields["columns"])})


def table_statements(columns: Sequence[Column]) -> dict[str, str]:
    """The CREATE TABLE statement of every table, by name."""
    own = ", ".join(f"{name} TEXT NOT NULL" for name in _OWN_HISTORY_COLUMNS)
    history = ", ".join(
        f"{quoted(column.name)} {column.type}" + (" PRIMARY KEY" if column.name == "generation" else "")
        for column in columns
    )
    return {
        "meta": _META,
        "state": _STATE,
        "history": f"CREATE TABLE history ({history}, {own})",
        "platform": _PLATFORM,
    }


def create_tables(connection: sqlite3.Connection, text: str) -> None:
    """Make an empty database that of a run, `text` being its `meta_text`."""
    connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    connection.execute("PRAGMA auto_vacuum = NONE")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute("BEGIN IMMEDIATE")
    for statement in table_statements(meta_from_text(text).columns).values():
        connection.execute(statement)
    for key, value in (("schema_version", str(SCHEMA_VERSION)), ("run", text)):
        connection.execute("INSERT INTO meta VALUES (?, ?, ?)", (key, value, text_sha256(key, value)))
    connection.execute("COMMIT")


def load_meta(connection: sqlite3.Connection, file: Path) -> RunMeta:
    """What the run is, checked. Raises Damaged, or StoreError if another version of this package wrote `file`."""
    rows = connection.execute("SELECT key, value, sha256 FROM meta").fetchall()
    for key, value, sha256 in rows:
        if text_sha256(str(key), str(value)) != sha256:
            raise Damaged(f"the record {key!r} of what the run is does not match its SHA-256")
    found = {key: value for key, value, _ in rows}
    version = int(found.get("schema_version", 0))
    if version > SCHEMA_VERSION:
        raise StoreError(
            f"{file} has schema version {version}; this es-service knows versions up to {SCHEMA_VERSION}. "
            f"Upgrade es-service to read or continue it."
        )
    if version < 1 or "run" not in found:
        raise Damaged("the record of what the run is is missing")
    if version < SCHEMA_VERSION:
        raise StoreError(
            f"{file} was written by an older es-service; version {READ_BY[version]} reads and continues it "
            f"(its schema version is {version}, this es-service reads {SCHEMA_VERSION})"
        )
    return meta_from_text(found["run"])


def history_insert(columns: Sequence[Column]) -> str:
    """The statement that stores a history row: values in the order of `columns`, then state_sha256, sha256."""
    names = [column.name for column in columns] + list(_OWN_HISTORY_COLUMNS)
    return f"INSERT INTO history ({', '.join(map(quoted, names))}) VALUES ({', '.join('?' * len(names))})"


def history_select(columns: Sequence[Column]) -> str:
    """Start of a query for history rows: values in the order of `columns`, then state_sha256, sha256."""
    # Qualified by the table, because SQLite takes a lone quoted name that is no column for a text.
    names = [column.name for column in columns] + list(_OWN_HISTORY_COLUMNS)
    return f"SELECT {', '.join(f'history.{quoted(name)}' for name in names)} FROM history"


def history_shared(columns: Sequence[Column], other: str) -> str:
    """The query for how many history rows the attached database `other` has just as this one has them."""
    names = map(quoted, [column.name for column in columns] + list(_OWN_HISTORY_COLUMNS))
    same = " AND ".join(f"ours.{name} IS theirs.{name}" for name in names)
    return f"SELECT count(*) FROM {other}.history AS theirs JOIN main.history AS ours ON {same}"


def quoted(name: str) -> str:
    """`name` as an SQL identifier."""
    return '"' + name.replace('"', '""') + '"'
