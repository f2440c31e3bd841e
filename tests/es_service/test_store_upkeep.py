"""Closing, verified copies, and network file systems."""

import os
import shutil
import sqlite3
import tempfile
from pathlib import Path

import pytest

from es_service.errors import StoreError
from es_service.store import folder as run_folder
from es_service.store import reader
from es_service.store import repair as store_repair
from es_service.store import rows as store_rows
from es_service.store import upkeep as store_upkeep
from es_service.store import writer as store
from es_service.store.folder import is_network_filesystem
from es_service.store.reader import read_generation, read_history, read_parts
from es_service.store.writer import RunStore
from tests.es_service.store_examples import (
    advance,
    assert_same_history,
    assert_same_state,
    copy_at_every_commit,
    create,
    finished,
    flip_bit,
    position_of,
    state_at,
    without_root_rights,
)


def test_a_clean_end_leaves_one_file_that_a_read_only_folder_can_hold(tmp_path):
    with tempfile.TemporaryDirectory() as parent:
        os.chmod(parent, 0o755)
        folder = finished(Path(parent) / "run", 4)
        assert (folder / "run.db").read_bytes()[18:20] == b"\x01\x01"
        assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "run.db", "run.lock"]
        os.chmod(folder, 0o555)
        for path in folder.iterdir():
            os.chmod(path, 0o444)
        with without_root_rights():
            assert_same_history(read_history(folder), 4)
            assert_same_state(read_parts(folder)[1], state_at(3))
            with pytest.raises(StoreError, match="Permission denied"):
                RunStore.open(folder)
        assert len(list(folder.iterdir())) == 3
        os.chmod(folder, 0o755)


def test_a_disk_without_a_write_ahead_log_is_told_and_gets_synchronous_commits(tmp_path, monkeypatch):
    """SQLite's locking by files has no shared memory, as on some disks that containers share."""
    folder = tmp_path / "run"
    create(folder, generations=1).close()

    def connect(file):
        return sqlite3.connect(f"{file.as_uri()}?vfs=unix-dotfile", uri=True, isolation_level=None)

    monkeypatch.setattr(store_repair, "connect", connect)
    with RunStore.open(folder) as run:
        (notice,) = run.notices
        assert notice == f"{folder}/run.db: SQLite cannot use a write-ahead log on this disk; its journal is delete"
        full = 2
        assert run._connection.execute("PRAGMA synchronous").fetchone() == (full,)
        advance(run, 5)
    monkeypatch.undo()
    assert_same_history(read_history(folder), 6)
    with RunStore.open(folder) as run:
        assert (run.generation, run.notices) == (5, [])
        assert run._connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_write_ahead_log_that_stays_on_a_network_is_refused(tmp_path, monkeypatch):
    class Stubborn(sqlite3.Connection):
        """Answers that its journal is what it was before."""

        def execute(self, sql, *values):
            return super().execute("SELECT 'wal'" if sql == "PRAGMA journal_mode = delete" else sql, *values)

    create(tmp_path / "run", generations=1).close()
    monkeypatch.setattr(store, "is_network_filesystem", lambda folder: True)
    monkeypatch.setattr(
        store_repair, "connect", lambda file: sqlite3.connect(file, isolation_level=None, factory=Stubborn)
    )
    with pytest.raises(StoreError, match="uses the journal wal instead of delete"):
        RunStore.open(tmp_path / "run")


def test_a_reader_that_holds_on_does_not_fail_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(store_upkeep, "_CLOSE_PATIENCE_S", 0.05)
    folder = tmp_path / "run"
    run = create(folder, generations=3)
    with reader.reading(folder) as (connection, _):
        assert connection.execute("SELECT count(*) FROM history").fetchone() == (3,)
        run.close()
    assert_same_history(read_history(folder), 3)
    with RunStore.open(folder) as run:
        assert (run.generation, run.notices) == (2, [])
    assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "run.db", "run.lock"]


