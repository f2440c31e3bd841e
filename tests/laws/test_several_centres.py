"""Generations that ask for several populations equal the reference implementations; what their history says."""

import pickle
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from es_service.loop import generation as generation_module
from es_service.loop.generation import fittest
from es_service.protocol import nearest
from es_service.protocol.episodes import in_blocks
from es_service.protocol.messages import EvaluationChunk, TrainingChunk
from es_service.protocol.nearest import NOVELTY
from es_service.protocol.policies import Recipes
from es_service.protocol.sent import Memory, Received, parcel
from es_service.search.algorithms.base import NO_CELL, CentreEvaluation, in_columns
from es_service.search.algorithms.common import add_to_archive, first_state, insert_into_map, novelty_of_centres
from es_service.search.algorithms.me_es import CELL_CHOICE, block_mode
from es_service.search.algorithms.nsra_es import adapted_weight
from es_service.search.maps.behaviour_map import empty_map
from es_service.search.maps.geometry import Grid
from tests.helpers import map_of
from tests.laws.me_es_runs import (
    BLOCK,
    PRESETS,
    Sharing,
    assert_near,
    config_of,
    drawn,
    evaluation,
    first_centres,
    noise_of,
    number,
    points,
    run_in_memory,
)
from tests.references import me_es as me_es_reference
from tests.references import novelty_search as novelty_reference
from tests.references.behaviour_map import GridMap

EMITTERS, CELLS = 3, (8, 8)


class Elsewhere(Sharing):
    """Each chunk is a message to one of two workers, which have of earlier ones what they were sent; all answers are
    one message, in blocks."""

    def __init__(self):
        super().__init__()
        self.workers = [(Memory(2**20, int), Received(2**20, Recipes.made)) for _ in range(2)]
        self.arrays = Counter()

    def evaluate(self, work):
        sent = [self._there(*one) for one in enumerate(work)]
        answered = in_blocks([super(Elsewhere, self).evaluate([one])[0] for one in sent])
        if isinstance(work[0][1], TrainingChunk):
            assert len(answered) == EMITTERS
        return pickle.loads(pickle.dumps(answered))

    def _there(self, number, one):
        memory, received = self.workers[number % 2]
        arrays, origins, written = pickle.loads(pickle.dumps(parcel([one], memory)))
        self.arrays.update((number % 2, name) for name in arrays)
        received.add(arrays)
        return received.work(origins, written)[0]


NSRA = {"fitness_weight_start": 0.5, "fitness_weight_step": 0.125, "fitness_weight_patience": 2}


@pytest.mark.parametrize("preset", ["literature", "uber"])
def test_blocks_side_by_side_equal_the_reference(preset):
    config = config_of(preset, generations=18, cells=CELLS, emitters=EMITTERS)
    state, store, evaluator = run_in_memory(config)
    emitters = me_es_reference.side_by_side(
        first_centres(config),
        GridMap(((-1.0, 1.0), (-1.0, 1.0)), CELLS),
        config.search.step.learning_rate,
        config.search.step.l2,
        mode="explore_exploit",
        length=BLOCK,
        neighbours=3,
        **PRESETS[preset],
    )
    elites, archive = emitters[0].map.elites, emitters[0].archive
    for ask, emitter in enumerate(emitters):
        emitter.evaluated(0, *evaluation(evaluator, 0, ask))
    shared, robbed = 0, 0
    for generation in range(1, 19):
        rows = store.evaluated[generation]
        begun = [emitter.start(*drawn(generation, CELL_CHOICE, i, 2)) for i, emitter in enumerate(emitters)]
        assert [row["start_cell"] for row in rows] == [number(cell, CELLS) for cell in begun]
        assert [row["fitness_weight"] for row in rows] == [float(one.climbs == "exploit") for one in emitters]
        shared += None not in begun and len(set(begun)) < EMITTERS
        highest = []
        for ask, emitter in enumerate(emitters):
            start, fitness, descriptor = points(evaluator, TrainingChunk, generation, ask)
            assert_near(start.parameters_D, emitter.es.centre)
            emitter.climb(noise_of(generation, ask), fitness, descriptor)
            assert_near(points(evaluator, EvaluationChunk, generation, ask)[0].parameters_D, emitter.es.centre)
            highest.append(float(fitness.max()))
        before = list(archive)
        for ask, emitter in enumerate(emitters):
            mean, place = evaluation(evaluator, generation, ask)
            robbed += emitter.elite is not None and emitter.elite not in elites.values()
            emitter.evaluated(generation, mean, place, highest[ask])
            found = novelty_reference.novelty(before, place, 3, PRESETS[preset]["squared"])
            assert rows[ask]["novelty"] == pytest.approx(found, rel=1e-12)
        mine = [[cell for cell, elite in elites.items() if elite is one.elite] for one in emitters]
        assert [row["cell"] for row in rows] == [number(cells[0], CELLS) if cells else None for cells in mine]
        map_ = map_of(store.after[generation])
        assert map_.cell_N.tolist() == [number(index, CELLS) for index in elites]
        for ours, name in ((map_.generation_N, "generation"), (map_.centre_N, "emitter")):
            assert ours.tolist() == [getattr(elite, name) for elite in elites.values()]
        for ours, name in ((map_.fitness_N, "fitness"), (map_.score_N, "score"), (map_.descriptor_N_B, "descriptor")):
            np.testing.assert_allclose(ours, [getattr(elite, name) for elite in elites.values()], rtol=1e-12)
    for index, elite in elites.items():
        assert_near(store.elite(number(index, CELLS)).parameters_D, elite.centre)
    np.testing.assert_allclose(state.search.archive.descriptor_N_B, archive, rtol=1e-12)
    assert shared >= 1, "some blocks began from the same elite"
    assert robbed >= 1, "an elite was replaced while a block that led from it was to be told"


