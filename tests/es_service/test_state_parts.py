"""Values that a search remembers: read-only, compared by content, stored in pieces, refused if they are no numbers."""

from __future__ import annotations

import numpy as np
import pytest

from es_service.loop import forms
from es_service.search.state_parts import BLOCK_ROWS, Appended, ByCell, Whole, changes, from_parts, problem, read_only


def rows(count):
    return Appended({"x": np.arange(2.0 * count).reshape(count, 2)})


def test_only_the_blocks_with_new_rows_are_written():
    assert set(changes({"a": rows(3 * BLOCK_ROWS)}, {})) == {f"rows_a/{block:08d}" for block in range(3)}
    found = changes({"a": rows(3 * BLOCK_ROWS + 1)}, {"a": rows(2 * BLOCK_ROWS + 1)})
    assert {name: len(part["x"]) for name, part in found.items() if part} == {
        "rows_a/00000002": BLOCK_ROWS,
        "rows_a/00000003": 1,
    }
    assert changes({"a": rows(5)}, {"a": rows(5)}) == {}
    assert changes({"a": rows(BLOCK_ROWS)}, {"a": rows(BLOCK_ROWS + 1)}) == {"rows_a/00000001": None}
    assert set(changes({"a": rows(0)}, {"a": rows(1)})) == {"rows_a/00000000"}


def test_wide_rows_are_in_small_blocks():
    found = changes({"a": Appended({"x": np.zeros((4, 70_000))})}, {})
    assert [len(part["x"]) for part in found.values() if part] == [1, 1, 1, 1]


def test_only_entries_that_differ_are_written():
    before = ByCell({7: {"x": np.zeros(2)}, 3: {"x": np.array(np.nan)}, 5: {"x": np.ones(1)}})
    after = ByCell({3: {"x": np.array(np.nan)}, np.int64(5): {"x": np.ones(2)}, 9: {}})
    found = changes({"a": after}, {"a": before})
    assert {name: None if part is None else sorted(part) for name, part in found.items()} == {
        "cells_a/00000005": ["x"],
        "cells_a/00000009": [],
        "cells_a/00000007": None,
    }
    assert list(from_parts({"cells_a": {}})["a"].entries) == []
    assert list(after.entries) == [3, 5, 9]


@pytest.mark.parametrize("other", [np.array(-0.0), np.array(0.0, np.float32), np.zeros(1), np.array(0)])
def test_bits_types_and_shapes_count(other):
    assert changes({"a": np.array(0.0)}, {"a": np.array(0.0)}) == {}
    assert set(changes({"a": other}, {"a": np.array(0.0)})) == {"own"}
    assert set(changes({"a": Whole({"x": other})}, {"a": Whole({"x": np.array(0.0)})})) == {"whole_a"}


def test_a_name_that_changes_its_kind_leaves_nothing_behind():
    before = {"a": rows(BLOCK_ROWS + 1), "b": np.array(1)}
    found = changes({"a": ByCell({1: {}})}, before)
    assert {name for name, part in found.items() if part is None} == {"rows_a/00000000", "rows_a/00000001", "own"}
    assert {name for name, part in found.items() if part is not None} == {"cells_a", "cells_a/00000001"}


def test_arrays_are_read_only_with_those_of_which_they_are_views():
    whole = np.zeros((2, 3))
    for value in (Whole({"x": whole[0]}).arrays["x"], read_only({"x": whole[1]})["x"], whole):
        with pytest.raises(ValueError, match="read-only"):
            value[...] = 1.0
    assert read_only({"x": np.asfortranarray(np.ones((2, 3)))})["x"].flags.c_contiguous


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ([0.0], "its own value 'a' is a list; it must be a NumPy array"),
        (np.array(["x"]), "its own value 'a' is an array of <U1; it must be"),
        (Whole({"x": 3}), "its own value 'a' has a int where a NumPy array"),
        (ByCell({-1: {}}), "its own value 'a' has cells that are no whole numbers from 0 on"),
        (Appended({}), "must have one or more arrays, all with the same number of rows"),
        (Appended({"x": np.zeros(2), "y": np.zeros(3)}), "all with the same number of rows"),
        (Appended({"x": np.zeros(())}), "all with the same number of rows"),
        (Appended({"x": np.zeros(2), "y": np.zeros(())}), "all with the same number of rows"),
    ],
)
def test_what_cannot_be_stored_is_named(value, why):
    assert why in problem({"b": np.zeros(1), "a": value})
    assert problem({"a": np.float32(1), "b": rows(1), "c": ByCell({0: {"x": np.zeros(1)}}), "d": Whole({})}) == ""


@pytest.mark.parametrize(("name", "is_right"), [("cells_a/00000005", True), ("cells_a", True), ("rows_a/5x", False)])
def test_a_stored_piece_ends_with_its_number(name, is_right):
    found = forms.problem(name, {}, forms.Sizes(1, 1, 1, None, ()))
    assert found == ("" if is_right else f"{name} has no number at its end")
