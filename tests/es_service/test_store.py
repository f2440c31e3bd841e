"""Creating a run and committing to it."""

import math
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from es_service.errors import StoreError, WayOut
from es_service.loop.history import Column
from es_service.loop.state import Generation
from es_service.store import create as store_create
from es_service.store import upkeep as store_upkeep
from es_service.store.create import Beginning
from es_service.store.reader import (
    read_evaluations,
    read_generation,
    read_history,
    read_meta,
    read_parts,
    read_platforms,
    reading,
)
from es_service.store.writer import RunStore
from tests.database import execute
from tests.es_service.store_examples import (
    COLUMNS,
    CONFIG_YAML,
    advance,
    assert_same_evaluations,
    assert_same_history,
    assert_same_state,
    contents_of,
    create,
    evaluated,
    evaluated_table,
    finished,
    history_row,
    meta,
    named_at,
    parts_of,
    state_at,
    without_root_rights,
)

# Creating


def test_a_new_run_has_its_files_and_no_generation(tmp_path):
    folder = tmp_path / "run"
    parent = {"run_id": "a" * 32, "folder": "b", "generation": 3, "digest": "c" * 64}
    with create(folder, run_meta=meta(parent=parent)) as run:
        assert run.generation is None
        assert run.last_history() is None
        assert run.load() == {}
        assert run.notices == []
        assert run.meta == meta(parent=parent)
    assert (folder / "config.yaml").read_text() == CONFIG_YAML
    assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "run.db", "run.lock"]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert read_meta(folder) == meta(parent=parent)
    with RunStore.open(folder) as run:
        assert run.generation is None


def test_an_existing_empty_folder_is_fine(tmp_path):
    create(tmp_path, generations=1).close()
    assert read_generation(tmp_path) == 0


def test_a_folder_with_a_run_says_resume(tmp_path):
    folder = finished(tmp_path / "run", 2)
    with pytest.raises(StoreError, match=f"{folder} already holds a run") as error:
        create(folder)
    assert error.value.way_out == WayOut("resume", "continue it", str(folder))
    assert read_generation(folder) == 1


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(StoreError, match=r"not empty and holds no run \(thesis.tex\); choose another folder"):
        create(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(StoreError, match="it is a file"):
        create(tmp_path / "thesis.tex")


def test_missing_parents_are_made_and_those_that_cannot_be_are_named(tmp_path):
    create(tmp_path / "a" / "b" / "run", generations=1).close()
    assert read_generation(tmp_path / "a" / "b" / "run") == 0
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=f"{tmp_path / 'file'}"):
        create(tmp_path / "file" / "b" / "run")
    with tempfile.TemporaryDirectory() as parent:
        os.chmod(parent, 0o555)
        with without_root_rights(), pytest.raises(StoreError, match=f"Permission denied in {parent}"):
            create(Path(parent) / "run")
        os.chmod(parent, 0o755)


def test_a_failed_creation_leaves_nothing_and_says_why(tmp_path, monkeypatch):
    def full(folder, text):
        raise OSError(28, "No space left on device")

    for folder in (tmp_path / "new", tmp_path / "existing"):
        with monkeypatch.context() as patch:
            patch.setattr(store_create, "write_config", full)
            if folder.name == "existing":
                folder.mkdir()
            with pytest.raises(StoreError, match=r"disk full .* free space, then try again"):
                create(folder)
        assert [path.name for path in tmp_path.rglob("*")] == (["existing"] if folder.name == "existing" else [])
        finished(folder, 1)
        assert read_generation(folder) == 0
        for path in (*folder.iterdir(), folder):
            path.rmdir() if path.is_dir() else path.unlink()


@pytest.mark.parametrize(
    "columns",
    [COLUMNS[1:], (*COLUMNS, Column("ENV_steps", "REAL", True, "")), (*COLUMNS, Column("sha256", "REAL", True, ""))],
)
def test_columns_that_cannot_be_a_table_are_refused(tmp_path, columns):
    with pytest.raises(StoreError, match="history columns"):
        create(tmp_path / "run", run_meta=meta(columns=columns))
    assert not (tmp_path / "run").exists()


# Committing


def test_state_and_history_come_back_bit_for_bit(tmp_path):
    with create(tmp_path / "run") as run:
        for generation in range(12):
            advance(run, generation)
            assert run.generation == generation
            assert_same_state(run.load(), state_at(generation))
            assert run.last_history()["env_steps"] == history_row(generation)["env_steps"]
    with RunStore.open(tmp_path / "run") as run:
        assert run.notices == []
        assert run.generation == 11
        assert_same_state(run.load(), state_at(11))
    assert_same_history(read_history(tmp_path / "run"), 12)


