"""Cells of a map: grids and centroids, edges, what is outside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.cluster.vq import kmeans2

from es_service import api
from es_service.loop.blocks import GEOMETRY
from es_service.loop.forms import Sizes, problem
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.maps import geometry as geometries
from es_service.search.maps.geometry import Cvt, Grid, intervals, make_geometry
from tests.es_service.config_examples import MINIMAL
from tests.es_service.map_examples import OBLONG, PLANE, SQUARE, map_config
from tests.references import behaviour_map as reference


@pytest.mark.parametrize(
    ("descriptor", "index"),
    [
        ((0.0, 0.0), (0, 0)),
        ((1.99, 0.49), (0, 0)),
        ((2.0, 0.5), (1, 1)),  # an edge belongs to the upper cell
        ((4.0, 1.5), (2, 3)),
        ((6.0, 2.0), (2, 3)),  # but for the last one
        ((-0.1, 9.0), (0, 3)),  # outside: the border cell
        ((1e300, -1e300), (2, 0)),
        ((3.0, 1.0), (1, 2)),
    ],
)
def test_cells_of_a_grid_by_hand(descriptor, index):
    assert PLANE.index_of(int(PLANE.cells_of([descriptor])[0])) == index
    assert reference.grid_index(PLANE.bounds, PLANE.shape, descriptor) == index


def test_edges_by_hand():
    assert [edges.tolist() for edges in PLANE.edges] == [[0.0, 2.0, 4.0, 6.0], [0.0, 0.5, 1.0, 1.5, 2.0]]
    assert Grid(((-0.3, 0.1),), (7,)).edges[0][-1] == 0.1


bounds_and_cells = st.lists(
    st.tuples(st.floats(-100.0, 100.0), st.floats(1e-3, 200.0), st.integers(1, 12)).map(
        lambda x: ((x[0], x[0] + x[1]), x[2])
    ),
    min_size=1,
    max_size=3,
)


@given(bounds_and_cells, st.data())
def test_grids_equal_the_reference_on_any_descriptor_and_on_every_edge(sides, data):
    bounds, shape = zip(*sides, strict=True)
    grid = Grid(bounds, shape)
    descriptors = [
        [data.draw(st.sampled_from(edges.tolist()) | st.floats(-400.0, 400.0)) for edges in grid.edges]
        for _ in range(5)
    ]
    expected = [
        reference.cell_number(shape, reference.grid_index(bounds, shape, descriptor)) for descriptor in descriptors
    ]
    assert grid.cells_of(descriptors).tolist() == expected


@given(places=st.lists(st.integers(-100, 300), min_size=1, max_size=9, unique=True))
def test_intervals_have_the_places_of_their_cells(places):
    """Of a grid and of a tessellation in one dimension."""
    for geometry in (Grid(((-1.0, 3.0),), (len(places),)), Cvt(((-1.0, 3.0),), np.array(places)[:, None] / 100)):
        ends_C_2 = intervals(geometry)
        assert np.sort(ends_C_2.ravel())[[0, -1]].tolist() == [-1.0, 3.0]
        assert (ends_C_2[:, 0] <= ends_C_2[:, 1]).all()
        middle_C = ends_C_2.mean(axis=1)
        wide_C = np.flatnonzero(np.diff(ends_C_2, axis=1)[:, 0] > 1e-9)
        assert geometry.cells_of(middle_C[:, None])[wide_C].tolist() == wide_C.tolist()


def test_cells_are_numbered_with_the_last_dimension_fastest():
    assert [PLANE.index_of(cell) for cell in (0, 1, 3, 4, 11)] == [(0, 0), (0, 1), (0, 3), (1, 0), (2, 3)]
    assert all(PLANE.cell_at(PLANE.index_of(cell)) == cell for cell in range(PLANE.size))
    assert all(reference.cell_number(PLANE.shape, PLANE.index_of(cell)) == cell for cell in range(PLANE.size))


@pytest.mark.parametrize("index", [(3, 0), (0, 4), (-1, 0), (0,), (0, 0, 0), ()])
def test_there_is_no_cell_outside_the_grid(index):
    assert PLANE.cell_at(index) is None


# Centroids


@pytest.mark.parametrize("bounds", [SQUARE, OBLONG])
def test_centroids_are_the_same_for_every_call_and_their_cells_are_alike(bounds):
    config = map_config(kind="cvt", cells=[256], bounds=[list(pair) for pair in bounds])
    cvt, again = make_geometry(config), make_geometry(config)
    assert isinstance(cvt, Cvt)
    assert isinstance(again, Cvt)
    assert cvt.centroid_C_B.tobytes() == again.centroid_C_B.tobytes()
    low, high = np.array(bounds).T
    places = np.random.default_rng(0).uniform(low, high, (100_000, 2))
    size = np.bincount(cvt.cells_of(places), minlength=256) / (100_000 / 256)
    assert 0.25 < size.min() <= size.max() < 2.5
    np.testing.assert_array_equal(cvt.cells_of(cvt.centroid_C_B), np.arange(256))


def test_centroids_lie_in_the_middle_of_their_cells():
    cvt = make_geometry(map_config(kind="cvt", cells=[16]))
    assert isinstance(cvt, Cvt)
    places = np.random.default_rng(1).uniform(-1.0, 1.0, (50_000, 2))
    cell = cvt.cells_of(places)
    middle = np.array([places[cell == c].mean(axis=0) for c in range(16)])
    assert np.abs(middle - cvt.centroid_C_B).max() < 0.1  # a cell is half as wide as the square is high


@pytest.mark.parametrize("dimensions", [1, 2, 7])
def test_centroids_of_k_means_are_as_many_and_nearly_as_even(dimensions):
    """A random place is at most 15 % farther from the nearest one than from one of Lloyd's, and nearer than to a random
    one."""
    bounds, config = ((-1.0, 3.0),) * dimensions, map_config(kind="cvt", cells=[200])
    random_N_B = np.random.default_rng(0).uniform(-1.0, 3.0, (4000, dimensions))

    def placed(how):
        cvt = make_geometry(config.model_copy(update={"bounds": bounds, "centroids": how}))
        assert isinstance(cvt, Cvt)
        assert cvt.size == 200
        assert ((cvt.centroid_C_B >= -1.0) & (cvt.centroid_C_B <= 3.0)).all()
        return cvt

    def distance(cvt):
        return np.linalg.norm(random_N_B - cvt.middles_of(cvt.cells_of(random_N_B)), axis=1).mean()

    lloyd, kmeans = distance(placed("lloyd")), distance(placed("kmeans"))
    drawn = distance(Cvt(bounds, np.random.default_rng(1).uniform(-1.0, 3.0, (200, dimensions))))
    assert kmeans < min(1.15 * lloyd, drawn)


def test_the_default_centroids_are_those_of_twenty_steps_of_lloyd_s_algorithm_bit_for_bit():
    bounds, key = [(0.0, 1.0), (-2.0, 2.0)], stream_keys(0, Domain.INITIALISATION, 0, 2**32)
    place_N_B = uniforms(key, np.arange(50 * 9 * 2, dtype=np.uint32)).astype(np.float64).reshape(-1, 2)
    share_C_B, _ = kmeans2(place_N_B, place_N_B[:9], iter=20, minit="matrix")
    cvt = make_geometry(map_config(kind="cvt", cells=[9], bounds=[list(pair) for pair in bounds]))
    assert isinstance(cvt, Cvt)
    low_B, high_B = np.array(bounds).T
    assert cvt.centroid_C_B.tobytes() == (low_B + share_C_B * (high_B - low_B)).tobytes()


@pytest.mark.parametrize("search", ["jedi", "memes", "map_elites"])
def test_a_config_is_read_without_placing_any_centroid(search, monkeypatch):
    """A method counts something for each cell; the number of cells is known before."""
    monkeypatch.setattr(geometries, "_centroids", lambda *_: pytest.fail("centroids are placed"))
    starts = {"starts": "least_tried"} if search == "memes" else {}
    config = MINIMAL | {"search": {"algorithm": search, **starts}, "map": {"kind": "cvt", "cells": [4096]}}
    assert api.load_config(config).map.cells == (4096,)


def test_the_nearest_centroid_and_of_equally_near_ones_the_first():
    cvt = Cvt(SQUARE, np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    assert cvt.cells_of([[0.4, 0.1], [0.5, 0.0], [1.0, 0.0], [0.5, 0.5], [-9.0, 9.0]]).tolist() == [0, 0, 1, 0, 3]


def test_many_descriptors_equal_the_reference():
    rng = np.random.default_rng(0)
    cvt = Cvt(((0.0, 1.0),) * 3, rng.integers(0, 5, (40, 3)) / 4)  # many are equally near
    descriptors = rng.integers(-1, 10, (500, 3)) / 8
    assert cvt.cells_of(descriptors).tolist() == [reference.nearest_centroid(cvt.centroid_C_B, d) for d in descriptors]


def test_descriptors_do_not_depend_on_how_many_are_asked_together():
    rng = np.random.default_rng(0)
    cvt = Cvt(SQUARE, rng.uniform(-1, 1, (5000, 2)))
    descriptors = rng.uniform(-1, 1, (450, 2))  # more than are compared at once
    assert cvt.cells_of(descriptors).tolist() == [int(cvt.cells_of(one[None])[0]) for one in descriptors]


def test_a_centroid_s_place_is_its_number():
    cvt = Cvt(SQUARE, np.zeros((5, 2)))
    assert (cvt.size, cvt.shape, cvt.index_of(3)) == (5, (5,), (3,))
    assert [cvt.cell_at(index) for index in ((4,), (5,), (-1,), (0, 0))] == [4, None, None, None]


def test_a_config_makes_its_geometry():
    grid = make_geometry(map_config(cells=[7, 3], bounds=[[-1, 2.5], [0.1, 0.3]]))
    assert grid == Grid(((-1.0, 2.5), (0.1, 0.3)), (7, 3))
    cvt = make_geometry(map_config(kind="cvt", cells=[9]))
    assert isinstance(cvt, Cvt)
    assert cvt.bounds == SQUARE


@pytest.mark.parametrize(("centroid", "is_right"), [((0.1, -0.9), True), ((0.5, 0.5), False), ((1e300, 0.0), False)])
def test_stored_centroids_are_different_places_in_the_map(centroid, is_right):
    arrays = {"bounds": np.array(SQUARE), "centroid_C_B": np.array([[0.5, 0.5], centroid])}
    found = problem(GEOMETRY, arrays, Sizes(9, 2, 2, (2,), SQUARE))
    assert found == (
        "" if is_right else "map/geometry has centroids outside of the bounds of the map, or twice the same"
    )


def test_cells_of_a_cvt_are_even_in_oblong_bounds_too():
    geometry = make_geometry(map_config(kind="cvt", cells=[64], bounds=[[0, 1], [0, 100]]))
    places = np.random.default_rng(0).uniform((0, 0), (1, 100), (64_000, 2))
    counts = np.bincount(geometry.cells_of(places), minlength=64)
    assert counts.min() > 400
    assert counts.max() < 2000
