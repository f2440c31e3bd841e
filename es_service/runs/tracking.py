"""Experiment trackers that show the history of a run while it runs: TensorBoard, Weights & Biases, and MLflow.

A tracker knows the newest generation that it has of a run, and takes the rows after it, so that it gets every row once,
whenever it is opened. Its entry is found again by the run's id. Each package is imported when its tracker is opened.

Each tracker has a thread, which reads committed rows from the store and sends those that the tracker does not have. So
the driver never waits for a tracker, and one that failed gets what it lacks when it works again, in this session or the
next.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import os
import random
import re
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, Protocol

from es_service.config.text import unknown_name
from es_service.errors import ConfigError, Interrupted, WayOut
from es_service.loop.history import Row
from es_service.runs.session import OnNotice
from es_service.runs.view import Run, open_run
from es_service.store.reader import read_history, read_start

PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
"""Name of a tracker, which is also that of the extra of this package -> the module that it needs."""
PROJECT = "es-service"
"""Project or experiment in which entries are made, unless the tracker's own environment variables name another."""
RUN_TAG = "es_service.run"
MOST_ROWS = 1000
"""History rows that are read and sent at once."""
LEVEL_BLOCK = 32768
"""Bytes of a block in the files of Weights & Biases."""
MLFLOW_BATCH = 1000
"""Most metrics that MLflow takes at once."""
MLFLOW_ATTEMPTS = 4
"""Attempts to find or make an experiment."""
Ending = Literal["finished", "failed", "interrupted"]
"""How a session has ended."""
MLFLOW_STATUS: Mapping[Ending, str] = {"finished": "FINISHED", "failed": "FAILED", "interrupted": "KILLED"}


class Tracker(Protocol):
    """The entry of a run in a tracker."""

    def newest(self) -> int:
        """Newest generation that the tracker has; -1 if it has none."""
        ...

    def log(self, rows: Sequence[Row]) -> None:
        """Add history rows, whose generations are all newer than `newest`, in their order."""
        ...

    def close(self, how: Ending = "finished") -> None:
        """Send what is still here, and say how the session has ended."""
        ...


def check_trackers(names: Sequence[str]) -> None:
    """Check that trackers exist and that their packages are installed. Raises ConfigError."""
    for name in names:
        if name not in PACKAGES:
            raise unknown_name("tracker", name, PACKAGES, "log")
        spec = importlib.util.find_spec(PACKAGES[name])
        if spec is None or spec.origin is None:  # a folder of the same name, as wandb makes it, is no package
            ways_out = [WayOut("install", "install it", extra=name)]
            sentence = f"the tracker {name} needs the package {PACKAGES[name]}"
            raise ConfigError(sentence, field="log", value=name, ways_out=ways_out)


def open_tracker(name: str, run: Run) -> Tracker:
    """The entry of a run in a tracker, which is made if there is none; `name` is a key of PACKAGES."""
    made: dict[str, Callable[[Run], Tracker]] = {"tensorboard": TensorBoard, "wandb": Wandb, "mlflow": MLflow}
    return made[name](run)


def fill(tracker: Tracker, run: Run, newest: int, *, has_ended: bool = True) -> int:
    """Send the rows after generation `newest` to a tracker; returns the newest generation that was sent.

    Args:
        has_ended: whether the session has. If not, the last row waits, since a program may record metrics of it.
    """
    while rows := read_history(run.folder, newest + 1, MOST_ROWS):
        if not has_ended:
            rows.pop()
        if not rows:
            break
        tracker.log(rows)
        newest = int(rows[-1]["generation"])
    return newest


def metrics(row: Row) -> dict[str, float]:
    """The values of a history row that a tracker shows: all finite numbers but the generation."""
    return {
        name: float(value)
        for name, value in row.items()
        if name != "generation" and value is not None and math.isfinite(value)
    }


def _begin(run: Run) -> float:
    """Seconds since 1970 at which generation 0 is shown, to which `wall_clock_s` is added: so pauses between sessions
    are left out. The rows that a fork has from its parent end when the fork was created."""
    created, parent = datetime.fromisoformat(run.meta.created).timestamp(), run.meta.parent
    if parent is None or read_start(run.folder) is not None:
        return created
    inherited = read_history(run.folder, parent["generation"], 1)
    return created - (inherited[0]["wall_clock_s"] if inherited else 0.0)


