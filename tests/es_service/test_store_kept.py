"""Which states a run keeps besides the last two, and that the others are deleted."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from es_service.errors import StoreError
from es_service.store.folder import DATABASE
from es_service.store.reader import read_kept, read_parts
from es_service.store.writer import RunStore
from tests.database import database, execute
from tests.es_service.store_examples import (
    advance,
    assert_policies,
    assert_same_state,
    assert_sound,
    create,
    digest,
    finished,
    generation_of,
    state_at,
)

STORED = ("state", "content", "history")


def kept(folder):
    """Generations whose states are kept; each is what it was."""
    whole = read_kept(folder)[1]
    for generation in whole:
        assert_same_state(read_parts(folder, generation)[1], state_at(generation))
        assert_policies(folder, generation)
    return whole


def test_states_are_kept_sparsely_and_the_last_two_always(tmp_path):
    with create(tmp_path / "run") as store:
        store.keep_every = 4
        for generation in range(15):
            advance(store, generation)
            wanted = {*range(0, generation + 1, 4), generation - 1, generation} - {-1}
            assert kept(tmp_path / "run") == sorted(wanted)
    assert_sound(tmp_path / "run", 14)
    assert digest(tmp_path / "run") == digest(finished(tmp_path / "plain", 15))
    with pytest.raises(StoreError, match=r"keeps the states of generations \[0, 4, 8, 12, 13, 14\]") as caught:
        read_parts(tmp_path / "run", 5)
    assert caught.value.suggestion == 14


@pytest.mark.parametrize("keep_every", [None, 4])
@pytest.mark.parametrize("together", [2, 3, 7, 20])
def test_generations_of_one_transaction_leave_what_they_leave_one_by_one(tmp_path, keep_every, together):
    """Row by row, in all tables; also where parts come, change and go, and policies come back, in one transaction."""
    left = []
    for folder, count in ((tmp_path / "alone", 1), (tmp_path / "together", together)):
        with create(folder) as store:
            store.keep_every = keep_every
            for last in (2, 15, 19):
                advance(store, last, together=count)
        with database(folder / DATABASE) as connection:
            left.append({table: sorted(connection.execute(f"SELECT * FROM {table}")) for table in STORED})
    assert left[0] == left[1]
    assert_sound(tmp_path / "together", 19)


def test_generations_of_one_transaction_are_the_next_ones_and_all_or_none(tmp_path):
    with create(tmp_path / "run", generations=3) as store:
        for wrong in ([], [4, 5], [3, 5], [3, 3], [4, 3]):
            with pytest.raises(StoreError, match="; the next generation is 3"):
                store.commit([generation_of(number) for number in wrong])
        *some, last = (generation_of(number) for number in (3, 4, 5))
        with pytest.raises(StoreError, match=r"generations 3 to 5 names [0-9a-f]{64}, which nobody has"):
            store.commit([*some, last._replace(contents={})])
        assert store.generation == 2
        assert_same_state(store.load(), state_at(2))
        store.commit([*some, last])
    assert_sound(tmp_path / "run", 5)


def test_nothing_else_stays_in_the_file(tmp_path):
    """No more rows than the states need: one for each part and each state in which it has another value or is gone."""
    with create(tmp_path / "run") as store:
        store.keep_every = 6
        advance(store, 20)
    rows, whole = read_kept(tmp_path / "run")
    for ats in rows.values():
        in_force = {max((at for at in ats if at <= generation), default=None) for generation in whole}
        assert sorted(ats) == sorted(in_force - {None})
    assert sorted(rows["guest"]) == [5, 11, 17, 19]
    with create(tmp_path / "plain") as store:
        advance(store, 20)
    assert kept(tmp_path / "plain") == [19, 20]


@settings(max_examples=15, deadline=None)
@given(sessions=st.lists(st.tuples(st.one_of(st.none(), st.integers(1, 7)), st.integers(1, 9)), min_size=1, max_size=4))
def test_what_is_kept_when_it_changes_between_sessions_stays(tmp_path_factory, sessions):
    folder = tmp_path_factory.mktemp("kept") / "run"
    create(folder).close()
    reached, wanted = -1, set()
    for keep_every, generations in sessions:
        with RunStore.open(folder) as store:
            store.keep_every = keep_every
            # Whether the states of the last two generations stay is decided by what is wanted now.
            wanted = {generation for generation in wanted if generation < reached - 1}
            begun = max(reached - 1, 0)
            reached += generations
            advance(store, reached)
        if keep_every is not None:
            wanted |= {generation for generation in range(begun, reached + 1) if generation % keep_every == 0}
        assert kept(folder) == sorted((wanted | {reached - 1, reached}) - {-1})


def test_a_damaged_kept_state_is_told_and_the_run_goes_on(tmp_path):
    with create(tmp_path / "run") as store:
        store.keep_every = 4
        advance(store, 10)
    execute(tmp_path / "run", "UPDATE state SET payload = x'00' WHERE part = 'observations' AND generation = 4")
    with RunStore.open(tmp_path / "run") as store:
        (notice,) = store.notices
        assert "state of 'observations' at generation 4 does not match its SHA-256" in notice
        assert store.generation == 10
    assert kept(tmp_path / "run") == [0, 8, 9, 10]
