"""Trackers get every row of a history once, whatever happens to them, and nothing that they do reaches the run."""

import contextlib
import importlib
import json
import os
import shutil
import struct
import sys
import threading
import time
from datetime import datetime

import numpy as np
import pytest

from es_service import api, open_run
from es_service.errors import ConfigError, Interrupted, StoreError
from es_service.runs import tracking
from es_service.runs.export import export
from es_service.runs.tracking import PACKAGES, TensorBoard, _key, check_trackers, fill, metrics, open_tracker
from es_service.store.codec import text_sha256
from tests.database import execute
from tests.run_examples import write_run

NAME = "tensorboard"
"""A tracker whose package is always installed; its place is taken by a recorder."""


class Recorder:
    """A tracker that remembers what it gets."""

    def __init__(self, kept, fails_at=None):
        self.kept, self.fails_at, self.closed = kept, fails_at, False

    def newest(self):
        return max(self.kept, default=-1)

    def log(self, rows):
        for row in rows:
            if row["generation"] == self.fails_at:
                raise OSError("no such host\nand more")
            self.kept.append(int(row["generation"]))

    def close(self, how):
        self.closed = how


@pytest.fixture
def folder(tmp_path):
    return write_run(tmp_path / "run", generations=20)


def session(folder, opened, body=lambda committed: committed({})):
    """Notices of a session with one tracker."""
    notices = []
    with tracking.tracked(folder, [NAME], notices.append, lambda name, run: opened()) as committed:
        body(committed)
    return notices


@pytest.mark.parametrize("lag", [-2, 0, 1, 7, 21])
def test_what_a_tracker_lacks_is_sent_once(folder, lag):
    """With a negative lag, the store has lost generations, which are computed again with the same values."""
    kept = list(range(21 - lag))
    recorder = Recorder(kept)
    assert session(folder, lambda: recorder) == []
    assert kept == list(range(max(21, 21 - lag)))
    assert recorder.closed == "finished"


def test_a_session_without_a_generation_sends_what_is_lacking(folder):
    kept = [0, 1]
    assert session(folder, lambda: Recorder(kept), lambda committed: None) == []
    assert kept == list(range(21))


def test_a_long_history_is_sent_in_pieces(folder, monkeypatch):
    monkeypatch.setattr("es_service.runs.tracking.MOST_ROWS", 4)
    kept = []
    session(folder, lambda: Recorder(kept))
    assert kept == list(range(21))


def test_rows_that_are_committed_during_a_session_are_sent(folder, monkeypatch):
    """The recorder sees a history that grows, since it is first read while only a part of it is there."""
    whole = tracking.fill
    shown = [5, 12]

    def fill_part(tracker, run, newest, *, has_ended):
        if not shown:
            return whole(tracker, run, newest, has_ended=has_ended)
        last = shown.pop(0)
        tracker.log([row for row in run.history_rows(newest + 1) if row["generation"] <= last])
        return last

    monkeypatch.setattr(tracking, "fill", fill_part)
    monkeypatch.setattr(tracking, "PAUSE_S", 0.01)
    kept = []

    def body(committed):
        committed({})
        end = time.monotonic() + 60
        while len(kept) < 13 and time.monotonic() < end:
            time.sleep(0.01)

    assert session(folder, lambda: Recorder(kept), body) == []
    assert kept == list(range(21))


@pytest.mark.parametrize("fails", ["at opening", 0, 9])
def test_a_tracker_that_fails_costs_one_notice_and_is_filled_in_the_next_session(folder, fails):
    kept = []

    def opened():
        if fails == "at opening":
            raise OSError("no such host")
        return Recorder(kept, fails)

    def body(committed):
        for _ in range(50):
            committed({})

    [notice] = session(folder, opened, body)
    assert notice.startswith("the tracker tensorboard failed (OSError: no such host). It is tried again")
    assert kept == list(range(0 if fails == "at opening" else fails))
    assert session(folder, lambda: Recorder(kept)) == []
    assert kept == list(range(21))