class TensorBoard:
    """Event files in `RUN/tensorboard` or another folder; their names contain the run's id."""

    def __init__(self, run: Run, folder: Path | None = None) -> None:
        self._run, self._folder, self._begin = run, folder or run.folder / "tensorboard", _begin(run)
        self._writer: Any = None

    def files(self) -> list[Path]:
        mark = f".{self._run.run_id}."
        there = self._folder.iterdir() if self._folder.is_dir() else ()
        return sorted(file for file in there if file.name.startswith("events.out.tfevents.") and mark in file.name)

    def newest(self) -> int:
        event_type = importlib.import_module("tensorboardX.proto.event_pb2").Event
        events = (event_type.FromString(record) for file in self.files() for record in _records(file.read_bytes()))
        return max((event.step for event in events if event.HasField("summary")), default=-1)

    def log(self, rows: Sequence[Row]) -> None:
        made_by = importlib.import_module("tensorboardX.event_file_writer")
        event = importlib.import_module("tensorboardX.proto.event_pb2").Event
        summary = importlib.import_module("tensorboardX.proto.summary_pb2").Summary
        for row in rows:
            if self._writer is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                # A session that begins within a second of the last one must not replace its file.
                suffix = f".{self._run.run_id}.{row['generation']}"
                self._writer = made_by.EventsWriter(str(self._folder / "events"), suffix)
            values = [summary.Value(tag=name, simple_value=value) for name, value in metrics(row).items()]
            self._writer.write_event(
                event(
                    wall_time=self._begin + row["wall_clock_s"], step=row["generation"], summary=summary(value=values)
                )
            )
        if rows:
            self._writer.flush()

    def close(self, how: Ending = "finished") -> None:
        if self._writer is not None:
            self._writer.close()


def _records(data: bytes) -> Iterator[bytes]:
    """Records of an event file: length, checksum, content, checksum; a torn one at the end is left out."""
    at = 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        if at + length + 16 > len(data):
            return
        yield data[at + 12 : at + 12 + length]
        at += length + 16


class Wandb:
    """A run of Weights & Biases with the id of our run; its files are in `RUN/wandb`.

    Without a network (WANDB_MODE=offline), the files that `wandb sync` uploads say what they have. So does a note
    beside them, since `wandb sync --clean` deletes them; rows of a session that was killed may be on no disk, so it is
    written at the end.
    """

    def __init__(self, run: Run) -> None:
        wandb = importlib.import_module("wandb")
        shared = wandb.setup(wandb.Settings(silent=True)).settings
        if shared.mode == "online" and not wandb.login(prompt=False):
            raise PermissionError("there is no API key; set WANDB_API_KEY, or WANDB_MODE=offline")
        self._begin, self._newest = _begin(run), -1
        self._folder, self._id = run.folder / "wandb", run.run_id
        self._entry = wandb.init(
            project=shared.project or PROJECT,
            id=run.run_id,
            name=run.folder.absolute().name,
            dir=str(run.folder),
            config=run.constants,
            resume="allow",
            settings=wandb.Settings(console="off", silent=True, reinit="create_new"),
        )

    def newest(self) -> int:
        if not self._entry.offline:
            return self._entry.starting_step - 1
        record = importlib.import_module("wandb.proto.wandb_internal_pb2").Record
        files = self._folder.glob(f"offline-run-*/run-{self._id}.wandb")
        stored = (record.FromString(one) for file in files for one in _level_records(file.read_bytes()))
        steps = [one.history.step.num for one in stored if one.HasField("history")]
        noted = [int(self._note.read_text())] if self._note.exists() else []
        return max([*steps, *noted], default=-1)

    @property
    def _note(self) -> Path:
        return self._folder / f"{self._id}.newest"

    def log(self, rows: Sequence[Row]) -> None:
        for row in rows:
            ended_at = {"_timestamp": self._begin + row["wall_clock_s"]}
            self._entry.log(metrics(row) | ended_at, step=row["generation"], commit=True)
            self._newest = row["generation"]

    def close(self, how: Ending = "finished") -> None:
        self._entry.finish(exit_code=0 if how == "finished" else 1)
        if self._entry.offline and self._newest >= 0:
            self._note.write_text(str(self._newest))


