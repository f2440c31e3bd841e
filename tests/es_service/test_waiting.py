"""Finished generations wait in memory while another program holds the database of their run."""

import contextlib
import shutil
import signal
import sqlite3

import pytest

from es_service import api
from es_service.errors import ConfigError, DatabaseHeldError, EvaluationError, Interrupted
from es_service.runs import waiting
from es_service.runs.certification import certify_run
from es_service.runs.run_status import read_status, state
from es_service.runs.view import open_run
from es_service.store import reader, writer
from es_service.store import repair as store_repair
from es_service.store.reader import read_generation
from es_service.store.writer import RunStore
from tests.es_service.store_examples import (
    advance,
    assert_same_state,
    contents_of,
    create,
    digest,
    generation_of,
    parts_of,
    policy,
)

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 5},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "me_es", "pairs": 4, "evaluation_episodes": 1},
    "map": {"cells": [4, 4]},
    "budget": {"generations": 8},
    "compute": {"engine": "inline", "workers": 1},
}
pytestmark = pytest.mark.usefixtures("workers_here")


class Viewer:
    """Another program that has the run's database open."""

    def __init__(self, folder, begin="BEGIN IMMEDIATE"):
        self._file, self._begin, self._connection = folder / "run.db", begin, None

    def hold(self):
        self._connection = sqlite3.connect(self._file, isolation_level=None)
        self._connection.execute(self._begin)
        self._connection.execute("SELECT count(*) FROM history").fetchone()

    def leave(self):
        if self._connection is not None:
            self._connection.close()
            self._connection = None


@pytest.fixture(autouse=True)
def _short_patience(monkeypatch):
    monkeypatch.setattr(waiting, "PATIENCE_S", 0.01)
    monkeypatch.setattr(waiting, "AGAIN_S", 0.0)
    monkeypatch.setattr(store_repair, "PATIENCE_S", 0.01)


@pytest.fixture(params=["a program that writes", "a reader, on a network"])
def begin(request, monkeypatch):
    """How a viewer begins the transaction by which the run cannot be written."""
    if request.param == "a program that writes":
        return "BEGIN IMMEDIATE"
    for module in (writer, reader):
        monkeypatch.setattr(module, "is_network_filesystem", lambda path: True)
    return "BEGIN"


def test_a_run_goes_on_while_a_viewer_holds_it_and_a_killed_one_computes_again_what_waited(tmp_path, begin):
    undisturbed = api.run(api.load_config(CONFIG), tmp_path / "undisturbed").run.folder
    folder, killed, notices, states = tmp_path / "run", tmp_path / "killed", [], []
    viewer = Viewer(folder, begin)

    def on_generation(row):
        if row["generation"] == 2:
            viewer.hold()
        elif row["generation"] == 5:
            states.append(state(read_status(open_run(folder))))
            shutil.copytree(folder, killed, ignore=shutil.ignore_patterns("*-shm"))
        elif row["generation"] == 6:
            viewer.leave()
        return {"at": row["generation"]}  # which waits, too

    api.run(api.load_config(CONFIG), folder, on_generation=on_generation, on_notice=notices.append)
    assert digest(folder) == digest(undisturbed)
    assert open_run(folder).history.metric_at.tolist() == list(range(9))
    assert [notice.partition(f"{folder / 'run.db'}")[0::2] for notice in notices] == [
        (
            "another program holds ",
            ", which cannot be written. Finished generations wait in memory, at most 256 MB of them; then the run "
            "pauses. Close that program: what waits is lost if this process is killed, and computed again when the run "
            "continues",
        ),
        ("", " can be written again, and everything that waited is stored"),
    ]
    assert states[0].endswith("another program holds run.db; finished generations that wait: 3")
    assert read_generation(killed) in (2, None if begin == "BEGIN" else 2)  # None: the copy that readers read there
    seen = []
    api.resume(killed, on_generation=lambda row: seen.append(row["generation"]), on_notice=notices.append)
    assert seen == list(range(3, 9))
    assert digest(killed) == digest(undisturbed)


def test_a_run_ends_and_begins_only_when_the_database_is_free(tmp_path):
    folder, notices = tmp_path / "run", []
    viewer = Viewer(folder)

    def on_notice(notice):
        notices.append(notice)
        if "pauses until" in notice:
            viewer.leave()

    def on_generation(row):
        if row["generation"] == 7:
            viewer.hold()

    api.run(api.load_config(CONFIG), folder, on_generation=on_generation, on_notice=on_notice)
    assert read_generation(folder) == 8
    viewer.hold()
    api.resume(folder, ["budget.generations=9"], on_notice=on_notice)
    assert read_generation(folder) == 9
    viewer.hold()
    certify_run(folder, best=True, top=0, episodes=2, on_notice=on_notice)
    assert len(open_run(folder).certified) == 1
    assert sum("another program holds" in notice for notice in notices) == 3


