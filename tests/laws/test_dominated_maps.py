"""Maps of slots, by Dominated Novelty Search, against their reference implementation.

Which elites stay, whole searches that fill such a map, what is counted of it, and what a config may say.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.api import load_config
from es_service.errors import ConfigError
from es_service.loop.blocks import GEOMETRY, stored
from es_service.loop.forms import Sizes, problem
from es_service.protocol.messages import EvaluationChunk, TrainingChunk
from es_service.protocol.noise import Domain, normals, stream_keys, uniforms
from es_service.search.algorithms.base import CentreEvaluation
from es_service.search.algorithms.common import add_to_archive_and_map, first_state
from es_service.search.algorithms.map_elites import PARENT_CHOICE
from es_service.search.algorithms.me_es import CELL_CHOICE
from es_service.search.algorithms.memes import RESET_CHOICE
from es_service.search.maps.behaviour_map import (
    EMPTY,
    empty_map,
    insert,
    insert_each,
    map_statistics,
    moved,
    places_of,
    projected,
)
from es_service.search.maps.dominated import BLOCK, dominated_novelty, survivors
from es_service.search.maps.geometry import Dominated, Grid, make_geometry
from tests.laws import me_es_runs, test_map_elites, test_memes
from tests.laws.me_es_runs import assert_near, evaluation, first_centres, noise_of, points, run_in_memory
from tests.references import dominated as reference
from tests.references import map_elites as map_elites_reference
from tests.references import me_es as me_es_reference
from tests.references import memes as memes_reference
from tests.references.behaviour_map import Elite, GridMap

BOUNDS = ((0.0, 8.0), (0.0, 4.0))
SLOTS = Dominated(BOUNDS, (4, 2), 3, 2)
"""Three slots, two neighbours, and a grid of 2 by 2."""


def with_slots(config, slots, neighbours=2):
    """The same config with a map of slots."""
    of_map = {"kind": "dominated", "slots": slots, "neighbours": neighbours}
    return config.model_copy(update={"map": config.map.model_copy(update=of_map)})


# Which policies stay


@pytest.mark.parametrize(
    ("places", "fitness", "novelty", "stay"),
    [
        ((0, 1, 3, 7), (4, 3, 2, 1), (np.inf, 1.0, 2.5, 5.0), [0, 2, 3]),
        ((0, 1, 3, 7), (1, 2, 3, 4), (2.0, 4.0, 4.0, np.inf), [1, 2, 3]),  # 0: the nearest two of three, 1 and 3
        ((5, 5, 5, 5), (2, 2, 2, 2), (np.inf, 0.0, 0.0, 0.0), [0, 1, 2]),  # copies: the older ones stay
        ((0, 20, 4, -8), (9, 8, 1, 1), (np.inf, 20.0, 10.0, 10.0), [0, 1, 2]),  # equal in both: the older stays
        ((0, 2, 4, 9), (1, 2, 4, 3), (3.0, 4.5, np.inf, 5.0), [1, 2, 3]),
    ],
)
def test_dominated_novelty_and_survivors_by_hand(places, fitness, novelty, stay):
    place_N_B, fitness_N = np.array(places, float)[:, None], np.array(fitness, float)
    assert dominated_novelty(place_N_B, fitness_N, 2).tolist() == list(novelty)
    assert survivors(place_N_B, fitness_N, 2, 3).tolist() == stay
    assert survivors(place_N_B, fitness_N, 2, 4).tolist() == [0, 1, 2, 3]


def elites_of(offers):
    return [Elite(float(fitness), (x / 2, y / 2), 0, np.nan) for x, y, fitness in offers]


offers_of_some = st.lists(st.tuples(st.integers(0, 16), st.integers(0, 8), st.integers(0, 4)), min_size=1, max_size=12)


@given(offers_of_some, st.integers(1, 4), st.integers(1, 9))
def test_any_policies_equal_the_reference(offers, neighbours, slots):
    elites = elites_of(offers)
    place_N_B, fitness_N = np.array([one.descriptor for one in elites]), np.array([one.fitness for one in elites])
    expected = reference.dominated_novelty(elites, neighbours)
    assert dominated_novelty(place_N_B, fitness_N, neighbours).tolist() == expected
    other = reference.SlotMap(slots, neighbours)
    entered = other.offer(elites)
    stay = survivors(place_N_B, fitness_N, neighbours, slots)
    assert stay.tolist() == [age for age, slot in enumerate(entered) if slot is not None]
    assert fitness_N[stay].max() == fitness_N.max()


@given(st.lists(offers_of_some, min_size=1, max_size=6))
def test_any_generations_give_the_reference_s_map(generations):
    map_, other = empty_map(SLOTS), reference.SlotMap(3, 2)
    best = -np.inf
    for generation, offers in enumerate(generations):
        elites = [replace(one, generation=generation, centre=n) for n, one in enumerate(elites_of(offers))]
        before = dict(zip(map_.cell_N.tolist(), zip(map_.generation_N, map_.centre_N, strict=True), strict=True))
        place_Q_B, fitness_Q = np.array([one.descriptor for one in elites]), np.array([one.fitness for one in elites])
        centre_Q = np.arange(len(elites))
        map_ = insert_each(map_, place_Q_B, fitness_Q, generation, centre_Q, np.full(len(elites), np.nan))
        entered = other.offer(elites)
        assert map_.cells_with(generation, centre_Q).tolist() == [EMPTY if slot is None else slot for slot in entered]
        assert map_.cell_N.tolist() == list(other.elites)
        found = list(zip(map_.generation_N.tolist(), map_.centre_N.tolist(), strict=True))
        assert found == [(one.generation, one.centre) for one in other.elites.values()]
        best = max(best, fitness_Q.max())
        assert map_.fitness_N.max() == best, "the fittest never leaves"
        slot_of = {who: slot for slot, who in before.items()}
        assert all(slot_of.get(who, slot) == slot for slot, who in zip(map_.cell_N.tolist(), found, strict=True))


@given(st.randoms(use_true_random=False))
def test_policies_of_different_fitness_may_come_in_any_order(random):
    """So that the map does not depend on the order of the asks either."""
    rng = np.random.default_rng(random.randrange(2**32))
    place_N_B, fitness_N, order = rng.uniform(size=(30, 3)), rng.normal(size=30), rng.permutation(30)
    stay = set(survivors(place_N_B, fitness_N, 3, 10).tolist())
    assert {int(order[row]) for row in survivors(place_N_B[order], fitness_N[order], 3, 10)} == stay


def test_blocks_do_not_change_a_bit():
    rng, count = np.random.default_rng(5), BLOCK * 2 + 50
    place_N_B, fitness_N = rng.uniform(size=(count, 2)), rng.integers(0, 40, count).astype(float)
    novelty_N = dominated_novelty(place_N_B, fitness_N, 3)
    for row in rng.choice(count, 40, replace=False):
        fitter = (fitness_N > fitness_N[row]) | ((fitness_N == fitness_N[row]) & (np.arange(count) < row))
        difference_N_B = place_N_B[row] - place_N_B[fitter]
        nearest = np.sqrt(np.sort(difference_N_B[:, 0] ** 2 + difference_N_B[:, 1] ** 2)[:3])
        assert novelty_N[row] == ((nearest[0] + nearest[1] + nearest[2]) / 3 if nearest.size == 3 else novelty_N[row])
    assert np.isinf(novelty_N).sum() == 1


# The map


def filled(*offers):
    """A map of three slots after one generation of (place, fitness)."""
    place_Q_B, fitness_Q = np.array([place for place, _ in offers], float), np.array([of for _, of in offers], float)
    none_Q = np.full(len(offers), np.nan)
    return insert_each(empty_map(SLOTS), place_Q_B, fitness_Q, 1, np.arange(len(offers)), none_Q)


def test_elites_keep_their_slots_and_newcomers_take_the_free_ones():
    map_ = filled(((0, 0), 3), ((1, 0), 2), ((7, 3), 1))
    assert map_.cell_N.tolist() == [0, 1, 2]
    # By distance from fitter ones, 5 of (4, 3) and 24.7 of (30, 0) exceed 2.6 of (1, 0) and 4.9 of (7, 3).
    newer = insert_each(
        map_, np.array([[30.0, 0.0], [4.0, 3.0]]), np.array([0.0, 2.5]), 2, np.array([5, 6]), np.array([9.0, 8.0])
    )
    assert dict(zip(newer.cell_N.tolist(), newer.descriptor_N_B.tolist(), strict=True)) == {
        0: [0.0, 0.0],
        1: [30.0, 0.0],
        2: [4.0, 3.0],
    }
    assert newer.generation_N.tolist() == [1, 2, 2]
    assert newer.score_N[1:].tolist() == [9.0, 8.0]
    assert map_.cell_N.tolist() == [0, 1, 2], "the old map stays as it was"
    same = insert_each(newer, np.array([[0.0, 0.0]]), np.array([-1.0]), 3, np.array([0]), np.array([0.0]))
    assert same is newer


def test_a_slot_has_no_place():
    map_ = filled(((0, 0), 3))
    for call in (lambda: insert(map_, np.zeros(2), 9.0, 1, 0, 0.0), lambda: moved(map_, 0, np.zeros(2))):
        with pytest.raises(ValueError, match="the slots of a dominated map have no places"):
            call()


def test_coverage_and_qd_score_are_those_of_the_fittest_in_each_cell_of_the_grid():
    map_ = filled(((0.5, 0.5), 3), ((1.5, 1.5), 5), ((99.0, -1.0), 1))
    assert places_of(map_).tolist() == [0, 0, 6]
    shown = projected(map_)
    assert shown.geometry == Grid(BOUNDS, (4, 2))
    assert (shown.cell_N.tolist(), shown.fitness_N.tolist()) == ([0, 6], [5.0, 1.0])
    assert projected(shown) is shown
    reachable = np.array([True] * 5 + [False] * 3)
    assert map_statistics(map_, -2.0, reachable) == {
        "map_cells": 2,
        "coverage": 0.25,
        "coverage_reachable": 0.2,
        "map_fitness_max": 5.0,
        "qd_score": 10.0,
    }


def test_a_centre_has_the_slot_of_its_elite_and_gives_it_its_score_as_long_as_it_is_one():
    state = first_state([np.zeros(3, np.float32)] * 2, 2, 1.0, empty_map(replace(SLOTS, slots=2)))

    def told(state, generation, *evaluations):
        return add_to_archive_and_map(
            state,
            [
                CentreEvaluation(generation, n, True, fitness, np.array(place), 10.0 * generation + n)
                for n, (place, fitness) in enumerate(evaluations)
            ],
        )

    state = told(state, 0, ((0.0, 0.0), 1.0), ((4.0, 0.0), 2.0))
    assert [centre.cell for centre in state.centres] == [0, 1]
    assert state.map.score_N.tolist() == [0.0, 1.0]
    # (4, 0) is the fittest. (9, 0) is 5 from it; (0, 0) is 4 from it and 9 from (9, 0); (4, 1) is 1 from it.
    state = told(state, 1, ((4.0, 1.0), 1.0), ((9.0, 0.0), 1.5))
    assert state.map.descriptor_N_B.tolist() == [[0.0, 0.0], [4.0, 0.0]]
    assert [centre.cell for centre in state.centres] == [EMPTY, EMPTY]
    assert state.map.score_N.tolist() == [10.0, 11.0], "each population was around an elite"
    state = told(state, 2, ((5.0, 0.0), 3.0), ((4.0, 1.0), 1.5))
    # (5, 0) is the fittest, (4, 0) is 1 from it, (0, 0) is 4.5 from both, (4, 1) 1.2 from both.
    assert state.map.descriptor_N_B.tolist() == [[0.0, 0.0], [5.0, 0.0]]
    assert [centre.cell for centre in state.centres] == [1, EMPTY]
    assert state.map.score_N.tolist() == [10.0, 20.0], "the centres were no elites any more"
    assert state.archive.size == 6


def test_a_strangers_geometry_of_slots_is_found_out():
    arrays = {
        "bounds": np.array(BOUNDS),
        "grid_shape": np.array([4, 2]),
        "slots": np.array(3),
        "neighbours": np.array(2),
    }
    sizes = Sizes(3, 2, 2, (4, 2), BOUNDS, dominated={"slots": 3, "neighbours": 2})
    assert problem(GEOMETRY, arrays, sizes) == ""
    others = {"slots": np.array(4), "neighbours": np.array(9), "grid_shape": np.array([8, 1]), "bounds": np.eye(2)}
    for name, other in others.items():
        assert "other cells or bounds" in problem(GEOMETRY, {**arrays, name: other}, sizes)
    assert "other cells or bounds" in problem(GEOMETRY, {**arrays, "shape": np.array([4, 2])}, sizes)
    assert "has slots" in problem(GEOMETRY, {**arrays, "shape": np.array([4, 2])}, sizes._replace(dominated={}))


# Searches


def assert_same_elites(state, store, other, *, exact=True):
    map_ = state.search.map
    assert map_.cell_N.tolist() == list(other.elites)
    assert map_.generation_N.tolist() == [one.generation for one in other.elites.values()]
    for slot, one in other.elites.items():
        ours = store.elite(slot).parameters_D
        np.testing.assert_array_equal(ours, one.centre) if exact else assert_near(ours, one.centre)


def test_map_elites_on_slots_equals_the_reference():
    config = with_slots(test_map_elites.config_of(), slots=25, neighbours=3)
    state, store, evaluator = run_in_memory(config)
    batch, centres = test_map_elites.BATCH, test_map_elites.CENTRES
    other = map_elites_reference.MapElites(reference.SlotMap(25, 3), test_map_elites.ISO, test_map_elites.LINE)
    first = zip(first_centres(config), store.evaluated[0], strict=True)
    rows_of_first = [(centre_D, row["fitness_mean"], (row["x"], row["y"])) for centre_D, row in first]
    other.map.offer(
        [Elite(fitness, place, 0, np.nan, of.astype(float), n) for n, (of, fitness, place) in enumerate(rows_of_first)]
    )
    left = 0
    for generation in range(1, 13):
        key = stream_keys(0, Domain.SELECTION, generation, PARENT_CHOICE)
        drawn = uniforms(key, np.arange(2 * batch, dtype=np.uint32)).tolist()
        made = []
        for n in range(batch):
            noise = normals(stream_keys(0, Domain.VARIATION, generation, n), me_es_runs.SHAPE.parameters + 1).astype(
                float
            )
            made.append(other.policy(drawn[2 * n], drawn[2 * n + 1], noise)[1])
        told, rows, before = (
            test_map_elites.evaluated(evaluator, generation),
            store.evaluated[generation],
            dict(other.map.elites),
        )
        offered = []
        for n, (child, (parameters_D, fitness, place_B)) in enumerate(zip(made, told, strict=True)):
            np.testing.assert_allclose(parameters_D, child, rtol=0, atol=2e-6 * np.abs(child).max())
            offered.append(Elite(fitness, place_B, generation, np.nan, parameters_D.astype(float), centres + n))
        assert [row["cell"] for row in rows] == other.map.offer(offered)
        left += sum(one not in other.map.elites.values() for one in before.values())
        cells = GridMap(((-1.0, 1.0), (-1.0, 1.0)), me_es_runs.CELLS)
        cells.offer([*other.map.elites.values()])
        assert store.rows[generation]["map_cells"] == len(cells.elites)
        assert store.rows[generation]["coverage"] == len(cells.elites) / 300
    assert_same_elites(state, store, other.map)
    assert left > 20
    assert len(other.map.elites) == 25


def test_memes_on_slots_equals_the_reference():
    config = with_slots(test_memes.config_of(), slots=9)
    state, store, evaluator = run_in_memory(config)
    step, every = config.search.step, range(test_memes.EMITTERS)
    other = memes_reference.Memes(
        first_centres(config), reference.SlotMap(9, 2), step.learning_rate, step.l2, mode="explore_exploit",
        patience=test_memes.PATIENCE, neighbours=3, newest=test_memes.NEWEST,
    )  # fmt: skip
    other.end(0, [evaluation(evaluator, 0, ask) for ask in every])
    begun_from = []
    for generation in range(1, 25):
        key, rows = stream_keys(0, Domain.SELECTION, generation, RESET_CHOICE), store.evaluated[generation]
        begun = other.begin(uniforms(key, np.arange(test_memes.EMITTERS, dtype=np.uint32)).tolist())
        assert [row["start_cell"] for row in rows] == begun
        begun_from += [slot for slot in begun if slot is not None]
        for ask in every:
            _, fitness, place = points(evaluator, TrainingChunk, generation, ask)
            other.climb(ask, noise_of(generation, ask), fitness, place)
            assert_near(points(evaluator, EvaluationChunk, generation, ask)[0].parameters_D, other.emitters[ask].centre)
        told = [evaluation(evaluator, generation, ask) for ask in every]
        assert [row["cell"] for row in rows] == other.end(generation, told)
    assert_same_elites(state, store, other.map, exact=False)
    assert len(other.map.elites) == 9
    assert len(set(begun_from)) >= 2


@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_me_es_on_slots_equals_the_reference(preset):
    """Its newest elites and its scores are those of slots, too."""
    config = with_slots(me_es_runs.config_of(preset), slots=7)
    state, store, evaluator = run_in_memory(config)
    step, [centre_D] = config.search.step, first_centres(config)
    other = me_es_reference.MapElitesES(
        centre_D, reference.SlotMap(7, 2), step.learning_rate, step.l2, mode="explore_exploit",
        length=me_es_runs.BLOCK, neighbours=3, **me_es_runs.PRESETS[preset],
    )  # fmt: skip
    other.evaluated(0, *evaluation(evaluator, 0))
    for generation in range(1, 31):
        row, key = store.rows[generation], stream_keys(0, Domain.SELECTION, generation, CELL_CHOICE)
        assert row["start_cell"] == other.start(*uniforms(key, np.arange(2, dtype=np.uint32)).tolist())
        _, fitness, place = points(evaluator, TrainingChunk, generation)
        other.climb(noise_of(generation), fitness, place)
        assert row["cell"] == other.evaluated(generation, *evaluation(evaluator, generation), float(fitness.max()))
    np.testing.assert_allclose(state.search.map.score_N, [one.score for one in other.map.elites.values()], rtol=1e-12)
    assert_same_elites(state, store, other.map, exact=False)
    assert len(other.map.elites) == 7


# The config


def config_of(*overrides, **search):
    source = {
        "task": {"environment": "point_maze"},
        "search": {"algorithm": "memes", **search},
        "map": {"kind": "dominated"},
        "budget": {"generations": 1},
    }
    return load_config(source, overrides)


def test_a_dominated_map_has_the_slots_of_the_paper_and_the_cells_of_a_grid():
    config = config_of()
    assert make_geometry(config.map) == Dominated(((-1.0, 1.0), (-1.0, 1.0)), (20, 20), 1024, 3)
    assert {"map.slots", "map.neighbours"} <= config.constants().keys()


@pytest.mark.parametrize(
    ("overrides", "search", "sentence"),
    [
        ((), {"algorithm": "es"}, "map.kind: dominated is not allowed for es, which does not fill such a map; must be "
         "grid, cvt or auto"),
        ((), {"algorithm": "nsra_es"}, "map.kind: dominated is not allowed for nsra_es"),
        ((), {"algorithm": "jedi"}, "map.kind: dominated is not allowed for jedi"),
        (("map.slots=5000",), {}, "map.slots: 5000 is not allowed; must be at most 4,096"),
        (("map.slots=0",), {}, "map.slots: 0 is not allowed; must be a whole number, at least 1"),
        (("map.neighbours=0",), {}, "map.neighbours: 0 is not allowed"),
        (("map.cells=[400]",), {}, "map.cells: [400] has 1 numbers; must be 2 numbers, one for each of x, y, or auto"),
        (("map.centroids=kmeans",), {}, "map.centroids: kmeans has no effect with map.kind = dominated"),
        (("map.kind=grid", "map.slots=9"), {}, "map.slots: 9 has no effect with map.kind = grid; leave it out (a key "
         "of kind dominated)"),
        (("map.kind=cvt", "map.neighbours=9"), {}, "map.neighbours: 9 has no effect with map.kind = cvt"),
        ((), {"starts": "least_tried"}, "search.starts: least_tried is not allowed with map.kind = dominated, whose "
         "slots change their elites; must be uniform, novelty or fitness"),
        ((), {"algorithm": "me_es", "cell_sampling": "least_tried"}, "search.cell_sampling: least_tried is not "
         "allowed"),
        ((), {"algorithm": "map_elites", "elites": {"kind": "eme"}}, "search.elites.kind: eme is not allowed "
         "with map.kind = dominated, whose slots have no places between which elites could move; must be once"),
    ],
)  # fmt: skip
def test_what_a_config_may_not_say(overrides, search, sentence):
    with pytest.raises(ConfigError) as caught:
        config_of(*overrides, **search)
    assert sentence in str(caught.value)


def test_the_grid_of_many_dimensions_divides_the_first_six():
    from es_service.config.resolution import default_cells

    assert default_cells("dominated", 2) == (20, 20)
    assert default_cells("dominated", 9) == (4,) * 6 + (1,) * 3


def test_a_map_of_slots_is_stored_and_read_as_it_is():
    config = with_slots(test_map_elites.config_of(generations=2), slots=25)
    state, store, _ = run_in_memory(config)
    assert store.load().keys() == stored(state).keys()
    again, _, _ = run_in_memory(
        config.model_copy(update={"budget": config.budget.model_copy(update={"generations": 4})}), store=store
    )
    straight, _, _ = run_in_memory(with_slots(test_map_elites.config_of(generations=4), slots=25))
    assert again.search.map.geometry == straight.search.map.geometry
    np.testing.assert_array_equal(again.search.map.cell_N, straight.search.map.cell_N)
    np.testing.assert_array_equal(again.search.map.policy_N, straight.search.map.policy_N)