@pytest.mark.parametrize("again_s", [0.01, 60.0])
def test_a_tracker_that_fails_for_a_while_gets_every_row_once(folder, monkeypatch, again_s):
    """It is opened again after a time, and at the end of the session."""
    monkeypatch.setattr(tracking, "PAUSE_S", 0.01)
    monkeypatch.setattr(tracking, "AGAIN_S", again_s)
    kept, works, notices = [], threading.Event(), []
    first = Recorder(kept, fails_at=9)
    answers = iter([first, OSError("no such host"), OSError("no such host")] if again_s < 1.0 else [first])

    def opened(name, run):
        answer = next(answers, None)
        if isinstance(answer, OSError):
            raise answer
        if answer is None:
            works.set()
        return answer or Recorder(kept)

    with tracking.tracked(folder, [NAME], notices.append, opened) as committed:
        committed({})
        until = time.monotonic() + 60
        while not (works.is_set() if again_s < 1.0 else notices) and time.monotonic() < until:
            time.sleep(0.01)
    assert (kept, first.closed) == (list(range(21)), "failed")
    assert [notice.partition(" (")[0] for notice in notices] == [
        "the tracker tensorboard failed",
        "the tracker tensorboard works again and has what it lacked",
    ]


def test_a_tracker_that_hangs_holds_up_neither_the_run_nor_its_end(folder, monkeypatch):
    monkeypatch.setattr(tracking, "FINISH_S", 0.1)
    free = threading.Event()
    notices = []
    with tracking.tracked(folder, [NAME], notices.append, lambda name, run: free.wait(60)) as committed:
        for _ in range(1000):
            committed({})
        assert notices == []
    [notice] = notices
    assert notice.startswith(f"the tracker {NAME} did not finish within 0.1 s; the run does not need it")
    free.set()


def test_nothing_is_sent_if_the_session_fails_before_its_first_generation(folder):
    """The folder may hold another run, which was the reason."""
    opened = []
    with pytest.raises(KeyError), tracking.tracked(folder, [NAME], print, lambda name, run: opened.append(name)):
        raise KeyError
    assert opened == []


def test_unknown_and_missing_trackers_are_refused(folder, monkeypatch):
    with pytest.raises(ConfigError, match=r"the tracker wanb is unknown; must be .* did you mean wandb\?"):
        check_trackers(["wanb"])
    for name, package in PACKAGES.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigError, match=f"the tracker {name} needs the package {package}") as caught:
            check_trackers([name])
        assert caught.value.way_out.extra == name


def test_a_folder_named_like_a_package_is_no_package(tmp_path, monkeypatch):
    (tmp_path / "wandb").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    importlib.invalidate_caches()
    with pytest.raises(ConfigError, match="the tracker wandb needs the package wandb"):
        check_trackers(["wandb"])


