"""Functions that can be compiled before they are called, so that the time of compiling is known apart from the rest."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Compilable:
    """A function that compiles what it needs at a call, unless `compile` has done so before."""

    run: Callable[..., Any]
    compile: Callable[..., object]
    """Function of the same arguments that compiles what `run` needs for them, and computes nothing else."""

    def __call__(self, *arguments: Any) -> Any:
        """The result of `run`."""
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
