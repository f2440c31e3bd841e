"""The novelty archive against a slow reference implementation and by hand; tree and store change no bit."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.protocol import nearest
from es_service.protocol.nearest import COPIES, ROWS, archive_entries
from es_service.search import novelty as search_novelty
from es_service.search.novelty import (
    TREE_STEP,
    NoveltyArchive,
    empty_archive,
    extended,
    novelty,
    sound_archive,
)
from tests.references import novelty_search as reference

coordinates = st.integers(-3, 3).map(float) | st.floats(-1e3, 1e3, allow_subnormal=False)
points = st.tuples(coordinates, coordinates)


def archive_of(descriptors, dimensions=2) -> NoveltyArchive:
    archive = empty_archive(dimensions)
    for index, descriptor in enumerate(descriptors):
        archive = extended(archive, descriptor, index, 0)
    return archive


def many(descriptor_N_B) -> NoveltyArchive:
    """An archive made in one go, as a resumed run makes it."""
    entries = np.asarray(descriptor_N_B, np.float64)
    return search_novelty.archive_of(entries, np.arange(len(entries)), np.zeros(len(entries), np.int64))


def of(archive, queries, neighbours=2, distance="euclidean", exclude=None):
    return novelty(archive, queries, neighbours=neighbours, distance=distance, exclude_Q=exclude).tolist()


def test_by_hand():
    archive = archive_of([(0, 0), (3, 4), (0, 1), (0, 1)])
    assert of(archive, [(0, 0)], 3) == [2 / 3]  # 0, 1, 1
    assert of(archive, [(0, 0)], 4) == [7 / 4]
    assert of(archive, [(0, 0)], 10) == [7 / 4]  # fewer than asked for: all of them
    assert of(archive, [(0, 0)], 4, "squared_euclidean") == [27 / 4]
    assert of(archive, [(0, 0)], 3, exclude=[0]) == [7 / 3]
    assert of(archive, [(0, 1)], 1, exclude=[2]) == [0.0]  # only that entry is left out, not its duplicate
    assert of(archive, [(0, 1)], 2, exclude=[-1]) == [0.0]


def test_only_the_newest_entries_count_if_the_others_are_left_out():
    """They stay in the archive, though; an index of an entry is its place among all."""
    archive = archive_of([(0, 0), (9, 9), (0, 2), (0, 5)])
    ask = {"neighbours": 1, "distance": "euclidean"}
    for newest, expected in ((None, 0.0), (9, 0.0), (4, 0.0), (3, 2.0), (2, 2.0), (1, 5.0)):
        assert novelty(archive, [(0, 0)], newest=newest, **ask).tolist() == [expected]
    assert novelty(archive, [(0, 2)] * 3, newest=2, exclude_Q=[2, 0, -1], **ask).tolist() == [3.0, 0.0, 0.0]
    assert archive.size == 4


@pytest.mark.parametrize("entries", [900, 3000])
def test_the_newest_entries_are_searched_as_if_there_were_no_others(entries):
    random = np.random.default_rng(0)
    places, queries = random.normal(size=(entries, 2)), random.normal(size=(50, 2))
    archive, own = many(places), random.integers(entries, size=50)
    for newest in (700, 40):
        alone = many(places[-newest:])
        ask = {"neighbours": 5, "distance": "euclidean"}
        np.testing.assert_array_equal(novelty(archive, queries, newest=newest, **ask), novelty(alone, queries, **ask))
        shifted = np.where(own >= entries - newest, own - (entries - newest), -1)
        np.testing.assert_array_equal(
            novelty(archive, places[own], newest=newest, exclude_Q=own, **ask),
            novelty(alone, places[own], exclude_Q=shifted, **ask),
        )
    longer = extended(archive, (50.0, 50.0), entries, 0)
    assert novelty(longer, [(50.0, 50.0)], neighbours=1, distance="euclidean", newest=700).tolist() == [0.0]


def test_nothing_is_near_in_an_empty_archive():
    """In particular no entry of zeros that was never made."""
    assert of(empty_archive(2), [(5.0, 5.0), (0.0, 0.0)]) == [0.0, 0.0]
    one = archive_of([(5.0, 5.0)])
    assert of(one, [(5.0, 5.0), (5.0, 6.0)], 10) == [0.0, 1.0]
    assert of(one, [(5.0, 5.0)], 10, exclude=[0]) == [0.0]


def test_axes_and_queries_that_are_not_finite():
    archive = archive_of([(0, 0)])
    result = novelty(
        archive, np.array([[[0, 1], [np.nan, 0]], [[0, 2], [0, np.inf]]]), neighbours=1, distance="euclidean"
    )
    np.testing.assert_array_equal(result, [[1, np.nan], [2, np.nan]])
    assert novelty(archive, np.array([3.0, 4.0]), neighbours=1, distance="euclidean") == 5.0


def test_an_archive_never_changes():
    first = archive_of([(0, 0)])
    second = extended(first, (1, 1), 7, 3)
    assert first.size == 1
    assert second.size == 2
    assert second.generation_N.tolist() == [0, 7]
    assert second.centre_N.tolist() == [0, 3]


def test_archives_that_share_room_do_not_see_each_others_entries():
    """An archive is never changed by what is added to it, twice over, or to one that came from it."""
    old = many([(float(n), 0.0) for n in range(3)])
    left, right = extended(old, (9.0, 9.0), 3, 0), extended(old, (7.0, 7.0), 3, 1)
    longer = extended(left, (8.0, 8.0), 4, 0)
    assert old.descriptor_N_B[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert left.descriptor_N_B[:, 0].tolist() == [0.0, 1.0, 2.0, 9.0]
    assert right.descriptor_N_B[:, 0].tolist() == [0.0, 1.0, 2.0, 7.0]
    assert longer.descriptor_N_B[:, 0].tolist() == [0.0, 1.0, 2.0, 9.0, 8.0]
    assert (left.centre_N[-1], right.centre_N[-1], longer.generation_N[-1]) == (0, 1, 4)


@given(st.lists(points, max_size=40), st.lists(points, min_size=1, max_size=5), st.integers(1, 12))
def test_equals_the_reference_bit_by_bit(entries, queries, neighbours):
    archive = archive_of(entries)
    for distance in ("euclidean", "squared_euclidean"):
        expected = [reference.novelty(entries, query, neighbours, distance != "euclidean") for query in queries]
        assert of(archive, queries, neighbours, distance) == expected


@pytest.mark.parametrize("dimensions", [1, 2, 4])
@pytest.mark.parametrize("scatter", ["uniform", "grid", "one point", "line", "piles"])
@pytest.mark.parametrize("neighbours", [10, COPIES - 7, COPIES + 3])
def test_the_tree_changes_no_bit(dimensions, scatter, neighbours):
    """Ties and duplicates, where a tree may choose other neighbours than we would, included."""
    rng = np.random.default_rng(0)
    entries = {
        "uniform": lambda n: rng.uniform(-1, 1, (n, dimensions)),
        "grid": lambda n: rng.integers(0, 4, (n, dimensions)) / 3.0,
        "one point": lambda n: np.full((n, dimensions), 0.3),
        "line": lambda n: np.repeat(rng.uniform(-1, 1, (n, 1)) / 3, dimensions, axis=1),
        "piles": lambda n: (
            np.where(rng.random((n, 1)) < 0.6, rng.integers(0, 2, (n, 1)) / 3, rng.normal(size=(n, 1)))
            + np.zeros(dimensions)
        ),
    }[scatter]
    archive = many(entries(2 * TREE_STEP + 100))
    assert archive.tree is not None
    assert archive.tree.entries == 2 * TREE_STEP
    assert (archive.tree.kd.n < 2 * TREE_STEP) == (
        scatter in ("one point", "piles") or (scatter, dimensions) == ("grid", 1)
    )
    queries = np.concatenate([entries(40), archive.descriptor_N_B[:10], archive.descriptor_N_B[-10:]])
    exclude = np.concatenate([np.full(40, -1), np.arange(10), np.arange(archive.size - 10, archive.size)])
    with_tree = of(archive, queries, neighbours, exclude=exclude)
    brute = NoveltyArchive(archive.descriptor_N_B, archive.generation_N, archive.centre_N)
    assert with_tree == of(brute, queries, neighbours, exclude=exclude)
    some = [
        reference.novelty(archive.descriptor_N_B, queries[i], neighbours, without=int(exclude[i])) for i in (0, 41, 59)
    ]
    assert [with_tree[i] for i in (0, 41, 59)] == some


@pytest.mark.parametrize("cores", [1, 3])
def test_many_queries_are_divided_and_change_no_bit(monkeypatch, cores):
    rng = np.random.default_rng(1)
    archive = many(rng.uniform(-1, 1, (TREE_STEP + 30, 2)))
    queries, exclude = rng.uniform(-1, 1, (50, 2)), rng.integers(-1, archive.size, 50)
    queries[[0, 13, 14, 49], 1] = math.nan
    whole = of(archive, queries, exclude=exclude)
    assert [i for i, one in enumerate(whole) if math.isnan(one)] == [0, 13, 14, 49]
    monkeypatch.setattr(nearest, "BLOCK", 7)
    monkeypatch.setattr(search_novelty, "usable_cpus", lambda: cores)
    np.testing.assert_array_equal(of(archive, queries, exclude=exclude), whole)


def test_a_pile_of_equal_ends_costs_no_more_than_its_copies(monkeypatch):
    """Policies that do not move: each query near them would otherwise look at all that ever ended there."""
    rng = np.random.default_rng(0)
    archive = many(np.concatenate([np.full((4000, 2), 0.25), rng.uniform(-1, 1, (1000, 2))]))
    assert archive.tree is not None
    looked_at: list[int] = []
    ball = type(archive.tree.kd).query_ball_point

    def counted(self, point, radius):
        found = ball(self, point, radius)
        looked_at.append(len(found))
        return found

    monkeypatch.setattr(type(archive.tree.kd), "query_ball_point", counted)
    queries = np.full((20, 2), 0.25) + rng.normal(size=(20, 2)) / 100
    brute = NoveltyArchive(archive.descriptor_N_B, archive.generation_N, archive.centre_N)
    assert of(archive, queries, 10) == of(brute, queries, 10)
    assert looked_at
    assert max(looked_at) < 2 * COPIES


def test_trees_become_rare_where_they_are_large():
    archive = many(np.random.default_rng(0).uniform(size=(2**18 + 700, 2)))
    assert archive.tree is not None
    assert archive.tree.entries == 2**18 + 512
    same = archive
    for _ in range(300):
        same = extended(same, (0.5, 0.5), 0, 0)
        assert same.tree is archive.tree
    assert extended(same, (0.5, 0.5), 0, 0).size == 2**18 + 1001
    brute = NoveltyArchive(same.descriptor_N_B, same.generation_N, same.centre_N)
    assert of(same, [(0.5, 0.5), (0.1, 0.7)], 10) == of(brute, [(0.5, 0.5), (0.1, 0.7)], 10)


@pytest.mark.parametrize("off", [-1e-12, 0.0, 1e-12])
def test_a_tree_that_rounds_otherwise_changes_no_bit(monkeypatch, off):
    """Though its last bits be off: queries that it cannot decide are compared with all that is as near."""
    archive = many(np.random.default_rng(1).integers(0, 6, (2 * TREE_STEP, 2)) / 7.0)
    queries = archive.descriptor_N_B[:50] + 1 / 3
    expected = of(NoveltyArchive(archive.descriptor_N_B, archive.generation_N, archive.centre_N), queries, 3)
    assert archive.tree is not None
    tree, undecided = type(archive.tree.kd), []
    query, ball = tree.query, tree.query_ball_point

    def rounded(self, points, count):
        reach, candidates = query(self, points, count)
        return reach * (1.0 + off), candidates

    def counted(self, point, radius):
        undecided.append(point)
        return ball(self, point, radius)

    monkeypatch.setattr(tree, "query", rounded)
    monkeypatch.setattr(tree, "query_ball_point", counted)
    assert of(archive, queries, 3) == expected
    assert len(undecided) > 10  # a grid is full of ties


def test_an_archive_that_a_search_has_cut_is_one_of_its_own_entries():
    """Its arrays may begin where those of the archive before do, and still be others."""
    whole = empty_archive(2)
    for entry in range(100):
        whole = extended(whole, [float(entry), 0.0], entry, 0)
    assert sound_archive(whole) is whole
    columns = {name: getattr(whole, name)[::2] for name in ("descriptor_N_B", "generation_N", "centre_N")}
    thinned = sound_archive(replace(whole, **columns, tree=None))
    np.testing.assert_array_equal(thinned.generation_N, np.arange(0, 100, 2))
    with pytest.raises(ValueError, match="arrays of the novelty archive"):
        sound_archive(replace(whole, generation_N=whole.generation_N[:50]))


@pytest.mark.parametrize("newest", [None, 700, 40])
@pytest.mark.parametrize("entries", [3, ROWS, 900])
def test_entries_that_travel_by_name_give_the_same_bits(entries, newest):
    """Each full array once, and a tree only where there is a new one."""
    random = np.random.default_rng(entries)
    places, queries = random.normal(size=(entries + 3 * ROWS, 2)), np.float32(random.normal(size=(5, 2, 2)))
    queries[1, 1, 0] = np.nan
    there: dict[bytes, np.ndarray] = {}
    before, size_before = None, 0
    for size in (entries, entries + 1, entries + ROWS, entries + 3 * ROWS):
        sent = archive_entries(places[:size], newest, 10, "euclidean")
        assert all(len(array) == ROWS for array in sent.arrays[:-1])
        rows = size if before is None else size - size_before
        assert sum(name not in there for name in sent.names) <= -(-rows // ROWS) + 1  # the last one grows
        there |= zip(sent.names, sent.arrays, strict=True)
        whole = replace(sent, arrays=()).complete(there, before)
        assert whole.size == min(size, newest or size)
        expected = novelty(many(places[:size]), queries, neighbours=10, distance="euclidean", newest=newest)
        np.testing.assert_array_equal(whole.novelty(queries), expected)
        assert whole.complete({}, whole) is whole
        if size == entries + 1 and newest is None:
            assert whole.tree is before.tree
        assert (whole.tree is None) == (whole.first + whole.size < ROWS)
        before, size_before = whole, size
