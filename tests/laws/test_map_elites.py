"""MAP-Elites against its reference implementation.

Also parents, variation, invalid policies, and what a config may say.
"""

from dataclasses import replace

import numpy as np
import pytest

from es_service.api import load_config
from es_service.config.workload import chunks_at_once, parallel_sentence
from es_service.errors import ConfigError
from es_service.protocol.content import names
from es_service.protocol.messages import PolicyChunk
from es_service.protocol.noise import Domain, normals, stream_keys, uniforms
from es_service.protocol.policies import IsoLine, variation
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import CentreEvaluation
from es_service.search.algorithms.common import first_state
from es_service.search.algorithms.map_elites import PARENT_CHOICE, parent_cells
from es_service.search.maps.behaviour_map import empty_map, insert
from es_service.search.maps.geometry import Grid
from tests.laws.me_es_runs import CELLS, SHAPE, first_centres, number, run_in_memory
from tests.references import map_elites as reference
from tests.references.behaviour_map import GridMap

BATCH, CENTRES, ISO, LINE = 20, 3, 0.3, 0.6


def config_of(generations=12, episodes=2, **search):
    return load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8]},
            "search": {
                "algorithm": "map_elites",
                "batch": BATCH,
                "centres": CENTRES,
                "iso_sigma": ISO,
                "line_sigma": LINE,
                "evaluation_episodes": episodes,
                **search,
            },
            "map": {"cells": list(CELLS)},
            "budget": {"generations": generations},
        }
    )


def evaluated(evaluator, generation):
    """(parameters, mean fitness, mean descriptor) of each policy of a generation."""
    asked = [(at, chunk, of) for at, chunk, of in evaluator.recorded if chunk.generation == generation]
    assert {type(chunk) for _, chunk, _ in asked} == {PolicyChunk}
    found = []
    for policies in {id(at): at for at, _, _ in asked}.values():
        results = [of for at, _, of in asked if at is policies]
        fitness = np.concatenate([of.fitness for of in results]).reshape(policies.episodes, -1)
        place = np.concatenate([of.descriptor for of in results]).reshape(policies.episodes, -1, 2)
        assert policies.observation_mean_N_O is policies.observation_std_N_O is None
        means = fitness.mean(0, dtype=np.float64), place.mean(0, dtype=np.float64)
        found += zip(policies.parameters_N_D.made(), *means, strict=True)
    return found


def test_twelve_generations_equal_the_reference():
    config = config_of()
    state, store, evaluator = run_in_memory(config)
    other = reference.MapElites(GridMap(((-1.0, 1.0), (-1.0, 1.0)), CELLS), ISO, LINE)
    elites = other.map.elites
    for index, (centre_D, row) in enumerate(zip(first_centres(config), store.evaluated[0], strict=True)):
        other.evaluated(0, index, centre_D.astype(float), row["fitness_mean"], (row["x"], row["y"]))
    seen = set()
    for generation in range(1, 13):
        key = stream_keys(0, Domain.SELECTION, generation, PARENT_CHOICE)
        drawn = uniforms(key, np.arange(2 * BATCH, dtype=np.uint32)).tolist()
        made = []
        for n in range(BATCH):
            noise = normals(stream_keys(0, Domain.VARIATION, generation, n), SHAPE.parameters + 1).astype(float)
            parents, child = other.policy(drawn[2 * n], drawn[2 * n + 1], noise)
            made.append(child)
            seen.add(parents)
        told, rows = evaluated(evaluator, generation), store.evaluated[generation]
        assert len(told) == len(rows) == BATCH
        for n, (child, (parameters_D, fitness, descriptor_B)) in enumerate(zip(made, told, strict=True)):
            np.testing.assert_allclose(parameters_D, child, rtol=0, atol=2e-6 * np.abs(child).max())
            other.evaluated(generation, CENTRES + n, parameters_D.astype(float), fitness, descriptor_B)
        for n, row in enumerate(rows):
            assert row["centre"] == CENTRES + n
            mine = [
                index for index, one in elites.items() if (one.generation, one.emitter) == (generation, CENTRES + n)
            ]
            assert row["cell"] == (number(mine[0]) if mine else None)
        assert store.rows[generation]["map_cells"] == len(elites)
    map_ = state.search.map
    assert map_.cell_N.tolist() == [number(index) for index in elites]
    assert map_.generation_N.tolist() == [one.generation for one in elites.values()]
    assert map_.centre_N.tolist() == [one.emitter for one in elites.values()]
    np.testing.assert_allclose(map_.fitness_N, [one.fitness for one in elites.values()], rtol=1e-6)
    for index, one in elites.items():
        np.testing.assert_array_equal(store.elite(number(index)).parameters_D, one.centre)
    assert len(elites) > 20
    assert len(seen) > 100
    assert any(x == y for x, y in seen)
    assert state.search.archive.size == CENTRES