def test_the_mode_of_a_block_is_that_of_a_later_one_of_the_emitters_before():
    settings = config_of(emitters=EMITTERS).search
    modes = [[block_mode(settings, 0, 1 + BLOCK * block, e) for e in range(EMITTERS)] for block in range(4)]
    assert modes == [["explore", "exploit", "explore"], ["exploit", "explore", "exploit"]] * 2
    coin = config_of(emitters=EMITTERS, alternation="coin").search
    thrown = [tuple(block_mode(coin, 0, 1 + BLOCK * block, e) for e in range(EMITTERS)) for block in range(60)]
    assert len(set(thrown)) == 8, "each emitter has a coin of its own"


def test_scores_of_centres_side_by_side_by_hand():
    """(centre, population's best, fitness, place) told in this order -> scores of the cells; cells of the centres."""
    state = first_state([np.zeros(3, np.float32)] * 2, 1, 0.0, empty_map(Grid(((0.0, 9.0),), (9,))))
    for centre_, best, fitness, place, scores, cells in (
        (0, 10, 1, 2.5, {2: 10}, [2, NO_CELL]),
        (1, 20, 2, 2.5, {2: 20}, [NO_CELL, 2]),  # replaces the elite that the other centre was
        (0, 30, 0, 4.5, {2: 20, 4: 30}, [4, 2]),  # which therefore scores nothing
        (1, 40, 0, 2.5, {2: 40, 4: 30}, [4, NO_CELL]),
    ):
        told = CentreEvaluation(1, centre_, True, fitness, np.array([place]), best)
        state = insert_into_map(state, told)
        assert state.map is not None
        assert dict(zip(state.map.cell_N.tolist(), state.map.score_N.tolist(), strict=True)) == scores
        assert [one.cell for one in state.centres] == cells


def test_the_novelty_of_a_centre_is_measured_against_the_newest_entries_by_hand():
    state = first_state([np.zeros(3, np.float32)] * 2, 1, 0.0)
    for generation, (index, place) in enumerate([(0, 1.0), (0, 5.0), (1, 9.0), (0, 20.0)]):
        state = add_to_archive(state, CentreEvaluation(generation, index, True, 0.0, np.array([place]), 0.0))
    settings = config_of(neighbours=2).novelty
    assert novelty_of_centres(state, settings).tolist() == [13.0, 6.0]  # (11 + 15) / 2, (4 + 8) / 2
    newest = settings.model_copy(update={"newest": 2})
    assert novelty_of_centres(state, newest).tolist() == [11.0, 11.0]
    newest = settings.model_copy(update={"newest": 1})
    assert novelty_of_centres(state, newest).tolist() == [0.0, 11.0], "one has no neighbour but itself"


