"""JEDi: the model of the map, the cells that it finds promising, and the course of targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.api import load_config
from es_service.config.parts import NearnessObjective
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import CentreEvaluation
from es_service.search.algorithms.common import first_state
from es_service.search.algorithms.jedi import TARGET, VISITS, is_not_dominated, predicted, promising, target_weight
from es_service.search.algorithms.settings import settings_of
from es_service.search.maps.behaviour_map import empty_map, insert
from es_service.search.maps.geometry import Cvt, Grid, make_geometry
from es_service.search.shaping import nearness_values
from tests.helpers import policy_with

POINTS_N_1 = np.array([[0.1], [0.3], [0.5]])


def jedi(**search):
    settings = {"algorithm": "jedi", "emitters": 2, "pairs": 16, "target_generations": 3, **search}
    config = load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": []},
            "search": settings,
            "map": {"bounds": [[0, 9], [0, 1]], "cells": [9, 1]},
            "budget": {"generations": 9},
        }
    )
    method = ALGORITHMS["jedi"](config)
    map_ = empty_map(make_geometry(config.map))
    return config, method, first_state([np.zeros(6, np.float32)] * 2, 2, 1.0, map_, method.extra, config.search)


def test_nearness_and_fitness_are_scaled_to_the_range_of_the_population():
    fitness, places = [0.0, 10.0, 5.0, np.nan], [[0.0, 0.0], [3.0, 4.0], [0.0, 1.0], [0.0, 0.0]]
    for weight, expected in ((1.0, [1.0, 0.0, 0.8]), (0.0, [0.0, 1.0, 0.5]), (0.25, [0.25, 0.75, 0.575])):
        found = nearness_values(NearnessObjective(descriptor=(0.0, 0.0), weight=weight), fitness, places)
        assert np.allclose(found[:3], expected)
        assert np.isnan(found[3])
    same = nearness_values(NearnessObjective(descriptor=(0.0, 0.0)), [1.0, 1.0], [[1.0, 0.0], [0.0, 1.0]])
    assert same.tolist() == [0.0, 0.0]


def test_what_no_other_exceeds_in_both_is_not_dominated():
    first, second = np.array([3.0, 1.0, 2.0, 3.0, 2.0, 0.0, 3.0]), np.array([1.0, 3.0, 2.0, 0.5, 2.0, 9.0, 1.0])
    assert is_not_dominated(first, second).tolist() == [True, True, True, False, True, True, True]
    rng = np.random.default_rng(3)
    first, second = rng.integers(0, 6, (2, 60)).astype(float)
    by_hand = [
        not any((a >= x and b >= y) and (a > x or b > y) for a, b in zip(first, second, strict=True))
        for x, y in zip(first, second, strict=True)
    ]
    assert is_not_dominated(first, second).tolist() == by_hand


def test_the_model_equals_a_gaussian_process_by_hand_with_the_kernel_that_it_has_fitted(monkeypatch):
    from sklearn.gaussian_process import GaussianProcessRegressor

    fitted = []
    fit = GaussianProcessRegressor.fit
    monkeypatch.setattr(GaussianProcessRegressor, "fit", lambda self, x, y: fitted.append(fit(self, x, y)) or self)
    fitness_N, noise_N = np.array([-3.0, 5.0, 4.0]), np.array([0.1, 0.05, 0.02])
    at_C_1 = np.array([[0.1], [0.2], [0.9]])
    mean_C, std_C = predicted(POINTS_N_1, fitness_N, noise_N, at_C_1)
    scale, length = np.exp(fitted[0].kernel_.theta)

    def kernel(a, b):
        return scale * np.exp(-0.5 * np.square((a - b.T) / length))

    standard_N = (fitness_N - fitness_N.mean()) / fitness_N.std()
    solved = np.linalg.solve(kernel(POINTS_N_1, POINTS_N_1) + np.diag(noise_N), np.eye(3))
    across = kernel(at_C_1, POINTS_N_1)
    assert np.allclose(mean_C, across @ solved @ standard_N, atol=1e-6)
    assert np.allclose(std_C**2, scale - np.sum((across @ solved) * across, axis=1), atol=1e-6)


def test_the_unit_of_fitness_does_not_matter_and_what_was_visited_often_is_known_better():
    fitness_N, at_C_1 = np.array([-3.0, 5.0, 4.0]), np.linspace(0, 1, 11)[:, None]
    first, second = (predicted(POINTS_N_1, scale, np.full(3, 0.1), at_C_1) for scale in (fitness_N, 7 * fitness_N - 90))
    assert np.allclose(first, second, atol=1e-5)
    _, std_C = predicted(POINTS_N_1, fitness_N, np.array([0.1, 0.1, 0.001]), POINTS_N_1)
    assert std_C[2] < std_C[0]
    mean_C, std_C = predicted(POINTS_N_1[:1], fitness_N[:1], np.full(1, 0.1), at_C_1)
    assert np.isfinite(mean_C).all()
    assert std_C.argmin() == 1


def test_promising_cells_are_good_ones_and_unknown_ones():
    map_ = empty_map(Grid(((0.0, 10.0),), (10,)))
    for place, fitness in ((0.5, 0.0), (1.5, 1.0), (2.5, 4.0), (3.5, 2.0)):
        map_, _, _ = insert(map_, np.array([place]), fitness, 0, int(place), 0.0)
    found = promising(map_, np.full(10, 50), 0.01)[:, 0].tolist()
    assert 2.5 in found, "the best elite"
    assert max(found) > 3.5, "a cell that nobody has seen"
    assert not {0.5, 1.5} & set(found), "known to be worse"


def test_middles_of_cells_lie_in_them():
    for geometry in (Grid(((-1.0, 2.0), (0.0, 9.0)), (4, 3)), Cvt(((0.0, 1.0),), np.array([[0.2], [0.9], [0.5]]))):
        cells = np.arange(geometry.size)
        assert (geometry.cells_of(geometry.middles_of(cells)) == cells).all()


def told(method, state, generation, places):
    """The state after each emitter has ended at a place, with its fitness; None is invalid."""
    evaluations = [
        CentreEvaluation(generation, emitter, place is not None, float(place or 0), np.array([place or np.nan, 0.5]))
        for emitter, place in enumerate(places)
    ]
    return method.tell(state, tuple(evaluations))


def test_targets_change_after_their_generations_and_emitters_start_from_the_nearest_elites():
    _, method, state = jedi()
    assert [one.objective.kind for one in method.ask(state, 1)] == ["fitness", "fitness"]
    assert method.start_cells(state, 1) == {}
    state = told(method, state, 0, (1.5, 5.5))
    targets = [state.extra[TARGET]]
    for generation in range(1, 7):
        starts = method.start_cells(state, generation)
        nearest = [1 if abs(x - 1.5) <= abs(x - 5.5) else 5 for x, _ in state.extra[TARGET]]
        assert starts == (dict(enumerate(nearest)) if generation in (1, 4) else {})
        for emitter, cell in starts.items():
            state = method.restart(state, emitter, cell, policy_with(np.ones(6, np.float32)))
        asked = method.ask(state, generation)
        assert [one.objective.descriptor for one in asked] == [tuple(target) for target in targets[-1].tolist()]
        assert [one.objective.weight for one in asked] == pytest.approx([[1.0, 0.65, 0.3][(generation - 1) % 3]] * 2)
        state = told(method, state, generation, (1.5, None))
        if generation % 3 == 0:
            targets.append(state.extra[TARGET])
        assert (state.extra[TARGET] == targets[-1]).all()
    assert len(targets) == 3
    assert state.extra[VISITS].tolist() == [0, 7, 0, 0, 0, 1, 0, 0, 0]


def test_while_the_map_is_empty_again_emitters_climb_fitness_and_nothing_counts_as_visited():
    """As in a fork whose task has changed."""
    _, method, state = jedi()
    state = told(method, state, 0, (1.5, 5.5))
    assert state.map is not None
    forked = replace(state, map=empty_map(state.map.geometry))
    assert method.start_cells(forked, 4) == {}
    assert [one.objective.kind for one in method.ask(forked, 4)] == ["fitness", "fitness"]
    assert told(method, forked, 4, (2.5, 2.5)).extra[VISITS].tolist() == [0, 0, 2, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(("generations", "expected"), [(1, [0.3, 0.3]), (2, [1.0, 0.3, 1.0])])
def test_the_weight_of_nearness_goes_from_its_start_to_its_end(generations, expected):
    config, _, _ = jedi(target_generations=generations)
    search = settings_of(config, type(config.search))
    assert [target_weight(search, one) for one in range(1, len(expected) + 1)] == pytest.approx(expected)
