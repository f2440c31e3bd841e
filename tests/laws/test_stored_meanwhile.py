"""A generation is stored and reported while the next one is computed, with the bits of one after the other."""

import math
import types
from dataclasses import replace

import numpy as np
import pytest

from es_service.errors import EvaluationError, Interrupted
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
    """Computes what was begun when somebody waits for it, and notes both. The results of some generations take longer
    than anybody waits who cannot wait for ever."""

    def __init__(self, notes, slow=()):
        super().__init__()
        self.notes, self.slow = notes, slow

    def begin(self, work):
        generation = work[0][1].generation
        self.notes.append(("sent", generation))

        def wait(most_s):
            if generation in self.slow and most_s < math.inf:
                self.notes.append(("waited in vain for", generation))
                driver.time.sleep(most_s)
                return None
            self.notes.append(("waited for", generation))
            return self.evaluate(work)

        return wait


class Noting(Remembering):
    def __init__(self, notes):
        super().__init__()
        self.notes = notes

    def commit(self, generations):
        self.notes.append(("stored", *(one.number for one in generations)))
        super().commit(generations)


def search_of(ask=lambda asked, generation: asked):
    config = config_of(GENERATIONS, episodes=1)
    algorithm = ALGORITHMS["map_elites"](config)
    return driver.Search(
        config,
        replace(algorithm, ask=lambda state, generation: ask(algorithm.ask(state, generation), generation)),
        lambda: (first_centres(config), no_observations(2)),
        SHIPPED["point_maze"],
    )


def run(evaluator, notes, report=lambda row: None, ask=lambda asked, generation: asked, interval_s=0.0):
    search, store = search_of(ask), Noting(notes)
    session = driver.run(search, store, None, report, commit_interval_s=interval_s)
    return store, lambda: driver.drive(session, evaluator)


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


@pytest.mark.parametrize("interval_s", [0.0, 100.0])
def test_what_a_metric_raises_loses_no_generation_before_it(monkeypatch, interval_s):
    def failing(search, one, reachable):
        if one.state.generation == 3:
            raise ZeroDivisionError("a user's metric")
        return rows(search, one, reachable)

    rows, notes = driver.rows, []
    monkeypatch.setattr(driver, "rows", failing)
    store, compute = run(Beginning(notes), notes, interval_s=interval_s)
    with pytest.raises(ZeroDivisionError):
        compute()
    assert store.rows[-1]["generation"] == 2


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


@pytest.fixture
def clock(monkeypatch):
    """The driver's clock, which stands still unless somebody sleeps or sets it forward: `now_s`."""
    seconds = types.SimpleNamespace(now_s=100.0)

    def sleep(s):
        seconds.now_s += s

    monkeypatch.setattr(driver, "time", types.SimpleNamespace(perf_counter=lambda: seconds.now_s, sleep=sleep))
    return seconds


def stored(notes):
    return [note[1:] for note in notes if note[0] == "stored"]


def test_generations_that_end_within_the_interval_are_stored_together(clock):
    notes, reported = [], []

    def ask(asked, generation):
        clock.now_s += 1.0  # the time of a generation, but for the first
        return asked

    def report(row):
        reported.append((row["generation"], store.generation))

    store, compute = run(Beginning(notes), notes, report, ask, interval_s=1.5)
    compute()
    # The first of each ends at t, the second at t + 1; then one more is sent at t + 2.
    assert stored(notes) == [(0, 1), (2, 3), (4, 5)]
    assert notes.index(("stored", 0, 1)) == notes.index(("sent", 2)) + 1, "while the next one is computed"
    assert reported == [(0, 1), (1, 1), (2, 3), (3, 3), (4, 5), (5, 5)], "after their commit"
    one_by_one, compute = run(Sharing(), [])
    compute()
    for some, others in zip(store.after, one_by_one.after, strict=True):
        assert some.keys() == others.keys()
        for name, arrays in some.items():
            for key, array in arrays.items():
                np.testing.assert_array_equal(array, others[name][key])


def test_a_generation_that_takes_long_leaves_none_before_it_unstored(clock):
    notes = []
    _, compute = run(Beginning(notes, slow=(3,)), notes, interval_s=1.5)
    compute()
    assert stored(notes) == [(0, 1, 2), (3, 4, 5)]
    began = notes.index(("sent", 3))
    assert notes[began + 1 : began + 4] == [("waited in vain for", 3), ("stored", 0, 1, 2), ("waited for", 3)]
    assert clock.now_s == 101.5, "no longer than the interval"


@pytest.mark.parametrize("evaluator", [Beginning, lambda notes: Sharing()])
def test_an_error_or_a_stop_loses_no_generation_of_a_group(evaluator, clock):
    notes = []
    store, compute = run(
        evaluator(notes), notes, ask=lambda asked, generation: asked if generation < 3 else (), interval_s=9.0
    )
    with pytest.raises(EvaluationError, match="generation 3"):
        compute()
    assert stored(notes) == [(0, 1, 2)]
    notes.clear()
    store, compute = run(
        evaluator(notes), notes, lambda row: Stop("enough") if row["generation"] == 1 else None, interval_s=9.0
    )
    state, reason = compute()
    assert stored(notes) == [(0, 1, 2, 3, 4, 5)]
    assert (state.generation, store.generation, reason) == (5, 5, "enough")


class Interrupting(Beginning):
    """Is interrupted when somebody waits for the results of a generation."""

    def begin(self, work):
        wait = super().begin(work)

        def interrupted(most_s):
            if work[0][1].generation == 4:
                raise Interrupted(15)
            return wait(most_s)

        return interrupted


def test_an_interruption_stores_and_reports_what_has_ended(clock):
    notes, reported = [], []
    _, compute = run(Interrupting(notes), notes, lambda row: reported.append(row["generation"]), interval_s=9.0)
    with pytest.raises(Interrupted):
        compute()
    assert stored(notes) == [(0, 1, 2, 3)]
    assert reported == [0, 1, 2, 3]
