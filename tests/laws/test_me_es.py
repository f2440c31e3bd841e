"""ME-ES against its reference implementation; modes of its blocks, invalid centres, statistics, interruption."""

import numpy as np
import pytest

from es_service.loop.blocks import value_of
from es_service.loop.history import history_columns
from es_service.loop.state import normalisation
from es_service.protocol.content import as_bytes
from es_service.protocol.messages import EvaluationChunk, GradientChunk, Moments, TrainingChunk
from es_service.protocol.noise import Domain, normals, stream_keys, uniforms
from es_service.search.algorithms.base import NO_CELL
from es_service.search.algorithms.me_es import CELL_CHOICE, block_mode
from es_service.store.codec import decode_part, encode_part
from tests.helpers import map_of
from tests.laws.me_es_runs import (
    BLOCK,
    CELLS,
    PRESETS,
    SHAPE,
    Sharing,
    assert_near,
    config_of,
    evaluation,
    number,
    points,
    run_in_memory,
)
from tests.references import me_es as reference
from tests.references.behaviour_map import GridMap, coverage, qd_score
from workers.environments import SHIPPED
from workers.policy import initial_parameters


@pytest.mark.parametrize("mode", ["explore", "exploit", "explore_exploit"])
@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_thirty_generations_equal_the_reference(preset, mode):
    config = config_of(preset, mode=mode)
    state, store, evaluator = run_in_memory(config)
    other = reference.MapElitesES(
        initial_parameters(SHAPE, config.policy.init, 0, 0),
        GridMap(((-1.0, 1.0), (-1.0, 1.0)), CELLS),
        config.search.step.learning_rate,
        config.search.step.l2,
        mode=mode,
        length=BLOCK,
        neighbours=3,
        **PRESETS[preset],
    )
    elites = other.map.elites
    other.evaluated(0, *evaluation(evaluator, 0))
    for generation in range(1, 31):
        row = store.rows[generation]
        key = stream_keys(0, Domain.SELECTION, generation, CELL_CHOICE)
        assert row["start_cell"] == number(other.start(*uniforms(key, np.arange(2, dtype=np.uint32)).tolist()))
        assert row["fitness_weight"] == {"explore": 0.0, "exploit": 1.0}[other.climbs]
        noise = [
            normals(key, SHAPE.parameters) for key in stream_keys(0, Domain.PARAMETER_NOISE, generation, np.arange(32))
        ]
        start, fitness, descriptor = points(evaluator, TrainingChunk, generation)
        assert_near(start.parameters_D, other.es.centre)
        other.climb(noise, fitness, descriptor)
        assert_near(points(evaluator, EvaluationChunk, generation)[0].parameters_D, other.es.centre)
        cell = other.evaluated(generation, *evaluation(evaluator, generation), float(fitness.max()))
        assert row["cell"] == number(cell)
        assert row["map_cells"] == len(elites)
        assert row["coverage"] == row["coverage_reachable"] == coverage(elites, 300)
        assert row["map_fitness_max"] == pytest.approx(max(elite.fitness for elite in elites.values()), rel=1e-12)
        assert row["qd_score"] == pytest.approx(qd_score(elites, -2.3431 * 200), rel=1e-12)
        map_ = map_of(store.after[generation])
        assert map_.cell_N.tolist() == [number(index) for index in elites]
        assert map_.generation_N.tolist() == [elite.generation for elite in elites.values()]
        for name in ("fitness", "score", "descriptor"):
            ours = map_.descriptor_N_B if name == "descriptor" else getattr(map_, f"{name}_N")
            np.testing.assert_allclose(ours, [getattr(elite, name) for elite in elites.values()], rtol=1e-12)
    for index, elite in elites.items():
        assert_near(store.elite(number(index)).parameters_D, elite.centre)
    np.testing.assert_allclose(state.search.archive.descriptor_N_B, other.archive, rtol=1e-12)
    entered = [row["cell"] for row in store.rows if row["cell"] is not None]
    assert 31 > len(entered) > len(elites) >= 8  # some entered no cell, some one that had an elite
    assert len({row["start_cell"] for row in store.rows} - {None}) >= 5
    assert len({row["fitness_weight"] for row in store.rows[1:]}) == (2 if mode == "explore_exploit" else 1)


