"""Kills, damaged files and full disks: the run continues with the same bits, or says that it cannot."""

import contextlib
import os
import random
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from es_service import store, store_reader
from es_service.digest import digest, digest_parts
from es_service.errors import StoreError
from es_service.store import RunStore
from es_service.store_codec import encode_part
from es_service.store_reader import read_generation, read_history, read_parts, verify_run
from tests.es_service.store_examples import (
    advance,
    assert_same_history,
    assert_same_state,
    copy_at_every_commit,
    create,
    finished,
    flip_bit,
    history_row,
    parts_of,
    position_of,
    state_at,
)
from tests.es_service.store_killer import GENERATIONS

ROOT = Path(__file__).parents[2]


def killed(tmp_path, jobs):
    """Names of the jobs that were killed; the others ended by themselves, well."""
    program = subprocess.run(
        [sys.executable, "-m", "tests.es_service.store_killer", str(tmp_path)],
        input="".join(f"{' '.join(map(str, job))}\n" for job in jobs),
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        check=True,
        timeout=120,
    )
    ends = dict(line.split() for line in program.stdout.splitlines())
    assert set(ends.values()) <= {"killed", "0"}, program.stderr
    return {name for name, end in ends.items() if end == "killed"}


def assert_sound(folder, generation):
    """The run opens with exactly this generation and nothing to report; reading it before that gave the same."""
    assert_same_history(read_history(folder), generation + 1)
    if generation >= 0:
        assert_same_state(read_parts(folder)[1], state_at(generation))
    with RunStore.open(folder) as run:
        assert run.notices == []
        assert run.generation == (None if generation < 0 else generation)
        assert_same_state(run.load(), state_at(generation))


# Kills

# With 50,000 bytes a checkpoint follows generation 0 and every second one after it, give or take; what is committed
# does not depend on that.
KILLS = [
    *(("opened", count, -1) for count in (1,)),
    *((hook, count, count - 2) for hook in ("before_begin", "mid_transaction", "before_commit") for count in (1, 2, 5)),
    *(("after_commit", count, count - 1) for count in (1, 2, 6)),
]


def test_a_killed_writer_loses_the_generation_in_flight_and_nothing_else(tmp_path):
    jobs = [("hook", f"{hook}-{count}", hook, count) for hook, count, _ in KILLS]
    checkpoints = [
        (f"{hook}-{count}", hook, count) for hook in ("before_checkpoint", "after_checkpoint") for count in (1, 2)
    ]
    jobs += [("hook", *checkpoint) for checkpoint in checkpoints]
    assert killed(tmp_path, jobs) == {job[1] for job in jobs}
    expected_digest = digest(finished(tmp_path / "uninterrupted", GENERATIONS))
    for hook, count, generation in KILLS:
        assert_sound(tmp_path / f"{hook}-{count}", generation)
    reached = {name: read_generation(tmp_path / name) for name, _, _ in checkpoints}
    assert reached["before_checkpoint-1"] == reached["after_checkpoint-1"]
    assert reached["before_checkpoint-1"] < reached["before_checkpoint-2"] <= GENERATIONS - 1
    for name, generation in reached.items():
        assert_sound(tmp_path / name, generation)
    for _, name, _, _ in jobs:
        with RunStore.open(tmp_path / name) as run:
            advance(run, GENERATIONS - 1)
        assert digest(tmp_path / name) == expected_digest


def test_a_creation_killed_at_any_file_operation_can_be_continued_or_repeated(tmp_path):
    names = [f"{kind}-{count}" for kind in ("new", "existing") for count in range(1, 60)]
    for name in names:
        if name.startswith("existing"):
            (tmp_path / name).mkdir()
    died = killed(tmp_path, [("create", name, "-", name.split("-")[1]) for name in names])
    assert {"new-1", "new-10", "existing-1", "existing-10"} <= died < set(names)
    outcomes = set()
    for name in names:
        folder = tmp_path / name
        if (folder / "run.db").exists():
            outcomes.add(("resumed", name in died))
            with RunStore.open(folder) as run:
                assert run.generation is None
                assert (folder / "config.yaml").read_text() == "seed: 0\n"
                advance(run, 0)
        else:
            outcomes.add(("repeated", name in died))
            assert folder.exists() is name.startswith("existing")
            if folder.exists():
                with pytest.raises(StoreError, match="give the same command again"):
                    RunStore.open(folder)
            create(folder, generations=1).close()
        assert_sound(folder, 0)
        assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "run.db", "run.lock"]
    assert outcomes == {("resumed", True), ("repeated", True), ("resumed", False)}
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)


