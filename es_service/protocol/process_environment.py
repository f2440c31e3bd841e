"""Environment variables of worker processes, which keep settings made elsewhere from changing the bits of results.

The driver sets them for the processes that it starts; a Ray actor sets them in its own process.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

from es_service.protocol.errors import TaskError

GPU_MEMORY_FRACTION = 0.9
"""Fraction of a GPU's memory that workers may use; workers that share a GPU divide it among them."""
GPU_SETTINGS = {
    "JAX_PLATFORMS": "cuda",
    "JAX_DEFAULT_MATMUL_PRECISION": "highest",
    "XLA_FLAGS": "--xla_gpu_deterministic_ops=true --xla_gpu_autotune_level=0",
}
"""Settings with which a GPU repeats its own bits, which differ from those of a CPU."""
DEPTH = "ES_SERVICE_DEPTH"
"""Variable of a process that runs code of a task: how many processes above it, and itself, do so."""
MOST_DEPTH = 3
"""In a process of this depth, no other run may start: code that starts a run of itself would never end doing so."""


def worker_environment(environment: Mapping[str, str], gpus: float = 0.0) -> dict[str, str]:
    """Environment variables of a worker process, made from those of the process that starts it.

    They allow one thread and one kind of device, and contain no other settings of JAX and XLA, so that settings made
    elsewhere cannot change the bits of a rollout. They have an effect only if JAX has not been imported yet.

    Args:
        environment: variables of the process that starts the worker.
        gpus: the worker's share of a GPU, which CUDA_VISIBLE_DEVICES must already name; with 0 no GPU is used.
    """
    kept = {name: value for name, value in environment.items() if not name.startswith(("JAX_", "XLA_", "PJRT_"))}
    threads = dict.fromkeys(("PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    if not gpus:
        return kept | threads | {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    return kept | threads | GPU_SETTINGS | {"XLA_CLIENT_MEM_FRACTION": f"{GPU_MEMORY_FRACTION * min(gpus, 1.0):g}"}


def on_gpu() -> bool:
    """Whether this process is a worker that has been given a GPU."""
    return os.environ.get("JAX_PLATFORMS") == GPU_SETTINGS["JAX_PLATFORMS"]


def same_imports() -> dict[str, str]:
    """Environment variables with which a child process imports from the same places as this process.

    PYTHONSAFEPATH excludes the current folder, where a user's `workers.py` would hide the package of that name.
    """
    return {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path), "PYTHONSAFEPATH": "1"}


def child_environment(gpus: float = 0.0, place: str = "") -> dict[str, str]:
    """Environment variables of a worker process, which imports from the same places as this process.

    Args:
        gpus: as for `worker_environment`.
        place: what CUDA_VISIBLE_DEVICES must be, with GPUs.
    """
    worker = worker_environment({**os.environ, "CUDA_VISIBLE_DEVICES": place}, gpus)
    return worker | same_imports() | {DEPTH: str(_depth() + 1)}


def _depth() -> int:
    return int(os.environ.get(DEPTH, "0"))


def require_no_import_of_a_task() -> None:
    """Raise TaskError in a process that describes a task or computes its episodes, if this is called by a module that
    is being imported: each such process would import the module, too, and start further ones without end.

    A function that is called later may have runs of its own, down to MOST_DEPTH.
    """
    if not _depth():
        return
    frame = sys._getframe(1)
    while frame is not None:
        name, spec = map(frame.f_globals.get, ("__name__", "__spec__"))
        if frame.f_code.co_name == "<module>" and name != "__main__" and spec is not None:
            raise TaskError(
                f"a run cannot start while {name} is imported, since the processes that run the code of a task import "
                f'it, too; put the call below `if __name__ == "__main__":` in {name}'
            )
        frame = frame.f_back
    if _depth() >= MOST_DEPTH:
        raise TaskError(
            f"the code of a task starts a run, and so does the code of that run's task, {MOST_DEPTH} deep; put calls "
            'that start a run below `if __name__ == "__main__":`'
        )
