"""This processor in the place of a GPU: the same functions of single lanes, compiled for it and run one by one."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

from workers.simd.backend.function_builder import FunctionBuilder, module
from workers.simd.backend.native import load_compiled
from workers.simd.backend.target import ISAS, Isa, Target, host_target

C_TYPES = {"ptr": ctypes.c_void_p, "i64": ctypes.c_int64, "float": ctypes.c_float}


@contextmanager
def single_lanes() -> Iterator[Target]:
    """Target of this processor with vectors of one lane."""
    widest = ISAS[host_target().isa]
    with mock.patch.dict(ISAS, {"one": Isa("single numbers", widest.architecture, 1, *widest[3:])}):
        yield host_target("one")


def on_host(functions: Sequence[FunctionBuilder], name: str) -> Callable[..., None]:
    """A kernel of functions as a function of this processor, with the kernel's arguments."""
    called = [f for f in functions if not f.name.endswith("_of_lane") or f.name == f"{name}_of_lane"]
    of_lane = next(f for f in called if f.name == f"{name}_of_lane")
    called.remove(of_lane)
    given = of_lane.parameters[:-1]
    inside = FunctionBuilder("inside", given, of_lane.target)
    names = ", ".join(one.replace(" noalias", "") for one in given)
    inside.loop("%lanes", lambda lane, _: (inside.do(f"call void @{of_lane.name}({names}, i64 {lane})"), [])[1])
    text = module([*called, of_lane, inside])
    native = load_compiled(text, lambda: text, of_lane.target)
    return native.function(*(C_TYPES[one.split()[0]] for one in given))


class HostArray:
    """An array in the memory of this processor."""

    def __init__(self, array: Any) -> None:
        self.array = array

    def read(self, first: int = 0, rows: int | None = None) -> Any:
        """As `GpuArray.read`."""
        return self.array[first : None if rows is None else first + rows].copy()


class HostModule:
    """Kernels of this processor."""

    def __init__(self, functions: Sequence[FunctionBuilder]) -> None:
        self._functions, self._compiled = functions, {}

    def launch(self, name: str, threads: int, *arguments: Any) -> None:
        """As `Module.launch`."""
        if name not in self._compiled:
            self._compiled[name] = on_host(self._functions, name)
        self._compiled[name](*(one.array if isinstance(one, HostArray) else one.value for one in arguments))


class HostGpu:
    """What `GpuEpisodes` needs of a `Gpu`."""

    name = "this processor as a GPU"

    def __init__(self, target: Target) -> None:
        self.target = target

    def enter(self) -> None:
        """Nothing."""

    def module(self, functions: Sequence[FunctionBuilder]) -> HostModule:
        """As `Gpu.module`."""
        return HostModule(functions)

    def array(self, shape: Sequence[int], dtype: Any) -> HostArray:
        """As `Gpu.array`, with values that nobody may read."""
        return HostArray(np.full(shape, 77, dtype))

    def copied(self, array: Any) -> HostArray:
        """As `Gpu.copied`."""
        return HostArray(np.ascontiguousarray(array).copy())
