"""Which states a run keeps besides the last two, and that the others are deleted."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from es_service.errors import StoreError
from es_service.store.reader import read_kept, read_parts
from es_service.store.writer import RunStore
from tests.database import execute
from tests.es_service.store_examples import (
    advance,
    assert_policies,
    assert_same_state,
    assert_sound,
    create,
    digest,
    finished,
    state_at,
)


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
