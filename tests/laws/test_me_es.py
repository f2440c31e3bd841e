"""ME-ES against its twin; where blocks start and what they climb, invalid centres, statistics, interruption."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from es_service import driver
from es_service.algorithms import ALGORITHMS
from es_service.algorithms.base import NO_CELL, Judgement
from es_service.algorithms.me_es import CELL_CHOICE, block_mode, cell_shares, elite_novelty
from es_service.algorithms.steps import archived, first_state, mapped
from es_service.api import load_config
from es_service.config.model import worker_spec
from es_service.history import history_columns
from es_service.maps.behaviour_map import BehaviourMap, cell_part, elite_part, map_from_parts
from es_service.maps.geometry import Grid
from es_service.noise import Domain, normals, stream_keys, uniforms
from es_service.novelty import empty_archive, extended
from es_service.protocol import EvaluationChunk, PolicyShape, TrainingChunk
from es_service.run_state import moments_from_arrays
from es_service.statistics import no_observations, normalisation
from es_service.store.codec import decode_part, encode_part
from tests.helpers import DirectEvaluator, MemoryStore
from tests.twins import me_es as twin
from tests.twins.behaviour_map import GridMap, cell_number, coverage, qd_score
from workers.environments import TASKS
from workers.policy import initial_parameters

SHAPE = PolicyShape((2, 8, 8, 2))
CELLS, BLOCK = (20, 15), 3
PRESETS = {
    "literature": {"first_block": "explore", "sampling": "top", "squared": False},
    "uber": {"first_block": "exploit", "sampling": "score", "squared": True},
}


def config_of(preset="literature", generations=30, seed=0, neighbours=3, **search):
    return load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8]},
            "search": {
                "algorithm": "me_es",
                "preset": preset,
                "pairs": 32,
                "sigma": 0.2,
                "learning_rate": 0.2,
                "evaluation_episodes": 20,
                "block_generations": BLOCK,
                "parent_statistics": "elite" if preset == "literature" else "global",  # both, and one for each preset
                **search,
            },
            "novelty": {"neighbours": neighbours},
            "map": {"cells": list(CELLS)},
            "budget": {"generations": generations},
            "compute": {"chunk_pairs": 16},
            "seed": seed,
        }
    )


@cache
def compiled(preset):
    return DirectEvaluator(worker_spec(config_of(preset), TASKS["point_maze"]))


class Sharing(DirectEvaluator):
    """Runs the functions that were compiled for its preset; evaluations of some generations end nowhere."""

    def __init__(self, preset="literature", spoiled=()):
        self.counts, self._run_chunk = compiled(preset).counts, compiled(preset)._run_chunk
        self.recorded, self.spoiled = [], spoiled

    def evaluate(self, centre, chunks):
        results = super().evaluate(centre, chunks)
        for chunk, result in zip(chunks, results, strict=True):
            if isinstance(chunk, EvaluationChunk) and chunk.generation in self.spoiled:
                result.descriptor[1] = np.nan
        return results


class Remembering(MemoryStore):
    """Keeps the parts as they were after each generation."""

    def __init__(self):
        super().__init__()
        self.after = []

    def commit(self, generation, parts, history):
        super().commit(generation, parts, history)
        self.after.append(dict(self.parts))


def run_in_memory(config, evaluator=None, store=None):
    evaluator, store = evaluator or Sharing(config.search.preset), store or Remembering()
    first = initial_parameters(SHAPE, config.policy.init, config.seed, 0)
    search = driver.Search(
        config, ALGORITHMS["me_es"](config), lambda: ([first], no_observations(2)), TASKS["point_maze"]
    )
    state, _ = driver.run(search, evaluator, store, lambda row: None)
    return state, store, evaluator


def points(evaluator, kind, generation):
    """The centre that all chunks of a kind were sent around, and all their results in the order of their ids."""
    found = [
        (chunk.chunk_id, point, result)
        for point, chunk, result in evaluator.recorded
        if isinstance(chunk, kind) and chunk.generation == generation
    ]
    found.sort(key=lambda item: item[0])
    assert len({id(point) for _, point, _ in found}) == 1
    results = [result for *_, result in found]
    return found[0][1], np.concatenate([r.fitness for r in results]), np.concatenate([r.descriptor for r in results])


def evaluation(evaluator, generation):
    """Mean fitness and descriptor over the 20 episodes of an evaluated centre."""
    _, fitness, descriptor = points(evaluator, EvaluationChunk, generation)
    return fitness[:20].astype(float).mean(), descriptor[:20].astype(float).mean(axis=0)


def number(index):
    return None if index is None else cell_number(CELLS, index)


def assert_near(ours, theirs):
    assert np.linalg.norm(ours - theirs) < 1e-6 * np.linalg.norm(theirs)


@pytest.mark.parametrize("mode", ["explore", "exploit", "explore_exploit"])
@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_thirty_generations_equal_the_twin(preset, mode):
    config = config_of(preset, mode=mode)
    state, store, evaluator = run_in_memory(config)
    other = twin.MapElitesES(
        initial_parameters(SHAPE, config.policy.init, 0, 0),
        GridMap(((-1.0, 1.0), (-1.0, 1.0)), CELLS),
        config.search.learning_rate,
        config.search.l2,
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
        map_ = map_from_parts(store.after[generation])
        assert map_ is not None
        assert map_.cell_N.tolist() == [number(index) for index in elites]
        assert map_.generation_N.tolist() == [elite.generation for elite in elites.values()]
        for name in ("fitness", "score", "descriptor"):
            ours = map_.descriptor_N_B if name == "descriptor" else getattr(map_, f"{name}_N")
            np.testing.assert_allclose(ours, [getattr(elite, name) for elite in elites.values()], rtol=1e-12)
    for index, elite in elites.items():
        assert_near(store.part(elite_part(number(index)))["centre_D"], elite.centre)
    np.testing.assert_allclose(state.search.archive.descriptor_N_B, other.archive, rtol=1e-12)
    entered = [row["cell"] for row in store.rows if row["cell"] is not None]
    assert 31 > len(entered) > len(elites) >= 8  # some entered no cell, some one that had an elite
    assert len({row["start_cell"] for row in store.rows} - {None}) >= 5
    assert len({row["fitness_weight"] for row in store.rows[1:]}) == (2 if mode == "explore_exploit" else 1)


# Blocks


def test_a_block_has_a_fresh_optimiser_and_keeps_it():
    _, store, _ = run_in_memory(config_of(generations=12))
    assert [int(parts["member_0"]["adam_step"]) for parts in store.after] == [0] + [1, 2, 3] * 4


def test_a_block_starts_from_its_elite_and_goes_on_from_wherever_it_comes():
    _, store, evaluator = run_in_memory(config_of())
    for generation in range(1, 31):
        row, before = store.rows[generation], store.after[generation - 1]
        start = points(evaluator, TrainingChunk, generation)[0].parameters_D
        if generation % BLOCK == 1:
            np.testing.assert_array_equal(start, before[elite_part(row["start_cell"])]["centre_D"])
        else:
            assert row["start_cell"] is None
            np.testing.assert_array_equal(start, points(evaluator, EvaluationChunk, generation - 1)[0].parameters_D)
    strays = [row["generation"] for row in store.rows if row["cell"] is None and row["generation"] % BLOCK]
    assert strays


def test_the_history_names_each_elite_that_entered_and_the_store_has_it():
    _, store, evaluator = run_in_memory(config_of())
    before = {}
    for row, parts in zip(store.rows, store.after, strict=True):
        written = [name for name, part in parts.items() if name.startswith("elite_") and part is not before.get(name)]
        assert written == ([] if row["cell"] is None else [elite_part(row["cell"])])
        point = points(evaluator, EvaluationChunk, row["generation"])[0]
        for name in written:
            np.testing.assert_array_equal(parts[name]["centre_D"], point.parameters_D)
            np.testing.assert_array_equal(parts[name]["observation_mean_O"], point.observation_mean_O)
            np.testing.assert_array_equal(parts[name]["observation_std_O"], point.observation_std_O)
            assert parts[name]["trace_T_B"].shape == (64, 2)
        before = parts


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


# Where a block starts. Elites on a line; as many cells of one unit as it takes.


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
    return cell_shares(map_, archive_of(map_, *others), settings, mode, sampling, drawn).tolist()


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
    start_cell = ALGORITHMS["me_es"](config).start_cell
    drawn = [start_cell(state_at(map_), generation) for generation in range(1, 3 * 3000, BLOCK)]
    share = [drawn.count(cell) / 3000 for cell in SPREAD]
    assert sum(share) == pytest.approx(1.0)
    np.testing.assert_allclose(share, expected, atol=4 * np.sqrt(0.25 / 3000))
    assert [s == 0 for s in share] == [e == 0 for e in expected]


def test_a_cell_is_drawn_only_where_a_block_begins_and_an_elite_is_there():
    start_cell = ALGORITHMS["me_es"](config_of()).start_cell
    assert [start_cell(state_at(line([7])), generation) for generation in range(1, 8)] == [7, None, None] * 2 + [7]
    assert start_cell(state_at(line([])), 1) is None


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
        judgement = Judgement(generation, 0, place is not None, fitness, np.array([place or np.nan]), best)
        state = mapped(archived(state, judgement), judgement)
        assert state.map is not None
        known = dict(zip(state.map.cell_N.tolist(), state.map.score_N.tolist(), strict=True))
        assert {cell: None if np.isnan(score) else score for cell, score in known.items()} == scores
        assert state.members[0].cell == cell
    assert state.archive.size == 7


def test_an_invalid_centre_enters_neither_archive_nor_map_and_the_search_goes_on():
    spoiled = (0, 5, 7)
    state, store, evaluator = run_in_memory(config_of(generations=12), Sharing(spoiled=spoiled))
    names = ("map_cells", "archive_size", "map_fitness_max", "qd_score", "cell")
    first = {name: store.rows[0][name] for name in names}
    assert first == {"map_cells": 0, "archive_size": 0, "map_fitness_max": None, "qd_score": 0.0, "cell": None}
    assert store.rows[1]["start_cell"] is None  # no elite anywhere: from where it is
    for generation in (5, 7):
        row, before = store.rows[generation], store.rows[generation - 1]
        assert np.isnan(row["centre_novelty"])
        assert row["cell"] is None
        assert store.after[generation]["member_0"]["cell"] == NO_CELL
        for name in (*names[:-1], "best_fitness"):
            assert row[name] == before[name]
    led = store.after[7][cell_part(store.rows[7]["start_cell"])]
    assert led["score"] == store.rows[7]["population_fitness_max"]
    for generation in (6, 8):
        start = points(evaluator, TrainingChunk, generation)[0].parameters_D
        np.testing.assert_array_equal(start, points(evaluator, EvaluationChunk, generation - 1)[0].parameters_D)
    assert state.search.map is not None
    assert not set(spoiled) & {*state.search.archive.generation_N.tolist(), *state.search.map.generation_N.tolist()}
    assert state.search.archive.size == 10
    assert np.isfinite(state.search.members[0].centre_D).all()


# Observation statistics


def statistics_of(evaluator, generation):
    """Of all chunks of a generation, the gradient's too."""
    found = {
        (point.observation_mean_O.tobytes(), point.observation_std_O.tobytes())
        for point, chunk, _ in evaluator.recorded
        if chunk.generation == generation
    }
    assert len(found) == 1
    return found.pop()