def test_only_the_next_generation_can_be_committed(tmp_path):
    with create(tmp_path / "run", generations=3) as run:
        for wrong in (0, 2, 4):
            with pytest.raises(StoreError, match=f"cannot store generation {wrong}; the next generation is 3"):
                run.commit([Generation(wrong, parts_of(wrong), history_row(wrong))])
        advance(run, 3)


def test_what_does_not_fit_leaves_the_store_as_it_was(tmp_path):
    with create(tmp_path / "run", generations=3) as run:
        with pytest.raises(StoreError, match="missing columns"):
            run.commit([Generation(3, parts_of(3), {}, contents=contents_of(3))])
        with pytest.raises(StoreError, match=r"generation 3 names [0-9a-f]{64}, which nobody has"):
            run.commit([Generation(3, parts_of(3), history_row(3))])
        with pytest.raises(StoreError, match="dtype"):
            run.commit([Generation(3, {"centre_0": {"a": "text"}}, history_row(3))])
        assert_same_state(run.load(), state_at(2))
        advance(run, 3)
        assert_same_state(run.load(), state_at(3))


def test_an_error_inside_the_transaction_takes_all_of_it_back(tmp_path):
    def hook(name):
        if name == failing:
            raise KeyboardInterrupt

    failing = None
    with create(tmp_path / "run", generations=4, hook=hook) as run:
        for name in ("before_begin", "mid_transaction", "before_commit"):
            failing = name
            with pytest.raises(KeyboardInterrupt):
                advance(run, 4)
            assert run.generation == 3
            assert_same_state(run.load(), state_at(3))
        failing = None
        advance(run, 5)
        assert_same_state(run.load(), state_at(5))


def test_the_state_of_the_last_two_generations_is_kept_and_no_more(tmp_path):
    folder = tmp_path / "run"
    with create(folder) as run:
        for generation in range(12):
            advance(run, generation)
            kept = execute(folder, "SELECT part, generation FROM state")
            for part in {name for at in range(generation + 1) for name in parts_of(at)}:
                written = [at for at in range(generation + 1) if part in parts_of(at)]
                until_before = [at for at in written if at <= generation - 1]
                expected = until_before[-1:] + [at for at in written if at > generation - 1]
                if expected and parts_of(expected[0])[part] is None:
                    del expected[0]  # a row that removes a part is kept only with an older one
                assert sorted(at for name, at in kept if name == part) == expected
    for generation in (10, 11):
        at, parts, _ = read_parts(folder, generation)
        assert at == generation
        assert_same_state(parts, state_at(generation))


def test_the_file_does_not_grow_with_the_states_it_has_seen(tmp_path):
    finished(tmp_path / "short", 5)
    finished(tmp_path / "long", 60)
    growth = (tmp_path / "long" / "run.db").stat().st_size - (tmp_path / "short" / "run.db").stat().st_size
    assert growth <= 2 * 8192


def test_hooks_are_called_in_order(tmp_path, monkeypatch):
    monkeypatch.setattr(store_upkeep, "CHECKPOINT_INTERVAL_S", 0.0)
    called = []
    with create(tmp_path / "run", generations=1, hook=called.append):
        pass
    checkpoint = ["before_checkpoint", "after_checkpoint"]
    commit = ["before_begin", "mid_transaction", "before_commit", "after_commit"]
    assert called == ["opened", *commit, *checkpoint, *checkpoint]
    called.clear()
    RunStore.open(tmp_path / "run", hook=called.append).close()
    assert called == ["opened", *checkpoint]


def test_the_log_is_emptied_after_some_time(tmp_path, monkeypatch):
    called = []
    with create(tmp_path / "run", generations=3, hook=called.append) as run:
        assert "before_checkpoint" not in called
        monkeypatch.setattr(store_upkeep, "CHECKPOINT_INTERVAL_S", 0.0)
        advance(run, 3)
        assert called.count("after_checkpoint") == 1


def test_the_log_of_a_small_run_stays_small(tmp_path):
    """Whatever its generations change: a whole centre, or many elites of a page and a half each."""
    for name, count, values in (("a centre", 1, 100_000), ("elites", 60, 3_000)):
        elites = {f"elite_{index}": {"x": np.zeros(values, np.float32)} for index in range(count)}
        folder, largest = tmp_path / name, 0
        with create(folder) as run:
            for generation in range(40):
                run.commit([Generation(generation, elites, history_row(generation), evaluated_table(generation))])
                largest = max(largest, (folder / "run.db-wal").stat().st_size)
        a_generation = 1.5 * sum(part["x"].nbytes for part in elites.values())
        assert largest < store_upkeep.LEAST_LOG_BYTES + a_generation, name