def test_a_repair_killed_at_any_file_operation_can_be_done_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        copy_at_every_commit(patch)
        finished(tmp_path / "whole", 3)
    with create(tmp_path / "left", generations=3, seed=1):
        log = (tmp_path / "left" / "run.db-wal").read_bytes()
    names = [f"open-{count}" for count in range(1, 60)]
    for name in names:
        shutil.copytree(tmp_path / "whole", tmp_path / name)
        # The log beside it would replay well: it must not be, into the copy.
        flip_bit(tmp_path / name / "run.db", 0)
        (tmp_path / name / "run.db-wal").write_bytes(log)
    died = killed(tmp_path, [("open", name, "-", name.split("-")[1]) for name in names])
    assert {"open-1", "open-10"} <= died < set(names)
    for name in names:
        with RunStore.open(tmp_path / name) as run:
            assert run.generation == 2
            assert_same_state(run.load(), state_at(2))
            assert len(run.notices) <= 1
        assert (tmp_path / name / "run.db.damaged").exists()
        assert not list((tmp_path / name).glob("run.db.restored*"))
        assert_sound(tmp_path / name, 2)


def test_on_a_network_a_killed_writer_loses_no_more(tmp_path, monkeypatch):
    for module in (store, store_reader):
        monkeypatch.setattr(module, "is_network_filesystem", lambda path: True)
    jobs = [job for job in KILLS if job[1] > 1]
    died = killed(tmp_path, [("network", f"{hook}-{count}", hook, count) for hook, count, _ in jobs])
    assert len(died) == len(jobs)
    for hook, count, generation in jobs:
        folder = tmp_path / f"{hook}-{count}"
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        # A journal to be rolled back sends readers to the copy, which here is as new.
        assert ("run.db-journal" in before) is (hook in ("mid_transaction", "before_commit"))
        assert_same_history(read_history(folder), generation + 1)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
        assert_sound(folder, generation)


# Damage


def test_a_damaged_newest_state_falls_back_one_generation(tmp_path):
    folder = finished(tmp_path / "run", 6)
    uninterrupted = digest(folder)
    payload = encode_part(parts_of(5)["observations"])
    flip_bit(folder / "run.db", position_of(folder / "run.db", payload) + len(payload) - 1)
    assert any("'observations' at generation 5" in problem for problem in verify_run(folder))
    with pytest.raises(StoreError, match="'observations' at generation 5 does not match"):
        read_parts(folder)
    with RunStore.open(folder) as run:
        assert len(run.notices) == 1
        assert "of generation 5, is damaged" in run.notices[0]
        assert "fell back to generation 4" in run.notices[0]
        assert run.generation == 4
        assert_same_state(run.load(), state_at(4))
        advance(run, 5)
    assert verify_run(folder) == []
    assert digest(folder) == uninterrupted


def test_a_damaged_newest_history_row_falls_back_one_generation(tmp_path):
    folder = finished(tmp_path / "run", 6)
    value = np.asarray(history_row(5)["centre_fitness_mean"], ">f8").tobytes()
    flip_bit(folder / "run.db", position_of(folder / "run.db", value) + 7)
    with pytest.raises(StoreError, match="history row of generation 5"):
        read_history(folder)
    with RunStore.open(folder) as run:
        assert "history row of generation 5" in run.notices[0]
        assert run.generation == 4
    assert_sound(folder, 4)


def test_a_damaged_older_state_is_cleared_away_and_costs_nothing(tmp_path):
    folder = finished(tmp_path / "run", 6)
    payload = encode_part(parts_of(4)["observations"])
    flip_bit(folder / "run.db", position_of(folder / "run.db", payload) + len(payload) - 1)
    assert_same_state(read_parts(folder)[1], state_at(5))
    with pytest.raises(StoreError, match="'observations' at generation 4 does not match"):
        read_parts(folder, 4)
    with RunStore.open(folder) as run:
        assert "newest generation, 5, is sound" in run.notices[0]
        assert run.generation == 5
    assert_sound(folder, 5)