def test_the_copy_is_a_verified_single_file_refreshed_when_it_is_time(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    with create(folder, generations=3) as run:
        assert not (folder / "run.db.copy").exists()
        copy_at_every_commit(monkeypatch)
        run.upkeep.copy_interval_s = 0.0
        advance(run, 4)
        assert not list(folder.glob("run.db.copy.*"))
        assert (folder / "run.db.copy").read_bytes()[18:20] == b"\x01\x01"
        run.upkeep.copy_interval_s = 1000.0
        advance(run, 6)
    (folder / "run.db").unlink()
    with RunStore.open(folder) as run:
        assert run.generation == 4
        assert any("missing" in notice and "generation 4" in notice for notice in run.notices)


@pytest.mark.parametrize("former", ["sound", "text", "another run", "not UTF-8", "missing"])
def test_a_copy_checks_only_rows_that_the_former_one_has_not(tmp_path, monkeypatch, former):
    """Each time all of a long run would keep its driver from its workers. Damage is noticed: test_store_damage."""
    checked: list[int] = []
    sound = store_rows.row_is_sound

    def counted(columns, row, *stored):
        checked.append(row[0])
        return sound(columns, row, *stored)

    copy_at_every_commit(monkeypatch)
    copy = tmp_path / "run" / "run.db.copy"
    with create(tmp_path / "run", generations=20) as run:
        if former == "text":
            copy.write_text("no database" * 1000)
        elif former == "another run":
            shutil.copy(finished(tmp_path / "other", 20, seed=1) / "run.db", copy)
        elif former == "not UTF-8":  # which SQLite quotes in its message
            flip_bit(copy, position_of(copy, b"BLE meta"), bit=7)
        elif former == "missing":
            copy.unlink()
        monkeypatch.setattr(store_rows, "row_is_sound", counted)
        advance(run, 20)
        assert checked == (list(range(18, 21)) if former == "sound" else list(range(21)))
        assert run.notices == []
    copy.replace(tmp_path / "run" / "run.db")
    assert_same_history(read_history(tmp_path / "run"), 21)


def test_a_young_copy_of_an_earlier_session_is_not_refreshed_at_once(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        copy_at_every_commit(patch)
        finished(folder, 2)
    made = (folder / "run.db.copy").stat().st_mtime
    with RunStore.open(folder) as run:
        advance(run, 2)
        assert (folder / "run.db.copy").stat().st_mtime == made
    os.utime(folder / "run.db.copy", (0, made - store_upkeep.LOCAL_COPY_INTERVAL_S))
    with RunStore.open(folder) as run:
        advance(run, 3)
        assert (folder / "run.db.copy").stat().st_mtime > made


def test_a_copy_that_cannot_be_made_is_a_notice(tmp_path, monkeypatch):
    def full(connection, folder):
        raise OSError(28, "No space left on device")

    copy_at_every_commit(monkeypatch)
    monkeypatch.setattr(store_upkeep, "make_copy", full)
    with create(tmp_path / "run", generations=3) as run:
        assert run.generation == 2
        assert len(run.notices) == 1
        assert "disk full: could not refresh run.db.copy" in run.notices[0]


@pytest.fixture
def on_network(monkeypatch):
    for module in (store, reader):
        monkeypatch.setattr(module, "is_network_filesystem", lambda path: True)


@pytest.mark.usefixtures("on_network")
def test_on_a_network_there_is_no_wal_and_readers_read_the_copy(tmp_path):
    folder = tmp_path / "run"
    with create(folder) as run:
        assert read_generation(folder) is None
        assert run.upkeep.copy_interval_s == store_upkeep.NETWORK_COPY_INTERVAL_S == 10.0
        advance(run, 3)
        assert read_generation(folder) is None
        run.upkeep.copy_interval_s = run.upkeep._copy_seconds = 0.0
        advance(run, 4)
        assert read_generation(folder) == 4
        assert not (folder / "run.db-wal").exists()
        assert run._connection.execute("PRAGMA synchronous").fetchone() == (2,)
        run.upkeep.copy_interval_s = 1000.0
        advance(run, 5)
    assert read_generation(folder) == 5
    (folder / "run.db").unlink()
    with RunStore.open(folder) as run:
        assert run.generation == 5


@pytest.mark.usefixtures("on_network")
def test_on_a_network_the_copy_does_not_stand_in_for_a_damaged_run(tmp_path):
    """It may be of an earlier generation."""
    folder = tmp_path / "run"
    with create(folder, generations=3) as run:
        run.upkeep.copy_interval_s = 1000.0
        advance(run, 5)
    assert read_generation(folder) == 5
    for position in (0, position_of(folder / "run.db", b"CREATE TABLE meta")):
        flip_bit(folder / "run.db", position, bit=1)
        for read in (read_generation, read_history, read_parts):
            with pytest.raises(StoreError, match=r"not a (database|run folder)|malformed"):
                read(folder)
        flip_bit(folder / "run.db", position, bit=1)


MOUNTS = r"""
22 27 0:21 / / rw,relatime - ext4 /dev/vda rw
23 22 0:22 / /home rw shared:1 - nfs4 server:/home rw
24 22 0:23 / /home/local rw - xfs /dev/vdb rw
25 22 0:24 / /with\040space rw - fuse.sshfs me@host: rw
26 22 0:25 / /lake rw master:2 propagate_from:3 - lustre 10.0.0.1@tcp:/lake rw
27 22 0:26 / /over rw - nfs server:/a rw
28 22 0:27 / /over rw - tmpfs tmpfs rw
29 22 0:28 / /docker rw - fuse.fuse-overlayfs fuse-overlayfs rw
30 22 0:29 / /shared rw - 9p hostshare rw
31 22 0:30 / /windows rw - fuseblk /dev/sdb1 rw
"""


@pytest.mark.parametrize(
    ("path", "network"),
    [
        ("/runs/a", False),
        ("/home/me/runs/a", True),
        ("/homework", False),
        ("/home/local/a", False),
        ("/with space/a", True),
        ("/lake/a", True),
        ("/over/a", False),
        ("/docker/a", False),
        ("/shared/a", True),
        ("/windows/a", False),
    ],
)
def test_network_file_systems_are_told_by_their_type(path, network):
    assert is_network_filesystem(Path(path), MOUNTS) is network


def test_this_machines_mounts_can_be_read():
    assert is_network_filesystem(Path("/proc")) is False
    assert is_network_filesystem(Path("/"), "no mounts at all\n1 2 3 - \n") is False
    assert {"nfs", "nfs4", "cifs", "smb3", "lustre", "gpfs", "ceph", "9p", "afs"} <= run_folder.NETWORK_FILE_SYSTEMS
