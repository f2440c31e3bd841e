"""LLVM IR becomes a function that can be called; what was compiled before is taken from the cache."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from workers.simd.backend import cache
from workers.simd.backend.target import Target, compile_object, compiler_version, load_object

OWN_VERSION = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py")))
).hexdigest()
"""Of this compiler: a hash of its source, of all folders, as it was imported."""


class Native(NamedTuple):
    """Machine code in memory."""

    address: int
    """Of `kernel`."""
    alive: object
    """Must stay alive as long as the code is used."""
    code_bytes: int
    cached: bool
    """Whether it was compiled before."""


def load_compiled(name: str, text: Callable[[], str], target: Target, folder: Path | None = None) -> Native:
    """Machine code of LLVM IR.

    Args:
        name: tells what it computes, in full: what has the same name is not compiled again.
        text: makes the IR; called only where the code is not in the cache.
        folder: of compiled kernels; the user's cache if None.
    """
    folder = folder or cache.cache_folder()
    versions = f"{target} {compiler_version()} {OWN_VERSION}"
    key = hashlib.sha256(f"{name} {versions}".encode()).hexdigest()
    kept = cache.load(folder, key) if folder else None
    code = kept if kept is not None else compile_object(text(), target)
    if kept is None and folder:
        cache.save(folder, key, code)
    return Native(*load_object(code, target), len(code), kept is not None)