def _level_records(data: bytes) -> Iterator[bytes]:
    """Records of a file of Weights & Biases, up to one that is torn or damaged. Behind seven bytes, it is of the form
    of a log of LevelDB."""
    at, record = 7, b""
    while at + 7 <= len(data):
        room = LEVEL_BLOCK - at % LEVEL_BLOCK
        if room < 7:  # the rest of a block is empty
            at += room
            continue
        crc32, length, kind = struct.unpack_from("<IHB", data, at)
        end = at + 7 + length
        if end > len(data) or zlib.crc32(data[at + 6 : end]) != crc32:
            return
        record += data[at + 7 : end]
        at = end
        if kind in (1, 4):  # a whole record, or the last part of one
            yield record
            record = b""


class MLflow:
    """A run of MLflow; since MLflow chooses the ids of its runs, ours is its tag `es_service.run`."""

    def __init__(self, run: Run) -> None:
        self._begin = _begin(run)
        self._entities = importlib.import_module("mlflow.entities")
        self._client = importlib.import_module("mlflow.tracking").MlflowClient()
        at = self._experiment(os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT))
        runs = self._client.search_runs([at], f"tags.`{RUN_TAG}` = '{run.run_id}'")
        if runs:
            self._id = runs[0].info.run_id
            self._client.update_run(self._id, status="RUNNING")
            return
        entry = self._client.create_run(at, run_name=run.folder.absolute().name, tags={RUN_TAG: run.run_id})
        self._id = entry.info.run_id
        settings = [self._entities.Param(_key(key), str(value)) for key, value in run.constants.items()]
        self._client.log_batch(self._id, params=settings)

    def _experiment(self, name: str) -> str:
        """The id of an experiment, which is made if there is none. Other runs of a sweep may make it, and the tables of
        a new database, at the same moment, on which MLflow raises errors of many kinds."""
        for attempt in range(1, MLFLOW_ATTEMPTS + 1):
            try:
                experiment = self._client.get_experiment_by_name(name)
                return self._client.create_experiment(name) if experiment is None else experiment.experiment_id
            except Exception:
                if attempt == MLFLOW_ATTEMPTS:
                    raise
                time.sleep(attempt * random.random())
        raise AssertionError

    def newest(self) -> int:
        return max((metric.step for metric in self._client.get_metric_history(self._id, "env_steps")), default=-1)

    def log(self, rows: Sequence[Row]) -> None:
        batch: list[Any] = []
        for row in rows:
            milliseconds = round(1000 * (self._begin + row["wall_clock_s"]))
            values = metrics(row)
            if len(batch) + len(values) > MLFLOW_BATCH:
                self._client.log_batch(self._id, metrics=batch)
                batch = []
            batch += [
                self._entities.Metric(_key(name), value, milliseconds, row["generation"])
                for name, value in values.items()
            ]
        if batch:
            self._client.log_batch(self._id, metrics=batch)

    def close(self, how: Ending = "finished") -> None:
        self._client.set_terminated(self._id, MLFLOW_STATUS[how])


def _key(name: str) -> str:
    """A name with only those letters that MLflow allows."""
    return re.sub(r"[^\w./ -]", "_", name, flags=re.ASCII)


PAUSE_S = 1.0
"""Seconds between two readings of the history, so that a fast run is read in larger pieces."""
FINISH_S = 30.0
"""Longest wait for all trackers at the end of a session."""
INTERRUPTED_S = 10.0
"""The same after an interruption."""
AGAIN_S = 60.0
"""Seconds after which a tracker that failed is opened again."""
TELL_S = 1.0
"""Wait for a tracker after which it is told."""
MOST_LETTERS = 300
"""Letters of a tracker's error that are shown."""
FAILING = "the tracker"
"""The first words of what is said of a tracker that failed."""
_LATER = "the run does not need it, and the next session that uses it sends what it lacks"

