"""The rollout `asked`: the program that asks a search computes the episodes by itself, and the service none."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from es_service.protocol.messages import TaskSpec, WorkerSpec
from es_service.protocol.options import OptionValue
from es_service.protocol.recordings import Recordings, RecordRequest
from workers.environments import TaskError
from workers.rollouts.backend import ChunkFunctions, RolloutBackend


class AskedRollout(RolloutBackend):
    """Chunks have all pairs, since nothing is distributed."""

    name = "asked"
    task_kinds = ("caller",)
    compile_s = (0, 0)
    chunk_pairs = (1, 2**20)

    def chunk_functions(self, spec: WorkerSpec) -> ChunkFunctions:
        _refuse()

    def record(self, spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
        _refuse()

    def random_steps(
        self, task: TaskSpec, options: Mapping[str, OptionValue], batch: int, steps: int
    ) -> Callable[[int], int]:
        _refuse()


def _refuse() -> NoReturn:
    raise TaskError("the episodes of this task are the caller's, so the service cannot compute any")
