"""A worker as an actor: a plain class that the Ray engine turns into one. It adds nothing to `worker.py` but transport.

Ray is not imported here. The process is this actor's alone, and JAX is imported only after its environment is set.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable

from es_service.protocol import Centre, Chunk, ChunkResult, WorkerSpec, worker_environment


class WorkerActor:
    """One worker of a run. Calls come one at a time, in the order they were made."""

    def __init__(self, spec: WorkerSpec, index: int) -> None:
        self._spec, self._index = spec, index
        self._run_chunk: Callable[[Centre, Chunk], ChunkResult] | None = None

    def __repr__(self) -> str:
        return f"worker-{self._index}@{socket.gethostname()}"

    def place(self) -> str:
        """Where this worker was put: host and process id. The first call, answered as soon as there is a place."""
        return f"{self!r} (pid {os.getpid()})"

    def build(self) -> None:
        """Import JAX with the settings every worker has, and build the run's functions."""
        environment = worker_environment(os.environ)
        for name in set(os.environ) - set(environment):
            del os.environ[name]
        os.environ.update(environment)
        from workers.worker import make_worker

        self._run_chunk = make_worker(self._spec)

    def run(self, centre: Centre, chunk: Chunk) -> ChunkResult:
        """The result of a chunk around a centre."""
        assert self._run_chunk is not None, "the engine calls build first"
        return self._run_chunk(centre, chunk)
