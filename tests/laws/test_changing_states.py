"""A state may change in any way: what is stored and read back is what a plain reference in memory has, at every kept
generation, through kills, reopened stores, damage of the newest generation, and forks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from es_service.loop.blocks import changes, names_of, state_of, stored
from es_service.loop.state import Best, Generation, RunState
from es_service.protocol.content import name_of, names
from es_service.protocol.messages import Moments
from es_service.search.algorithms.base import SearchState, frozen
from es_service.search.algorithms.common import first_state
from es_service.search.maps.behaviour_map import (
    COLUMNS,
    changed,
    empty_map,
    insert,
    moved,
    removed,
    resampled,
    with_names,
)
from es_service.search.novelty import archive_of, extended
from es_service.store.create import Beginning
from es_service.store.digest import digest_parts
from es_service.store.reader import read_evaluations, read_history, read_kept, read_parts
from es_service.store.writer import RunStore
from tests.database import database
from tests.es_service.map_examples import PLANE
from tests.es_service.store_examples import (
    CONFIG_YAML,
    assert_same_state,
    create,
    evaluated_table,
    history_row,
    meta,
    verify_run,
)

GENERATIONS = 7


def policy_of(generation, centre):
    """The policy with which an entry of the map begins. Some generations evaluate the same ones."""
    return {"parameters_D": np.float32([generation // 2, centre])}


POLICIES = {name_of(policy): policy for at in range(GENERATIONS) for policy in [policy_of(at, 0)]}
"""Every policy by its name."""


def some(rng, *shape):
    """Values among which some are equal, NaN or a zero of either sign."""
    return rng.choice([0.0, -0.0, np.nan, 1.0, 2.0], shape)


# Changes of a state; each takes (state, generation, generator) and returns a state, perhaps an equal one.


def centre_moves(state, generation, rng):
    index = int(rng.integers(len(state.centres)))
    centre = replace(state.centres[index], centre_D=rng.choice(np.float32([0, 1]), 3), cell=int(rng.integers(-1, 2)))
    return replace(state, centres=(*state.centres[:index], centre, *state.centres[index + 1 :]))


def centres_come_and_go(state, generation, rng):
    centres = list(state.centres)
    if len(centres) > 1 and rng.random() < 0.5:
        del centres[int(rng.integers(len(centres)))]
    else:
        centres.insert(int(rng.integers(len(centres) + 1)), centres[0])
    return replace(state, centres=tuple(centres))


def weight_changes(state, generation, rng):
    return replace(state, weight=replace(state.weight, value=float(some(rng)), stagnant=int(rng.integers(3))))


def archive_grows(state, generation, rng):
    archive = state.archive
    for _ in range(int(rng.integers(1, 300))):
        archive = extended(archive, rng.normal(size=2), generation, 0)
    return replace(state, archive=archive)


def archive_shrinks_and_changes(state, generation, rng):
    kept = np.flatnonzero(rng.random(state.archive.size) < rng.choice([0.1, 0.5, 1.0]))
    columns = [getattr(state.archive, name)[kept] for name in ("descriptor_N_B", "generation_N", "centre_N")]
    if kept.size and rng.random() < 0.5:
        columns[0][int(rng.integers(kept.size))] = rng.choice([0.0, -0.0, 1.0], 2)
    return replace(state, archive=archive_of(*columns))


def elite_enters(state, generation, rng):
    map_ = state.map
    for centre in range(int(rng.integers(1, 6))):
        map_, _, _ = insert(map_, rng.uniform([0, 0], [6, 2]), rng.normal(), generation, centre, rng.normal(), 2)
    return replace(state, map=map_)


def elite_changes(state, generation, rng):
    if not state.map.size:
        return state
    map_, cell = state.map, int(rng.choice(state.map.cell_N))
    way = rng.integers(5)
    if way == 0:
        map_ = changed(map_, cell, fitness=float(some(rng)), samples=3)
    elif way == 1:
        map_ = removed(map_, cell)
    elif way == 2 and map_.samples_N is not None:
        map_, _, _ = resampled(map_, cell, rng.uniform([0, 0], [6, 2]), rng.normal(), 1)
    elif way == 3:  # by hand: all columns in another order
        rows = rng.permutation(map_.size)
        columns = ("cell_N", *COLUMNS, *(() if map_.samples_N is None else ("samples_N",)))
        map_ = replace(map_, **{name: getattr(map_, name)[rows] for name in columns})
    else:
        map_, _, _ = moved(map_, cell, rng.uniform([0, 0], [6, 2]))
    return replace(state, map=map_)


def samples_are_counted_or_not(state, generation, rng):
    counted = None if state.map.samples_N is not None else np.full(state.map.size, 4)
    return replace(state, map=replace(state.map, samples_N=counted))


def own_values_change(state, generation, rng):
    extra = dict(state.extra)
    name = str(rng.choice(["a", "b", "c"]))
    way, then = rng.integers(7), extra.get(name)
    if way == 0:
        extra.pop(name, None)
    elif way == 1:
        extra[name] = some(rng, *rng.integers(0, 3, int(rng.integers(3)))).astype(rng.choice(["f4", "f8"]))
    elif way == 2:
        extra[name] = {str(key): some(rng, 2) for key in range(rng.integers(3))}
    elif way == 3 or not isinstance(then, Mapping):
        rows = int(rng.integers(0, 3000))
        extra[name] = {"x": some(rng, rows, 2), "n": rng.integers(0, 2, rows)} if way % 2 else {}
    elif "n" in then:
        kept = then["x"].shape[0] - int(rng.integers(2)) * int(rng.integers(1000))
        more = int(rng.integers(0, 1000))
        x, n = then["x"][: max(0, kept)], then["n"][: max(0, kept)]
        extra[name] = {"x": np.concatenate([x, some(rng, more, 2)]), "n": np.append(n, np.arange(more))}
    else:
        entries = {key: entry for key, entry in then.items() if rng.random() < 0.8}
        for key in rng.integers(0, 5, 2):
            entries[f"at {key}"] = {"x": some(rng, int(rng.integers(3)))}
        extra[name] = entries
    return replace(state, extra=extra)


def names_are_remembered(state, generation, rng):
    """A search keeps names of policies that leave the map, and forgets some."""
    if not state.map.size:
        return state
    kept = state.map.policy_N[rng.random(state.map.size) < 0.3]
    return replace(state, extra={**state.extra, "hall": kept[kept != np.zeros((), kept.dtype)]})


def nothing_changes(state, generation, rng):
    """Everything is made anew and has the same content."""
    extra = {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in state.extra.items()}
    columns = {name: getattr(state.map, name).copy() for name in ("cell_N", *COLUMNS)}
    centres = tuple(replace(centre, centre_D=centre.centre_D.copy()) for centre in state.centres)
    return replace(state, centres=centres, extra=extra, map=replace(state.map, **columns))


CHANGES = [
    centre_moves,
    centres_come_and_go,
    weight_changes,
    archive_grows,
    archive_shrinks_and_changes,
    elite_enters,
    elite_changes,
    elite_changes,
    samples_are_counted_or_not,
    own_values_change,
    own_values_change,
    names_are_remembered,
    nothing_changes,
]


def run_state(search: SearchState, generation, before: RunState | None) -> RunState:
    """A state of a run, whose entries of this generation have got the names of their policies."""

    def named(rows):
        found = names(name_of(policy_of(generation, row)) for row in rows)
        return found, found

    POLICIES.update((name_of(policy), policy) for policy in (policy_of(generation, centre) for centre in range(6)))
    search = replace(search, map=with_names(search.map, generation, np.arange(6), named))
    best = before.best if before is not None and generation % 3 else Best(generation, 1.0, named([0])[0][0])
    moments = Moments(float(generation), np.zeros(2), np.ones(2))
    return RunState(generation, frozen(search), moments, best, generation * 10, generation, 0.0)


def every_state(seed, changes):
    """States of a run, one a generation, each after some changes."""
    rng = np.random.default_rng(seed)
    search = first_state([np.zeros(3, np.float32)] * 2, 2, 1.0, empty_map(PLANE), {"a": np.arange(3.0)})
    states: list[RunState] = []
    for generation, chosen in enumerate(changes):
        for change in chosen:
            search = change(search, generation, rng)
        states.append(run_state(search, generation, states[-1] if states else None))
        search = states[-1].search
    return states


def reference(state: RunState):
    """All blocks of a state."""
    return stored(state)


def commit(store, states, before):
    """Commit states in one transaction, of which the first comes after `before`."""

    def stored_of(now, then):
        row, evaluations = history_row(now.generation), evaluated_table(now.generation)
        return Generation(now.generation, changes(now, then)[0], row, evaluations, POLICIES)

    store.commit([stored_of(now, then) for then, now in pairwise([before, *states])])


def loaded(folder, generation):
    """The state of a generation as a session that continues from it has it."""
    return state_of(read_parts(folder, generation)[1], generation, 0.0)


def assert_policies_of(folder, states):
    """The store has the policies that these states name, and no others."""
    with database(folder / "run.db") as connection:
        found = {name for (name,) in connection.execute("SELECT name FROM content")}
    assert found == frozenset().union(*(names_of(stored(state)) for state in states))


class Killed(Exception):  # noqa: N818 (no error)
    """The process ends here."""


def kill_at(name):
    def hook(reached):
        if reached == name:
            raise Killed

    return hook


courses = st.lists(st.lists(st.sampled_from(CHANGES), max_size=4), min_size=GENERATIONS, max_size=GENERATIONS)
seeds = st.integers(0, 2**32)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(courses, seeds, st.sampled_from([None, 2, 3]), st.sets(st.integers(0, GENERATIONS - 1)), st.data())
def test_every_kept_generation_is_the_reference_whatever_happened(tmp_path_factory, course, seed, keep, reopened, data):
    """Some commits are killed and repeated by another process, which continues from what is stored; some have several
    generations."""
    states, folder = every_state(seed, course), tmp_path_factory.mktemp("states") / "run"
    store, before, expected = create(folder), None, [*map(reference, states)]
    while (generation := 0 if store.generation is None else store.generation + 1) < GENERATIONS:
        together = states[generation : generation + data.draw(st.integers(1, 3))]
        if reopened.intersection(one.generation for one in together):
            instant = data.draw(st.sampled_from(["before_begin", "mid_transaction", "before_commit"]))
            store._hook = kill_at(instant)
            with pytest.raises(Killed):
                commit(store, together, before)
            store.close()
            store = RunStore.open(folder)
            assert store.notices == []
            before = loaded(folder, generation - 1) if generation else None
        store.keep_every = keep
        commit(store, together, before)
        before = together[-1]
        assert_same_state(store.load(), expected[before.generation])
        assert_policies_of(folder, [states[at] for at in read_kept(folder)[1]])
    newest = GENERATIONS - 1
    kept = read_kept(folder)[1]
    assert set(kept) == {newest - 1, newest, *(range(0, newest, keep) if keep else ())}
    for at in kept:
        assert_same_state(read_parts(folder, at)[1], expected[at])
    store.close()
    assert verify_run(folder) == []
    with RunStore.open(folder) as again:
        assert again.notices == []
        assert_same_state(again.load(), expected[-1])
    other = folder.with_name("other")
    contents = {name: POLICIES[name] for name in names_of(expected[-1])}
    evaluations = read_evaluations(folder)
    beginning = Beginning(read_history(folder), expected[-1], contents, newest=newest, evaluations=evaluations)
    RunStore.create(other, CONFIG_YAML, meta(), beginning).close()
    assert digest_parts(other) == digest_parts(folder), "the digest does not depend on how the state came about"


@settings(max_examples=40, deadline=None)
@given(courses, seeds)
def test_the_same_is_written_after_a_resume_and_what_has_not_changed_is_not(course, seed):
    states = every_state(seed, course)
    for before, state in pairwise(states):
        resumed = state_of(reference(before), before.generation, 0.0)
        straight, after_resume = (changes(state, then)[0] for then in (before, resumed))
        assert straight.keys() == after_resume.keys()
        then, now = reference(before), reference(state)
        differing = {name for name in now if name not in then or not same(now[name], then[name])}
        assert {name for name, part in straight.items() if part is None} == then.keys() - now.keys()
        written = {name for name, part in straight.items() if part is not None}
        assert differing == written


@settings(max_examples=15)
@given(courses, seeds)
def test_new_names_are_those_that_the_state_before_has_not_and_perhaps_others_of_what_differs(course, seed):
    for before, state in pairwise([None, *every_state(seed, course)]):
        had = frozenset() if before is None else names_of(stored(before))
        blocks, new_names = changes(state, before)
        assert names_of(stored(state)) - had <= new_names <= names_of(blocks)


def same(now, then):
    return now.keys() == then.keys() and all(
        now[name].dtype == then[name].dtype
        and now[name].shape == then[name].shape
        and now[name].tobytes() == then[name].tobytes()
        for name in now
    )


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(courses, seeds, st.integers(0, 10**6))
def test_damage_of_the_newest_generation_falls_back_to_the_one_before(tmp_path_factory, course, seed, chosen):
    states, folder = every_state(seed, course), tmp_path_factory.mktemp("damage") / "run"
    with create(folder) as store:
        together = 1 + chosen % 4  # generations of a transaction
        for first in range(0, GENERATIONS, together):
            commit(store, states[first : first + together], states[first - 1] if first else None)
    expected = digest_parts(folder)
    with database(folder / "run.db") as connection:
        newest = connection.execute("SELECT part FROM state WHERE generation = ?", (GENERATIONS - 1,)).fetchall()
        [part] = newest[chosen % len(newest)]
        how = ["payload = x'00'", "payload = x''", "sha256 = 'x'"][chosen % 3]
        connection.execute(f"UPDATE state SET {how} WHERE part = ? AND generation = ?", (part, GENERATIONS - 1))
        is_lost = chosen % 7 == 0
        if is_lost:
            connection.execute("DELETE FROM state WHERE part = ? AND generation = ?", (part, GENERATIONS - 1))
    with RunStore.open(folder) as store:
        if is_lost or part in reference(states[-1]) or how != "payload = x''":
            assert store.generation == GENERATIONS - 2
            assert_same_state(store.load(), reference(states[-2]))
            commit(store, states[-1:], loaded(folder, GENERATIONS - 2))
    assert digest_parts(folder) == expected
