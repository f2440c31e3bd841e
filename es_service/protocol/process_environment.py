"""Environment variables of worker processes, and the files of what they print.

The driver sets them for the processes that it starts; a Ray actor sets them in its own process.
"""

from __future__ import annotations

import fcntl
import os
import stat
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import cache

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


# What processes print, in files of which only the newest part is kept.
#
# A simulator may print in each of its steps, for days, also from code that is not Python and from processes of its own.
# All of them append to one file, and nobody waits for a reader, as at a pipe. A thread elsewhere looks at the file's
# size, and cuts off its beginning. Its end is there after a SIGKILL, too.

LOOK_S = 0.02
"""Longest time in seconds between two looks at the files; less while one of them grows fast."""
SHORTEST_S = 0.001


class NewestOutput:
    """Files that are cut to half a size before they exceed it, by a thread that lives as long as there is one.

    A line that is written while a file is cut may be lost, or come before older ones.
    """

    def __init__(self) -> None:
        """Watch no file yet."""
        self._files: dict[int, tuple[int, int]] = {}
        """Descriptors of our own -> (most bytes, bytes at the last look)."""
        self._turn, self._thread, self._end = threading.Lock(), threading.Thread(), threading.Event()

    def add(self, descriptor: int, most_bytes: int) -> int:
        """Watch the file to which a descriptor leads; whoever has inherited this descriptor appends from now on.

        Returns the number for `forget`. Raises OSError if it leads to nothing that can be read and cut, such as a pipe.
        """
        flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError("its size cannot be changed, since it is no regular file")
        is_readable = flags & os.O_ACCMODE == os.O_RDWR
        watched = os.dup(descriptor) if is_readable else os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR | os.O_APPEND)
        fcntl.fcntl(descriptor, fcntl.F_SETFL, flags | os.O_APPEND)
        with self._turn:
            if not self._files:
                self._end = threading.Event()
                self._thread = threading.Thread(target=self._run, args=(self._end,), daemon=True, name="newest output")
                self._thread.start()
            self._files[watched] = most_bytes, 0
        return watched

    def forget(self, watched: int) -> None:
        """Leave a file as it is from now on."""
        with self._turn:
            if self._files.pop(watched, None) is None:
                return
            os.close(watched)
            if self._files:
                return
            self._end.set()
            thread = self._thread
        thread.join()

    def _run(self, end: threading.Event) -> None:
        wait_s, looked_s = LOOK_S, time.monotonic()
        while not end.wait(wait_s):
            now, wait_s = time.monotonic(), LOOK_S
            with self._turn:
                if end.is_set():
                    return
                for watched, (most, before) in self._files.items():
                    size = os.fstat(watched).st_size
                    growth = (size - before) / (now - looked_s)
                    if size > 3 * most // 4:
                        with suppress(OSError):  # such as a full disk
                            size = cut(watched, most // 2)
                    self._files[watched] = most, size
                    wait_s = min(wait_s, (most - size) / 4 / max(growth, 1.0))
            looked_s, wait_s = now, max(wait_s, SHORTEST_S)


def newest_output() -> NewestOutput:
    """The files that this process watches."""
    return _of(os.getpid())


@cache
def _of(process: int) -> NewestOutput:
    """Those of a process; one that was forked has no thread that watches them."""
    return NewestOutput()


def cut(descriptor: int, most_bytes: int) -> int:
    """Take away the beginning of a file that others append to, up to the end of a line; returns how many bytes are
    left. What others write at the same moment may be lost."""
    newest = newest_lines(descriptor, most_bytes)
    os.ftruncate(descriptor, 0)
    os.write(descriptor, newest)
    return len(newest)


def newest_lines(descriptor: int, most_bytes: int) -> bytes:
    """The end of a file, at most so many bytes: from the beginning of a line on, if there is one among them."""
    first = max(0, os.fstat(descriptor).st_size - most_bytes)
    newest = os.pread(descriptor, most_bytes, first)
    return newest[newest.find(b"\n") + 1 :] or newest if first else newest