# Parents and their children


def cell_name(cell):
    """Name of the policy in a cell."""
    return bytes([1, cell] * 16)


def elites_in(cells):
    """A state whose map has elites in some of a hundred cells in a row."""
    map_ = empty_map(Grid(((0.0, 100.0),), (100,)))
    for cell in cells:
        map_, _, entered = insert(map_, np.array([cell + 0.5]), 0.0, 0, cell, np.nan)
        assert entered
    map_ = replace(map_, policy_N=names(map(cell_name, cells)))
    return first_state([np.zeros(3, np.float32), np.ones(3, np.float32)], 1, 1.0, map_)


def test_both_parents_are_drawn_from_all_filled_cells_with_equal_probability():
    cells, config = [70, 3, 50, 51], config_of(batch=4000)
    drawn_N_2 = parent_cells(config, elites_in(cells), 1)
    together = [(x, y) for x in cells for y in cells]
    found = [((drawn_N_2 == pair).all(axis=1)).mean() for pair in together]
    assert sum(found) == pytest.approx(1.0)
    np.testing.assert_allclose(found, 1 / 16, atol=4 * np.sqrt(1 / 16 / 4000))
    assert (parent_cells(config, elites_in(cells), 2) != drawn_N_2).any()


def test_parents_are_named_each_once_as_the_elites_of_their_cells():
    config, state = config_of(batch=2), elites_in([70, 3, 50, 51])
    (asked,) = ALGORITHMS["map_elites"](config).ask(state, 1)
    recipes, cell_N_2 = asked.parameters_N_D, parent_cells(config, state, 1)
    assert len(recipes.names) == len(set(recipes.names)) == len(np.unique(cell_N_2)) <= 4
    assert recipes.parents == ()
    named = [[recipes.names[parent] for parent in both] for both in recipes.parent_N_2.tolist()]
    assert named == [[cell_name(cell) for cell in both] for both in cell_N_2.tolist()]


def test_while_the_map_is_empty_the_parents_are_the_centres():
    """As in a fork whose evaluations mean something else."""
    search = ALGORITHMS["map_elites"](config_of(batch=64, iso_sigma=0.0, line_sigma=0.0))
    (asked,) = search.ask(elites_in([]), 1)
    assert {tuple(row) for row in asked.parameters_N_D.made().tolist()} == {(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)}


