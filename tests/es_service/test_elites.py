"""Elites that are kept in memory: what is given is what was found last, stored or not, whatever was asked before."""

import numpy as np
import pytest

from es_service.loop.elites import Elites
from es_service.loop.parts import elite_from_arrays, elite_part, elite_to_arrays
from es_service.search.maps.behaviour_map import Elite
from tests.es_service.store_examples import create, history_row

KILOBYTE = 1024


def elite(value, kilobytes=1):
    return Elite(np.full(kilobytes * 256, value, np.float32), *np.zeros((3, 0), np.float32))


class Counting:
    """Parts of a store, and the cells that were read."""

    def __init__(self):
        self.parts, self.read = {}, []

    def part(self, name):
        self.read.append(name)
        return self.parts[name]


@pytest.fixture
def store():
    store = Counting()
    store.parts = {elite_part(cell): elite_to_arrays(elite(cell)) for cell in range(5)}
    return store


def test_an_elite_that_was_read_needs_no_other_reading_until_there_is_no_room(store):
    elites = Elites(store.part, most_bytes=3 * KILOBYTE)
    for cell in (0, 1, 2, 0, 3, 0, 2, 1):
        assert elites(cell).centre_D[0] == cell
    assert store.read == [elite_part(cell) for cell in (0, 1, 2, 3, 1)]  # 1 was not asked for the longest


def test_of_a_map_larger_than_the_room_only_the_rest_is_read_again(store):
    """As a batch of mutants asks for it, generation after generation."""
    elites = Elites(store.part, most_bytes=3 * KILOBYTE)
    for _ in range(3):
        assert [found.centre_D[0] for found in elites.of([0, 1, 2, 3, 4, 4]).values()] == [0, 1, 2, 3, 4]
    assert store.read == [elite_part(cell) for cell in (0, 1, 2, 3, 4, *(3, 4) * 2)]
    elites.of([3, 4])
    assert elites(4).centre_D[0] == 4
    assert store.read[9:] == [elite_part(cell) for cell in (3, 4)], "others make room for what alone is asked for"


def test_an_elite_larger_than_the_room_is_read_each_time(store):
    store.parts[elite_part(0)] = elite_to_arrays(elite(0, kilobytes=4))
    elites = Elites(store.part, most_bytes=3 * KILOBYTE)
    assert [elites(cell).centre_D[0] for cell in (0, 0, 1, 1)] == [0, 0, 1, 1]
    assert store.read == [elite_part(cell) for cell in (0, 0, 1)]


def test_what_a_generation_has_changed_holds_before_and_after_it_is_stored(store):
    elites = Elites(store.part)
    assert elites(1).centre_D[0] == 1
    elites.change({elite_part(1): elite_to_arrays(elite(8)), elite_part(2): None, "counters": {}})
    for _ in range(2):
        assert [elites(cell).centre_D[0] for cell in (0, 1)] == [0, 8]
        with pytest.raises(KeyError):
            elites(2)
        store.parts[elite_part(1)] = elite_to_arrays(elite(8))
        store.parts.pop(elite_part(2), None)
        elites.stored()


def test_elites_are_read_only_and_other_arrays_than_those_that_can_be_written(store):
    elites, given = Elites(store.part), elite(8)
    elites.change({elite_part(0): elite_to_arrays(given)})
    given.centre_D[:] = 9
    for cell in (0, 1):
        with pytest.raises(ValueError, match="read-only"):
            elites(cell).centre_D[0] = 0
    assert elites(0).centre_D[0] == 8


def test_the_run_store_gives_the_newest_part(tmp_path):
    with create(tmp_path / "run") as store:
        for generation in range(3):
            parts = {elite_part(0): elite_to_arrays(elite(generation)), elite_part(1): None}
            store.commit(generation, parts, history_row(generation))
            assert elite_from_arrays(store.part(elite_part(0))).centre_D[0] == generation
            with pytest.raises(KeyError):
                store.part(elite_part(1))
