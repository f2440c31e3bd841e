"""MEMES against its reference implementation.

Also when an emitter is reset and from where, interruption, and what a config may say.
"""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from es_service.api import load_config
from es_service.config.workload import parallel_sentence
from es_service.errors import ConfigError
from es_service.loop.blocks import EXTRA, joined
from es_service.loop.history import history_columns
from es_service.protocol.messages import EvaluationChunk, TrainingChunk
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import CentreEvaluation
from es_service.search.algorithms.common import TRIED, Starts, drawn_cell, first_state, start_shares
from es_service.search.algorithms.memes import AGE, RESET_CHOICE, STAGNANT
from es_service.search.maps.behaviour_map import empty_map, insert
from es_service.search.maps.geometry import Grid
from es_service.search.novelty import empty_archive, extended
from es_service.store.codec import decode_part, encode_part
from tests.helpers import policy_with
from tests.laws import me_es_runs
from tests.laws.me_es_runs import (
    CELLS,
    Sharing,
    assert_near,
    evaluation,
    first_centres,
    noise_of,
    number,
    points,
    run_in_memory,
)
from tests.references import memes as reference
from tests.references.behaviour_map import GridMap
from workers.environments import SHIPPED

EMITTERS, PATIENCE, NEWEST = 4, 2, 30


def config_of(generations=24, **search):
    """A run whose newest entries are soon fewer than all; l2 keeps Adam from dividing rounding by rounding."""
    named = {"algorithm": "memes", "emitters": EMITTERS, "stagnation_generations": PATIENCE}
    named["step"] = {"learning_rate": 0.2, "l2": 0.005}
    config = me_es_runs.config_of(generations=generations, **{**named, "parent_statistics": "global", **search})
    return config.model_copy(update={"novelty": config.novelty.model_copy(update={"newest": NEWEST})})


@pytest.mark.parametrize("mode", ["explore_exploit", "explore", "exploit"])
def test_twenty_four_generations_equal_the_reference(mode):
    config = config_of(mode=mode)
    state, store, evaluator = run_in_memory(config)
    other = reference.Memes(
        first_centres(config),
        GridMap(((-1.0, 1.0), (-1.0, 1.0)), CELLS),
        config.search.step.learning_rate,
        config.search.step.l2,
        mode=mode,
        patience=PATIENCE,
        neighbours=3,
        newest=NEWEST,
    )
    elites, every, resets = other.map.elites, range(EMITTERS), []
    other.end(0, [evaluation(evaluator, 0, ask) for ask in every])
    for generation in range(1, 25):
        rows = store.evaluated[generation]
        key = stream_keys(0, Domain.SELECTION, generation, RESET_CHOICE)
        begun = other.begin(uniforms(key, np.arange(EMITTERS, dtype=np.uint32)).tolist())
        resets += [(ask, cell) for ask, cell in enumerate(begun) if cell is not None]
        assert [row["start_cell"] for row in rows] == [number(cell) for cell in begun]
        assert [row["fitness_weight"] for row in rows] == [0.0 if explores else 1.0 for explores in other.explores]
        for ask in every:
            start, fitness, descriptor = points(evaluator, TrainingChunk, generation, ask)
            assert_near(start.parameters_D, other.emitters[ask].centre)
            other.climb(ask, noise_of(generation, ask), fitness, descriptor)
            moved = points(evaluator, EvaluationChunk, generation, ask)[0].parameters_D
            assert_near(moved, other.emitters[ask].centre)
        told = [evaluation(evaluator, generation, ask) for ask in every]
        for row, (_, place) in zip(rows, told, strict=True):
            assert row["novelty"] == pytest.approx(other.novelty(place), rel=1e-12)
        assert [row["cell"] for row in rows] == [number(cell) for cell in other.end(generation, told)]
        assert joined(store.after[generation])[EXTRA][STAGNANT].tolist() == other.useless
    map_ = state.search.map
    assert map_.cell_N.tolist() == [number(index) for index in elites]
    for index, elite in elites.items():
        assert_near(store.elite(number(index)).parameters_D, elite.centre)
    np.testing.assert_allclose(state.search.archive.descriptor_N_B, other.archive, rtol=1e-12)
    assert state.search.archive.size == 25 * EMITTERS > NEWEST, "the archive itself stays whole"
    assert len(resets) >= 5
    assert len({emitter for emitter, _ in resets}) >= 2
    assert len({cell for _, cell in resets}) >= 3


# Resets


def evaluated(generation, emitter, fitness, place, valid=True):
    return CentreEvaluation(generation, emitter, valid, fitness, np.array([place]), 0.0)


def begun(emitters=2, **search):
    """(the search, its state before any evaluation), with a map of nine cells in a row."""
    algorithm = ALGORITHMS["memes"](config_of(emitters=emitters, **search))
    map_ = empty_map(Grid(((0.0, 9.0),), (9,)))
    return algorithm, first_state([np.zeros(3, np.float32)] * emitters, 1, 0.0, map_, algorithm.extra)


