"""Environment variables of the processes in which workers live, so that nothing set elsewhere changes their bits.

The driver starts such processes, a Ray actor finds itself in one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

GPU_MEMORY_FRACTION = 0.9
"""Of a whole GPU; workers that share one divide this among them."""
GPU_SETTINGS = {
    "JAX_PLATFORMS": "cuda",
    "JAX_DEFAULT_MATMUL_PRECISION": "highest",
    "XLA_FLAGS": "--xla_gpu_deterministic_ops=true --xla_gpu_autotune_level=0",
}
"""So that a GPU repeats its own bits; they are not those of a CPU."""


def worker_environment(environment: Mapping[str, str], gpus: float = 0.0) -> dict[str, str]:
    """Environment variables for a worker process, made from those of whoever starts it.

    One thread, one kind of device, and none of the other settings of JAX and XLA, so that nothing set elsewhere can
    change the bits of a rollout. In force only where JAX has not been imported yet.

    Args:
        gpus: the worker's share of a GPU, which CUDA_VISIBLE_DEVICES names already; with 0 no GPU is touched.
    """
    kept = {name: value for name, value in environment.items() if not name.startswith(("JAX_", "XLA_", "PJRT_"))}
    threads = dict.fromkeys(("PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    if not gpus:
        return kept | threads | {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    return kept | threads | GPU_SETTINGS | {"XLA_CLIENT_MEM_FRACTION": f"{GPU_MEMORY_FRACTION * min(gpus, 1.0):g}"}


def child_environment() -> dict[str, str]:
    """Environment variables for a process like a worker's, without a GPU, that imports what this one can import.

    And nothing else: a current folder with a `workers.py` of its own must not take the place of ours.
    """
    path = os.pathsep.join(path or os.getcwd() for path in sys.path)
    return worker_environment(os.environ) | {"PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
