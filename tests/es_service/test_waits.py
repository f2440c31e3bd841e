"""What a run says while nothing is heard of it: that it waits for a place, or that its workers compile."""

from __future__ import annotations

import logging

import pytest

from es_service import api
from es_service.dispatch import waits
from es_service.dispatch.events import (
    Compiled,
    Limits,
    Placed,
    Progress,
    Result,
    SetWorkers,
    Submit,
    Tick,
    WorkerLost,
    WorkerUp,
    WorkItem,
)
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import initial_state
from es_service.dispatch.waits import AGAIN_S, NOTICE_S, SILENCE_S, Waits
from es_service.protocol.messages import Chunk
from es_service.runs import engine, evaluation, session
from es_service.runs.engine import compiling_sentence, note_compiled, was_compiled
from es_service.runs.run_status import doing, read_status
from tests.helpers import spec, workers_in_this_process
from tests.system.session import SMALL

KINDS = ("EvaluationChunk", "TrainingChunk")


def test_a_wait_is_told_when_it_begins_and_when_it_ends():
    """First for a place, then for a compiler, of one kind of chunks after another."""
    told, state = [], initial_state(Limits(1))
    what = Waits(lambda shortage: told.append(("place", shortage)), lambda *of: told.append(("compile", *of)))

    def at(now: float, *events) -> list[tuple[str, ...]]:
        nonlocal state
        for event in events:
            handle(state, event, now)
        told.clear()
        what.tell(state, now, lambda: "it is full")
        return list(told)

    assert at(0.0, Tick()) == []
    assert at(NOTICE_S) == [("place", "it is full")]
    assert at(NOTICE_S + 1.0) == []
    assert at(10.0, Placed(0)) == [("place", "")]
    what.begin(KINDS, 10.0)
    work = Submit(tuple(WorkItem(kind, kind) for kind in KINDS))
    assert at(10.0, work) == at(10.0 + 0.9 * SILENCE_S, WorkerUp(0)) == []
    assert at(10.0 + SILENCE_S) == [("compile", KINDS[0], "")]
    assert at(20.0) == []
    assert at(21.0, Compiled(0, KINDS[0], 5.0)) == [("compile", "", "")]
    assert at(22.0) == [], "it computes"
    assert at(23.0, Result(0, KINDS[0], 1)) == [("compile", KINDS[1], "")]
    assert at(24.0, Compiled(0, KINDS[1], 0.9), Result(0, KINDS[1], 1)) == [("compile", "", "")]
    what.begin(KINDS, 30.0)
    assert at(30.0, work) == at(30.0 + 2 * SILENCE_S) == [], "it computes, which a deadline limits"
    assert at(40.0, Progress(0, "resetting", 4, 16)) == [("compile", "", "resetting 16 environments: 4 of 16")]
    assert at(41.0, Progress(0, "resetting", 5, 16)) == [], "not of each of them"
    both = Progress(0, "resetting", 9, 16), SetWorkers(2), WorkerUp(1), Submit((WorkItem("more", KINDS[0]),))
    assert at(40.0 + AGAIN_S, *both) == [("compile", "", "resetting 16 environments: 9 of 16")]
    making = Progress(1, "making", 1, 8)
    assert at(40.0 + 2 * AGAIN_S, making) == [("compile", "", "making 8 environments: 1 of 8")]
    assert at(52.0, WorkerLost(1, "killed")) == [], "soon after the last text"
    assert at(53.0, Progress(0)) == [("compile", "", "")]


def test_what_was_compiled_before_is_remembered_with_all_that_the_code_depends_on(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kind, other = KINDS
    assert "(evaluation episodes, first time, about 10 s)" in compiling_sentence(
        spec(rollout="simd"), kind, "", here=True
    )
    for known in (False, True):
        assert was_compiled(spec(), kind) == known
        note_compiled(spec(), kind)
    assert compiling_sentence(spec(), kind, "", here=True) == (
        "loading compiled code for point_maze (evaluation episodes, about 6 s)"
    )
    assert "(evaluation episodes, about 15 s the first time)" in compiling_sentence(spec(), kind, "", here=False)
    starting = compiling_sentence(spec(rollout="host"), kind, "", here=True)
    assert starting == "starting workers for point_maze (evaluation episodes)", "they compile nothing"
    making = "making 16 environments: 4 of 16"
    assert compiling_sentence(spec(rollout="host"), kind, making, here=True) == f"{making} (point_maze)"
    assert compiling_sentence(spec(), "", "", here=True) == ""
    assert was_compiled(spec(seed=9), kind)
    changed = (spec(episode_steps=9), spec(rollout="simd"), spec(sources={"workers/worker.py": "0"}))
    assert not any(was_compiled(one, kind) for one in changed)
    assert not was_compiled(spec(), other)
    monkeypatch.setattr(engine, "MOST_FILES", 1)
    note_compiled(spec(), other)
    assert len(list((tmp_path / "es-service" / "compiled").iterdir())) == 1


def test_a_cache_that_cannot_be_written_only_makes_it_the_first_time(tmp_path, monkeypatch):
    (tmp_path / "es-service").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    note_compiled(spec(), KINDS[0])
    assert not was_compiled(spec(), KINDS[0])


def test_every_kind_of_chunk_has_words():
    assert {kind.__name__ for kind in Chunk.__args__} == set(engine.CONTENTS)


def test_a_run_says_how_long_it_places_centroids_and_a_resumed_one_has_them(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "LONG_PLACING_S", 0.0)
    config, said = SMALL | {"map": {"kind": "cvt", "cells": [9]}, "budget": {"generations": 1}}, []
    with workers_in_this_process():  # in this test alone
        api.run(config, tmp_path / "run", on_compile=said.append)
        sentence = "placing the centroids of the map (9 cells in 2 dimensions, about 0 s)"
        assert [one for one in said if "centroids" in one] == [sentence]
        api.resume(tmp_path / "run", ["budget.generations=2"], on_compile=said.append)
        api.run(config | {"map": {"cells": [3, 3]}}, tmp_path / "grid", on_compile=said.append)
        assert [one for one in said if "centroids" in one] == [sentence]


@pytest.mark.slow
def test_a_run_says_that_its_workers_compile(tmp_path, monkeypatch, caplog):
    """To its caller, in the log, and in `status`; a second run knows that they have compiled before."""
    monkeypatch.setattr(waits, "SILENCE_S", 0.0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    caplog.set_level(logging.INFO, "es_service")
    config = SMALL | {"budget": {"generations": 1}}
    said, states = [], []

    def hear(sentence: str) -> None:
        said.append(sentence)
        states.append(doing(read_status(api.open_run(tmp_path / "run"))))

    api.run(config, tmp_path / "run", on_compile=hear)
    said_first = "compiling for point_maze (evaluation episodes, first time, about 10 s)"
    assert said[0] == said_first
    assert any("training episodes, first time" in sentence for sentence in said)
    assert states == said
    assert set(said) <= {record.getMessage() for record in caplog.records}
    said.clear()
    api.run(config, tmp_path / "again", on_compile=said.append)
    assert said[0] == "loading compiled code for point_maze (evaluation episodes, about 4 s)"
    said.clear()
    run = api.open_run(tmp_path / "run")
    best = evaluation.candidates(run, best=True, centre=False, cells=(), every=False)
    loads = "loading compiled code for point_maze (evaluation episodes, about 4 s)"
    for known in (said_first, loads):  # code that also says which succeed
        said.clear()
        assert len(list(evaluation.evaluate(run, best, 1, on_notice=said.append))) == 1
        assert said == [known]