def of_the_run(parts):
    return tuple(x.tobytes() for x in normalisation(moments_from_arrays(parts["observations"]), True))


def of_the_elite(part):
    return part["observation_mean_O"].tobytes(), part["observation_std_O"].tobytes()


def test_a_block_can_run_with_its_elite_s_statistics():
    state, store, evaluator = run_in_memory(config_of(parent_statistics="elite"))
    differ = 0
    for first in range(1, 31, BLOCK):
        elite = of_the_elite(store.after[first - 1][elite_part(store.rows[first]["start_cell"])])
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
        assert "own_mean_O" not in store.after[generation]["member_0"]


# Interruption


@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_a_search_put_together_again_inside_a_block_equals_an_uninterrupted_one(preset):
    _, straight, _ = run_in_memory(config_of(preset, generations=12))
    _, store, _ = run_in_memory(config_of(preset, generations=7))
    assert store.parts["member_0"]["adam_step"] == 1
    assert ("own_mean_O" in store.parts["member_0"]) == (preset == "literature")
    store.parts = {name: decode_part(encode_part(part)) for name, part in store.parts.items()}
    run_in_memory(config_of(preset, generations=12), store=store)
    assert store.parts.keys() == straight.parts.keys()
    for name, part in straight.parts.items():
        assert encode_part(store.parts[name]) == encode_part(part)
    columns = [c.name for c in history_columns(TASKS["point_maze"], True) if c.deterministic]
    kept = [[[row[name] for name in columns] for row in s.rows] for s in (store, straight)]
    np.testing.assert_array_equal(np.array(kept[0], float), np.array(kept[1], float))
