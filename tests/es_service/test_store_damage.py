"""Damaged files: the run continues with the same bits, or says that it cannot."""

import errno
import os
import random
import shutil

import numpy as np
import pytest

from es_service.errors import StoreError
from es_service.protocol.content import name_of, names_in
from es_service.store import repair
from es_service.store import writer as store
from es_service.store.codec import encode_part
from es_service.store.digest import checked_parts, digest_parts
from es_service.store.reader import (
    connected_to,
    read_certifications,
    read_evaluations,
    read_generation,
    read_history,
    read_kept,
    read_parts,
    read_platforms,
)
from es_service.store.sound import read_sound
from es_service.store.writer import RunStore
from tests.database import database, execute
from tests.es_service.store_examples import (
    OTHER,
    advance,
    assert_policies,
    assert_same_history,
    assert_same_state,
    assert_sound,
    certified,
    contents_of,
    copy_at_every_commit,
    create,
    digest,
    evaluated,
    finished,
    flip_bit,
    history_row,
    parts_of,
    policy,
    position_of,
    state_at,
    verify_run,
)


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
        assert "of the newest generation, 5, is damaged" in run.notices[0]
        assert "fell back to generation 4" in run.notices[0]
        assert run.generation == 4
        assert_same_state(run.load(), state_at(4))
        advance(run, 5)
    assert verify_run(folder) == []
    assert digest(folder) == uninterrupted


def damage_policy(folder, generation, how):
    """Damage the policy that a generation has added, or delete it."""
    ((name, content),) = contents_of(generation).items()
    if how == "missing":
        execute(folder, "DELETE FROM content WHERE name = ?", name)
    else:
        payload = encode_part(content)
        flip_bit(folder / "run.db", position_of(folder / "run.db", payload) + len(payload) - 1)
    return name.hex()


@pytest.mark.parametrize("how", ["damaged", "missing"])
def test_a_damaged_policy_of_the_newest_state_falls_back_one_generation(tmp_path, how):
    folder = finished(tmp_path / "run", 6)
    uninterrupted = digest(folder)
    name = damage_policy(folder, 5, how)
    assert "state of 'map' at generation 5 names a content that is missing or damaged" in verify_run(folder)
    with pytest.raises(StoreError, match=f"{name}.*(does not match its name|, which its state names)"):
        read_parts(folder, named=lambda generation, parts: names_in(parts["map"]))
    with RunStore.open(folder) as run:
        (notice,) = run.notices
        assert "of the newest generation, 5, is damaged" in notice
        assert "names a content that is missing or damaged" in notice
        assert "fell back to generation 4" in notice
        assert_same_state(run.load(), state_at(4))
        assert_policies(folder, 4)
        advance(run, 5)
    assert_sound(folder, 5)
    assert digest(folder) == uninterrupted


def test_a_damaged_policy_that_two_states_name_takes_both(tmp_path):
    """That of generation 6 is still in a cell of generations 7 and 8; the next state that is kept is that of 4."""
    folder = kept_run(tmp_path / "run", 8)
    uninterrupted = digest(folder)
    damage_policy(folder, 6, "damaged")
    with RunStore.open(folder) as run:
        assert "generations 5 to 8 are not complete and intact" in run.notices[0]
        run.keep_every = 4
        assert_policies(folder, 4)
        advance(run, 8)
    assert_sound(folder, 8)
    assert digest(folder) == uninterrupted


def test_a_damaged_policy_of_an_older_state_costs_nothing(tmp_path):
    folder = kept_run(tmp_path / "run", 11)
    damage_policy(folder, 6, "damaged")
    with RunStore.open(folder) as run:
        assert "newest generation, 11, is intact" in run.notices[0]
    assert_sound(folder, 11)
    assert read_kept(folder)[1] == [0, 4, 10, 11]


def test_a_policy_that_nothing_names_is_deleted_and_said(tmp_path):
    folder = finished(tmp_path / "run", 6)
    content = policy(99)
    execute(folder, "INSERT INTO content VALUES (?, ?)", name_of(content), encode_part(content))
    with RunStore.open(folder) as run:
        assert f"the content {name_of(content).hex()} is named by nothing" in run.notices[0]
        assert run.generation == 5
    assert_sound(folder, 5)


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