class OneKind:
    """Recorder of a run that has only ever had workers of one kind."""

    def __init__(self, store):
        self._store = store

    def workers(self):
        return frozenset()

    def commit(self, workers, generations):
        self._store.commit(generations)


@contextlib.contextmanager
def held(folder, tell=lambda notice: None, should_stop=lambda: None, generations=3):
    """(store for the loop, its run store, viewer that holds the database) of a run with some generations."""
    viewer = Viewer(folder)
    with create(folder, generations=generations) as store:
        viewer.hold()
        try:
            with waiting.patient_store(store, OneKind(store), should_stop, tell, lambda generation: None) as patient:
                yield patient, store, viewer
        finally:
            viewer.leave()


def give(patient, first, last):
    for generation in range(first, last + 1):
        patient.commit([generation_of(generation)])


def test_the_loop_reads_policies_whether_they_wait_or_not(tmp_path):
    with held(tmp_path / "run") as (patient, store, viewer):
        for last in range(3, 9):
            give(patient, last, last)
            for generation in range(3, last + 1):
                assert_same_state({"": patient.content(*contents_of(generation))}, {"": policy(generation)})
        assert store.generation == 2
        viewer.leave()
        give(patient, 9, 9)
        assert store.generation == 9
        assert_same_state({"": patient.content(*contents_of(9))}, {"": policy(9)})
        assert set(store.contents()) == {name for at in range(6, 10) for name in contents_of(at)}
        with pytest.raises(KeyError):
            patient.content(*contents_of(5))
    with create(tmp_path / "whole", generations=3) as whole:
        advance(whole, 9)
    assert digest(tmp_path / "run") == digest(tmp_path / "whole")


def test_a_run_pauses_when_more_waits_than_memory_may_hold(tmp_path, monkeypatch):
    size = sum(array.nbytes for part in parts_of(4).values() for array in part.values())
    monkeypatch.setattr(waiting, "MOST_BYTES", 3 * size)
    paused = []

    def tell(notice):
        if "pauses until" in notice:
            paused.append(given)
            viewer.leave()

    with held(tmp_path / "run", tell) as (patient, store, viewer):
        for given in range(3, 20):
            give(patient, given, given)
        assert store.generation == 19
    assert len(paused) == 1
    assert 5 <= paused[0] <= 8


def interrupted(folder, error, *, last, tell=lambda notice: None, leaves=False):
    """A session that is ended by an error after its generations up to `last`."""
    with held(folder, tell, should_stop=lambda: signal.SIGTERM) as (patient, _, viewer):
        give(patient, 3, last)
        if leaves:
            viewer.leave()
        raise error


@pytest.mark.parametrize("most", [0, waiting.MOST_BYTES])
def test_a_stop_while_generations_wait_is_an_error_that_says_how_many_are_lost(tmp_path, monkeypatch, most):
    """Whether the run has paused, which then sees the request itself, or not, where waits for workers see it."""
    monkeypatch.setattr(waiting, "MOST_BYTES", most)
    folder = tmp_path / "run"
    which = "generation 3" if most == 0 else "4 generations"
    with pytest.raises(DatabaseHeldError, match=f"so {which} could not be stored before the end; close") as error:
        interrupted(folder, Interrupted(signal.SIGTERM), last=6)
    assert isinstance(error.value.__cause__, Interrupted)
    assert (error.value.way_out.action, error.value.way_out.run) == ("resume", str(folder))
    with RunStore.open(folder) as store:
        assert store.generation == 2


def test_a_stop_when_the_viewer_has_left_loses_nothing(tmp_path):
    with pytest.raises(Interrupted):
        interrupted(tmp_path / "run", Interrupted(signal.SIGINT), last=6, leaves=True)
    assert read_generation(tmp_path / "run") == 6


def test_an_error_of_the_rollouts_is_what_is_raised_and_a_notice_says_what_is_lost(tmp_path):
    notices = []
    with pytest.raises(EvaluationError, match="no worker"):
        interrupted(tmp_path / "run", EvaluationError("no worker"), last=4, tell=notices.append)
    assert "2 generations could not be stored before the end" in notices[-1]


def test_a_wrong_answer_of_the_caller_loses_no_generation_that_waits(tmp_path):
    with pytest.raises(ConfigError, match="wrong"):
        interrupted(tmp_path / "run", ConfigError("wrong"), last=6, leaves=True)
    assert read_generation(tmp_path / "run") == 6