def test_a_log_that_a_reader_holds_back_is_told_once_and_cut_afterwards(tmp_path, monkeypatch):
    monkeypatch.setattr(store_upkeep, "CHECKPOINT_INTERVAL_S", 0.0)
    monkeypatch.setattr(store_upkeep, "LEAST_LOG_BYTES", 2**16)
    monkeypatch.setattr(store_upkeep, "MOST_LOG_BYTES", 2**16)
    folder = tmp_path / "run"
    with create(folder, generations=3) as run:
        with reading(folder) as (connection, _):
            connection.execute("SELECT count(*) FROM history").fetchone()
            advance(run, 40)
            assert (folder / "run.db-wal").stat().st_size > 4 * 2**16
        assert [notice.partition(",")[0] for notice in run.notices] == [
            f"{folder}: a program reads run.db without a pause"
        ]
        advance(run, 45)
        assert (folder / "run.db-wal").stat().st_size <= 2**16
        assert len(run.notices) == 1


def test_a_fork_begins_with_its_parent_s_history_and_state(tmp_path):
    history = [history_row(generation) for generation in range(4)]
    platforms = [(0, {"jax": "1"}), (2, {"jax": "2"})]
    beginning = Beginning(
        iter(history), state_at(3), named_at(3), platforms, newest=3, evaluations=map(evaluated, range(4))
    )
    with RunStore.create(tmp_path / "run", CONFIG_YAML, meta(), beginning) as run:
        assert run.generation == 3
        assert run.start is None
        assert run.record_platform(4, {"jax": "2"}) is False
        assert_same_state(run.load(), state_at(3))
        advance(run, 5)
    assert read_platforms(tmp_path / "run") == platforms
    assert_same_history(read_history(tmp_path / "run"), 6)
    assert_same_evaluations(read_evaluations(tmp_path / "run"), 6)
    assert_same_evaluations(read_evaluations(tmp_path / "run", 0, 4), 4)
    with RunStore.open(tmp_path / "run") as run:
        assert run.notices == []
        assert_same_state(run.load(), state_at(5))


def test_a_fork_s_columns_are_its_own(tmp_path):
    """A newer version may have more columns than the parent's run, or fewer."""
    history = [{**history_row(0), "gone": 1.0}]
    del history[0]["goal_distance"]
    beginning = Beginning(history, state_at(0), named_at(0), newest=0)
    with RunStore.create(tmp_path / "run", CONFIG_YAML, meta(), beginning) as run:
        advance(run, 2)
    first = read_history(tmp_path / "run")[0]
    assert math.isnan(first["goal_distance"])
    assert "gone" not in first
    assert [len(centres) for centres in read_evaluations(tmp_path / "run")] == [0, 2, 1], "the parent had none"


def test_a_start_is_kept_with_the_run(tmp_path):
    start = {"centre_D": np.arange(5, dtype=np.float32), "count": np.asarray(3.0)}
    with RunStore.create(tmp_path / "run", CONFIG_YAML, meta(), Beginning(start=start)) as run:
        assert run.generation is None
        assert_same_state({"start": run.start}, {"start": start})
        advance(run, 2)
    with RunStore.open(tmp_path / "run") as run:
        assert_same_state({"start": run.start}, {"start": start})


def test_a_closed_store_says_so(tmp_path):
    run = create(tmp_path / "run", generations=1)
    run.close()
    run.close()
    with pytest.raises(StoreError, match="was closed"):
        advance(run, 1)


# Platforms


def test_platforms_are_recorded_where_they_change(tmp_path):
    folder = tmp_path / "run"
    with create(folder) as run:
        assert run.record_platform(0, {"cpu": "a", "jax": "1"})
        advance(run, 2)
        assert not run.record_platform(3, {"jax": "1", "cpu": "a"})
        # A session that commits nothing leaves no trace once another one takes its place.
        assert run.record_platform(3, {"cpu": "b"})
        assert not run.record_platform(3, {"cpu": "a", "jax": "1"})
        advance(run, 4)
        assert run.record_platform(5, {"cpu": "b"})
        with pytest.raises(StoreError, match="generation 4 is already stored"):
            run.record_platform(4, {"cpu": "c"})
    assert read_platforms(folder) == [(0, {"cpu": "a", "jax": "1"}), (5, {"cpu": "b"})]
