"""The database of a run, for tests that look into it or damage it behind the back of the store."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path


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
