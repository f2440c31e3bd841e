"""Kernels for 64-bit Arm on this machine: compiled by simd, linked with `arm_driver.c`, run by qemu's user emulation.

Under `emulation`, the functions of `workers.simd` take targets of Arm like those of this processor, and everything else
is as ever: a call of a kernel sends its memory to a process of qemu and takes it back.
"""

from __future__ import annotations

import ctypes
import functools
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from workers.simd.backend import native
from workers.simd.backend.native import Native
from workers.simd.backend.target import ISAS, Target, target_of

COMPILER, QEMU = "aarch64-linux-gnu-gcc", ("qemu-aarch64-static", "qemu-aarch64")
DRIVER = Path(__file__).with_name("arm_driver.c")
WIDTHS = [name for name, isa in ISAS.items() if isa.architecture == "aarch64"]


def _qemu() -> str | None:
    return next(filter(None, map(shutil.which, QEMU)), None)


def lacking() -> str:
    """What this machine lacks, in a sentence; empty if it can run code for Arm."""
    lacks = [COMPILER] if shutil.which(COMPILER) is None else []
    lacks += [] if _qemu() else [QEMU[0]]
    return f"{' and '.join(lacks)} not installed (Debian: gcc-aarch64-linux-gnu, qemu-user-static)" if lacks else ""


needs_emulation = pytest.mark.skipif(
    bool(lacking()) or platform.machine() not in ("x86_64", "AMD64"), reason=lacking() or "compares with x86-64"
)


def arm_targets() -> list[Any]:
    """Targets of Arm as parameters of a test: one width of the code in `make test`, the others in `make long`."""
    return [
        pytest.param(target_of(name), marks=[needs_emulation, *[pytest.mark.long] * (number > 0)])
        for number, name in enumerate(WIDTHS)
    ]


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """A folder for this process, with the driver compiled."""
    folder = tempfile.TemporaryDirectory(prefix="arm")
    options = ["-c", "-O1", "-Wall", "-Werror", "-ffreestanding", "-fno-stack-protector"]
    subprocess.run([COMPILER, *options, str(DRIVER), "-o", f"{folder.name}/driver.o"], check=True)
    return folder


class Emulated:
    """A kernel as a program for Arm."""

    def __init__(self, code: bytes) -> None:
        """Link a kernel's object file."""
        folder = _folder().name
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".o", delete=False) as file:
            file.write(code)
        self.program = file.name.removesuffix(".o")
        parts = ["-nostdlib", "-static", f"{folder}/driver.o", file.name]
        subprocess.run([COMPILER, *parts, "-o", self.program], check=True)

    def call(self, signature: tuple[Any, ...], given: tuple[Any, ...]) -> None:
        """Call the kernel.

        Args:
            signature: ctypes of the arguments.
            given: arrays and numbers. Arrays of uint64 are addresses of policies in the memory of this process.
        """
        segments: list[np.ndarray] = []
        addresses: list[int] = []
        integers: list[int] = []
        floats: list[np.float32] = []
        pointed: dict[int, int] = {}
        for ctype, one in zip(signature, given, strict=True):
            if ctype is ctypes.c_float:
                floats.append(np.float32(one))
            elif not isinstance(one, np.ndarray):
                integers += [0, int(one)]
            else:
                integers += [1, len(segments)]
                place = len(segments)
                segments.append(one)
                for number, address in enumerate(one.reshape(-1).tolist() if one.dtype == np.uint64 else ()):
                    if address not in pointed:
                        pointed[address] = len(segments)
                        floats_there = ctypes.c_float * _policy_size(given)
                        segments.append(np.ctypeslib.as_array(floats_there.from_address(address)))
                    addresses += [place, 8 * number, pointed[address]]
        assert len(integers) <= 24
        assert len(floats) <= 2
        counts = [len(segments), len(addresses) // 3, len(integers) // 2, len(floats)]
        bits = [int(one.view(np.uint32)) for one in floats]
        head = np.array([*counts, *(one.nbytes for one in segments), *addresses, *integers, *bits], np.uint64)
        data = [np.ascontiguousarray(one).reshape(-1).view(np.uint8).tobytes() for one in segments]
        command = [str(_qemu()), self.program]
        done = subprocess.run(command, input=b"".join([head.tobytes(), *data]), capture_output=True, check=False)
        assert done.returncode == 0, f"the driver ended with {done.returncode} {done.stderr!r}"
        start = 0
        for one in segments:
            found = np.frombuffer(done.stdout, np.uint8, one.nbytes, start)
            start += one.nbytes
            if one.dtype != np.uint64 and one.flags.writeable:
                assert one.flags.c_contiguous
                one.reshape(-1).view(np.uint8)[:] = found
        assert start == len(done.stdout)


def _policy_size(given: tuple[Any, ...]) -> int:
    """Floats in memory from the address of a policy on, of the two kernels that are given such addresses."""
    carries, places = given[0], given[5]  # of episodes; the kernel of recipes has the number of parameters there
    return int(places.max()) + carries.shape[-1] if isinstance(places, np.ndarray) else places


@contextmanager
def emulation() -> Iterator[None]:
    """A context in which kernels for Arm are run by qemu, those for this processor as ever."""
    load_object, function = native.load_object, Native.function

    def load(code: bytes, target: Target) -> tuple[int, object]:
        return (0, Emulated(code)) if target.isa in WIDTHS else load_object(code, target)

    def function_of(self: Native, *signature: Any) -> Any:
        if not isinstance(self.alive, Emulated):
            return function(self, *signature)
        return lambda *given: self.alive.call(signature, given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "load_object", load)
        patch.setattr(Native, "function", function_of)
        yield
