"""The tables of `run.db`, and the description of the run. The table `meta` is the same in all schema versions."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from es_service.errors import StoreError
from es_service.loop.history import Column
from es_service.protocol.messages import TaskSpec
from es_service.store.codec import column_bytes, text_sha256
from es_service.store.facts import Damaged, RunFacts, column_problem, facts, require_form

SCHEMA = "schema_version"
"""Record of the table `meta` with the schema version."""
SCHEMA_VERSION = 8
EXTENDED_SCHEMA = 9
"""That of runs with metrics that a program has recorded, or with a certified policy that is stored under its name:
version 0.27 does not know the one, and would delete the other."""
READ_BY = {1: "0.1", 2: "0.1", 3: "0.5.0", 4: "0.6.0", 5: "0.12.0", 6: "0.25.0", 7: "0.25.0"}
"""Older schema version -> newest version of es-service that reads it."""
APPLICATION_ID = 0x45535256
"""Number in the header of the file, by which tools recognise the kind of a database."""
PAGE_BYTES = 8192
"""Size of a database page."""
GENERATION_TABLES = ("state", "history", "platform")
"""Tables whose rows belong to a generation; falling back to a generation deletes the newer rows of each table.

A new table of this kind must be added here. Its rows must be hashed into the history row of their generation, as those
of the state are; otherwise the loss of a row is not noticed. The table content has what rows of the state and of
certified policies name."""

_META = "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, sha256 TEXT NOT NULL) WITHOUT ROWID"
_STATE = (
    "CREATE TABLE state (part TEXT NOT NULL, generation INTEGER NOT NULL, sha256 TEXT NOT NULL, "
    "payload BLOB NOT NULL, PRIMARY KEY (part, generation)) WITHOUT ROWID"
)
_CONTENT = "CREATE TABLE content (name BLOB PRIMARY KEY NOT NULL, payload BLOB NOT NULL)"
_PLATFORM = "CREATE TABLE platform (generation INTEGER PRIMARY KEY, platform TEXT NOT NULL, sha256 TEXT NOT NULL)"
_CERTIFICATION = (
    "CREATE TABLE certification (number INTEGER NOT NULL, rank INTEGER NOT NULL, facts TEXT NOT NULL, "
    "payload BLOB NOT NULL, sha256 TEXT NOT NULL, PRIMARY KEY (number, rank)) WITHOUT ROWID"
)
METRICS = "CREATE TABLE metric (generation INTEGER PRIMARY KEY, named TEXT NOT NULL, sha256 TEXT NOT NULL)"
OWN_HISTORY_COLUMNS = {"evaluations": "BLOB", "state_sha256": "TEXT", "sha256": "TEXT"}
"""Columns of the table history besides those of the run: the evaluated centres (`rows.table_bytes`), the SHA-256 of
the state, and that of the row."""


@dataclass(frozen=True)
class RunMeta:
    """Description of a run, stored once when the run is created; loading turns tuples inside its dicts into lists."""

    run_id: str
    created: str
    """ISO time, UTC."""
    config: dict[str, Any]
    """Resolved config, as values that JSON can represent."""
    constants: dict[str, Any]
    """Settings that must not change on resume, as values that JSON can represent."""
    task: dict[str, Any]
    """The task's `TaskSpec` as a dict, so that the run can be read without the task's package."""
    columns: tuple[Column, ...]
    """Columns of the history, including `generation`."""
    evaluation_columns: tuple[Column, ...] = ()
    """Columns of the evaluated centres, without `generation`."""
    parent: dict[str, Any] | None = None
    """Run from which this one was forked or took its first centre: run id, folder, generation, digest. None if there is
    none."""
    given: dict[str, Any] | None = None
    """What `config` was resolved from: the values that the user gave, by dotted key. A fork resolves again what it
    changes of it. None for a run of an older version: all values of `config`."""

    @cached_property
    def heading(self) -> bytes:
        """The columns of the history, as they are hashed with each row."""
        return column_bytes(self.columns)


def table_statements(columns: Sequence[Column]) -> dict[str, str]:
    """Table name -> its CREATE TABLE statement."""
    own = ", ".join(f"{name} {kind} NOT NULL" for name, kind in OWN_HISTORY_COLUMNS.items())
    history = ", ".join(
        f"{quoted(column.name)} {column.type}" + (" PRIMARY KEY" if column.name == "generation" else "")
        for column in columns
    )
    return {
        "meta": _META,
        "state": _STATE,
        "content": _CONTENT,
        "history": f"CREATE TABLE history ({history}, {own})",
        "platform": _PLATFORM,
        "certification": _CERTIFICATION,
    }


def create_tables(connection: sqlite3.Connection, meta: RunMeta) -> None:
    """Create the tables of a run in an empty database and store its description. Raises StoreError if no table can have
    its columns."""
    if problem := column_problem(meta.columns, OWN_HISTORY_COLUMNS):
        raise StoreError(problem)
    connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    connection.execute("PRAGMA auto_vacuum = NONE")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        for statement in table_statements(meta.columns).values():
            connection.execute(statement)
        put_meta(connection, SCHEMA, str(SCHEMA_VERSION))
        put_meta(connection, "run", json.dumps(asdict(meta), sort_keys=True))


def put_meta(connection: sqlite3.Connection, key: str, value: str) -> None:
    """Store a record in the table `meta`, in place of the former one."""
    connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?, ?)", (key, value, text_sha256(key, value)))


def get_meta(connection: sqlite3.Connection, key: str) -> str | None:
    """The value of a record in the table `meta`, which `load_meta` has checked; None if there is none."""
    row = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
    return None if row is None else row[0]


def load_meta(connection: sqlite3.Connection, file: Path) -> RunMeta:
    """The description of the run, after its SHA-256 and its form were checked, and that the tables are those of a run:
    a view in place of one could take for ever.

    Raises:
        Damaged: the description is damaged or missing.
        StoreError: `file` has another schema version.
    """
    tables = dict(connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql NOT NULL"))
    if tables.get("meta", _META) != _META:
        raise Damaged("its table meta is not that of a run")
    rows = connection.execute("SELECT key, value, sha256 FROM meta").fetchall()
    for key, value, sha256 in rows:
        if text_sha256(str(key), str(value)) != sha256:
            raise Damaged(f"the record {key!r} in its table meta does not match its SHA-256")
    records = {key: value for key, value, _ in rows}
    version = facts(records.get(SCHEMA, "0"), int, "its schema version")
    if version > EXTENDED_SCHEMA:
        raise StoreError(
            f"{file} has schema version {version}; this version of es-service supports versions up to "
            f"{EXTENDED_SCHEMA}. Upgrade es-service to read or continue the run."
        )
    if version < 1 or "run" not in records:
        raise Damaged("the records 'schema_version' and 'run' in its table meta are missing or wrong")
    if version < SCHEMA_VERSION:
        raise StoreError(
            f"{file} was written by an older version of es-service; use version {READ_BY[version]} to read or continue "
            f"it (its schema version is {version}, and this version of es-service supports {SCHEMA_VERSION})"
        )
    fields = facts(records["run"], RunFacts, "its description of the run", has_paths=True)
    require_form(fields["task"], TaskSpec, "its description of the task")
    columns = {name: tuple(Column(**column) for column in fields[name]) for name in ("columns", "evaluation_columns")}
    meta = RunMeta(**fields | columns)
    if tables.pop("metric", METRICS) != METRICS or tables != table_statements(meta.columns):
        raise Damaged("its tables are not those of a run")
    return meta


def quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
