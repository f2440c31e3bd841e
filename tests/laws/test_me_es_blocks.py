"""ME-ES: where a block starts, worked by hand. Elites on a line; as many cells of one unit as it takes."""

from dataclasses import replace

import numpy as np
import pytest

from es_service.protocol.content import NAME
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import NO_CELL, CentreEvaluation
from es_service.search.algorithms.common import add_to_archive, elite_novelty, first_state, insert_into_map
from es_service.search.algorithms.me_es import cell_shares
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.maps.geometry import Grid
from es_service.search.novelty import empty_archive, extended
from tests.laws.me_es_runs import BLOCK, config_of


def line(descriptors, fitness=None, generations=None, scores=None):
    count = len(descriptors)
    return BehaviourMap(
        Grid(((0.0, 100.0),), (100,)),
        np.array(descriptors, np.int64),
        np.array(fitness or [0.0] * count, np.float64),
        np.array(descriptors, np.float64)[:, None],
        np.array(generations or range(count), np.int64),
        np.zeros(count, np.int64),
        np.array(scores or [0.0] * count, np.float64),
        *np.zeros((2, count), NAME),
    )


def archive_of(map_, *others):
    """The elites' own entries, each at its generation, and more that entered no cell: (generation, descriptor)."""
    entries = [*zip(map_.generation_N.tolist(), map_.descriptor_N_B[:, 0].tolist(), strict=True), *others]
    archive = empty_archive(1)
    for generation, descriptor in sorted(entries):
        archive = extended(archive, [descriptor], generation, 0)
    return archive


def shares(map_, mode, sampling, drawn, *others):
    settings = config_of(neighbours=1).novelty
    novelty_N = elite_novelty(map_, archive_of(map_, *others), settings)
    return cell_shares(map_, novelty_N, mode, sampling, drawn).tolist()


SPREAD = [0, 1, 3, 6, 10, 15, 21]
"""Distances to the nearest: 1 1 2 3 4 5 6."""
DUPLICATES = [(50 + x, float(x)) for x in SPREAD]
"""Centres that ended where an elite had ended before."""


@pytest.mark.parametrize("drawn", [0.0, 0.3, 0.99])
def test_exploring_from_the_top_five_by_hand(drawn):
    assert shares(line(SPREAD), "explore", "top", drawn) == [0, 0, 1, 1, 1, 1, 1]
    # A centre that entered no cell ended where the last elite did; the fifth of the top is the first of two equal ones.
    assert shares(line(SPREAD), "explore", "top", drawn, (50, 21.0)) == [1, 0, 1, 1, 1, 1, 0]
    assert shares(line([0, 1, 9]), "explore", "top", drawn) == [1, 1, 1]
    assert shares(line([7]), "explore", "top", drawn) == [1]


def test_exploring_by_novelty_by_hand():
    assert shares(line(SPREAD), "explore", "score", 0.0999) == [1] * 7
    assert shares(line(SPREAD), "explore", "score", 0.1) == [0, 0, 2, 3, 4, 5, 6]
    assert shares(line(SPREAD), "explore", "score", 0.99, (50, 21.0)) == [1, 0, 2, 3, 4, 5, 0]
    assert shares(line([0, 1, 9]), "explore", "score", 0.99) == [1, 1, 8]
    assert shares(line([7]), "explore", "score", 0.99) == [1]


def test_nothing_novel_anywhere():
    """Then any elite will do."""
    assert shares(line(SPREAD), "explore", "score", 0.99, *DUPLICATES) == [1] * 7
    assert shares(line(SPREAD), "explore", "top", 0.99, *DUPLICATES) == [1] * 7


def test_exploiting_the_fittest_by_hand():
    late = line(SPREAD, fitness=[9, 8, 1, 5, 2, 3, 4])
    assert shares(late, "exploit", "top", 0.4999) == [1, 1, 0, 0, 0, 0, 0]
    assert shares(late, "exploit", "top", 0.5) == [0, 0, 0, 1, 0, 0, 1]
    # The cell found first has a new elite: of the last five to enter, and the fittest of them.
    replaced = line(SPREAD, fitness=[9, 8, 1, 5, 2, 3, 4], generations=[9, 1, 2, 3, 4, 5, 6])
    assert shares(replaced, "exploit", "top", 0.5) == [1, 0, 0, 1, 0, 0, 0]
    for drawn in (0.0, 0.99):
        assert shares(line([0, 1, 9], fitness=[-3, -1, -2]), "exploit", "top", drawn) == [0, 1, 1]
        assert shares(line([7]), "exploit", "top", drawn) == [1]