def test_an_emitter_is_reset_after_generations_in_which_nothing_of_its_entered_the_map():
    """(fitness and place of the one emitter, then of the other; None if invalid) -> counts, emitters reset after it."""
    search, state = begun(stagnation_generations=3)
    for generation, (first, second, counts, reset) in enumerate(
        [
            ((-5, 1.5), (-5, 3.5), [0, 0], []),
            ((-5, 1.5), (-4, 3.5), [1, 0], []),  # no fitter than its cell's elite
            ((-6, 1.5), (-3, 3.5), [2, 0], []),
            ((-9, 5.5), (-8, 5.5), [3, 0], [0]),  # entered, but the other one took its place at once
            ((-9, 1.5), (-9, 5.5), [1, 1], []),  # began again before this generation
            (None, (-9, 5.5), [2, 2], []),
            ((-9, 7.5), None, [0, 3], [1]),  # an empty cell
        ]
    ):
        for emitter in search.start_cells(state, generation):
            state = search.restart(state, emitter, 3, policy_with(np.ones(3, np.float32)))
        told = tuple(
            evaluated(generation, emitter, *(of or (0.0, np.nan)), valid=of is not None)
            for emitter, of in enumerate((first, second))
        )
        state = search.tell(state, told)
        assert state.extra[STAGNANT].tolist() == counts
        assert sorted(search.start_cells(state, generation + 1)) == reset


def test_an_emitter_begins_again_with_a_fresh_optimiser_and_a_count_of_its_own():
    search, state = begun(emitters=3)
    state = replace(state, extra={STAGNANT: np.array([5, 7, 1])})
    used = replace(state.centres[1], step={"adam_step": np.array(9), "adam_m_D": np.ones(3, np.float32)})
    state = replace(state, centres=(state.centres[0], used, state.centres[2]))
    after = search.restart(state, 1, 4, policy_with(np.full(3, 2, np.float32)))
    assert after.extra[STAGNANT].tolist() == [5, 0, 1]
    assert (after.centres[1].step["adam_step"], after.centres[1].cell) == (0, 4)
    assert after.centres[1].step["adam_m_D"].tolist() == [0, 0, 0]
    assert after.centres[1].centre_D.tolist() == [2, 2, 2]
    assert after.centres[0] is state.centres[0]


def test_the_elite_is_any_of_the_map_with_equal_probability():
    search, state = begun(emitters=1000)
    places = [7.5, 0.5, 3.5, 4.5]
    told = [evaluated(0, emitter, 0.0, places[min(emitter, 3)]) for emitter in range(1000)]
    state = replace(search.tell(state, tuple(told)), extra={STAGNANT: np.full(1000, PATIENCE)})
    drawn = list(search.start_cells(state, 1).values())
    assert len(drawn) == 1000
    np.testing.assert_allclose(
        [drawn.count(cell) / 1000 for cell in (7, 0, 3, 4)], 0.25, atol=4 * np.sqrt(0.1875 / 1000)
    )
    assert list(search.start_cells(state, 2).values()) != drawn


def test_while_the_map_is_empty_no_emitter_is_reset():
    search, state = begun()
    assert search.start_cells(replace(state, extra={STAGNANT: np.array([99, 99])}), 1) == {}


# Interruption


def test_a_search_put_together_again_equals_an_uninterrupted_one():
    """Stopped where emitters have been reset already, and others are about to be."""
    _, straight, _ = run_in_memory(config_of(generations=16))
    stop = next(at for at, parts in enumerate(straight.after) if at > 5 and (joined(parts)[EXTRA][STAGNANT] == 1).any())
    _, store, _ = run_in_memory(config_of(generations=stop))
    store.parts = {name: decode_part(encode_part(part)) for name, part in store.parts.items()}
    run_in_memory(config_of(generations=16), Sharing(), store)
    assert {name: encode_part(part) for name, part in store.parts.items()} == {
        name: encode_part(part) for name, part in straight.parts.items()
    }
    columns = [c.name for c in history_columns(SHIPPED["point_maze"], True) if c.deterministic]
    kept = [[[row[name] for name in columns] for row in s.rows] for s in (store, straight)]
    np.testing.assert_array_equal(np.array(kept[0], float), np.array(kept[1], float))


# The config


PLAIN = {"task": {"environment": "point_maze"}, "search": {"algorithm": "memes"}, "budget": {"generations": 1}}


