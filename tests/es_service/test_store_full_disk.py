"""Full disks: the run stops with a message, loses nothing, and continues when there is space."""

import contextlib
import os
import shutil
import sqlite3
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from es_service.errors import StoreError
from es_service.loop.state import Generation
from es_service.store.folder import explained
from es_service.store.reader import read_history, read_parts
from es_service.store.writer import RunStore
from tests.es_service.store_examples import (
    advance,
    assert_same_history,
    assert_same_state,
    assert_sound,
    create,
    history_row,
    state_at,
)


def test_a_full_database_stops_the_commit_and_keeps_the_rest(tmp_path):
    folder = tmp_path / "run"
    with create(folder, generations=3) as run:
        connection = run._connection
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")
        big = {"centre_0": {"centre_D": np.zeros(100_000, np.float32)}}
        with pytest.raises(StoreError, match=r"disk full while storing generation 3 .* free space\.\n.* resume\("):
            run.commit([Generation(3, big, history_row(3))])
        assert run.generation == 2
        assert_same_state(run.load(), state_at(2))
        connection.execute("PRAGMA max_page_count = 1000000")
        advance(run, 3)
    assert_sound(folder, 3)


def fill(disk):
    """Leave not a byte of space."""
    ballast = os.open(disk / "ballast", os.O_WRONLY | os.O_CREAT)
    with contextlib.suppress(OSError):
        while True:
            os.write(ballast, bytes(4096))
    os.close(ballast)
    assert shutil.disk_usage(disk).free == 0


def test_a_full_disk_stops_the_run_which_continues_when_there_is_space(small_disk):
    folder = small_disk / "run"
    with create(folder, generations=2) as run:
        with pytest.raises(StoreError, match="disk full while storing generation"):
            advance(run, 2000)
        reached = run.generation
        assert 2 < reached < 1999
        assert_same_state(run.load(), state_at(reached))
    assert_same_history(read_history(folder), reached + 1)
    fill(small_disk)
    with pytest.raises(StoreError, match="disk full"), RunStore.open(folder) as run:
        advance(run, reached + 100)
    assert_same_state(read_parts(folder)[1], state_at(reached))
    (small_disk / "ballast").unlink()
    subprocess.run(["mount", "-o", "remount,size=8m", str(small_disk)], check=True)
    with RunStore.open(folder) as run:
        assert run.notices == []
        assert run.generation == reached
        advance(run, reached + 3)
    assert_sound(folder, reached + 3)


@pytest.mark.parametrize(("free", "full"), [(0, True), (10**9, False)])
def test_an_io_error_without_space_is_a_full_disk(tmp_path, monkeypatch, free, full):
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR_SHMSIZE
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free))
    assert ("disk full" in str(explained(error, tmp_path, "testing"))) is full


def test_no_space_for_what_sqlite_needs_beside_the_log_of_a_killed_run_is_no_damage(small_disk):
    """Its shared memory, without which a log cannot be read. The log itself has all generations."""
    folder, killed = small_disk / "run", small_disk / "killed"
    with create(folder, generations=3):
        shutil.copytree(folder, killed, ignore=shutil.ignore_patterns("*-shm"))
    fill(small_disk)
    for use in (RunStore.open, read_history):
        with pytest.raises(StoreError, match=r"disk full while .* Everything stored before is safe; free space"):
            use(killed)
    (small_disk / "ballast").unlink()
    assert_sound(killed, 2)


def test_creating_a_run_on_a_full_disk_says_so(small_disk):
    fill(small_disk)
    with pytest.raises(StoreError, match=r"disk full while .* free space, then try again"):
        create(small_disk / "run")
    assert [path.name for path in small_disk.iterdir()] == ["ballast"]
