"""What the digest of a run sees and what it does not."""

import numpy as np
import pytest

from es_service.errors import StoreError
from es_service.loop.state import Generation
from es_service.protocol.content import name_of
from es_service.store import schema as store_schema
from es_service.store.codec import encode_part
from es_service.store.digest import checked_parts, digest_at, digest_of, digest_parts
from es_service.store.reader import read_generation
from es_service.store.rows import table_bytes
from es_service.store.writer import RunStore
from tests.database import database, execute
from tests.es_service.store_examples import (
    COLUMNS,
    CONFIG,
    EVALUATION_COLUMNS,
    advance,
    as_table,
    contents_of,
    create,
    digest,
    evaluated,
    evaluated_table,
    finished,
    flip_bit,
    history_row,
    meta,
    parts_of,
    position_of,
    state_at,
    verify_run,
)

GENERATIONS = 6


@pytest.fixture
def folder(tmp_path):
    return finished(tmp_path / "run", GENERATIONS)


def change(folder, statement, *values):
    """Change the database behind the store's back."""
    with database(folder / "run.db") as connection:
        assert connection.execute(statement, values).rowcount == 1


def changed_names(before, after):
    assert before.keys() == after.keys()
    return {name for name in before if before[name] != after[name]}


def test_names_are_the_state_parts_and_the_tables(folder):
    parts = digest_parts(folder)
    assert list(parts) == [
        "state/best",
        "state/centre_0",
        "state/centre_1",
        "state/centre_2",
        "state/guest",
        "state/observations",
        "map",
        "history",
        "evaluations",
    ]
    assert all(len(value) == 64 for value in (*parts.values(), digest(folder)))


def test_equal_runs_have_equal_digests_however_they_were_written(folder, tmp_path):
    with create(tmp_path / "in_two_sessions", generations=2):
        pass
    with RunStore.open(tmp_path / "in_two_sessions") as store:
        for generation in range(2, GENERATIONS):
            advance(store, generation)
            assert digest(store.folder) == digest(finished(tmp_path / str(generation), generation + 1))
    assert digest(tmp_path / "in_two_sessions") == digest(folder)