@pytest.mark.parametrize(("algorithm", "weight"), [("ns_es", 0.0), ("nsr_es", 0.5), ("nsra_es", 0.5)])
def test_every_centre_at_once_equals_the_reference(algorithm, weight):
    rule = NSRA if algorithm == "nsra_es" else {}
    config = config_of(
        generations=14, algorithm=algorithm, centres=3, update="all", step={"learning_rate": 0.05}, **rule
    )
    state, store, evaluator = run_in_memory(config)
    other = novelty_reference.NoveltySearch(
        first_centres(config),
        config.search.step.learning_rate,
        config.search.step.l2,
        neighbours=3,
        weight=weight,
        rule=(0.125, 2, 0.0) if algorithm == "nsra_es" else None,
    )
    for index in range(3):
        other.initial(index, evaluation(evaluator, 0, index)[1])
    for generation in range(1, 15):
        rows = store.evaluated[generation]
        assert [row["centre"] for row in rows] == [0, 1, 2]
        assert [row["fitness_weight"] for row in rows] == [other.weight] * 3
        for ask in range(3):
            start, *found = points(evaluator, TrainingChunk, generation, ask)
            assert_near(start.parameters_D, other.centres[ask].centre)
            other.generation(ask, noise_of(generation, ask), *found)
        told = [(ask, *evaluation(evaluator, generation, ask)) for ask in range(3)]
        expected = [novelty_reference.novelty(other.archive, place, 3) for *_, place in told]
        assert [row["novelty"] for row in rows] == pytest.approx(expected, rel=1e-12)
        other.told(told)
        assert store.rows[generation]["archive_size"] == len(other.archive) == 3 + 3 * generation
    for ours, theirs in zip(state.search.centres, other.centres, strict=True):
        assert_near(ours.centre_D, theirs.centre)
        assert ours.step["adam_step"] == 14
    np.testing.assert_allclose(state.search.archive.descriptor_N_B, other.archive, rtol=1e-12)
    assert state.search.archive.centre_N.tolist() == [0, 1, 2] * 15
    weights = [row["fitness_weight"] for row in store.rows]
    if algorithm == "nsra_es":  # it rose by more than a step at once, and it fell
        assert max(np.diff(weights)) > 0.125 > 0.0 > min(np.diff(weights))
    else:
        assert set(weights) == {weight}


def test_patience_counts_generations_and_the_record_is_told_centre_by_centre():
    search = config_of(algorithm="nsra_es", fitness_weight_min_gain=0.0, **NSRA).search
    weight, values = replace(first_state([], 1, 0.5).weight, record=0.0), []
    for fitnesses in ([-1, -1, -1], [-1, -1, -1], [1, 3, 2], [-1, 4, -1], [4, 4, None], [None] * 3, [-1, -1, -1]):
        told = [CentreEvaluation(1, i, f is not None, f or 0.0, np.zeros(1)) for i, f in enumerate(fitnesses)]
        weight = adapted_weight(search, weight, tuple(told))
        values.append((weight.value, weight.record, weight.stagnant))
    #  1 without; 2 without: down; two records; one; 1 without; 2 without: down; 1 without
    assert values == [
        (0.5, 0.0, 1),
        (0.375, 0.0, 0),
        (0.625, 3, 0),
        (0.75, 4, 0),
        (0.75, 4, 1),
        (0.625, 4, 0),
        (0.625, 4, 1),
    ]


# The history and the evaluated centres

SAME = {
    "centre": "centre",
    "fitness_weight": "fitness_weight",
    "start_cell": "start_cell",
    "cell": "cell",
    "fitness_mean": "centre_fitness_mean",
    "fitness_std": "centre_fitness_std",
    "return_mean": "centre_return_mean",
    "x": "centre_x",
    "y": "centre_y",
    "novelty": "centre_novelty",
    "update_norm": "update_norm",
}
"""Column of an evaluated centre -> that of the history, whose row is about the fittest of them."""


