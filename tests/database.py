"""The database of a run, for tests that look into it or damage it behind the back of the store."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from es_service.store import certifications
from es_service.store.schema import put_meta


@contextmanager
def database(file: Path) -> Iterator[sqlite3.Connection]:
    """A connection in a transaction, which is committed at the end, or rolled back after an error; then it is closed,
    which a connection of SQLite is not by its own `with`."""
    with closing(sqlite3.connect(file)) as connection, connection:
        yield connection


def execute(folder: Path, statement: str, *values: object) -> list[tuple]:
    """The rows that a statement on a run's database gives."""
    with database(folder / "run.db") as connection:
        return connection.execute(statement, values).fetchall()


def as_0_23_wrote_it(folder: Path, **changed: object) -> None:
    """Change the database of a run that has ended by its first decision into what 0.23 wrote: one certification, whose
    facts do not say whether it decided, in schema version 6; `changed` are other facts of it."""
    with database(folder / "run.db") as connection:
        (_, decision), _ = certifications.rows(connection)
        assert decision is not None
        connection.execute("DELETE FROM certification")
        facts = {name: value for name, value in decision.facts.items() if name not in ("decides", "tries")} | changed
        certifications.insert(connection, decision.number, [(facts, decision.arrays)])
        put_meta(connection, "schema_version", "6")