def test_a_damaged_record_of_evaluated_centres_falls_back_one_generation(tmp_path):
    folder = finished(tmp_path / "run", 6)
    value = np.asarray(evaluated(5)[1]["fitness_mean"], "<f8").tobytes()
    flip_bit(folder / "run.db", position_of(folder / "run.db", value))
    with pytest.raises(StoreError, match="history row of generation 5"):
        read_evaluations(folder)
    with RunStore.open(folder) as run:
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
        assert "newest generation, 5, is intact" in run.notices[0]
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
        with pytest.raises(StoreError, match=r"Neither run\.db nor run\.db\.copy in .* can be used"):
            RunStore.open(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (folder / "run.db.copy").unlink()
    with pytest.raises(StoreError, match=r"cannot be used: .* There is no run\.db\.copy"):
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
    execute(folder, "DELETE FROM state WHERE part = 'observations' AND generation = 5")
    with pytest.raises(StoreError, match="state of generation 5 is damaged"):
        read_parts(folder)
    with RunStore.open(folder) as run:
        assert run.generation == 4
        assert "fell back" in run.notices[0]


def test_a_damaged_index_of_the_contents_is_noticed_and_made_again(tmp_path):
    folder = finished(tmp_path / "run", 6)
    uninterrupted, name = digest(folder), next(iter(contents_of(5)))
    content = (folder / "run.db").read_bytes()
    places = [at for at in range(len(content)) if content.startswith(name, at)]
    for place in places:
        (folder / "run.db").write_bytes(content)
        flip_bit(folder / "run.db", place + 20)
        assert verify_run(folder)
        with RunStore.open(folder) as run:
            assert len(run.notices) == 1
            advance(run, 5)
        assert_sound(folder, 5)
        assert digest(folder) == uninterrupted
    assert len(places) > 2, "the policy, its index, and the blocks that name it"


def test_a_certified_policy_stays_while_no_state_names_it(tmp_path):
    folder = tmp_path / "run"
    with create(folder, generations=1) as run:
        run.add_certification(*certified(OTHER, policy(0)))
        run.add_certification(*certified(OTHER))
        rows, contents = certified({"parameters_D": OTHER["parameters_D"] + 1})
        with pytest.raises(StoreError, match=f"certification 2 names {next(iter(contents)).hex()}, which nobody has"):
            run.add_certification(rows, {})
        advance(run, 11)
    assert_sound(folder, 11)
    uninterrupted = digest(folder)
    damage_states(folder, (11,))
    with RunStore.open(folder) as run:
        assert run.generation == 10
        assert np.array_equal(run.content(name_of(OTHER))["parameters_D"], OTHER["parameters_D"])
        advance(run, 11)
    assert_sound(folder, 11)
    assert digest(folder) == uninterrupted
    assert [[*row.contents] for row in read_certifications(folder)] == [
        [name_of(content)] for content in (OTHER, policy(0), OTHER)
    ]


@pytest.mark.parametrize("damage", ["DELETE FROM content", "UPDATE content SET payload = x'00'"])
def test_a_certification_whose_policy_is_damaged_goes_and_so_does_the_policy(tmp_path, damage):
    folder = tmp_path / "run"
    with create(folder, generations=1) as run:
        run.add_certification(*certified(OTHER))
        run.add_certification(*certified(policy(0)))
        advance(run, 3)
    execute(folder, f"{damage} WHERE name = x'{name_of(OTHER).hex()}'")
    with pytest.raises(StoreError, match=r"row 0 of certification 0 names the content|does not match its name"):
        read_certifications(folder)
    with RunStore.open(folder) as run:
        assert "row 0 of certification 0 is damaged" in run.notices[0]
        assert name_of(OTHER) not in run.contents()
        assert run.next_certification == 2
    assert_sound(folder, 3)
    assert [[*row.contents] for row in read_certifications(folder)] == [[name_of(policy(0))]]


def test_a_damaged_index_of_the_contents_loses_no_certification(tmp_path):
    folder, name, left = tmp_path / "run", name_of(OTHER), []
    with create(folder, generations=3) as run:
        run.add_certification(*certified(OTHER))
    content = (folder / "run.db").read_bytes()
    for place in [at for at in range(len(content)) if content.startswith(name, at)]:
        (folder / "run.db").write_bytes(content)
        flip_bit(folder / "run.db", place + 20)
        RunStore.open(folder).close()
        assert_sound(folder, 2)
        left.append(len(read_certifications(folder)))
    assert sorted(left) == [0, 0, 1], "its row, the policy, and the index of the policies"


def kept_run(folder, last, every=4):
    """A run that keeps states, and ended cleanly."""
    with create(folder) as run:
        run.keep_every = every
        advance(run, last)
    return folder


def damage_states(folder, generations):
    """Make the newest states unusable: a part that changes in every generation."""
    execute(
        folder, f"UPDATE state SET payload = x'00' WHERE part = 'observations' AND generation IN {(*generations, -1)}"
    )


def test_with_the_last_two_states_damaged_the_run_falls_back_to_the_newest_kept_one(tmp_path):
    folder = kept_run(tmp_path / "run", 11)
    uninterrupted, intact = digest(folder), (folder / "run.db").read_bytes()
    for damaged, reached in (((10, 11), 8), ((8, 10, 11), 4), ((0, 4, 10, 11), 8)):
        (folder / "run.db").write_bytes(intact)
        damage_states(folder, damaged)
        with RunStore.open(folder) as run:
            (notice,) = run.notices
            assert "'observations' at generation 11 does not match" in notice
            assert f"generations {reached + 1} to 11 are not complete and intact" in notice
            assert f"fell back to generation {reached}, the newest whose state is stored and intact" in notice
            assert run.generation == reached
            assert_same_state(run.load(), state_at(reached))
            run.keep_every = 4
            assert_same_history(read_history(folder), reached + 1)
            advance(run, 11)
        assert_sound(folder, 11)
        assert digest(folder) == uninterrupted
    assert read_kept(folder)[1] == [8, 10, 11]  # 0 and 4 were damaged


def test_a_damaged_history_row_falls_back_to_the_newest_kept_state_before_it(tmp_path):
    folder = kept_run(tmp_path / "run", 11)
    uninterrupted = digest(folder)
    execute(folder, "UPDATE history SET env_steps = 1 WHERE generation = 6")
    with RunStore.open(folder) as run:
        assert "fell back to generation 4" in run.notices[0]
        run.keep_every = 4
        advance(run, 11)
    assert digest(folder) == uninterrupted


def test_a_database_of_which_more_than_a_generation_would_be_deleted_is_kept(tmp_path):
    """One bad row can cost most of a run, the intact newest state included; also what is only in the log is kept."""
    folder = tmp_path / "killed"
    with create(tmp_path / "run") as run:
        run.keep_every = 10
        advance(run, 59)
        execute(tmp_path / "run", "UPDATE history SET sha256 = x'00' WHERE generation = 12")
        shutil.copytree(tmp_path / "run", folder)
    dump = _content(folder / "run.db")
    for _ in ("first", "again, when an earlier one is in its place"):
        with RunStore.open(folder) as run:
            assert run.generation == 10
            assert "the damaged database, with all generations, is kept as run.db.damaged" in run.notices[0]
        assert _content(folder / "run.db.damaged") == dump
        assert {path.name for path in folder.iterdir()} == {"config.yaml", "run.db", "run.db.damaged", "run.lock"}
        shutil.copy(folder / "run.db.damaged", folder / "run.db")

    folder = kept_run(tmp_path / "by one", 11)
    damage_states(folder, (11,))
    with RunStore.open(folder) as run:
        assert (run.generation, "run.db.damaged" in run.notices[0]) == (10, False)
    assert not (folder / "run.db.damaged").exists()


def test_a_database_that_cannot_be_kept_loses_no_generation(tmp_path, monkeypatch):
    folder = kept_run(tmp_path / "run", 11)
    execute(folder, "UPDATE history SET env_steps = 1 WHERE generation = 6")
    before = _content(folder / "run.db")

    def is_full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(repair, "sync_file", is_full)
        with pytest.raises(StoreError, match="full"):
            RunStore.open(folder)
    assert _content(folder / "run.db") == before
    assert not list(folder.glob("run.db.damaged*"))


def _content(file):
    """All rows of a database, as statements."""
    with database(file) as connection:
        return list(connection.iterdump())


def test_what_loses_fewer_generations_is_taken_a_kept_state_or_the_copy(tmp_path, monkeypatch):
    """Also the copy instead of one generation less; and never a copy that is damaged itself."""
    for copied, damaged, reached in ((6, (10, 11), 8), (9, (10, 11), 9), (8, (10, 11), 8), (11, (11,), 11)):
        folder = tmp_path / f"{copied} {len(damaged)}"
        with create(folder) as run, monkeypatch.context() as patch:
            copy_at_every_commit(patch)
            run.keep_every, run.upkeep.copy_interval_s = 4, 0.0
            advance(run, copied)
            run.upkeep.copy_interval_s = 1000.0
            advance(run, 11)
        uninterrupted = digest(folder)
        damage_states(folder, damaged)
        shutil.copytree(folder, tmp_path / "other")
        with RunStore.open(folder) as run:
            assert run.generation == reached
            assert ("Restored run.db.copy" in run.notices[0]) == (copied > 8)
            advance(run, 11)
        assert_sound(folder, 11)
        assert digest(folder) == uninterrupted
        flip_bit(tmp_path / "other" / "run.db.copy", 39)
        with RunStore.open(tmp_path / "other") as run:
            assert run.generation == (10 if damaged == (11,) else 8)
        shutil.rmtree(tmp_path / "other")


def test_a_history_row_that_vanished_is_noticed(tmp_path):
    folder = finished(tmp_path / "run", 6)
    execute(folder, "DELETE FROM history WHERE generation = 2")
    for use in (RunStore.open, read_history):
        with pytest.raises(StoreError, match=r"history row of generation 2 is (damaged or )?missing"):
            use(folder)


def test_the_newest_history_row_that_vanished_is_noticed(tmp_path):
    """Without it, the rest looks like a run that ended one generation earlier."""
    folder = finished(tmp_path / "run", 6)
    execute(folder, "DELETE FROM history WHERE generation = 5")
    for read in (read_generation, read_history, read_evaluations, read_parts):
        with pytest.raises(
            StoreError, match="history after generation 4 is missing; the state is that of generation 5"
        ):
            read(folder)
    with pytest.raises(StoreError, match="at generation 5 has no history row"):
        checked_parts(folder)
    assert "history rows of generations 5 are damaged or missing" in read_sound(folder).problems[0]
    with RunStore.open(folder) as run:
        assert "at generation 5 has no history row" in run.notices[0]
        advance(run, 5)
    assert_sound(folder, 5)


def test_other_tables_and_columns_are_noticed(tmp_path):
    for statement in ("ALTER TABLE history RENAME COLUMN goal_distance TO other", "CREATE TABLE other (a)"):
        folder = finished(tmp_path / statement[:5], 3)
        execute(folder, statement)
        with pytest.raises(StoreError, match="its tables are not those of a run"):
            RunStore.open(folder)
        with pytest.raises(StoreError, match="its tables are not those of a run"):
            read_history(folder)


def test_table_statements_that_are_not_utf_8_are_noticed(tmp_path):
    """SQLite's messages quote them, and Python cannot decode such a message."""
    folder = finished(tmp_path / "run", 3)
    flip_bit(folder / "run.db", position_of(folder / "run.db", b"BLE meta"), bit=7)
    for _ in ("without a copy", "with a copy that is damaged, too"):
        for use in (RunStore.open, read_history, read_parts, checked_parts, read_sound):
            with pytest.raises(StoreError, match=r"can(not)? be (read|used)"):
                use(folder)
        with pytest.raises(UnicodeDecodeError):
            connected_to(folder / "run.db")
        shutil.copy(folder / "run.db", folder / "run.db.copy")


def test_text_that_is_not_utf_8_is_not_repeated(tmp_path):
    """SQLite's message has its bytes, of which one may be a newline."""
    folder = finished(tmp_path / "run", 3)
    execute(folder, r"UPDATE history SET state_sha256 = CAST(X'0A71EC24' AS TEXT) WHERE generation = 2")
    with pytest.raises(StoreError, match="cannot be read: Could not decode to UTF-8") as caught:
        read_history(folder)
    assert caught.value.sentence.endswith("column 'state_sha256'")


def test_another_platform_or_meta_is_noticed(tmp_path):
    with create(tmp_path / "run") as run:
        run.record_platform(0, {"cpu": "a"})
        advance(run, 2)
    execute(tmp_path / "run", """UPDATE platform SET platform = '{"cpu": "b"}'""")
    for use in (RunStore.open, read_platforms):
        with pytest.raises(StoreError, match="platform recorded at generation 0 does not match"):
            use(tmp_path / "run")
    execute(tmp_path / "run", "UPDATE meta SET value = replace(value, '0', '1') WHERE key = 'run'")
    with pytest.raises(StoreError, match="record 'run' in its table meta does not match"):
        read_history(tmp_path / "run")


def test_a_platform_that_vanished_is_noticed(tmp_path):
    """It would take with it that a run is mixed."""
    for first in (0, 2):
        folder = tmp_path / str(first)
        with create(folder) as run:
            run.record_platform(0, {"cpu": "a"})
            advance(run, 1)
            run.record_platform(2, {"cpu": "b"})
        with RunStore.open(folder) as run:
            assert run.notices == []
            run.record_platform(2, {"cpu": "c"})
            advance(run, 3)
        assert read_platforms(folder) == [(0, {"cpu": "a"}), (2, {"cpu": "c"})]
        execute(folder, f"DELETE FROM platform WHERE generation = {first}")
        for use in (RunStore.open, read_platforms):
            with pytest.raises(StoreError, match=f"platform recorded at generation {first} is missing"):
                use(folder)


def test_a_platform_is_lost_together_with_its_only_generation(tmp_path):
    folder = tmp_path / "run"
    with create(folder) as run:
        run.record_platform(0, {"cpu": "a"})
        advance(run, 4)
    with RunStore.open(folder) as run:
        run.record_platform(5, {"cpu": "b"})
        advance(run, 5)
    execute(folder, "DELETE FROM state WHERE generation = 5")
    with RunStore.open(folder) as run:
        assert run.generation == 4
        assert read_platforms(folder) == [(0, {"cpu": "a"})]
        run.record_platform(5, {"cpu": "a"})
        advance(run, 6)
    assert read_platforms(folder) == [(0, {"cpu": "a"})]


def test_platforms_that_an_older_version_recorded_or_replaced_are_read(tmp_path, monkeypatch):
    """Older versions store no list of the platforms, and leave that of a newer version as it is."""
    folder, platforms = tmp_path / "run", []

    def work(generation, cpu, last):
        with RunStore.open(folder) as run:
            run.record_platform(generation, {"cpu": cpu})
            advance(run, last)
            assert run.notices == []
        platforms.append(read_platforms(folder))

    create(folder).close()
    with monkeypatch.context() as older:
        older.setattr(store, "store_platform_list", lambda execute: None)
        work(0, "a", 1)
    work(2, "a", 2)
    work(3, "b", 2)  # killed before it has finished a generation
    with monkeypatch.context() as older:
        older.setattr(store, "store_platform_list", lambda execute: None)
        work(3, "a", 4)
        work(5, "c", 5)
    work(6, "d", 6)
    assert [[at for at, _ in found] for found in platforms] == [[0], [0], [0, 3], [0], [0, 5], [0, 5, 6]]
    execute(folder, "DELETE FROM platform WHERE generation = 5")
    with pytest.raises(StoreError, match="platform recorded at generation 5 is missing"):
        read_platforms(folder)


def test_the_newest_generation_is_read_from_its_sound_row(tmp_path):
    folder = finished(tmp_path / "run", 6)
    execute(folder, "UPDATE history SET env_steps = 1 WHERE generation = 2")
    assert read_generation(folder) == 5
    execute(folder, "UPDATE history SET env_steps = 1 WHERE generation = 5")
    with pytest.raises(StoreError, match="history row of generation 5"):
        read_generation(folder)


def test_a_row_of_a_negative_generation_is_noticed(tmp_path):
    """Readers begin at generation 0, but the digest would include it."""
    folder = finished(tmp_path / "run", 3)
    copied = (
        "SELECT -1, env_steps, centre_fitness_mean, goal_distance, seconds_rollout, evaluations, state_sha256, sha256"
    )
    execute(folder, f"INSERT INTO history {copied} FROM history WHERE generation = 0")
    for use in (RunStore.open, checked_parts):
        with pytest.raises(StoreError, match="history row of a negative generation"):
            use(folder)


def test_many_problems_are_not_all_named(tmp_path):
    folder = finished(tmp_path / "run", 30)
    execute(folder, "UPDATE history SET env_steps = 1 WHERE generation < 20")
    with pytest.raises(StoreError, match=r"generation 7 does not match its SHA-256; and 13 more problems\."):
        RunStore.open(folder)


@pytest.mark.parametrize(("position", "complaint"), [(18, "unknown file format"), (39, "quick_check"), (0, "SQLite")])
def test_a_damaged_header_takes_the_copy(tmp_path, monkeypatch, position, complaint):
    copy_at_every_commit(monkeypatch)
    folder = finished(tmp_path / "run", 3)
    flip_bit(folder / "run.db", position, bit=1)
    with RunStore.open(folder) as run:
        assert complaint in run.notices[0]
        assert "Restored" in run.notices[0]
    assert_sound(folder, 2)


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


@pytest.mark.slow
def test_a_bit_flipped_anywhere_never_gives_another_run(tmp_path, run_with_copy):
    rng = random.Random(0)
    size = (run_with_copy / "run.db").stat().st_size
    content = (run_with_copy / "run.db").read_bytes()
    # Half of them where the file is not empty: there are more zeros than data in so short a run.
    filled = [position for position in range(size) if content[position]]
    positions = [rng.randrange(size) for _ in range(30)] + rng.sample(filled, 60) + rng.sample(range(100), 20)
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


def test_digest_parts_of_a_restored_run_equal_the_original(tmp_path, monkeypatch):
    copy_at_every_commit(monkeypatch)
    folder = finished(tmp_path / "run", 4)
    expected = digest_parts(folder)
    (folder / "run.db").write_bytes(b"gone")
    RunStore.open(folder).close()
    assert digest_parts(folder) == expected
