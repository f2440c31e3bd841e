"""Reading beside a writer, of what is kept, and of what is no run."""

import contextlib
import os
import re
import shutil
import sqlite3
import tempfile
from pathlib import Path

import pytest

from es_service.errors import StoreError
from es_service.store import reader
from es_service.store.reader import (
    read_generation,
    read_history,
    read_meta,
    read_newest,
    read_parts,
    read_platforms,
)
from es_service.store.schema import put_meta
from es_service.store.writer import RunStore
from tests.database import database, execute
from tests.es_service.store_examples import (
    advance,
    assert_same_history,
    assert_same_state,
    create,
    finished,
    state_at,
    verify_run,
    without_root_rights,
)


def test_readers_follow_a_writer(tmp_path):
    folder = tmp_path / "run"
    with create(folder) as run:
        assert read_history(folder) == []
        assert read_newest(folder) is None
        with pytest.raises(StoreError, match="no generation yet"):
            read_parts(folder)
        for generation in range(5):
            advance(run, generation)
            assert read_generation(folder) == generation
            assert_same_history(read_history(folder), generation + 1)
            assert [row["generation"] for row in read_history(folder, 3)] == list(range(3, generation + 1))
            assert [row["generation"] for row in read_history(folder, 1, limit=2)] == [1, 2][:generation]
            assert read_newest(folder) == pytest.approx(read_history(folder)[-1], nan_ok=True)
            assert_same_state(read_parts(folder)[1], state_at(generation))


def test_a_generation_that_is_not_kept_is_refused_with_those_that_are(tmp_path):
    folder = finished(tmp_path / "run", 6)
    for generation in (0, 3, 6, -1):
        with pytest.raises(StoreError, match=rf"state of generation {generation}; .* states of generations \[4, 5\]"):
            read_parts(folder, generation)


def test_readers_change_nothing(tmp_path):
    folder = finished(tmp_path / "run", 3)
    before = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}
    read_meta(folder), read_history(folder), read_parts(folder), read_platforms(folder), verify_run(folder)
    assert {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()} == before


def test_what_is_no_run_folder_is_called_that(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "other").mkdir()
    for content, name in ((b"not a database" * 100, "text"), (b"", "empty")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.db").write_bytes(content)
    (tmp_path / "foreign").mkdir()
    execute(tmp_path / "foreign", "CREATE TABLE a (b)")
    for name in ("file", "other", "missing", "text", "empty", "foreign"):
        for use in (RunStore.open, read_meta, read_history, read_parts):
            with pytest.raises(StoreError, match="not a run folder"):
                use(tmp_path / name)
    assert not (tmp_path / "other" / "run.lock").exists()


def test_a_folder_of_runs_is_not_a_run_folder_but_its_runs_are_named(tmp_path):
    for name, named in (("a", f"contains the run folder {tmp_path / 'a'}"), ("b", "contains 2 run folders, such as")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.db").touch()
        with pytest.raises(StoreError, match=f"not a run folder, but {re.escape(named)}"):
            read_meta(tmp_path)


def test_a_log_that_cannot_be_opened_is_no_damage(tmp_path):
    """That of a killed run, in a folder in which nothing may be made: SQLite needs a file of its own beside the log."""
    with tempfile.TemporaryDirectory() as parent:
        os.chmod(parent, 0o755)
        with create(Path(parent) / "run", generations=3):
            folder = shutil.copytree(
                Path(parent) / "run", Path(parent) / "killed", ignore=shutil.ignore_patterns("*-shm")
            )
        os.chmod(folder, 0o555)
        with without_root_rights(), pytest.raises(StoreError, match=r"can be read and written, then .* a copy of"):
            read_history(folder)
        assert_same_history(read_history(shutil.copytree(folder, tmp_path / "copy")), 3)
        os.chmod(folder, 0o755)


def test_a_database_that_somebody_locks_is_no_damage(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "_BUSY_S", 0.0)
    folder = finished(tmp_path / "run", 3)
    with contextlib.closing(sqlite3.connect(folder / "run.db", isolation_level=None)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        with pytest.raises(StoreError, match=r"Another program has .*run\.db open; close that program, then"):
            read_history(folder)


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (10, r"schema version 10; .* versions up to 9\. Upgrade"),
        (1, r"use version 0\.1 to read or continue it .* is 1, .* es-service supports 8"),
    ],
)
def test_another_schema_version_names_both_and_says_what_to_use(tmp_path, version, message):
    folder = finished(tmp_path / "run", 1)
    with database(folder / "run.db") as connection:
        put_meta(connection, "schema_version", str(version))
    for use in (RunStore.open, read_meta, read_history):
        with pytest.raises(StoreError, match=message):
            use(folder)


def test_history_that_ends_before_the_state_is_noticed(tmp_path):
    """Damage to a page can make SQLite see fewer rows without an error."""
    folder = finished(tmp_path / "run", 6)
    execute(folder, "DELETE FROM history WHERE generation >= 4")
    for since in (None, 3, 4):
        with pytest.raises(StoreError, match="the history after generation 3 is missing"):
            read_history(folder, since)
    assert len(read_history(folder, 1, limit=3)) == 3, "those are there"
    with pytest.raises(StoreError, match="the history after generation 3 is missing"):
        read_history(folder, 1, limit=4)


def test_the_newest_row_is_checked_alone(tmp_path):
    """What says where a run stands must not take the longer the longer it has been running."""
    folder = finished(tmp_path / "run", 6)
    for generation, problem in ((2, None), (5, "the history row of generation 5 is damaged")):
        execute(folder, "UPDATE history SET seconds_rollout = 99 WHERE generation = ?", generation)
        with pytest.raises(StoreError, match=problem) if problem else contextlib.nullcontext():
            read_newest(folder)
    execute(folder, "DELETE FROM history WHERE generation = 5")
    with pytest.raises(StoreError, match="the history after generation 4 is missing"):
        read_newest(folder)