@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_a_config_has_the_settings_of_the_paper_but_fewer_emitters_and_pairs(preset):
    config = load_config(PLAIN, {"search.preset": preset})
    search = config.search
    assert (search.sigma, search.step.learning_rate, search.step.l2) == (0.02, 0.01, 0.0)
    assert (search.stagnation_generations, search.evaluation_episodes) == (32, 1)
    assert (config.novelty.newest, config.novelty.neighbours) == (50_000, 10)
    assert (config.policy.observation_normalization, config.policy.action_noise) == (False, 0.0)
    assert (search.emitters, search.centres, search.pairs) == (16, 16, 32)
    assert config.search.populations() == 16
    assert "search.pairs and search.emitters change that" in parallel_sentence(config)
    wanted = {"search.emitters": 3, "search.pairs": 8, "search.step.l2": 0.1}
    other = load_config(PLAIN, {"search.preset": preset, **wanted})
    assert (other.search.centres, other.search.pairs, other.search.step.l2) == (3, 8, 0.1)


def test_it_has_a_centre_for_each_emitter_and_needs_a_map():
    with pytest.raises(ConfigError) as caught:
        load_config(PLAIN, {"search.centres": 5, "map.enabled": False})
    assert "5 is not allowed for memes, which has one centre for each of search.emitters; must be 16" in str(
        caught.value
    )
    assert "map.enabled: false is not allowed for memes, whose emitters begin again from" in str(caught.value)


# Objectives and starts


def test_each_emitter_has_one_of_the_objectives_in_turn():
    target = {"kind": "target", "descriptor": [0.5, 0.1], "radius": 0.2}
    search, state = begun(emitters=4, objectives=[{"kind": "novelty"}, target, {"kind": "mixture", "weight": 0.25}])
    asked = search.ask(state, 1)
    assert [one.objective.kind for one in asked] == ["novelty", "target", "mixture", "novelty"]
    assert [one.fitness_weight for one in asked] == [0.0, 1.0, 0.25, 0.0]


def told(search, state, generation, places):
    """The state after every emitter has found a new cell, or None for the old one."""
    found = [evaluated(generation, emitter, float(generation), place) for emitter, place in enumerate(places)]
    return search.tell(state, tuple(found))


def test_an_emitter_that_exploits_begins_again_after_its_generations_although_its_centres_enter_the_map():
    search, state = begun(stagnation_generations=99, exploit_generations=3)  # the first explores, the second exploits
    ages = []
    for generation in range(8):
        for emitter in (reset := search.start_cells(state, generation)):
            state = search.restart(state, emitter, 3, policy_with(np.ones(3, np.float32)))
        ages.append((sorted(reset), state.extra[AGE].tolist()))
        state = told(search, state, generation, (1.5, 5.5))  # each generation is fitter than the one before
    assert ages == [
        ([], [0, 0]),
        ([], [0, 0]),
        ([], [1, 1]),
        ([], [2, 2]),
        ([1], [3, 0]),
        ([], [4, 1]),
        ([], [5, 2]),
        ([1], [6, 0]),
    ]


def test_starts_are_drawn_in_these_proportions():
    config = config_of()
    map_, archive = empty_map(Grid(((0.0, 9.0),), (9,))), empty_archive(1)
    for place, fitness in ((0.5, -9.0), (1.5, -3.0), (7.5, -7.0)):
        map_, _, _ = insert(map_, np.array([place]), fitness, 0, int(place), 0.0)
        archive = extended(archive, np.array([place]), 0, int(place))
    nearest = config.novelty.model_copy(update={"neighbours": 1})
    tried_C = np.array([2, 1, 0, 0, 0, 0, 0, 1, 0])
    shares = {how: start_shares(how, map_, archive, nearest, tried_C).tolist() for how in get_args(Starts)}
    assert shares == {
        "uniform": [1.0, 1.0, 1.0],
        "novelty": [1.0, 1.0, 6.0],
        "least_tried": [0.0, 1.0, 1.0],
        "fitness": [0.0, 6.0, 2.0],
    }
    assert [drawn_cell(map_, np.array([0.0, 6.0, 2.0]), drawn) for drawn in (0.0, 0.74, 0.76, 0.999)] == [1, 1, 7, 7]
    same = replace(map_, fitness_N=np.full(3, -1.0))
    assert start_shares("fitness", same, archive, nearest, None).tolist() == [1.0, 1.0, 1.0]


def test_starts_are_counted_where_the_least_tried_is_wanted():
    search, state = begun(starts="least_tried", stagnation_generations=1)
    state = told(search, state, 0, (1.5, 5.5))
    elite, drawn = policy_with(np.ones(3, np.float32)), []
    for generation in range(1, 5):
        state = told(search, state, -generation, (1.5, 5.5))  # nothing is fitter than before
        for emitter, cell in search.start_cells(state, generation).items():
            state = search.restart(state, emitter, cell, elite)
            drawn.append(cell)
    counts_C = state.extra[TRIED]
    assert len(drawn) == 8
    assert [counts_C[1], counts_C[5], counts_C.sum()] == [drawn.count(1), drawn.count(5), 8]
    assert TRIED not in begun()[1].extra