def test_a_child_is_its_first_parent_plus_noise_plus_a_step_along_the_line_to_the_second():
    x_D, y_D = (np.random.default_rng(seed).normal(size=20_000).astype(np.float32) for seed in (0, 1))
    key = stream_keys(0, Domain.VARIATION, 1, 0)
    np.testing.assert_array_equal(variation(x_D, y_D, key, IsoLine(0.0, 0.0)), x_D)
    noise_D = variation(x_D, x_D, key, IsoLine(0.005, 0.05)) - x_D  # no line from a parent to itself
    assert noise_D.std() == pytest.approx(0.005, rel=4 / np.sqrt(2 * 20_000))
    assert abs(np.corrcoef(noise_D, x_D)[0, 1]) < 4 / np.sqrt(20_000)
    steps = []
    for n in range(2000):
        key = stream_keys(0, Domain.VARIATION, 1, n)
        step_D = variation(x_D[:4], y_D[:4], key, IsoLine(0.0, 0.05)) - x_D[:4]
        shares = step_D / (y_D - x_D)[:4]
        np.testing.assert_allclose(shares, shares[0], atol=1e-5)
        steps.append(shares[0])
    assert np.std(steps) == pytest.approx(0.05, rel=4 / np.sqrt(2 * 2000))
    assert np.mean(steps) == pytest.approx(0.0, abs=4 * 0.05 / np.sqrt(2000))


def test_a_policy_made_with_others_is_the_same_as_one_made_alone():
    config, size = config_of(batch=19), 999
    noise = [normals(key, size) for key in stream_keys(0, Domain.PARAMETER_NOISE, 1, np.arange(2))]
    state, search = first_state(noise, 1, 1.0, elites_in([]).map), ALGORITHMS["map_elites"](config)
    (asked,) = search.ask(state, 3)
    made_N_D = asked.parameters_N_D.made()
    for n, (x, y) in enumerate(parent_cells(config, state, 3)):
        key = stream_keys(0, Domain.VARIATION, 3, n)
        alone_D = variation(noise[x], noise[y], key, IsoLine(ISO, LINE))
        np.testing.assert_array_equal(made_N_D[n], alone_D)
        np.testing.assert_array_equal(asked.parameters_N_D.part([n, 0]).made()[0], alone_D)


def test_an_invalid_policy_and_one_no_fitter_than_the_elite_enter_no_map():
    search = ALGORITHMS["map_elites"](config_of())
    state = search.tell(elites_in([]), tuple(told(0, index, -9.0, 10.5) for index in (0, 1)))
    assert (state.map.size, state.archive.size) == (1, 2)
    after = search.tell(
        state,
        (
            told(1, 2, -1.0, 20.5, valid=False),
            told(1, 3, -9.0, 10.5),
            told(1, 4, -8.0, 10.5),
            told(1, 5, -7.0, 30.5),
            told(1, 6, -7.0, 30.6),
        ),
    )
    assert after.map.cell_N.tolist() == [10, 30]
    assert after.map.centre_N.tolist() == [4, 5]
    assert after.archive is state.archive
    assert after.centres is state.centres


def told(generation, centre, fitness, place, valid=True):
    return CentreEvaluation(generation, centre, valid, fitness, np.array([place]))


# The config


PLAIN = {"task": {"environment": "point_maze"}, "search": {"algorithm": "map_elites"}, "budget": {"generations": 1}}


@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_a_config_has_one_episode_for_each_policy_and_plain_observations(preset):
    config = load_config(PLAIN, {"search.preset": preset})
    search = config.search
    assert (search.batch, search.iso_sigma, search.line_sigma, search.evaluation_episodes) == (256, 0.005, 0.05, 1)
    assert (search.centres, config.policy.observation_normalization, config.policy.observation_clip) == (
        32,
        False,
        None,
    )
    assert load_config(PLAIN, {"search.centres": 7, "search.evaluation_episodes": 5}).search.centres == 7
    assert chunks_at_once(config) == 16
    assert "(256 policies), enough for 16 workers; search.batch and" in parallel_sentence(config)


def test_statistics_that_nothing_gathers_and_a_search_without_a_map_are_refused():
    with pytest.raises(ConfigError) as caught:
        load_config(PLAIN, {"policy.observation_normalization": True, "map.enabled": False})
    assert [problem.field for problem in caught.value.problems] == ["policy.observation_normalization", "map.enabled"]
    assert "policy.observation_normalization: true is not allowed for map_elites, which has no train" in str(
        caught.value
    )
    assert "map.enabled: false is not allowed for map_elites, whose policies descend from elites" in str(caught.value)