Open = Callable[[str, Run], Tracker]


@contextmanager
def tracked(
    folder: str | os.PathLike[str], names: Sequence[str], on_notice: OnNotice, opened: Open = open_tracker
) -> Iterator[Callable[[Row], None]]:
    """Context manager around a session of a run, which sends its history to trackers.

    A tracker that fails, or is too slow at the end, costs a notice and never the run.

    Args:
        folder: folder of the run, which need not exist yet.
        names: keys of `trackers.PACKAGES`.
        on_notice: called with a notice, from another thread.
        opened: opens a tracker by its name.

    Yields:
        what is to be called after each committed generation.

    Raises:
        ConfigError: a tracker is unknown, or its package is not installed.
    """
    check_trackers(names)
    end = _End(threading.Event())

    def thread(name: str) -> threading.Thread:
        work = (folder, name, opened, end, on_notice)
        return threading.Thread(target=_follow, args=work, name=f"tracker {name}", daemon=True)

    threads = {name: thread(name) for name in names}

    def begin(_: Row | None = None) -> None:
        for tracker_thread in threads.values():
            if tracker_thread.ident is None:
                tracker_thread.start()

    try:
        yield begin
        begin()  # a session without a generation: a tracker may lack rows of earlier ones
    except BaseException as error:
        end.how = "interrupted" if isinstance(error, Interrupted | KeyboardInterrupt) else "failed"
        raise
    finally:
        end.has_come.set()
        # Of a session in which no generation was run, none has begun: the folder may hold another run.
        begun = {name: one for name, one in threads.items() if one.ident is not None}
        _wait(begun, INTERRUPTED_S if end.how == "interrupted" else FINISH_S, on_notice)


@dataclass
class _End:
    """Whether and how a session has ended."""

    has_come: threading.Event
    how: Ending = "finished"


def _wait(threads: Mapping[str, threading.Thread], longest_s: float, on_notice: OnNotice) -> None:
    """Wait for the threads of trackers, together at most for some time."""
    until = time.monotonic() + longest_s
    for name, thread in threads.items():
        thread.join(min(TELL_S, max(0.0, until - time.monotonic())))
        if thread.is_alive() and (left_s := until - time.monotonic()) > 0.0:
            on_notice(f"waiting for the tracker {name}, at most {left_s:.0f} s; Ctrl-C ends the wait")
            thread.join(left_s)
        if thread.is_alive():
            on_notice(f"{FAILING} {name} did not finish within {longest_s:g} s; {_LATER}")


def _follow(folder: str | os.PathLike[str], name: str, opened: Open, end: _End, on_notice: OnNotice) -> None:
    """The work of a tracker's thread. A tracker that fails is opened again after `AGAIN_S`, and at the end of the
    session if it has worked before: it may have been out of reach for a while of a long run."""
    has_worked = is_failing = False
    while True:
        tracker = None
        try:
            run = open_run(folder)
            tracker = opened(name, run)
            newest = tracker.newest()
            has_worked, last = True, False
            while not last:
                last = end.has_come.wait(PAUSE_S)  # first, so that the metrics of the first generation are recorded
                newest = fill(tracker, run, newest, has_ended=last)
                if is_failing:
                    on_notice(f"{FAILING} {name} works again and has what it lacked")
                is_failing = False
            tracker.close(end.how)
            return
        except Exception as error:  # whatever a tracker raises must not end the run
            if not is_failing:
                on_notice(_failed(name, error))
            is_failing = True
        if end.has_come.is_set():
            return
        with suppress(Exception):
            if tracker is not None:
                tracker.close("failed")
        if end.has_come.wait(AGAIN_S) and not has_worked:
            return


def _failed(name: str, error: Exception) -> str:
    reason = str(error).partition("\n")[0]
    reason = reason if len(reason) <= MOST_LETTERS else f"{reason[:MOST_LETTERS]} ..."
    return (
        f"{FAILING} {name} failed ({type(error).__name__}: {reason}). It is tried again every {AGAIN_S:g} s; {_LATER}"
    )