@pytest.mark.parametrize(("drawn", "expected"), [(0.0, [1, 1, 0, 0, 0, 0, 0]), (0.99, [0, 0, 1, 1, 0, 0, 0])])
def test_of_equally_fit_elites_those_in_the_cells_filled_first(drawn, expected):
    assert shares(line(SPREAD, fitness=[5.0] * 7), "exploit", "top", drawn) == expected


def test_exploiting_scores_by_hand():
    six = line(SPREAD[:6], scores=[5, 9, 1, 7, 3, 8])
    assert shares(six, "exploit", "score", 0.4999) == [0, 1, 0, 0, 0, 0]
    assert shares(six, "exploit", "score", 0.5) == [0, 0, 0, 7, 0, 8]  # of the newest three; less the lowest, plus 1
    five = line(SPREAD[:5], scores=[-1, -2, -9, -4, -3])
    assert shares(five, "exploit", "score", 0.5) == [0, 0, 0, 6, 7]
    dozen = line(list(range(12)), scores=[*range(12, 0, -1)], generations=[*range(20, 8, -1)])
    assert shares(dozen, "exploit", "score", 0.5) == [0] * 7 + [5, 4, 0, 0, 0]  # newest as cells, not as elites
    four = line(SPREAD[:4], scores=[1, 3, 2, 0])
    for drawn in (0.0, 0.99):
        assert shares(four, "exploit", "score", drawn) == [0, 1, 0, 0]
        assert shares(line([7]), "exploit", "score", drawn) == [1]


def test_of_equal_scores_those_of_the_cells_filled_first():
    equal = line(SPREAD[:6], scores=[3, 7, 7, 4, 4, 4])
    assert shares(equal, "exploit", "score", 0.0) == [0, 1, 0, 0, 0, 0]
    assert shares(equal, "exploit", "score", 0.5) == [0, 0, 0, 2, 2, 0]


def test_an_elite_without_a_score_comes_last():
    none = np.nan
    assert shares(line([0, 1, 3], scores=[none, 4, 3]), "exploit", "score", 0.0) == [0, 1, 0]
    assert shares(line([0, 1], scores=[none, 3]), "exploit", "score", 0.0) == [0, 1]
    assert shares(line([0, 1, 3], scores=[none] * 3), "exploit", "score", 0.0) == [1, 0, 0]
    assert shares(line([0, 1, 3, 6, 10], scores=[9, 8, 7, 6, none]), "exploit", "score", 0.5) == [0, 0, 0, 1, 1]
    assert shares(line(SPREAD[:6], scores=[9, 8, 7, none, 6, 5]), "exploit", "score", 0.5) == [0, 0, 0, 0, 2, 1]


def test_an_elite_s_own_entry_is_no_neighbour_but_an_equal_one_is():
    map_ = line([10, 20], generations=[5, 0])
    archive = archive_of(map_, (2, 10.0), (3, 14.0))  # without a generation 1 or 4
    assert archive.generation_N.tolist() == [0, 2, 3, 5]
    plain, squared = (config_of(preset, neighbours=2).novelty for preset in ("literature", "uber"))
    assert elite_novelty(map_, archive, plain).tolist() == [2.0, 8.0]  # (0 + 4) / 2, (6 + 10) / 2
    assert elite_novelty(map_, archive, squared).tolist() == [8.0, 68.0]  # (0 + 16) / 2, (36 + 100) / 2
    newest = plain.model_copy(update={"newest": 2})  # 14 and the 10 of generation 5, which is the first elite's own
    assert elite_novelty(map_, archive, newest).tolist() == [4.0, 8.0]


def test_of_several_initial_centres_each_elite_leaves_out_its_own_entry():
    """And one that made none leaves out nothing."""
    map_ = replace(line([0, 10, 25, 40], generations=[0, 0, 0, 7]), centre_N=np.array([0, 2, 1, 0]))
    archive = empty_archive(1)
    for centre, descriptor in enumerate([0.0, 25.0, 10.0]):
        archive = extended(archive, [descriptor], 0, centre)
    novelty_N = elite_novelty(map_, archive, config_of(neighbours=1).novelty)
    assert novelty_N.tolist() == [10.0, 10.0, 15.0, 15.0]


