"""Compilation of LLVM IR to machine code in memory; code that was compiled before comes from the cache."""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from workers.simd.backend import cache
from workers.simd.backend.machine_code import compile_object, compiler_version, load_object
from workers.simd.backend.target import Target

OWN_VERSION = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py")))
).hexdigest()
"""Version of this compiler: a hash of all its source files at the time of import."""


class Native(NamedTuple):
    """Machine code of a kernel in memory."""

    address: int
    """Address of the function `kernel`."""
    alive: object
    """Object that must stay alive as long as the code is used."""
    code_bytes: int
    cached: bool
    """Whether the code came from the cache."""

    def function(self, *arguments: Any) -> Callable[..., None]:
        """The function `kernel` for arguments of these ctypes, where arrays stand for pointers to their data; the code
        lives as long as it does."""
        kernel = ctypes.CFUNCTYPE(None, *arguments)(self.address)

        def call(*given: Any) -> None:
            assert self.alive
            kernel(*[argument.ctypes.data if isinstance(argument, np.ndarray) else argument for argument in given])

        return call


def load_compiled(
    name: str,
    text: Callable[[], str],
    target: Target,
    folder: Path | None = None,
    check: Callable[[Native], object] = lambda native: None,
) -> Native:
    """Compile LLVM IR, or load the machine code from the cache.

    Args:
        name: complete description of what the code computes; code with the same name is not compiled again.
        text: function that gives the IR; called only if the code is not in the cache.
        target: processor and instruction set.
        folder: folder of the cache; the user's cache if None.
        check: function that raises an exception if new code is wrong; such code is not kept.
    """
    folder = folder or cache.cache_folder()
    if folder and not cache.trusted(folder):
        folder = None
    versions = f"{target} {compiler_version()} {OWN_VERSION}"
    key = hashlib.sha256(f"{name} {versions}".encode()).hexdigest()
    kept = cache.load(folder, key) if folder else None
    code = kept if kept is not None else compile_object(text(), target)
    native = Native(*load_object(code, target), len(code), kept is not None)
    if kept is None:
        check(native)
        if folder:
            cache.save(folder, key, code)
    return native