def test_layout_does_not_count(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(store_schema, "PAGE_BYTES", 1024)
    expected = digest(folder)
    with create(tmp_path / "other", run_meta=meta(columns=COLUMNS[::-1], run_id="b" * 32)) as store:
        for generation in range(GENERATIONS):
            parts = {
                part: arrays and dict(reversed(arrays.items()))
                for part, arrays in reversed(parts_of(generation).items())
            }
            row, centres = history_row(generation), evaluated_table(generation)
            store.commit([Generation(generation, parts, row, centres, contents_of(generation))])
    assert digest(tmp_path / "other") == expected
    execute(tmp_path / "other", "VACUUM")
    assert digest(tmp_path / "other") == expected


def test_when_a_part_was_last_written_does_not_count(folder, tmp_path):
    with create(tmp_path / "all", generations=GENERATIONS - 1) as store:
        last = GENERATIONS - 1
        store.commit([Generation(last, state_at(last), history_row(last), evaluated_table(last), contents_of(last))])
    assert digest(tmp_path / "all") == digest(folder)


def test_seconds_and_rates_do_not_count(folder):
    before = digest(folder)
    change(folder, "UPDATE history SET seconds_rollout = 1e9 WHERE generation = 3")
    assert digest(folder) == before
    assert verify_run(folder) != []


def test_platforms_and_meta_do_not_count(folder, tmp_path):
    with create(
        tmp_path / "elsewhere",
        run_meta=meta(config=CONFIG | {"search": {"pairs": 9}}, created="2026-01-01T00:00:00+00:00"),
    ) as store:
        store.record_platform(0, {"cpu": "another"})
        advance(store, GENERATIONS - 1)
    assert digest(tmp_path / "elsewhere") == digest(folder)


@pytest.mark.parametrize("part", ["centre_0", "centre_1", "centre_2", "observations"])
def test_one_flipped_bit_in_a_state_counts(folder, part):
    before, whole = digest_parts(folder), digest(folder)
    payload = encode_part(state_at(GENERATIONS - 1)[part])
    position = position_of(folder / "run.db", payload[-40:]) + 39
    flip_bit(folder / "run.db", position)
    assert changed_names(before, digest_parts(folder)) == {f"state/{part}"}
    assert digest(folder) != whole
    assert any("does not match its SHA-256" in problem for problem in verify_run(folder))


def test_a_state_that_cannot_be_read_is_an_error(folder):
    change(folder, "UPDATE state SET payload = x'00' WHERE part = 'observations' AND generation = 5")
    with pytest.raises(StoreError, match="a state payload begins with"):
        digest(folder)


@pytest.mark.parametrize("column", [column.name for column in COLUMNS if column.deterministic])
def test_one_changed_deterministic_history_value_counts(folder, column):
    before = digest_parts(folder)
    if column == "generation":
        change(folder, "UPDATE history SET generation = 77 WHERE generation = 5")
    elif column == "env_steps":
        change(folder, "UPDATE history SET env_steps = env_steps + 1 WHERE generation = 2")
    else:
        value = history_row(2)[column]
        change(folder, f"UPDATE history SET {column} = ? WHERE generation = 2", float(np.nextafter(value, np.inf)))
    assert changed_names(before, digest_parts(folder)) == {"history"}


@pytest.mark.parametrize("change_of", ["value", "row", "order", "nothing"])
def test_every_evaluated_centre_counts(folder, change_of):
    """In all columns but those that a later version has added."""
    before = digest_parts(folder)
    rows = evaluated(0)
    if change_of in ("value", "nothing"):
        name = {"value": "fitness_mean", "nothing": "fitness_first"}[change_of]
        rows[1][name] = float(np.nextafter(rows[1][name], np.inf))
    rows = rows[:-1] if change_of == "row" else rows[::-1] if change_of == "order" else rows
    payload = table_bytes(EVALUATION_COLUMNS, as_table(EVALUATION_COLUMNS, rows))
    change(folder, "UPDATE history SET evaluations = ? WHERE generation = 0", payload)
    assert changed_names(before, digest_parts(folder)) == ({"evaluations"} if change_of != "nothing" else set())


def test_columns_that_do_not_count_leave_the_digest_of_a_run_without_them(folder, tmp_path):
    with RunStore.create(tmp_path / "older", "", meta(evaluation_columns=EVALUATION_COLUMNS[:-1])) as store:
        advance(store, GENERATIONS - 1)  # a newer version gives it the other column too
    assert digest_parts(tmp_path / "older") == digest_parts(folder)


def test_evaluated_centres_that_cannot_be_taken_apart_are_an_error(folder):
    payload = table_bytes(EVALUATION_COLUMNS, evaluated_table(0))
    change(folder, "UPDATE history SET evaluations = ? WHERE generation = 0", payload[:-1])
    with pytest.raises(StoreError, match="the evaluated centres are unreadable from byte"):
        digest_parts(folder)


def test_no_value_is_not_zero(folder):
    before = digest(folder)
    change(folder, "UPDATE history SET goal_distance = 0.0 WHERE generation = 3")
    assert digest(folder) != before


def test_one_generation_less_or_another_seed_counts(folder, tmp_path):
    less = digest_parts(finished(tmp_path / "less", GENERATIONS - 1))
    ours = digest_parts(folder)
    assert ours.pop("state/guest"), "it came with the last generation"
    assert {"history", "state/observations"} <= changed_names(ours, less)
    other = digest_parts(finished(tmp_path / "seed", GENERATIONS, seed=1))
    assert changed_names(digest_parts(folder), other) == {
        name for name in other if name not in ("history", "evaluations", "state/guest")
    }
    change(folder, "DELETE FROM history WHERE generation = 5")
    assert digest_parts(folder)["history"] == less["history"]


def test_names_types_and_shapes_of_arrays_count():
    array = np.arange(4, dtype=np.float32)
    different = [
        {"a": array},
        {"b": array},
        {"a": array.reshape(2, 2)},
        {"a": array.view(np.int32)},
        {"a": array.astype(np.float64)},
        {"a": array[:2], "b": array[2:]},
        {},
    ]
    assert len({name_of(arrays) for arrays in different}) == len(different)
    assert name_of({"a": array.astype(">f4")}) == name_of({"a": array})
    assert name_of({"a": np.asfortranarray(array.reshape(2, 2))}) == name_of({"a": array.reshape(2, 2)})


def test_the_digest_after_the_generation_before_is_that_of_a_run_that_ended_there(folder, tmp_path):
    newest = read_generation(folder)
    assert newest is not None
    assert digest_at(folder, newest) == digest(folder)
    assert digest_at(folder, newest - 1) == digest(finished(tmp_path / "less", GENERATIONS - 1))
    assert digest_at(folder, newest - 2) is None


def test_parts_and_total_are_of_one_moment_and_of_a_sound_run(folder):
    parts, mixed = checked_parts(folder)
    assert (parts, digest_of(parts), mixed) == (digest_parts(folder), digest(folder), False)
    change(folder, "UPDATE history SET seconds_rollout = 1e9 WHERE generation = 3")  # which no digest would show
    with pytest.raises(StoreError, match=r"damaged: history row of generation 3 .*; .*\n.* resume\("):
        checked_parts(folder)


def test_a_run_without_a_generation_has_a_digest(tmp_path):
    create(tmp_path / "run").close()
    assert list(digest_parts(tmp_path / "run")) == ["history", "evaluations"]


def test_a_run_is_mixed_from_the_first_generation_on_another_platform(tmp_path):
    folder = tmp_path / "run"
    with create(folder) as store:
        assert not checked_parts(folder)[1]
        store.record_platform(0, {"cpu": "a"})
        advance(store, 2)
        assert not checked_parts(folder)[1]
        store.record_platform(3, {"cpu": "b"})
        assert not checked_parts(folder)[1]
        advance(store, 3)
        assert checked_parts(folder)[1]
        store.record_platform(4, {"cpu": "a"})
        advance(store, 4)
    assert checked_parts(folder)[1]


@pytest.mark.parametrize("part", ["map/geometry", "map#000000", "map#000003"])
def test_every_part_of_the_map_counts(tmp_path, part):
    found = []
    for changed in (False, True):
        parts = {name: {"x": np.zeros(3, np.float32)} for name in ("map/geometry", "map#000000", "map#000003")}
        parts[part]["x"][1] = changed
        with create(tmp_path / str(changed)) as store:
            store.commit([Generation(0, state_at(0) | parts, history_row(0), contents=contents_of(0))])
        found.append(digest_parts(tmp_path / str(changed)))
    assert {name for name in found[0] if found[0][name] != found[1][name]} == {"map"}