@pytest.mark.parametrize("asked", [[0, 1, 2], [1, 0, 2], [2, 1, 0], [2, 0, 1]])
def test_an_elite_s_own_entry_is_no_neighbour_in_whatever_order_a_search_asks_for_centres(asked):
    places = {0: 0.0, 1: 10.0, 2: 30.0}
    map_ = replace(line([0, 10, 30], generations=[4, 4, 4]), centre_N=np.arange(3))
    archive = extended(empty_archive(1), [5.0], 3, 0)
    for centre in asked:
        archive = extended(archive, [places[centre]], 4, centre)
    assert elite_novelty(map_, archive, config_of(neighbours=1).novelty).tolist() == [5.0, 5.0, 20.0]


def state_at(map_):
    return replace(first_state([np.zeros(3, np.float32)], 1, 0.0, map_), archive=archive_of(map_))


@pytest.mark.parametrize(
    ("mode", "sampling", "expected"),
    [
        ("explore", "top", [0, 0, 0.2, 0.2, 0.2, 0.2, 0.2]),
        ("explore", "score", 0.1 / 7 + 0.9 * np.array([0, 0, 2, 3, 4, 5, 6]) / 20),
        ("exploit", "top", [0.25, 0.25, 0, 0.25, 0, 0, 0.25]),
        ("exploit", "score", [0.5, 0, 0, 0, 0.5 * 6 / 13, 0, 0.5 * 7 / 13]),
    ],
)
def test_cells_are_drawn_in_these_proportions(mode, sampling, expected):
    map_ = line(SPREAD, fitness=[9, 8, 1, 5, 2, 3, 4], scores=[19, 2, 11, 12, 7, 5, 8])
    config = config_of(mode=mode, cell_sampling=sampling, neighbours=1)
    start_cells = ALGORITHMS["me_es"](config).start_cells
    drawn = [start_cells(state_at(map_), generation)[0] for generation in range(1, 3 * 3000, BLOCK)]
    share = [drawn.count(cell) / 3000 for cell in SPREAD]
    assert sum(share) == pytest.approx(1.0)
    np.testing.assert_allclose(share, expected, atol=4 * np.sqrt(0.25 / 3000))
    assert [s == 0 for s in share] == [e == 0 for e in expected]


def test_a_cell_is_drawn_only_where_a_block_begins_and_an_elite_is_there():
    start_cells = ALGORITHMS["me_es"](config_of()).start_cells
    begun = [start_cells(state_at(line([7])), generation) for generation in range(1, 8)]
    assert begun == [{0: 7}, {}, {}] * 2 + [{0: 7}]
    assert start_cells(state_at(line([])), 1) == {}


# What an evaluation changes


def test_scores_by_hand():
    """(population's best, fitness, descriptor or None if invalid) -> scores of the cells; the cell entered."""
    state = first_state([np.zeros(3, np.float32)], 1, 0.0, line([]))
    for generation, (best, fitness, place, scores, cell) in enumerate(
        [
            (np.nan, -5, 1.5, {1: None}, 1),
            (10, -6, 1.2, {1: 10}, NO_CELL),  # from the elite of cell 1, to none
            (20, -7, 4.5, {1: 10, 4: 20}, 4),  # from none: scores nothing but what it enters
            (7, 0, None, {1: 10, 4: 7}, NO_CELL),  # invalid, but the population counts, lower as it is
            (99, -8, 4.1, {1: 10, 4: 7}, NO_CELL),
            (30, -1, 1.1, {1: 30, 4: 7}, 1),
            (40, -0.5, 1.9, {1: 40, 4: 7}, 1),  # into its own cell
            (50, -9, 6.0, {1: 50, 4: 7, 6: 50}, 6),
        ]
    ):
        evaluation = CentreEvaluation(generation, 0, place is not None, fitness, np.array([place or np.nan]), best)
        state = insert_into_map(add_to_archive(state, evaluation), evaluation)
        assert state.map is not None
        known = dict(zip(state.map.cell_N.tolist(), state.map.score_N.tolist(), strict=True))
        assert {cell: None if np.isnan(score) else score for cell, score in known.items()} == scores
        assert state.centres[0].cell == cell
    assert state.archive.size == 7
