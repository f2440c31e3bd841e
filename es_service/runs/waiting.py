"""The run's store for the loop, in which finished generations wait while another program holds the database.

A viewer of SQLite databases may hold a run for as long as somebody looks at it: with a write transaction on a local
disk, by reading alone where `run.db` has a rollback journal. That must not end a run of days. Generations are stored in
their order, those that were given together in one transaction, so a process that is killed loses the newest of them,
which the next session computes again with the same bits.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TypeVar

from es_service.errors import ConfigError, DatabaseHeldError, Interrupted, StoreError, WayOut
from es_service.loop.state import Generation
from es_service.protocol.content import Arrays
from es_service.runs.checked_config import Recorder
from es_service.store.folder import DATABASE
from es_service.store.writer import RunStore

MOST_BYTES = 256 * 2**20
"""The run pauses when its waiting generations have more bytes than this."""
PATIENCE_S = 1.0
"""Seconds for which a commit waits before its generation waits in memory, and after which a run that has paused looks
again for a request to stop."""
AGAIN_S = 0.5
"""Least seconds between two attempts to store what waits in memory."""

Value = TypeVar("Value")


def when_free(act: Callable[[], Value], held: Callable[[], object]) -> Value:
    """What `act` returns when no other program holds the database; `held` is called before each further attempt."""
    while True:
        try:
            return act()
        except DatabaseHeldError:
            held()


def telling_once(folder: Path, tell: Callable[[str], None]) -> Callable[[], None]:
    """Function for `when_free` that gives a notice at its first call."""
    told: list[str] = []

    def held() -> None:
        if not told:
            told.append(f"another program holds {folder / DATABASE}; close it. This pauses until then")
            tell(told[0])

    return held


class PatientStore:
    """Commits generations as soon as the database can be written; `patient_store` makes one."""

    def __init__(
        self,
        store: RunStore,
        recorder: Recorder,
        should_stop: Callable[[], int | None],
        tell: Callable[[str], None],
        on_commit: Callable[[int], object],
        told: Callable[[], Mapping[str, float]],
    ) -> None:
        """Hold nothing yet. `on_commit` is called with each generation that has been committed; `tell` with notices;
        `told` returns the metrics that the transaction of a generation has with it."""
        self._store, self._recorder = store, recorder
        self._should_stop, self._tell, self._on_commit = should_stop, tell, on_commit
        self._metrics_told = told
        self._waiting: deque[tuple[int, frozenset[str], Sequence[Generation]]] = deque()
        self._metrics: dict[int, Mapping[str, float]] = {}
        self._bytes, self._again_s, self._is_held = 0, 0.0, False
        self.has_failed = False
        """Whether a commit has failed for another reason than that the database is held."""
        self._told: set[str] = set()

    def content(self, name: bytes) -> Arrays:
        """A content that a generation names that was given.

        Raises:
            Interrupted: a stop was requested while it could not be read. Otherwise as `RunStore.content`.
        """
        for _, _, generations in self._waiting:
            for one in generations:
                if name in one.contents:
                    return one.contents[name]
        return when_free(partial(self._store.content, name), self._pause)

    def commit(self, generations: Sequence[Generation]) -> None:
        """Store generations, or let them wait in memory while another program holds the database.

        Raises:
            Interrupted: so many generations wait that the run has paused, and a stop was requested. Otherwise as
                `Recorder.commit`.
        """
        given = [part for one in generations for part in (*one.parts.values(), *one.contents.values(), one.evaluations)]
        size = sum(array.nbytes for part in given if part is not None for array in part.values())
        is_first = not self._waiting
        *others, last = generations
        taken = [*others, last._replace(recorded=self._metrics_told())]
        self._waiting.append((size, self._recorder.workers(), taken))
        self._bytes += size
        if is_first or time.monotonic() >= self._again_s:
            self.store_waiting(PATIENCE_S if is_first else 0.0)
        while self._bytes > MOST_BYTES and not self.store_waiting(PATIENCE_S):
            self._pause()

    def record(self, generation: int, metrics: Mapping[str, float]) -> None:
        """Store metrics of a generation that was given, or let them wait with it."""
        self._metrics[generation] = metrics
        if not self._waiting:
            self.store_waiting(PATIENCE_S)

    def store_waiting(self, patience_s: float) -> bool:
        """Store what waits, the oldest first; return whether nothing waits any longer."""
        try:
            with self._store.patience(patience_s):
                while self._waiting:
                    size, workers, generations = self._waiting[0]
                    self._recorder.commit(workers, generations)
                    self._waiting.popleft()
                    self._bytes -= size
                    for one in generations:
                        self._on_commit(one.number)
                        if one.number in self._metrics:
                            self._record(one.number)
                for at in list(self._metrics):
                    self._record(at)
        except DatabaseHeldError:
            self._hold()
            return False
        except (StoreError, ConfigError):
            self.has_failed = True
            raise
        if self._is_held:
            self._is_held = False
            self._store.lock.say()
            self._say(f"{self._file} can be written again, and everything that waited is stored")
        return True

    def _record(self, generation: int) -> None:
        self._store.record_metrics(generation, self._metrics[generation])
        del self._metrics[generation]

    def finish(self) -> None:
        """Return when nothing waits. Raises Interrupted if a stop was requested before that."""
        while not self.store_waiting(PATIENCE_S):
            self._pause()

    def lost(self) -> DatabaseHeldError:
        """The error of a session that ends while generations wait."""
        generations = [one.number for *_, given in self._waiting for one in given] or list(self._metrics)
        which = f"generation {generations[0]}" if len(generations) == 1 else f"{len(generations)} generations"
        again = "What is lost is computed again with the same results when the run continues"
        if not self._waiting:
            which, again = f"metrics of {which}", "They are not recorded again"
        return DatabaseHeldError(
            f"another program holds {self._file}, so {which} could not be stored before the end; close that program. "
            f"{again}",
            run=self._store.folder,
            ways_out=[WayOut("resume", "continue after the program is closed", str(self._store.folder))],
        )

    @property
    def _file(self) -> str:
        return str(self._store.folder / DATABASE)

    def _pause(self) -> None:
        """Pause until the next attempt to use the database. Raises Interrupted if a stop was requested."""
        self._hold()
        self._say(f"the run pauses until no other program holds {self._file}")
        if (number := self._should_stop()) is not None:
            raise Interrupted(number)

    def _hold(self) -> None:
        """Say that the database is held, to the user once and to readers of the run's status each time."""
        self._is_held, self._again_s = True, time.monotonic() + AGAIN_S
        count = sum(len(generations) for *_, generations in self._waiting)
        self._store.lock.say(doing=f"another program holds {DATABASE}; finished generations that wait: {count:,}")
        self._say(
            f"another program holds {self._file}, which cannot be written. Finished generations wait in memory, at "
            f"most {MOST_BYTES // 2**20} MB of them; then the run pauses. Close that program: what waits is lost if "
            "this process is killed, and computed again when the run continues"
        )

    def _say(self, notice: str) -> None:
        """Give a notice, once in a session."""
        if notice not in self._told:
            self._told.add(notice)
            self._tell(notice)


@contextmanager
def patient_store(
    store: RunStore,
    recorder: Recorder,
    should_stop: Callable[[], int | None],
    tell: Callable[[str], None],
    on_commit: Callable[[int], object],
    told: Callable[[], Mapping[str, float]] = dict,
) -> Iterator[PatientStore]:
    """Context manager with the store for a session, after which everything is stored, however long that takes.

    Raises:
        DatabaseHeldError: the session was interrupted, and another program still holds the database. If another error
            ends the session, that is raised, and a notice says what could not be stored.
    """
    patient = PatientStore(store, recorder, should_stop, tell, on_commit, told)
    try:
        yield patient
        patient.finish()
    except BaseException as error:
        if patient.has_failed or patient.store_waiting(PATIENCE_S):
            raise  # what could not be committed would fail again
        if isinstance(error, Interrupted | KeyboardInterrupt):
            raise patient.lost() from error
        tell(patient.lost().sentence)
        raise
