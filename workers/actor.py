"""A worker as a plain class, which the Ray engine turns into an actor; it adds only transport to `worker.py`.

The actor has a process of its own and imports JAX only after setting its environment. Messages are pickled `bytes`.
"""

from __future__ import annotations

import os
import pickle
import re
import socket
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

from es_service.protocol.episodes import apart, in_blocks
from es_service.protocol.machine import cpu_seconds, platform_info, platform_text
from es_service.protocol.messages import Report, Work, WorkerPlace
from es_service.protocol.process_environment import DEPTH, newest_output, worker_environment
from es_service.protocol.sent import LackingError, Received
from es_service.protocol.sources import OtherCodeError, why_refused
from es_service.protocol.user_code import sendable
from workers import progress
from workers.compiling import xla_cache_settings

if TYPE_CHECKING:  # they import JAX, whose settings are made here
    from workers.cores import Cores
    from workers.reports import Reports
    from workers.worker import Made

KEPT_LOGS = 16
"""Ended workers of a job whose output stays on a node."""


class WorkerActor:
    """One worker of a run, and of others after it if it stays. Its methods are called in the order of the requests, one
    at a time or two side by side: then cores that have nothing left to do of one work item begin the next one."""

    def __init__(self, spec: bytes, index: int, gpus: float = 0.0, cores: int = 1) -> None:
        """Keep the arguments; `build` makes the worker.

        Args:
            spec: the pickled WorkerSpec.
            index: number of this worker within its run.
            gpus: share of a GPU that Ray has assigned to this actor; 0 for the CPU.
            cores: number of cores that it may use at a time.
        """
        self._spec, self._index, self._gpus, self._cores = spec, index, gpus, cores
        self._joins = cores > 1  # with one core, an item has few chunks
        self._task_code: tuple[str, ...] = ()
        self._of_all: Cores | None = None
        self._made: Made | None = None
        self._received: Received | None = None
        self._reports: Reports | None = None
        self._watched: list[int] = []
        """Numbers of the files of its output, see `NewestOutput`."""
        self._before_s = 0.0
        """Seconds of processors that it has used for earlier runs."""
        self._turn = Lock()
        """Held while it compiles, and while it takes the arrays that came with a call."""

    def __repr__(self) -> str:
        return f"worker-{self._index}@{socket.gethostname()}"

    def place(self) -> WorkerPlace:
        """Host, process and node of this worker. The engine calls this first; it returns once the actor is placed."""
        import ray

        logs = [os.readlink(file) for file in ("/proc/self/fd/1", "/proc/self/fd/2") if os.path.exists(file)]
        return WorkerPlace(socket.gethostname(), os.getpid(), ray.get_runtime_context().get_node_id(), tuple(logs))

    def progress(self) -> tuple[progress.Seen, Report | None]:
        """How far it is with the oldest of its calls, and its report; answered while they run, so that the engine can
        ask it."""
        return progress.seen(), self._reports and self._reports.report()

    def build(self, given: bytes | None = None) -> str:
        """Import JAX with the settings of all workers and build the run's functions; returns the platform's text.

        What it tells of its output and of its processors' time begins anew.

        Args:
            given: the pickled WorkerSpec of another run, which takes over an actor that has nothing left to do.

        Raises:
            OtherCodeError: this host must not work for the run: it has other code than the driver, or another platform
                than the run's.
        """
        spec, earlier = pickle.loads(given or self._spec), self._of_all
        if earlier is None:
            for descriptor in (1, 2):  # Ray has a file for each of the two
                with suppress(OSError):  # a Ray that takes the output through a pipe has limits of its own
                    self._watched.append(newest_output().add(descriptor, spec.output_bytes // 2))
            with suppress(OSError):
                remove_old_logs(Path(os.readlink("/proc/self/fd/1")))
        else:
            self._before_s = self._seconds_so_far()
            for file in self._watched:
                os.ftruncate(file, 0)
        if problem := why_refused(spec.sources, spec.task_code, spec.platform):
            raise OtherCodeError(problem)
        environment = worker_environment(os.environ, self._gpus)
        for name in set(os.environ) - set(environment):
            del os.environ[name]
        os.environ.update({DEPTH: "1"} | environment | xla_cache_settings())
        from workers.cores import Cores
        from workers.reports import reports_of, require_room
        from workers.rollouts import BACKENDS, platform_of_gpu

        self._task_code = spec.task_code
        self._received = Received(spec.parent_cache_bytes, BACKENDS[spec.rollout].made)
        with sendable(*self._task_code):
            self._reports = reports_of(spec, self._cores, before=self._reports)
            self._of_all = earlier or Cores(self._cores)
            self._made = self._of_all.made(spec)
            if earlier is None:
                require_room(spec, self._cores)
        return platform_of_gpu(spec.rollout) or platform_text(platform_info())

    def compile(self, item: bytes, *arrays: bytes) -> float:
        """Compile for chunks without running them; returns the seconds that it took. The arguments are those of `run`.

        The engine calls this before the first call of `run` for each kind of chunk.
        """
        assert self._made is not None, "compile was called before build"
        with self._turn, sendable(*self._task_code):
            return self._made.seconds_to_compile(self._unpacked(item, arrays))

    def run(self, item: bytes, *arrays: bytes) -> bytes:
        """Run chunks; returns the pickled (results, its report or None, seconds of processors that its process and
        those of its cores have used for this run so far), or None if it lacks arrays. With several cores, the results
        are joined by `in_blocks`.

        Args:
            item: pickled (arrays by name, origins, work) of a `Parcel`.
            arrays: large arrays by name, each pickled.
        """
        assert self._made is not None, "run was called before build"
        assert self._reports is not None, "build makes them, too"
        with sendable(*self._task_code):
            try:
                with self._turn:
                    work = self._unpacked(item, arrays)
            except LackingError:
                return pickle.dumps(None)
            self._reports.note(results := self._made.run_chunks(work))
            seconds = self._seconds_so_far() - self._before_s
            if self._joins:
                results = in_blocks(results)
            return pickle.dumps((results, self._reports.report(), seconds), pickle.HIGHEST_PROTOCOL)

    def _seconds_so_far(self) -> float:
        """Seconds of processors that this process has used, and those of its cores."""
        return cpu_seconds(()) if self._of_all is None else self._of_all.cpu_s

    def _unpacked(self, item: bytes, arrays: tuple[bytes, ...]) -> list[Work]:
        """The chunks of a call with their subjects. Raises LackingError."""
        assert self._received is not None, "build makes it, too"
        small, origins, work = pickle.loads(item)
        for named in (small, *map(pickle.loads, arrays)):
            self._received.add(named)
        received = self._received.work(origins, work)
        return apart(received) if self._joins else received


def remove_old_logs(own: Path) -> None:
    """Remove what ended workers of the same job have printed on this node, but for the last KEPT_LOGS of them.

    Ray never does, and a run whose workers are replaced may go on for weeks.

    Args:
        own: where this worker prints: a file named by Ray `worker-WORKER-JOB-PROCESS.out`, else nothing is removed.
    """
    named = re.fullmatch(r"worker-\w+-(\w+)-\d+\.out", own.name)
    if named is None:
        return
    logs = [
        log
        for log in own.parent.glob(f"worker-*-{named[1]}-*.out")
        if not Path("/proc", log.stem.rpartition("-")[2]).exists()
    ]
    for log in sorted(logs, key=lambda log: log.stat().st_mtime)[:-KEPT_LOGS]:
        _, worker, _, process = log.stem.split("-")
        of_ray = log.with_name(f"python-core-worker-{worker}_{process}.log")
        for file in (log, log.with_suffix(".err"), of_ray):
            file.unlink(missing_ok=True)