# Blocks


def test_a_block_has_a_fresh_optimiser_and_keeps_it():
    _, store, _ = run_in_memory(config_of(generations=12))
    assert [int(parts["centres/0/step"]["adam_step"]) for parts in store.after] == [0] + [1, 2, 3] * 4


def test_a_block_starts_from_its_elite_and_goes_on_from_wherever_it_comes():
    _, store, evaluator = run_in_memory(config_of())
    for generation in range(1, 31):
        row, before = store.rows[generation], store.after[generation - 1]
        start = points(evaluator, TrainingChunk, generation)[0].parameters_D
        if generation % BLOCK == 1:
            np.testing.assert_array_equal(start, store.elite(row["start_cell"], before).parameters_D)
        else:
            assert row["start_cell"] is None
            np.testing.assert_array_equal(start, points(evaluator, EvaluationChunk, generation - 1)[0].parameters_D)
    strays = [row["generation"] for row in store.rows if row["cell"] is None and row["generation"] % BLOCK]
    assert strays


def test_the_history_names_each_elite_that_entered_and_the_store_has_it():
    _, store, evaluator = run_in_memory(config_of())
    before = {}
    for row, parts in zip(store.rows, store.after, strict=True):
        map_ = map_of(parts)
        named = dict(zip(map_.cell_N.tolist(), as_bytes(map_.policy_N), strict=True))
        entered = [cell for cell in named if named[cell] != before.get(cell)]
        assert entered == ([] if row["cell"] is None else [row["cell"]])
        point = points(evaluator, EvaluationChunk, row["generation"])[0]
        for cell in entered:
            elite = store.elite(cell, parts)
            np.testing.assert_array_equal(elite.parameters_D, point.parameters_D)
            np.testing.assert_array_equal(elite.observation_mean_O, point.observation_mean_O)
            np.testing.assert_array_equal(elite.observation_std_O, point.observation_std_O)
            assert elite.trace_T_B.shape == (64, 2)
        before = named


def modes(count, **search):
    settings = config_of(**search).search
    return [block_mode(settings, 0, generation) for generation in range(1, count + 1)]


def test_blocks_take_turns_from_the_first():
    explore, exploit = ["explore"] * BLOCK, ["exploit"] * BLOCK
    assert modes(12, first_block="explore") == (explore + exploit) * 2
    assert modes(12, first_block="exploit") == (exploit + explore) * 2
    assert modes(3, block_generations=1, first_block="exploit") == ["exploit", "explore", "exploit"]


@pytest.mark.parametrize("alternation", ["round_robin", "coin"])
def test_one_mode_alone_never_changes(alternation):
    assert set(modes(60, mode="explore", first_block="exploit", alternation=alternation)) == {"explore"}
    assert set(modes(60, mode="exploit", first_block="explore", alternation=alternation)) == {"exploit"}


def test_a_coin_is_fair_stays_down_for_a_block_and_depends_on_the_seed_alone():
    settings = config_of(alternation="coin").search
    found = [block_mode(settings, 0, generation) for generation in range(1, 6001)]
    blocks = found[::BLOCK]
    assert all(found[i] == blocks[i // BLOCK] for i in range(6000))
    explores = np.array([mode == "explore" for mode in blocks])
    assert explores.mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2000))
    assert (explores[1:] == explores[:-1]).mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2000))
    assert [block_mode(settings, 0, generation) for generation in range(6000, 0, -1)] == found[::-1]
    assert [block_mode(settings, 1, generation) for generation in range(1, 6001)] != found