def test_damage_that_falling_back_cannot_heal_takes_the_copy(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    with create(folder) as run, monkeypatch.context() as patch:
        copy_at_every_commit(patch)
        run.upkeep.copy_interval_s = 0.0
        advance(run, 3)
        run.upkeep.copy_interval_s = 1000.0
        advance(run, 9)
    value = np.asarray(history_row(6)["centre_fitness_mean"], ">f8").tobytes()
    flip_bit(folder / "run.db", position_of(folder / "run.db", value))
    damaged = (folder / "run.db").read_bytes()
    with RunStore.open(folder) as run:
        assert "history row of generation 6" in run.notices[0]
        assert "Restored run.db.copy, which reaches generation 3" in run.notices[0]
        assert "kept as run.db.damaged" in run.notices[0]
        assert run.generation == 3
        assert_same_state(run.load(), state_at(3))
    assert (folder / "run.db.damaged").read_bytes() == damaged
    assert_sound(folder, 3)


def test_without_anything_sound_the_run_is_refused_and_left_as_it_is(tmp_path, monkeypatch):
    copy_at_every_commit(monkeypatch)
    folder = finished(tmp_path / "run", 6)
    for name in ("run.db", "run.db.copy"):
        (folder / name).write_bytes((folder / name).read_bytes()[:5000])
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for _ in range(2):
        with pytest.raises(StoreError, match=r"Nothing in .* can be trusted"):
            RunStore.open(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (folder / "run.db.copy").unlink()
    with pytest.raises(StoreError, match=r"cannot be trusted, and there is no run.db.copy"):
        RunStore.open(folder)


def test_a_copy_of_damaged_content_does_not_replace_a_good_one(tmp_path, monkeypatch):
    copy_at_every_commit(monkeypatch)
    with create(tmp_path / "run", generations=4) as run:
        good = (tmp_path / "run" / "run.db.copy").read_bytes()
        run._connection.execute("UPDATE history SET env_steps = env_steps + 1 WHERE generation = 2")
        advance(run, 4)
        assert "could not refresh run.db.copy" in run.notices[0]
        assert (tmp_path / "run" / "run.db.copy").read_bytes() == good
        assert not list((tmp_path / "run").glob("run.db.copy.*"))


def test_a_state_row_that_vanished_is_not_replaced_by_an_older_one(tmp_path):
    folder = finished(tmp_path / "run", 6)
    with sqlite3.connect(folder / "run.db") as connection:
        connection.execute("DELETE FROM state WHERE part = 'observations' AND generation = 5")
    connection.close()
    with pytest.raises(StoreError, match="state of generation 5 is damaged"):
        read_parts(folder)
    with RunStore.open(folder) as run:
        assert run.generation == 4
        assert "fell back" in run.notices[0]


def test_swapped_columns_and_foreign_tables_are_noticed(tmp_path):
    folder = finished(tmp_path / "run", 6)
    with sqlite3.connect(folder / "run.db") as connection:
        connection.execute("ALTER TABLE history RENAME COLUMN goal_distance TO other")
    connection.close()
    for use in (RunStore.open, read_history):
        with pytest.raises(StoreError, match=r"not those of a run|no such column"):
            use(folder)


def damaged_at_random(folder, target, damage, with_copy):
    """Open and read one damaged run; what comes back is right, or an error. Returns what happened."""
    shutil.copytree(folder, target)
    newest = read_generation(folder)
    if not with_copy:
        (target / "run.db.copy").unlink()
    damage(target / "run.db")
    for read, check in (
        (lambda: read_history(target), lambda found: assert_same_history(found, newest + 1)),
        (lambda: read_parts(target)[1], lambda found: assert_same_state(found, state_at(newest))),
    ):
        try:
            found = read()
        except StoreError:
            continue
        check(found)
    try:
        run = RunStore.open(target)
    except StoreError:
        assert not with_copy
        return "refused"
    with run:
        assert_same_state(run.load(), state_at(run.generation))
        reached, notices = run.generation, run.notices
    assert reached == newest or notices
    assert_sound(target, reached)
    restored = any("Restored" in notice for notice in notices)
    shutil.rmtree(target)
    return "restored" if restored else "fell back" if reached < newest else "repaired" if notices else "unharmed"


@pytest.fixture(scope="module")
def run_with_copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("damage") / "run"
    with pytest.MonkeyPatch.context() as patch:
        copy_at_every_commit(patch)
        with create(folder, generations=8) as run:
            run.upkeep.copy_interval_s = 1000.0
            advance(run, 11)
    return folder


def test_a_bit_flipped_anywhere_never_gives_another_run(tmp_path, run_with_copy):
    rng = random.Random(0)
    size = (run_with_copy / "run.db").stat().st_size
    content = (run_with_copy / "run.db").read_bytes()
    # Half of them where the file is not empty: there are more zeros than data in so short a run.
    filled = [position for position in range(size) if content[position]]
    positions = [rng.randrange(size) for _ in range(60)] + rng.sample(filled, 120) + rng.sample(range(100), 40)
    outcomes = []
    for number, position in enumerate(positions):
        bit = rng.randrange(8)
        target = tmp_path / f"{number}-{position}-{bit}"
        damage = lambda file, position=position, bit=bit: flip_bit(file, position, bit)  # noqa: E731
        outcomes.append(damaged_at_random(run_with_copy, target, damage, with_copy=number % 3 == 0))
    counts = {outcome: outcomes.count(outcome) for outcome in sorted(set(outcomes))}
    assert counts.keys() == {"unharmed", "repaired", "fell back", "restored", "refused"}, counts


def test_a_file_cut_anywhere_never_gives_another_run(tmp_path, run_with_copy):
    size = (run_with_copy / "run.db").stat().st_size
    for number, length in enumerate([0, 1, 50, 100, 4096, 8192, 20_000, size // 2, size - 8192, size - 1]):
        for with_copy in (False, True):
            target = tmp_path / f"{number}-{length}-{with_copy}"
            damage = lambda file, length=length: os.truncate(file, length)  # noqa: E731
            expected = {"restored"} if with_copy else {"refused"}
            # A last page that was not in use may be cut off.
            expected |= {"unharmed"} if length >= size - 8192 else set()
            assert damaged_at_random(run_with_copy, target, damage, with_copy) in expected


def test_a_damaged_log_costs_generations_but_never_changes_them(tmp_path):
    with create(tmp_path / "run", generations=6):
        shutil.copytree(tmp_path / "run", tmp_path / "killed")
    log = (tmp_path / "killed" / "run.db-wal").read_bytes()
    assert len(log) > 90_000
    reached = set()
    for number, position in enumerate(random.Random(1).sample(range(len(log)), 25)):
        folder = tmp_path / str(number)
        shutil.copytree(tmp_path / "killed", folder)
        (folder / "run.db-shm").unlink()
        flip_bit(folder / "run.db-wal", position)
        with RunStore.open(folder) as run:
            generation = run.generation
            assert_same_state(run.load(), state_at(-1 if generation is None else generation))
            advance(run, 5)
        reached.add(generation)
        assert_sound(folder, 5)
    assert len(reached) > 2


# Full disks


def test_a_full_database_stops_the_commit_and_keeps_the_rest(tmp_path):
    folder = tmp_path / "run"
    with create(folder, generations=3) as run:
        connection = run._connection
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")
        big = {"member_0": {"centre_D": np.zeros(100_000, np.float32)}}
        with pytest.raises(
            StoreError, match=r"disk full while storing generation 3 .* free space, then `es-service resume"
        ):
            run.commit(3, big, history_row(3))
        assert run.generation == 2
        assert_same_state(run.load(), state_at(2))
        connection.execute("PRAGMA max_page_count = 1000000")
        advance(run, 3)
    assert_sound(folder, 3)


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"cannot mount a small disk: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


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


def test_creating_a_run_on_a_full_disk_says_so(small_disk):
    fill(small_disk)
    with pytest.raises(StoreError, match=r"disk full while .* free space, then give the same command again"):
        create(small_disk / "run")
    assert [path.name for path in small_disk.iterdir()] == ["ballast"]


def test_digest_parts_of_a_restored_run_equal_the_original(tmp_path, monkeypatch):
    copy_at_every_commit(monkeypatch)
    folder = finished(tmp_path / "run", 4)
    expected = digest_parts(folder)
    (folder / "run.db").write_bytes(b"gone")
    RunStore.open(folder).close()
    assert digest_parts(folder) == expected
