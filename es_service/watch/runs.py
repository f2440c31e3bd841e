"""The runs below some folders, read again and again: which there are, and what is new in one of them.

A run is named by a key, which is looked up among the runs that were found, so that no request can name a file. Links
are followed for the folders that were given, and for nothing below them: neither a folder nor a file of a run may be a
link that leads out of them.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from es_service.errors import ServiceError, StoreError
from es_service.report.data import RunData, followed, run_data
from es_service.runs.certified import Certified, certified_elsewhere, measure_of, newest_certified
from es_service.runs.run_status import RunStatus, read_status
from es_service.runs.selection import RankedBy
from es_service.runs.view import open_run
from es_service.store.folder import CONFIG, COPY, DATABASE, LOCK, holds_run, leads_out
from es_service.store.lock import lock_holder

MOST_ROWS = 20_000
"""Generations that are read at once: half a second of a core, so that a long run has its first picture soon and its
log can be emptied meanwhile."""
AGAIN_S = 30.0
"""A run is read again after so many seconds, even if its files look the same: a network file system may be late."""
DEEPEST = 8
"""Levels of folders below a given one in which runs are found."""
FILES = (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm", f"{DATABASE}-journal", COPY, CONFIG, LOCK)


class FoundRun(NamedTuple):
    """A run below a given folder."""

    key: str
    name: str
    """Its folder as users name it: the given folder, with its whole path if another one has the same name, and the way
    from there."""
    folder: Path
    root: Path


class RunSummary(NamedTuple):
    """What a list shows of a run."""

    found: FoundRun
    status: RunStatus | None
    certified: Certified | None
    elsewhere: Mapping[str, Certified]
    """Title of another task -> the certified policy in it."""
    problem: str
    """Why it cannot be read; empty if it can."""

    @property
    def measure(self) -> RankedBy:
        """What `task.fitness` says of an episode of a run that can be read."""
        assert self.status is not None
        return measure_of(self.status.run.constants["task.fitness"])

    @property
    def certified_fitness(self) -> float | None:
        """Mean fitness of the certified policy in its certification episodes; None if there is none."""
        if self.certified is None or self.status is None:
            return None
        return self.certified.episodes.mean_fitness(self.status.run.constants["task.fitness"])


class Runs:
    def __init__(self, roots: Sequence[Path]) -> None:
        self._roots = [root.absolute() for root in roots]
        names = [root.name for root in dict.fromkeys(self._roots)]
        self._titles = {root: root.name if names.count(root.name) == 1 else str(root) for root in self._roots}
        self._known: dict[str, FoundRun] = {}
        self._summaries: dict[str, tuple[Any, RunSummary]] = {}

    def find(self) -> list[FoundRun]:
        """The runs that there are now, in the order of their names."""
        runs = {run.key: run for root in self._roots for run in _below(root, self._titles[root])}
        self._known |= runs
        before = self._summaries  # to which another thread may add meanwhile
        self._summaries = {key: before[key] for key in runs if key in before}
        return list(runs.values())

    def get(self, key: str) -> FoundRun | None:
        """A run that is there, or was there before; None if there is none of this key."""
        return self._known.get(key) or {run.key: run for run in self.find()}.get(key)

    def summaries(self) -> list[RunSummary]:
        """All runs; those whose files have not changed are not read again."""
        return [self._summary(run) for run in self.find()]

    def _summary(self, run: FoundRun) -> RunSummary:
        seen = seen_of(run.folder)
        before = self._summaries.get(run.key)
        if before is None or before[0] != seen:
            self._summaries[run.key] = before = seen, _summary(run)
        return before[1]

    def moved(self, run_id: str, but: FoundRun) -> FoundRun | None:
        """A run of this id in another folder."""
        for summary in self.summaries():
            if summary.found.key != but.key and summary.status is not None and summary.status.run.run_id == run_id:
                return summary.found
        return None


class RunReading:
    """A run that is read again and again; each time, only what is new. Threads that do so at once wait for another."""

    def __init__(self, found: FoundRun) -> None:
        self._found, self._followed = found, followed(found.folder)
        self._seen: Any = None
        self._lock = threading.Lock()
        self.data: RunData | None = None
        """The run as it was read last; None before that."""
        self.whole = False
        """Whether all of its generations are read."""

    def update(self) -> bool:
        """Read what is new; return whether there was something. Raises StoreError if the run cannot be read."""
        with self._lock:
            return self._update()

    def _update(self) -> bool:
        seen = seen_of(self._found.folder), time.monotonic() // AGAIN_S
        if self.whole and seen == self._seen:
            return False
        require_inside(self._found)
        driver = lock_holder(self._found.folder)  # read before the history, so that the last row is not missed
        self.whole, self._seen = False, None
        sound, self.whole = self._followed.read(MOST_ROWS)
        self.data, self._seen = run_data(self._found.folder, sound, driver), seen
        return True


def seen_of(folder: Path) -> Mapping[str, Any]:
    """What shows without opening a run whether it has changed: its files, and who writes."""
    files: dict[str, Any] = {}
    for name in (DATABASE, f"{DATABASE}-wal", COPY, CONFIG):
        try:
            stat = os.stat(folder / name)
        except OSError:
            continue
        files[name] = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
    return files | {LOCK: lock_holder(folder)}


def require_inside(run: FoundRun) -> None:
    """Raise StoreError if the folder of a run, or one of its files, is a link out of the folder that was given."""
    for name in ("", *FILES):
        if leads_out(run.folder / name, run.root):
            what = f"{run.folder / name} is a link that leads out of {run.root}; it is not followed"
            raise StoreError(what, run=run.folder)


def _summary(run: FoundRun) -> RunSummary:
    try:
        require_inside(run)
        status = read_status(open_run(run.folder))
        certified, elsewhere = newest_certified(run.folder), certified_elsewhere(run.folder)
    except ServiceError as error:
        return RunSummary(run, None, None, {}, " ".join(error.sentence.split()))
    return RunSummary(run, status, certified, elsewhere, "")


def _below(root: Path, title: str) -> Iterator[FoundRun]:
    for folder in _run_folders(root, DEEPEST):
        key = hashlib.sha256(os.fsencode(folder)).hexdigest()[:16]
        name = title if folder == root else str(Path(title) / folder.relative_to(root))
        # A name may be no UTF-8; then it is shown with question marks.
        yield FoundRun(key, os.fsencode(name).decode(errors="replace"), folder, root)


def _run_folders(folder: Path, deeper: int) -> Iterator[Path]:
    """Run folders in and below a folder, in the order of their names; hidden ones are runs in creation, or not runs."""
    try:
        if holds_run(folder):
            yield folder
            return
        inside = [
            entry.name for entry in os.scandir(folder) if entry.is_dir(follow_symlinks=False) and entry.name[:1] != "."
        ]
    except (OSError, ServiceError):
        return  # it was deleted meanwhile, or is not ours to read
    if deeper:
        for name in sorted(inside):
            yield from _run_folders(folder / name, deeper - 1)
