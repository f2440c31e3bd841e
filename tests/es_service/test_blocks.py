"""A state as named arrays: compared by content, stored in blocks of rows, read-only, refused if they are no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.loop import forms
from es_service.loop.blocks import BLOCK_BYTES, changes, joined, state_of, stored, value_of
from es_service.loop.state import NO_BEST, RunState
from es_service.protocol.messages import Moments
from es_service.search.algorithms.base import frozen
from es_service.search.algorithms.common import first_state
from es_service.search.arrays import problem, read_only, same_rows
from es_service.search.maps.behaviour_map import BehaviourMap, empty_map
from es_service.search.maps.geometry import Cvt, Dominated
from tests.es_service.map_examples import PLANE

ROWS = BLOCK_BYTES // 16
"""Rows of a block of an array [rows, 2] of float64."""


def state(extra=None, map_=None):
    search = frozen(first_state([np.zeros(3, np.float32)] * 2, 2, 1.0, map_, extra or {}))
    return RunState(0, search, Moments(1.0, np.zeros(2), np.ones(2)), NO_BEST, 2**40, 3, 0.0)


def rows(count):
    return {"a": {"x": np.arange(2.0 * count).reshape(count, 2)}}


def found(now, then):
    """Blocks of a search's own values that differ, with the number of rows of x; None for those that are gone."""
    differing = changes(state(now), state(then))[0].items()
    return {name: None if block is None else len(block["x"]) for name, block in differing if name.startswith("extra/")}


def test_only_the_blocks_with_new_rows_are_written():
    assert found(rows(3 * ROWS), {}) == {f"extra/a#{block:06d}": ROWS for block in range(3)}
    assert found(rows(3 * ROWS + 1), rows(2 * ROWS + 1)) == {"extra/a#000002": ROWS, "extra/a#000003": 1}
    assert found(rows(5), rows(5)) == {}
    assert found(rows(ROWS), rows(ROWS + 1)) == {"extra/a#000001": None}
    assert found(rows(0), rows(1)) == {"extra/a#000000": 0}
    assert found(rows(1), rows(0)) == {"extra/a#000000": 1}


def test_only_the_blocks_in_which_rows_have_changed_are_written():
    changed = rows(3 * ROWS)
    changed["a"]["x"][ROWS] = -0.0
    assert found(changed, rows(3 * ROWS)) == {"extra/a#000001": ROWS}


def test_wide_rows_are_in_small_blocks():
    assert found({"a": {"x": np.zeros((4, 70_000))}}, {}) == {f"extra/a#{block:06d}": 1 for block in range(4)}


def test_what_is_not_all_of_the_same_rows_is_stored_whole():
    assert found({"a": {"x": np.zeros(5 * ROWS), "y": np.zeros(())}}, {}) == {"extra/a": 5 * ROWS}


@pytest.mark.parametrize("other", [np.array(-0.0), np.array(0.0, np.float32), np.zeros(1), np.array(0)])
def test_bits_types_and_shapes_count(other):
    assert "extra" not in changes(state({"a": np.array(0.0)}), state({"a": np.array(0.0)}))[0]
    differing, _ = changes(state({"a": other}), state({"a": np.array(0.0)}))
    assert [name for name, block in differing.items() if block and "a" in block] == [
        "extra#000000" if other.ndim else "extra"
    ]


def test_a_name_that_changes_its_kind_leaves_nothing_behind():
    differing, _ = changes(state({"a": {"y": np.array(1)}}), state(rows(ROWS + 1)))
    assert {name for name, block in differing.items() if block is None} == {"extra/a#000000", "extra/a#000001"}
    assert joined({name: block for name, block in differing.items() if block}).keys() == {"extra/a"}


def test_a_state_is_what_its_blocks_say():
    """Optional values, numbers, tuples, alternatives and nested mappings come back as what they were."""
    geometry = Cvt(((0.0, 1.0), (-1.0, 2.0)), np.array([[0.1, 0.0], [0.2, 1.0], [0.9, 1.5]]))
    extra = {"deep": {"deeper": {"x": np.arange(3)}, "empty": {}}, "plain": np.array(True)}
    before = state(extra, empty_map(geometry, counts_samples=True))
    first, second = before.search.centres
    first = replace(first, own_mean_O=np.ones(2, np.float32), own_std_O=np.zeros(2, np.float32), entry=3)
    before = replace(before, search=replace(before.search, centres=(first, second)))
    again = state_of(stored(before), 0, 0.0)
    assert changes(again, before) == ({}, frozenset())
    assert (again.env_steps, again.search.weight, again.search.centres[0].entry) == (2**40, before.search.weight, 3)
    assert again.search.centres[1].own_mean_O is None
    assert again.search.map.geometry.bounds == geometry.bounds
    assert again.search.map.samples_N.dtype == np.int64
    assert dict(again.search.extra["deep"]["empty"]) == {}
    grid = state_of(stored(state({}, empty_map(PLANE))), 0, 0.0).search.map
    assert (grid.geometry, grid.samples_N) == (PLANE, None)
    slots = Dominated(PLANE.bounds, PLANE.shape, 9, 2)
    assert state_of(stored(state({}, empty_map(slots))), 0, 0.0).search.map.geometry == slots
    assert state_of(stored(state()), 0, 0.0).search.map is None


def test_a_missing_array_is_named():
    nodes = joined(stored(state({}, empty_map(PLANE))))
    assert value_of(BehaviourMap | None, nodes, "map").size == 0
    with pytest.raises(ValueError, match="the state has no archive"):
        state_of({path: arrays for path, arrays in nodes.items() if path != "archive"}, 0, 0.0)


def test_arrays_are_read_only_with_those_of_which_they_are_views():
    whole = np.zeros((3, 3))
    for value in (read_only({"a": {"x": whole[0]}})["a"]["x"], read_only({"x": whole[1]})["x"], whole):
        with pytest.raises(ValueError, match="read-only"):
            value[...] = 1.0
    assert read_only({"x": np.asfortranarray(np.ones((2, 3)))})["x"].flags.c_contiguous


def test_rows_at_the_same_place_in_memory_are_the_same():
    room = np.arange(8.0)
    np.testing.assert_array_equal(same_rows(room[:6], room[:4]), [True] * 4)
    np.testing.assert_array_equal(same_rows(room[:6], room[1:5]), [False] * 4)
    np.testing.assert_array_equal(same_rows(room[:6:2], room[:4]), [True, False, False])


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ([0.0], "its own value 'a' is a list; it must be a NumPy array"),
        (np.array(["x"]), "its own value 'a' is an array of <U1; it must be"),
        ({"x": 3}, "its own value 'x' is a int; it must be a NumPy array"),
        ({"x/y": np.zeros(1)}, "the name 'x/y' of a value of its own is no text without '/' and '#'"),
        ({3: np.zeros(1)}, "the name 3 of a value of its own is no text"),
    ],
)
def test_what_cannot_be_stored_is_named(value, why):
    assert why in problem({"b": np.zeros(1), "a": value})
    assert problem({"a": np.float32(1), "b": rows(1), "c": {"0": {"x": np.zeros(1)}}, "d": {}}) == ""


@pytest.mark.parametrize(("name", "is_right"), [("extra/a#00005", True), ("extra/a", True), ("extra/a#5x", False)])
def test_a_stored_block_ends_with_its_number(name, is_right):
    found = forms.problem(name, {}, forms.Sizes(1, 1, 1, None, ()))
    assert found == ("" if is_right else f"{name} has no number at its end")