def test_an_invalid_centre_enters_neither_archive_nor_map_and_the_search_goes_on():
    spoiled = (0, 5, 7)
    state, store, evaluator = run_in_memory(config_of(generations=12), Sharing(spoiled=spoiled))
    names = ("map_cells", "archive_size", "map_fitness_max", "qd_score", "cell")
    first = {name: store.rows[0][name] for name in names}
    assert first == {"map_cells": 0, "archive_size": 0, "map_fitness_max": None, "qd_score": 0.0, "cell": None}
    assert store.rows[1]["start_cell"] is None  # no elite anywhere: from where it is
    for generation in (5, 7):
        row, before = store.rows[generation], store.rows[generation - 1]
        assert row["centre_novelty"] is None
        assert row["cell"] is None
        assert store.after[generation]["centres/0"]["cell"] == NO_CELL
        for name in (*names[:-1], "best_fitness"):
            assert row[name] == before[name]
    map_ = map_of(store.after[7])
    assert map_.score_N[map_.row_of(store.rows[7]["start_cell"])] == store.rows[7]["population_fitness_max"]
    for generation in (6, 8):
        start = points(evaluator, TrainingChunk, generation)[0].parameters_D
        np.testing.assert_array_equal(start, points(evaluator, EvaluationChunk, generation - 1)[0].parameters_D)
    assert state.search.map is not None
    assert not set(spoiled) & {*state.search.archive.generation_N.tolist(), *state.search.map.generation_N.tolist()}
    assert state.search.archive.size == 10
    assert np.isfinite(state.search.centres[0].centre_D).all()


# Observation statistics


def statistics_of(evaluator, generation):
    """Of all chunks of a generation but the gradient's, which need none."""
    found = {
        (point.observation_mean_O.tobytes(), point.observation_std_O.tobytes())
        for point, chunk, _ in evaluator.recorded
        if chunk.generation == generation and not isinstance(chunk, GradientChunk)
    }
    assert len(found) == 1
    return found.pop()


def of_the_run(parts):
    return tuple(x.tobytes() for x in normalisation(value_of(Moments, parts, "observations"), True))


def of_the_elite(elite):
    return elite.observation_mean_O.tobytes(), elite.observation_std_O.tobytes()


def test_a_block_can_run_with_its_elite_s_statistics():
    state, store, evaluator = run_in_memory(config_of(parent_statistics="elite"))
    differ = 0
    for first in range(1, 31, BLOCK):
        elite = of_the_elite(store.elite(store.rows[first]["start_cell"], store.after[first - 1]))
        for generation in range(first, first + BLOCK):
            assert statistics_of(evaluator, generation) == elite
            differ += elite != of_the_run(store.after[generation - 1])
    assert differ > 15
    trained = [r.moments.count for _, chunk, r in evaluator.recorded if isinstance(chunk, TrainingChunk)]
    assert state.observations.count == sum(trained)  # the run's are gathered all the same


def test_a_block_can_run_with_the_run_s_statistics():
    _, store, evaluator = run_in_memory(config_of(parent_statistics="global"))
    for generation in range(1, 31):
        assert statistics_of(evaluator, generation) == of_the_run(store.after[generation - 1])
        assert "own_mean_O" not in store.after[generation]["centres/0"]


# Interruption


@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_a_search_put_together_again_inside_a_block_equals_an_uninterrupted_one(preset):
    _, straight, _ = run_in_memory(config_of(preset, generations=12))
    _, store, _ = run_in_memory(config_of(preset, generations=7))
    assert store.parts["centres/0/step"]["adam_step"] == 1
    assert ("own_mean_O" in store.parts["centres/0"]) == (preset == "literature")
    store.parts = {name: decode_part(encode_part(part)) for name, part in store.parts.items()}
    run_in_memory(config_of(preset, generations=12), store=store)
    assert store.parts.keys() == straight.parts.keys()
    for name, part in straight.parts.items():
        assert encode_part(store.parts[name]) == encode_part(part)
    columns = [c.name for c in history_columns(SHIPPED["point_maze"], True) if c.deterministic]
    kept = [[[row[name] for name in columns] for row in s.rows] for s in (store, straight)]
    np.testing.assert_array_equal(np.array(kept[0], float), np.array(kept[1], float))