def events(files):
    """The events with values of event files, in the order of the files."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for file in files:
        data, at = file.read_bytes(), 0
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            found.append(Event.FromString(data[at + 12 : at + 12 + length]))
            at += length + 16
    assert [event.file_version for event in found if event.file_version] == ["brain.Event:2"] * len(files)
    return [event for event in found if event.HasField("summary")]


def test_tensorboard_has_every_row_once_with_its_values(folder):
    run = open_run(folder)
    rows = run.history_rows()
    for part in (rows[:5], [], rows[5:6], rows[6:]):
        tracker = open_tracker("tensorboard", run)
        assert tracker.newest() == (part[0]["generation"] - 1 if part else 4)
        tracker.log(part)
        tracker.close()
    found = events(TensorBoard(run).files())
    assert [event.step for event in found] == list(range(21))
    for event, row in zip(found, rows, strict=True):
        shown = {value.tag: value.simple_value for value in event.summary.value}
        assert shown == {name: np.float32(value) for name, value in metrics(row).items()}
        assert event.wall_time == pytest.approx(1735689600 + row["wall_clock_s"], abs=1e-3)  # 2025-01-01
    assert {"best_fitness", "coverage", "env_steps"} <= metrics(rows[0]).keys()
    assert not {"generation", "centre_novelty"} & metrics(rows[0]).keys()  # the latter has no value yet


def test_a_torn_event_at_the_end_is_sent_again(folder):
    run = open_run(folder)
    tracker = open_tracker("tensorboard", run)
    fill(tracker, run, -1)
    tracker.close()
    [file] = tracker.files()
    file.write_bytes(file.read_bytes()[:-3])
    again = open_tracker("tensorboard", run)
    assert again.newest() == 19
    fill(again, run, again.newest())
    again.close()
    assert [event.step for event in events(again.files()[1:])] == [20]


def test_an_export_replaces_the_event_files_of_its_run_alone(folder, tmp_path):
    out = tmp_path / "out"
    other = write_run(tmp_path / "other", {"seed": 1}, generations=3)
    export(open_run(other), "tensorboard", out)
    for _ in range(2):
        files = export(open_run(folder), "tensorboard", out)
        assert [event.step for event in events(files)] == list(range(21))
    assert len(list(out.iterdir())) == 2


def test_mlflow_allows_no_other_letters():
    assert _key("centre_x (m): é$") == "centre_x _m__ __"


def test_the_rows_that_a_fork_has_of_its_parent_end_when_it_was_created(folder, tmp_path):
    parent, began_s = open_run(folder), time.time()
    fork = api.fork(folder, {"budget.generations": 21}, out=tmp_path / "fork", on_notice=lambda notice: None).run
    tracker = open_tracker("tensorboard", fork)
    fill(tracker, fork, -1)
    tracker.close()
    *_, inherited, own = events(tracker.files())
    assert parent.history_rows()[-1]["wall_clock_s"] > 1.0
    assert inherited.wall_time == pytest.approx(datetime.fromisoformat(fork.meta.created).timestamp(), abs=1e-3)
    assert began_s - 1.0 <= inherited.wall_time <= own.wall_time <= time.time()


@pytest.mark.parametrize(
    ("error", "how"),
    [(None, "finished"), (Interrupted("SIGTERM"), "interrupted"), (StoreError("the disk is full"), "failed")],
)
def test_a_tracker_is_told_how_the_session_has_ended(folder, error, how):
    def body(committed):
        committed({})
        if error is not None:
            raise error

    recorder = Recorder([])
    with contextlib.nullcontext() if error is None else pytest.raises(type(error)):
        session(folder, lambda: recorder, body)
    assert (recorder.closed, recorder.kept) == (how, list(range(21)))


def test_an_interruption_waits_for_all_trackers_together_and_says_so(folder, monkeypatch):
    for name, value in {"INTERRUPTED_S": 0.3, "TELL_S": 0.1}.items():
        monkeypatch.setattr(tracking, name, value)
    free, notices = threading.Event(), []
    begun_s = time.monotonic()
    names = ["tensorboard", "tensorboardX"]
    monkeypatch.setattr(tracking, "check_trackers", lambda names: None)

    def interrupted():
        with tracking.tracked(folder, names, notices.append, lambda name, run: free.wait(60)) as committed:
            committed({})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - begun_s < tracking.FINISH_S
    free.set()
    assert notices[0] == f"waiting for the tracker {names[0]}, at most 0 s; Ctrl-C ends the wait"
    ended = [f"the tracker {name} did not finish within 0.3 s" for name in names]
    assert [notice.partition(";")[0] for notice in notices[1:]] == ended


def sessions(folder, name):
    """Two sessions with a real tracker, of which the first got only a part of the history."""
    run = open_run(folder)
    tracker = open_tracker(name, run)
    assert tracker.newest() == -1
    tracker.log(run.history_rows()[:8])
    tracker.close()
    time.sleep(1.1)  # wandb names the files of a session by the second
    notices = []
    with tracking.tracked(folder, [name], notices.append) as committed:
        committed({})
    assert notices == []


@pytest.mark.filterwarnings("ignore")
def test_wandb_has_every_row_once(folder, monkeypatch):
    """Without a network: what `wandb sync` would upload."""
    pytest.importorskip("wandb", reason="this test needs the extra wandb")
    from wandb.proto.wandb_internal_pb2 import Record

    monkeypatch.setenv("WANDB_MODE", "offline")
    sessions(folder, "wandb")
    wait_for_wandb(folder)

    def records():
        for file in sorted((folder / "wandb").glob("offline-run-*/*.wandb")):
            yield from map(Record.FromString, blocks(file.read_bytes()))

    rows = [record.history for record in records() if record.HasField("history")]
    assert [row.step.num for row in rows] == list(range(21))
    assert {record.run.run_id for record in records() if record.HasField("run")} == {open_run(folder).run_id}
    for row, stored in zip(rows, open_run(folder).history_rows(), strict=True):
        shown = {item.nested_key[0] if item.nested_key else item.key: json.loads(item.value_json) for item in row.item}
        assert shown["_timestamp"] == pytest.approx(1735689600 + stored["wall_clock_s"], abs=1e-3)
        assert shown["best_fitness"] == stored["best_fitness"]


def wait_for_wandb(folder):
    """Its process writes the end of a file a moment after it has said that it has finished."""
    before, end_s = -1, time.monotonic() + 30
    while (size := sum(file.stat().st_size for file in folder.glob("wandb/offline-run-*/*.wandb"))) != before:
        assert time.monotonic() < end_s
        before = size
        time.sleep(1.5)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("lost", ["the note", "the files", "the last row and the note"])
def test_wandb_s_files_and_the_note_beside_them_say_what_it_has(folder, monkeypatch, lost):
    """A session that was killed has written no note; `wandb sync --clean` deletes the files."""
    pytest.importorskip("wandb", reason="this test needs the extra wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    run = open_run(folder)
    tracker = open_tracker("wandb", run)
    fill(tracker, run, -1)
    tracker.close()
    wait_for_wandb(folder)
    if "note" in lost:
        [note] = (folder / "wandb").glob("*.newest")
        note.unlink()
    [kept] = (folder / "wandb").glob("offline-run-*")
    if lost == "the files":
        shutil.rmtree(kept)
    if "row" in lost:
        [file] = kept.glob("*.wandb")
        at = file.read_bytes().rfind(b"best_fitness")
        file.write_bytes(file.read_bytes()[:at])
    again = open_tracker("wandb", run)
    assert again.newest() == (19 if "row" in lost else 20)
    again.close()


@pytest.mark.filterwarnings("ignore")
def test_wandb_that_is_disabled_has_nothing(folder, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="this test needs the extra wandb")
    run = open_run(folder)
    wandb.teardown()  # it keeps the mode of its first run in a process
    monkeypatch.setenv("WANDB_MODE", "disabled")
    tracker = open_tracker("wandb", run)
    fill(tracker, run, -1)
    tracker.close()
    wandb.teardown()
    monkeypatch.setenv("WANDB_MODE", "offline")
    again = open_tracker("wandb", run)
    assert again.newest() == -1
    again.close()


def blocks(data):
    """Records of a file in the format of LevelDB's log, behind the seven bytes of its header."""
    at, record = 7, b""
    while at + 7 <= len(data):
        if 32768 - at % 32768 < 7:  # the rest of a block is empty
            at += 32768 - at % 32768
            continue
        length, kind = struct.unpack_from("<HB", data, at + 4)
        record += data[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield record
            record = b""


@pytest.mark.filterwarnings("ignore")
def test_mlflow_has_every_row_once(folder, tmp_path, monkeypatch):
    pytest.importorskip("mlflow", reason="this test needs the extra mlflow")
    from mlflow.tracking import MlflowClient

    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")
    sessions(folder, "mlflow")
    client = MlflowClient()
    [entry] = client.search_runs([client.get_experiment_by_name("es-service").experiment_id])
    assert entry.data.tags["es_service.run"] == open_run(folder).run_id
    assert entry.data.params["search.algorithm"] == "me_es"
    assert entry.info.status == "FINISHED"
    history = client.get_metric_history(entry.info.run_id, "best_fitness")
    assert [one.step for one in history] == list(range(21))
    assert [one.value for one in history] == [row["best_fitness"] for row in open_run(folder).history_rows()]
    open_tracker("mlflow", open_run(folder)).close("failed")
    assert client.get_run(entry.info.run_id).info.status == "FAILED"


@pytest.mark.parametrize("name", ["x/../../../victim/thesis", "*", "' OR tags.a = 'b", "A" * 32, "a" * 31, "a" * 33])
def test_a_run_whose_id_is_not_ours_reaches_no_path_pattern_or_query(tmp_path, name):
    """It is refused when it is read, so an export deletes nothing elsewhere, and no tracker is asked for it."""
    folder, victim = write_run(tmp_path / "run", generations=2), tmp_path / "victim"
    victim.mkdir()
    (victim / "thesis.txt").write_text("years of work")
    (folder / "export/events.out.tfevents.1.x").mkdir(parents=True)
    (folder / "export/events.out.tfevents.1.of_another_run.1").write_text("events")
    run_as(folder, name)
    with pytest.raises(StoreError, match=r"its description of the run: run_id: .*, not "):
        export(open_run(folder), "tensorboard", folder / "export")
    assert (victim / "thesis.txt").read_text() == "years of work"
    assert (folder / "export/events.out.tfevents.1.of_another_run.1").exists()


def run_as(folder, name):
    """Give a run another id, with the SHA-256 that belongs to it."""
    [(text,)] = execute(folder, "SELECT value FROM meta WHERE key = 'run'")
    text = json.dumps(json.loads(text) | {"run_id": name})
    execute(folder, "UPDATE meta SET value = ?, sha256 = ? WHERE key = 'run'", text, text_sha256("run", text))


def test_an_export_of_events_replaces_those_of_the_same_run_only(folder):
    there = [f"events.out.tfevents.1.host.{id_}.0" for id_ in (open_run(folder).run_id, "b" * 32)]
    (folder / "export").mkdir()
    for name in there:
        (folder / "export" / name).write_text("old")
    written = export(open_run(folder), "tensorboard", folder / "export")
    assert there[0] not in os.listdir(folder / "export")
    assert {file.name for file in written} | {there[1]} == {*os.listdir(folder / "export")}
