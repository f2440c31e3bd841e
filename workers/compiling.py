"""Functions that can be compiled before they are called, so that the time of compiling is known apart from the rest,
and where XLA keeps compiled rollouts on disk, so that only the first worker process of a machine compiles them.

Only processes with a worker's environment use XLA's cache: with another number of threads XLA compiles other code, and
JAX's key for an entry does not contain that number.
"""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from es_service.protocol.machine import cpu_kind, processor_fields
from workers.simd.backend.cache import cache_folder

MOST_BYTES = 200 * 2**20
"""Size above which JAX removes the least recently used entries."""


@dataclass(frozen=True)
class Compilable:
    """A function that compiles what it needs at a call, unless `compile` has done so before."""

    run: Callable[..., Any]
    compile: Callable[..., object]
    """Function of the same arguments that compiles what `run` needs for them, and computes nothing else."""

    def __call__(self, *arguments: Any) -> Any:
        return self.run(*arguments)

    def seconds_to_compile(self, *arguments: Any) -> float:
        """Compile, and say how long it took in seconds."""
        started = time.perf_counter()
        self.compile(*arguments)
        return time.perf_counter() - started


def jitted(function: Callable[..., Any]) -> Compilable:
    """The function compiled by XLA, once for each shape of its arguments. A call runs what `compile` made."""
    import jax  # here, since a worker without JAX tasks does not load it

    run = jax.jit(function)
    return Compilable(run, lambda *arguments: run.lower(*arguments).compile())


def xla_cache_settings() -> dict[str, str]:
    """Environment variables that make JAX use the cache, if set before it is imported; none where there is no folder
    that belongs to this user alone."""
    kernels = cache_folder()
    if kernels is None:
        return {}
    folder = kernels.with_name("xla") / _processor()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        seen = folder.stat()
    except OSError:
        return {}
    if seen.st_uid != os.geteuid() or stat.S_IMODE(seen.st_mode) & 0o022:
        return {}  # somebody else could put code there
    return {
        "JAX_COMPILATION_CACHE_DIR": str(folder),
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(MOST_BYTES),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    }


def _processor() -> str:
    """A name for processors that run the same machine code: JAX's key does not contain what this one can do."""
    fields = processor_fields()
    features = [cpu_kind(), *(fields[name] for name in ("flags", "Features", "CPU variant") if name in fields)]
    return hashlib.sha256("\n".join(features).encode()).hexdigest()[:16]
