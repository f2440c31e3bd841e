"""A generation is stored and reported while the next one is computed, with the bits of one after the other."""

from dataclasses import replace

import numpy as np
import pytest

from es_service.errors import EvaluationError
from es_service.loop import driver
from es_service.loop.budget import Clock
from es_service.loop.contents import StatePolicies
from es_service.loop.generation import initial_state
from es_service.loop.state import Stop, no_observations
from es_service.protocol.episodes import completed
from es_service.protocol.messages import EvaluationChunk
from es_service.search.algorithms import ALGORITHMS
from tests.laws.me_es_runs import Remembering, Sharing, first_centres
from tests.laws.test_map_elites import config_of
from workers.environments import SHIPPED

GENERATIONS = 5


class Beginning(Sharing):
    """Computes what was begun when somebody waits for it, and notes both."""

    def __init__(self, notes):
        super().__init__()
        self.notes = notes

    def begin(self, work):
        generation = work[0][1].generation
        self.notes.append(("sent", generation))

        def wait():
            self.notes.append(("waited for", generation))
            return self.evaluate(work)

        return wait


class Noting(Remembering):
    def __init__(self, notes):
        super().__init__()
        self.notes = notes

    def commit(self, generation, parts, history, evaluations, contents):
        self.notes.append(("stored", generation))
        super().commit(generation, parts, history, evaluations, contents)


def search_of(ask=lambda asked, generation: asked):
    config = config_of(GENERATIONS, episodes=1)
    algorithm = ALGORITHMS["map_elites"](config)
    return driver.Search(
        config,
        replace(algorithm, ask=lambda state, generation: ask(algorithm.ask(state, generation), generation)),
        lambda: (first_centres(config), no_observations(2)),
        SHIPPED["point_maze"],
    )


def run(evaluator, notes, report=lambda row: None, ask=lambda asked, generation: asked):
    search, store = search_of(ask), Noting(notes)
    return store, lambda: driver.drive(driver.run(search, store, None, report), evaluator)


def test_a_generation_is_stored_after_the_next_was_sent_and_before_its_results_are_awaited():
    notes = []
    beside, compute = run(Beginning(notes), notes)
    compute()
    expected = [("sent", 0), ("waited for", 0)]
    for generation in range(1, GENERATIONS + 1):
        expected += [("sent", generation), ("stored", generation - 1), ("waited for", generation)]
    assert notes == [*expected, ("stored", GENERATIONS)]
    one_by_one, compute = run(Sharing(), [])
    compute()
    assert len(beside.after) == len(one_by_one.after) == GENERATIONS + 1
    for some, others in zip(beside.after, one_by_one.after, strict=True):
        assert some.keys() == others.keys()
        for name, arrays in some.items():
            for key, array in arrays.items():
                np.testing.assert_array_equal(array, others[name][key])


def test_a_list_of_results_drives_a_generation():
    search, work_of, results_of = search_of(), [], []

    def compute(work):
        work_of.append(work)
        results_of.append(Sharing().evaluate(work))
        return results_of[-1]

    def bits(evaluate):
        requests = driver.generation(search, StatePolicies({}.get), Clock(0.0), initial_state(search))
        parts = completed(requests, evaluate).parts
        return {name: {key: array.tobytes() for key, array in (part or {}).items()} for name, part in parts.items()}

    computed = bits(compute)
    assert {type(chunk) for _, chunk in work_of[0]} == {EvaluationChunk}
    assert bits(lambda work: results_of.pop(0)) == computed
    results_of.append([replace(result, fitness=result.fitness + 1) for result in Sharing().evaluate(work_of[0])])
    assert bits(lambda work: results_of.pop(0)) != computed
    assert not results_of


def test_a_stop_ends_the_run_with_the_generation_that_was_reported():
    notes = []
    store, compute = run(Beginning(notes), notes, lambda row: Stop("enough") if row["generation"] == 2 else None)
    state, reason = compute()
    assert (state.generation, store.generation, reason) == (2, 2, "enough")
    assert notes[-2:] == [("sent", 3), ("stored", 2)]


@pytest.mark.parametrize("evaluator", [Beginning, lambda notes: Sharing()])
def test_an_error_of_the_next_generation_loses_nothing(evaluator):
    notes = []
    store, compute = run(evaluator(notes), notes, ask=lambda asked, generation: asked if generation < 3 else ())
    with pytest.raises(EvaluationError, match="generation 3"):
        compute()
    assert store.generation == 2


@pytest.mark.parametrize("evaluator", [Beginning, lambda notes: Sharing()])
def test_a_stop_does_not_hide_why_the_next_generation_failed(evaluator):
    notes = []
    store, compute = run(
        evaluator(notes),
        notes,
        lambda row: Stop("enough") if row["generation"] == 2 else None,
        ask=lambda asked, generation: asked if generation < 3 else (),
    )
    with pytest.raises(EvaluationError, match="generation 3"):
        compute()
    assert store.generation == 2


def test_a_store_that_fails_is_not_asked_again():
    notes, failing = [], OSError("the disk is full")

    def report(row):
        if row["generation"] == 2:
            raise failing

    _, compute = run(Beginning(notes), notes, report)
    with pytest.raises(OSError, match="the disk is full"):
        compute()
    assert [note for note in notes if note[0] == "stored"] == [("stored", 0), ("stored", 1), ("stored", 2)]
