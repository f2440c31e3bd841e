"""A worker as an actor: a plain class that the Ray engine turns into one. It adds nothing to `worker.py` but transport.

The process is this actor's alone, and JAX is imported only after its environment is set. Messages are pickled `bytes`.
"""

from __future__ import annotations

import os
import pickle
import socket
from collections.abc import Callable, Sequence
from functools import partial

from es_service.protocol.machine import platform_info, platform_text
from es_service.protocol.messages import Centre, Chunk, ChunkResult, WorkerPlace
from es_service.protocol.process_environment import worker_environment


class WorkerActor:
    """One worker of a run. Calls come one at a time, in the order they were made."""

    def __init__(self, spec: bytes, index: int, gpus: float = 0.0) -> None:
        """Do nothing yet.

        Args:
            spec: the pickled WorkerSpec.
            index: number of this worker within its run.
            gpus: share of a GPU that Ray has given this actor; 0 for the CPU.
        """
        self._spec, self._index, self._gpus = spec, index, gpus
        self._run_chunks: Callable[[Centre, Sequence[Chunk]], list[ChunkResult]] | None = None

    def __repr__(self) -> str:
        return f"worker-{self._index}@{socket.gethostname()}"

    def place(self) -> WorkerPlace:
        """Where this worker was put. The first call, answered as soon as there is a place."""
        import ray

        return WorkerPlace(socket.gethostname(), os.getpid(), ray.get_runtime_context().get_node_id())

    def build(self) -> str:
        """Import JAX with the settings every worker has, and build the run's functions; the platform's text."""
        environment = worker_environment(os.environ, self._gpus)
        for name in set(os.environ) - set(environment):
            del os.environ[name]
        os.environ.update(environment)
        from workers.worker import make_worker, run_chunks

        self._run_chunks = partial(run_chunks, make_worker(pickle.loads(self._spec)))
        if not self._gpus:
            return platform_text(platform_info())
        import jax

        return platform_text(platform_info() | {"device": jax.devices()[0].device_kind})

    def run(self, centre: bytes, chunks: bytes) -> bytes:
        """The pickled results of chunks around a centre."""
        assert self._run_chunks is not None, "the engine calls build first"
        return pickle.dumps(self._run_chunks(pickle.loads(centre), pickle.loads(chunks)), pickle.HIGHEST_PROTOCOL)
