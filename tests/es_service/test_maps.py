"""The behaviour map: what enters, what is counted, what is stored."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.search.maps.behaviour_map import (
    EMPTY,
    changed,
    empty_map,
    insert,
    insert_each,
    map_statistics,
    moved,
    removed,
    resampled,
)
from tests.es_service.map_examples import PLANE
from tests.references import behaviour_map as reference

# Insertion


def filled(*offers, geometry=PLANE):
    """The map after these offers of (descriptor, fitness); generations 0, 1, ..., scores 100, 101, ..."""
    map_ = empty_map(geometry)
    for generation, (descriptor, fitness) in enumerate(offers):
        map_, _, _ = insert(map_, np.array(descriptor, float), fitness, generation, 0, 100.0 + generation)
    return map_


def columns_of(map_):
    found = {field.name: getattr(map_, field.name) for field in dataclasses.fields(map_) if field.name != "geometry"}
    return {name: values for name, values in found.items() if values is not None}


def assert_same_map(map_, other):
    assert map_.geometry == other.geometry
    assert columns_of(map_).keys() == columns_of(other).keys()
    for name, values in columns_of(map_).items():
        np.testing.assert_array_equal(values, getattr(other, name))
        assert values.dtype == getattr(other, name).dtype


def test_an_empty_cell_is_entered_and_a_fitter_one_replaces_while_an_equal_one_does_not():
    first = filled(((1.0, 0.1), 5.0))
    equal, cell, entered = insert(first, np.array([1.5, 0.2]), 5.0, 1, 0, 7.0)
    assert (cell, entered) == (0, False)
    assert_same_map(equal, first)
    worse, cell, entered = insert(first, np.array([1.5, 0.2]), -9.0, 1, 0, 7.0)
    assert (cell, entered) == (0, False)
    assert_same_map(worse, first)
    better, cell, entered = insert(first, np.array([1.5, 0.2]), np.nextafter(5.0, 6.0), 8, 3, 7.0)
    assert (cell, entered, better.size) == (0, True, 1)
    assert better.descriptor_N_B.tolist() == [[1.5, 0.2]]
    assert (better.generation_N[0], better.centre_N[0], better.score_N[0]) == (8, 3, 7.0)


def test_cells_stay_in_the_order_of_their_discovery():
    map_ = filled(((5.0, 1.9), 1.0), ((0.0, 0.0), 1.0), ((3.0, 1.0), 1.0), ((5.5, 1.8), 2.0), ((0.1, 0.1), 2.0))
    assert map_.cell_N.tolist() == [11, 0, 6]
    assert map_.generation_N.tolist() == [3, 4, 2]
    assert [map_.row_of(cell) for cell in (11, 0, 6, 5)] == [0, 1, 2, None]


def test_insertion_and_scores_leave_the_old_map_as_it_was():
    map_ = filled(((1.0, 0.1), 5.0), ((5.0, 1.9), 1.0))
    before = {name: values.copy() for name, values in columns_of(map_).items()}
    for values in columns_of(map_).values():
        values.setflags(write=False)
    insert(map_, np.array([1.0, 0.1]), 6.0, 2, 0, 0.0)
    insert(map_, np.array([3.0, 0.1]), 6.0, 2, 0, 0.0)
    changed(map_, 11, score=9.0)
    for name, values in columns_of(map_).items():
        np.testing.assert_array_equal(values, before[name])


def test_a_score_is_changed_where_the_centre_has_an_elite():
    map_ = filled(((1.0, 0.1), 5.0), ((5.0, 1.9), 1.0))
    assert changed(map_, 11, score=-3.0).score_N.tolist() == [100.0, -3.0]
    assert changed(map_, 5, score=-3.0) is map_


@given(
    st.lists(
        st.tuples(st.integers(-1, 8).map(float), st.integers(-2, 10).map(lambda x: x / 4), st.integers(0, 4)),
        max_size=30,
    )
)
def test_any_offers_give_the_reference_s_map_and_never_a_worse_one(offers):
    map_, other = empty_map(PLANE), reference.GridMap(PLANE.bounds, PLANE.shape)
    worst = np.full(PLANE.size, -np.inf)
    for generation, (x, y, fitness) in enumerate(offers):
        map_, cell, entered = insert(map_, np.array([x, y]), float(fitness), generation, 0, math.nan)
        index = other.insert(reference.Elite(float(fitness), (x, y), generation, math.nan))
        assert entered == (index is not None)
        assert not entered or PLANE.index_of(cell) == index
        fitness_C = np.full(PLANE.size, -np.inf)
        fitness_C[map_.cell_N] = map_.fitness_N
        assert (fitness_C >= worst).all()
        worst = fitness_C
    assert [PLANE.index_of(cell) for cell in map_.cell_N] == list(other.elites)
    assert map_.fitness_N.tolist() == [elite.fitness for elite in other.elites.values()]
    assert map_.generation_N.tolist() == [elite.generation for elite in other.elites.values()]
    columns = map_statistics(map_, -2.0, None)
    assert columns["coverage"] == reference.coverage(other.elites, 12)
    assert columns["qd_score"] == reference.qd_score(other.elites, -2.0)


@given(
    st.lists(
        st.tuples(st.integers(-1, 8).map(float), st.integers(-2, 10).map(lambda x: x / 4), st.integers(0, 4)),
        min_size=1,
        max_size=60,
    ),
    st.integers(1, 20),
    st.booleans(),
    st.booleans(),
)
def test_a_batch_enters_as_its_offers_one_after_another(offers, batch, counts_samples, with_gaps):
    place_N_2, fitness_N = np.array([offer[:2] for offer in offers]), np.array([float(offer[2]) for offer in offers])
    score_N, centre_N = np.where(fitness_N == 2.0, np.nan, -fitness_N), np.arange(len(offers)) + 3
    at_once = one_by_one = empty_map(PLANE, counts_samples=counts_samples)
    for generation, first in enumerate(range(0, len(offers), batch)):
        part = slice(first, first + batch)
        columns = fitness_N[part], generation, centre_N[part], score_N[part], 7
        at_once = insert_each(at_once, place_N_2[part], *columns)
        for row in range(len(offers))[part]:
            values = float(fitness_N[row]), generation, int(centre_N[row]), float(score_N[row]), 7
            one_by_one, _, _ = insert(one_by_one, place_N_2[row], *values)
        if with_gaps:
            at_once, one_by_one = (removed(map_, int(map_.cell_N[0])) for map_ in (at_once, one_by_one))
        assert_same_map(at_once, one_by_one)
        for earlier in range(generation + 1):
            entries = zip(at_once.generation_N, at_once.centre_N, at_once.cell_N, strict=True)
            cells = {centre: cell for made, centre, cell in entries if made == earlier}
            assert at_once.cells_with(earlier, centre_N).tolist() == [cells.get(one, EMPTY) for one in centre_N]


# Entries that change, move and leave


def test_a_changed_entry_has_other_values_and_its_place():
    map_ = filled(((1.0, 0.1), 5.0), ((5.0, 1.9), 1.0))
    now = changed(map_, 0, fitness=-3.0, score=7.0, samples=9)
    assert (now.fitness_N.tolist(), now.score_N.tolist(), now.samples_N) == ([-3.0, 1.0], [7.0, 101.0], None)
    np.testing.assert_array_equal(now.descriptor_N_B, map_.descriptor_N_B)
    assert changed(map_, 5, fitness=9.0) is map_


def test_the_others_keep_their_order_when_an_entry_leaves():
    map_ = filled(((5.0, 1.9), 1.0), ((0.0, 0.0), 1.0), ((3.0, 1.0), 1.0))  # cells 11, 0, 6
    without = removed(map_, 0)
    assert without.cell_N.tolist() == [11, 6]
    assert without.generation_N.tolist() == [0, 2]
    again, _, _ = insert(without, np.array([0.0, 0.0]), -1.0, 9, 0, 0.0)
    assert again.cell_N.tolist() == [11, 6, 0]
    assert removed(map_, 5) is map_
    assert removed(removed(removed(map_, 0), 6), 11).size == 0


def test_a_moved_entry_wins_its_new_cell_or_leaves_the_map():
    map_ = filled(((5.0, 1.9), 1.0), ((0.0, 0.0), 2.0), ((3.0, 1.0), 1.0))  # cells 11, 0, 6
    stays, cell, is_there = moved(map_, 0, np.array([0.4, 0.2]))
    assert (cell, is_there, stays.cell_N.tolist()) == (0, True, [11, 0, 6])
    assert stays.descriptor_N_B[1].tolist() == [0.4, 0.2]
    to_empty, cell, is_there = moved(map_, 11, np.array([0.0, 1.9]))
    assert (cell, is_there, to_empty.cell_N.tolist()) == (3, True, [0, 6, 3])
    assert to_empty.generation_N.tolist() == [1, 2, 0]
    wins, cell, is_there = moved(map_, 0, np.array([3.0, 1.0]))
    assert (cell, is_there, wins.cell_N.tolist()) == (6, True, [11, 6])
    assert (wins.generation_N.tolist(), wins.fitness_N.tolist()) == ([0, 1], [1.0, 2.0])
    leaves, cell, is_there = moved(map_, 11, np.array([3.0, 1.0]))  # as fit as the elite there
    assert (cell, is_there, leaves.cell_N.tolist(), leaves.generation_N.tolist()) == (6, False, [0, 6], [1, 2])
    with pytest.raises(KeyError):
        moved(map_, 5, np.zeros(2))


def test_samples_are_counted_and_averaged_where_a_map_counts_them():
    map_ = empty_map(PLANE, counts_samples=True)
    map_, _, _ = insert(map_, np.array([0.0, 0.0]), 4.0, 0, 0, 0.0, samples=3)
    map_, cell, is_there = resampled(map_, 0, np.array([4.0, 0.4]), 8.0, 1)
    assert map_.samples_N is not None
    assert (cell, is_there, map_.samples_N.tolist(), map_.fitness_N.tolist()) == (0, True, [4], [5.0])
    assert map_.descriptor_N_B.tolist() == [[1.0, 0.1]]
    map_, _, entered = insert(map_, np.array([0.0, 0.0]), 6.0, 1, 0, 0.0, samples=2)
    assert (entered, map_.samples_N.tolist()) == (True, [2])
    with pytest.raises(ValueError, match="does not count samples"):
        resampled(filled(((1.0, 0.1), 5.0)), 0, np.zeros(2), 0.0, 1)


# Metrics


def test_metrics_by_hand():
    map_ = filled(((1.0, 0.1), -5.0), ((5.0, 1.9), -1.5), ((3.0, 0.0), -20.0))
    reachable = np.ones(12, bool)
    reachable[[0, 2, 3]] = False  # of 9 reachable cells 2 are filled; the first is out of reach
    assert map_statistics(map_, -100.0, reachable) == {
        "map_cells": 3,
        "coverage": 0.25,
        "coverage_reachable": pytest.approx(2 / 9),
        "map_fitness_max": -1.5,
        "qd_score": 95.0 + 98.5 + 80.0,
    }


def test_metrics_of_an_empty_map():
    assert map_statistics(empty_map(PLANE), -100.0, None) == {
        "map_cells": 0,
        "coverage": 0.0,
        "coverage_reachable": None,
        "map_fitness_max": None,
        "qd_score": 0.0,
    }


def test_the_qd_score_does_not_depend_on_the_order_of_its_terms():
    offers = [((1.0, 0.1), 1e16), ((5.0, 1.9), 1.0), ((3.0, 0.0), -1e16), ((3.0, 1.9), 1.0)]
    scores = {map_statistics(filled(*order), 0.0, None)["qd_score"] for order in (offers, offers[::-1])}
    assert scores == {2.0}