@pytest.mark.parametrize(
    "search", [{}, {"algorithm": "nsra_es"}, {"emitters": 3}, {"algorithm": "nsr_es", "centres": 4, "update": "all"}]
)
def test_the_row_of_a_generation_is_that_of_its_fittest_centre(search):
    config = config_of(generations=9, **search)
    _, store, _ = run_in_memory(config)
    several = config.search.centres if "emitters" in search or "update" in search else 1
    assert [len(rows) for rows in store.evaluated] == [config.search.centres] + [several] * 9
    for row, rows in zip(store.rows, store.evaluated, strict=True):
        best = max(rows, key=lambda one: one["fitness_mean"])
        assert {name: best.get(name) for name in SAME} == {name: row[theirs] for name, theirs in SAME.items()}
    if several > 1:
        assert len({row["centre"] for row in store.rows[1:]}) > 1
    steps = [sum(one["env_steps"] for one in rows) for rows in store.evaluated]
    assert np.cumsum(steps).tolist() == [row["env_steps"] for row in store.rows]


class Spoiling(Sharing):
    """As many members of each population are invalid as its number says, and one more."""

    def evaluate(self, work):
        results = super().evaluate(work)
        for (_, chunk), result in zip(work, results, strict=True):
            if isinstance(chunk, TrainingChunk) and chunk.chunk_id == 1:
                result.fitness[: chunk.ask + 1, 0] = np.nan
        return results


def test_counts_of_a_generation_are_sums_over_its_populations():
    _, store, evaluator = run_in_memory(config_of(generations=4, emitters=3), Spoiling())
    for generation in range(1, 5):
        row, before = store.rows[generation], store.rows[generation - 1]
        results = {
            kind: [r for _, c, r in evaluator.recorded if isinstance(c, kind) and c.generation == generation]
            for kind in (TrainingChunk, EvaluationChunk)
        }
        assert len(results[TrainingChunk]) == len(results[EvaluationChunk]) == 6
        trained = sum(int(r.steps.sum()) for r in results[TrainingChunk])
        kept = sum(int(r.steps[: 4 if i % 2 else 16].sum()) for i, r in enumerate(results[EvaluationChunk]))
        assert row["env_steps"] - before["env_steps"] == trained + kept
        assert row["episodes"] - before["episodes"] == 3 * (64 + 20)
        assert row["invalid_members"] == 1 + 2 + 3
        fitness = np.concatenate([r.fitness.ravel() for r in results[TrainingChunk]])
        assert row["population_fitness_max"] == np.nanmax(fitness)
        assert row["population_fitness_min"] == np.nanmin(fitness)


def test_the_fittest_valid_centre_is_shown_and_of_equal_ones_the_first():
    def shown(*fitness):
        told = [CentreEvaluation(1, 0, f is not None, 99.0 if f is None else f, np.zeros(1)) for f in fitness]
        return fittest(in_columns(told))

    assert shown(1.0, 3.0, 2.0) == 1
    assert shown(-2.0, -1.0, -1.0) == 1
    assert shown(None, -3.0, -2.0) == 2
    assert shown(None, None) == 0


@pytest.mark.parametrize("newest", [None, 20])
def test_novelty_has_the_same_bits_where_the_members_are(monkeypatch, newest):
    """And full arrays of the archive travel once to a worker, whatever it was sent between them."""
    config = config_of(generations=12, cells=CELLS, emitters=EMITTERS)
    config = config.model_copy(update={"novelty": config.novelty.model_copy(update={"newest": newest})})
    _, here, _ = run_in_memory(config)
    monkeypatch.setattr(nearest, "ROWS", 8)
    monkeypatch.setattr(generation_module, "NOVEL_MEMBERS", 1)
    _, there, evaluator = run_in_memory(config, Elsewhere())
    for before, after in zip(here.after, there.after, strict=True):
        assert before.keys() == after.keys()
        for part, arrays in before.items():
            for name, array in arrays.items():
                np.testing.assert_array_equal(after[part][name], array, strict=True)
    given = {
        (chunk.generation, chunk.ask)
        for _, chunk, result in evaluator.recorded
        if isinstance(chunk, TrainingChunk) and NOVELTY in result.outputs
    }
    explores = {
        (generation, ask)
        for generation in range(1, 13)
        for ask in range(EMITTERS)
        if block_mode(config.search, 0, generation, ask) == "explore"
    }
    assert given == explores
    assert set(evaluator.arrays.values()) == {1}
