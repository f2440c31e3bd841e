"""NVIDIA's driver by ctypes: it compiles PTX for its GPU, which needs no other software of NVIDIA, and runs kernels."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from workers.simd.backend.function_builder import FunctionBuilder
from workers.simd.backend.ptx import ptx
from workers.simd.backend.target import Target, target_of

LIBRARY = "libcuda.so.1"
THREADS = 128
"""Threads of a block of all kernels."""
LOG_BYTES = 4096
MAJOR, MINOR = 75, 76
"""Numbers of the attributes of a device that have its compute capability."""
ERROR_LOG, ERROR_LOG_BYTES = 5, 6
"""Numbers of the options of the driver's compiler that have its messages."""


class GpuError(RuntimeError):
    """The driver refused a call."""


class Gpu:
    """The first GPU that this process may use."""

    def __init__(self) -> None:
        """Begin to use it.

        Raises:
            GpuError: there is no driver, or no GPU.
        """
        try:
            self._library = ctypes.CDLL(LIBRARY)
        except OSError as error:
            raise GpuError(f"NVIDIA's driver is not installed: {error}") from None
        device, context = ctypes.c_int(), ctypes.c_void_p()
        self._call("cuInit", ctypes.c_uint(0))
        self._call("cuDeviceGet", ctypes.byref(device), ctypes.c_int(0))
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)
        self._context = context
        name = ctypes.create_string_buffer(256)
        self._call("cuDeviceGetName", name, ctypes.c_int(len(name)), device)
        self.name = name.value.decode()
        """Kind of the GPU, such as `NVIDIA H200`."""
        self.enter()

    def enter(self) -> None:
        self._call("cuCtxSetCurrent", self._context)

    @property
    def target(self) -> Target:
        return target_of("ptx")

    def module(self, functions: Sequence[FunctionBuilder]) -> Module:
        """Compile the kernels of functions, see `ptx.ptx`. The driver keeps what it has compiled in a folder of the
        user.

        Raises:
            GpuError: the driver refuses them; its messages are in the error.
        """
        text = ctypes.c_char_p(ptx(functions).encode())
        module, log = ctypes.c_void_p(), ctypes.create_string_buffer(LOG_BYTES)
        options = (ctypes.c_int * 2)(ERROR_LOG, ERROR_LOG_BYTES)
        values = (ctypes.c_void_p * 2)(ctypes.cast(log, ctypes.c_void_p), LOG_BYTES)
        try:
            self._call(
                "cuModuleLoadDataEx", ctypes.byref(module), text, ctypes.c_uint(2), options, values
            )  # fmt: skip
        except GpuError as error:
            raise GpuError(f"{error}: {log.value.decode(errors='replace').strip()}") from None
        return Module(self, module)

    def array(self, shape: Sequence[int], dtype: Any) -> GpuArray:
        """Memory of the GPU for an array, whose values are undefined.

        Raises:
            GpuError: there is too little memory.
        """
        pointer, size = ctypes.c_uint64(), int(np.prod(shape)) * np.dtype(dtype).itemsize
        self._call("cuMemAlloc_v2", ctypes.byref(pointer), ctypes.c_size_t(max(size, 1)))
        return GpuArray(self, pointer, tuple(shape), np.dtype(dtype))

    def copied(self, array: Any) -> GpuArray:
        copy = self.array(array.shape, array.dtype)
        copy.write(array)
        return copy

    def _call(self, name: str, *arguments: Any) -> None:
        code = getattr(self._library, name)(*arguments)
        if code:
            text = ctypes.c_char_p()
            self._library.cuGetErrorString(ctypes.c_int(code), ctypes.byref(text))
            raise GpuError(f"{name}: {(text.value or b'an unknown error').decode()}")


class GpuArray:
    """An array in the GPU's memory, which is freed with this object."""

    def __init__(self, gpu: Gpu, pointer: ctypes.c_uint64, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._gpu, self.pointer, self.shape, self.dtype = gpu, pointer, shape, dtype

    def write(self, array: Any) -> None:
        """Copy an array of this shape and dtype to the GPU."""
        given = np.ascontiguousarray(array)
        assert (given.shape, given.dtype) == (self.shape, self.dtype), (given.shape, given.dtype, self.shape)
        self._gpu._call("cuMemcpyHtoD_v2", self.pointer, ctypes.c_void_p(given.ctypes.data), _size(given.nbytes))

    def read(self, first: int = 0, rows: int | None = None) -> Any:
        """Rows of the array, all by default; waits for the kernels that were launched before."""
        array = np.empty((self.shape[0] - first if rows is None else rows, *self.shape[1:]), self.dtype)
        start = self.pointer.value + first * int(np.prod(self.shape[1:])) * self.dtype.itemsize
        here = ctypes.c_void_p(array.ctypes.data)
        self._gpu._call("cuMemcpyDtoH_v2", here, ctypes.c_uint64(start), _size(array.nbytes))
        return array

    def __del__(self) -> None:
        """Free the memory; at the end of the process the driver does it."""
        self._gpu._library.cuMemFree_v2(self.pointer)


class Module:
    def __init__(self, gpu: Gpu, module: ctypes.c_void_p) -> None:
        self._gpu, self._module = gpu, module
        self._functions: dict[str, ctypes.c_void_p] = {}

    def launch(self, name: str, threads: int, *arguments: Any) -> None:
        """Run a kernel in so many threads, after those that were launched before.

        Args:
            arguments: arrays of the GPU, and numbers as ctypes.
        """
        if name not in self._functions:
            function = ctypes.c_void_p()
            self._gpu._call("cuModuleGetFunction", ctypes.byref(function), self._module, name.encode())
            self._functions[name] = function
        values = [argument.pointer if isinstance(argument, GpuArray) else argument for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        grid, one = ctypes.c_uint(-(-threads // THREADS)), ctypes.c_uint(1)
        self._gpu._call(
            "cuLaunchKernel", self._functions[name], grid, one, one, ctypes.c_uint(THREADS), one, one,
            ctypes.c_uint(0), None, pointers, None,
        )  # fmt: skip


def _size(count: int) -> ctypes.c_size_t:
    return ctypes.c_size_t(count)


@cache
def the_gpu() -> Gpu:
    """The GPU of this process. Raises GpuError as `Gpu`."""
    return Gpu()
