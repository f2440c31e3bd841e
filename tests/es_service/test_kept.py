"""The container of elites that are measured again: cases worked out by hand, and laws for any batch."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.protocol.content import NAME
from es_service.search.maps.behaviour_map import empty_map
from es_service.search.maps.geometry import Grid
from es_service.search.maps.kept import (
    KeptPolicies,
    at_rows,
    drawn_again,
    empty_kept,
    put,
    top_layer,
    with_means,
)

LINE = Grid(((0.0, 10.0),), (10,))
"""Ten cells in a row: cell 3 reaches from 3 to 4."""


def policies(*values, first=0, generation=0):
    """Policies of (fitness, place), one sample each, numbered from `first` on."""
    count = len(values)
    numbers = first + np.arange(count)
    fitness, place = (np.array([value[at] for value in values], float) for at in (0, 1))
    return KeptPolicies(
        numbers,
        np.full(count, -1),
        fitness,
        place[:, None],
        np.ones(count, int),
        np.full(count, generation),
        numbers,
        np.full(count, np.nan),
        *np.zeros((2, count), NAME),
    )


def kept_of(*values, depth=2, **more):
    return put(empty_kept(1), policies(*values), LINE, depth, **more)


def cells_of(kept):
    """Cell -> numbers of its policies by rank."""
    found = {}
    for cell, serial in zip(kept.cell_K.tolist(), kept.serial_K.tolist(), strict=True):
        found.setdefault(cell, []).append(serial)
    return found


def test_a_cell_keeps_its_fittest_policies_and_of_equal_ones_the_older():
    kept = kept_of((1, 3.5), (2, 3.1), (2, 3.9), (5, 7.0), (0, 3.0))
    assert cells_of(kept) == {3: [1, 2], 7: [3]}
    assert kept.ranks.tolist() == [0, 1, 0]
    more = put(kept, policies((2, 3.2), (3, 3.3), (4, 7.5), first=5), LINE, 2)
    assert cells_of(more) == {3: [6, 1], 7: [3, 7]}
    assert cells_of(put(more, empty_kept(1), LINE, 1)) == {3: [6], 7: [3]}


def test_luck_falls_moves_or_leaves_and_the_next_one_rises():
    """Three policies in cell 3; the fittest is measured again with 0 at 5.5: its means are 4 at 4.5."""
    kept = kept_of((8, 3.5), (6, 3.2), (5, 3.8), (3, 4.1), (2, 4.2), depth=3)
    again = with_means(kept, np.array([0]), np.array([0.0]), np.array([[5.5]]))
    assert (again.fitness_K[0], again.descriptor_K_B[0, 0], again.samples_K[0]) == (4.0, 4.5, 2)
    assert kept.fitness_K[0] == 8.0
    moved = put(at_rows(again, np.arange(1, 5)), at_rows(again, np.array([0])), LINE, 3)
    assert cells_of(moved) == {3: [1, 2], 4: [0, 3, 4]}
    assert cells_of(put(at_rows(again, np.arange(1, 5)), at_rows(again, np.array([0])), LINE, 2)) == {
        3: [1, 2],
        4: [0, 3],
    }
    third = with_means(moved, np.array([2]), np.array([-2.0]), np.array([[4.5]]))  # (8 + 0 - 2) / 3
    assert (third.fitness_K[2], third.samples_K[2]) == (2.0, 3)
    np.testing.assert_allclose(third.descriptor_K_B[2], [4.5])
    fallen = put(third, empty_kept(1), LINE, 3)
    assert cells_of(fallen) == {3: [1, 2], 4: [3, 0, 4]}  # equal to policy 4, and older
    assert cells_of(put(third, empty_kept(1), LINE, 1)) == {3: [1], 4: [3]}


def test_in_a_deep_grid_newcomers_take_free_places_and_then_those_of_random_residents():
    kept = kept_of((8, 3.5), (6, 3.2), depth=3)
    worse = policies((1, 3.1), (0, 3.9), first=2)
    for drawn, left in ((0.9, 0), (0.2, 1)):
        random = np.array([1.0 - drawn, drawn])
        after = put(kept, worse, LINE, 3, "any", random)
        assert cells_of(after) == {3: [left, 2, 3]}
    many = policies(*[(-n, 3.5) for n in range(5)], first=2)
    assert cells_of(put(kept, many, LINE, 3, "any", np.zeros(2))) == {3: [2, 3, 4]}


def test_the_map_is_the_top_layer_in_the_order_of_filling():
    kept = kept_of((1, 7.5), (2, 3.5), (3, 3.6), (4, 5.5))
    first = top_layer(kept, empty_map(LINE, counts_samples=True))
    assert first.cell_N.tolist() == [7, 3, 5]  # by the numbers 0, 2 and 3
    assert first.centre_N.tolist() == [0, 2, 3]
    gone = at_rows(kept, kept.cell_K != 3)
    more = put(gone, policies((1, 1.5), (9, 5.1), (2, 0.5), first=4, generation=1), LINE, 2)
    second = top_layer(more, first)
    assert second.cell_N.tolist() == [7, 5, 1, 0]
    assert second.centre_N.tolist() == [0, 5, 4, 6]
    assert second.samples_N.tolist() == [1, 1, 1, 1]
    assert second.fitness_N.tolist() == [1.0, 9.0, 1.0, 2.0]
    assert top_layer(empty_kept(1), first).size == 0


@pytest.mark.parametrize(
    ("draw", "weights"),
    [
        ("exponential", [1.0, np.exp(-1), np.exp(-2), 1.0]),
        ("linear", [3.0, 2.0, 1.0, 3.0]),
        ("harmonic", [1.0, 1 / 2, 1 / 3, 1.0]),
        ("uniform", [1.0] * 4),
    ],
)
def test_policies_are_drawn_by_rank_without_replacement(draw, weights):
    kept = kept_of((5, 3.5), (4, 3.5), (3, 3.5), (1, 8.0), depth=3)
    rng, trials, weights = np.random.default_rng(0), 800, np.array(weights)
    share = weights / weights.sum()
    pairs = np.zeros((4, 4))
    for _ in range(trials):
        first, second = drawn_again(kept, 2, draw, rng.random(4)).tolist()
        pairs[first, second] += 1 / trials
    for i in range(4):
        for j in range(i + 1, 4):  # one after the other, in either order
            expected = share[i] * share[j] / (1 - share[i]) + share[j] * share[i] / (1 - share[j])
            assert pairs[i, j] == pytest.approx(expected, abs=4 * np.sqrt(expected / trials))
    assert drawn_again(kept, 4, draw, np.zeros(4)).tolist() == [0, 1, 2, 3]
    assert drawn_again(kept, 9, draw, np.zeros(4)).tolist() == [0, 1, 2, 3]
    assert drawn_again(kept, 0, draw, rng.random(4)).size == 0


VALUES = st.lists(st.tuples(st.integers(0, 4), st.floats(-1, 11)), max_size=30)


@given(VALUES, VALUES, st.integers(1, 4))
def test_a_batch_is_put_as_by_sorting_each_cell(first, second, depth):
    kept = put(kept_of(*first, depth=depth), policies(*second, first=len(first)), LINE, depth)
    cells = {}
    for batch, offset in ((first, 0), (second, len(first))):
        for n, (fitness, place) in enumerate(batch, offset):
            cells.setdefault(min(9, max(0, int(np.floor(place)))), []).append((-fitness, n))
        cells = {cell: sorted(one)[:depth] for cell, one in cells.items()}
    assert cells_of(kept) == {cell: [n for _, n in one] for cell, one in sorted(cells.items())}
    assert kept.centre_K.tolist() == kept.serial_K.tolist()
