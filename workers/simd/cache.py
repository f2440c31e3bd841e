"""Compiled kernels on disk: by content, target and versions. An entry is whole or is not used."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from pathlib import Path

MAGIC = b"es-service kernel 1\n"
MOST_ENTRIES = 100
"""Beyond this the entries longest unused go."""


def cache_folder() -> Path:
    """Where kernels are kept: `es-service/kernels` in the user's cache (XDG_CACHE_HOME, else ~/.cache)."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "es-service" / "kernels"


def load(folder: Path, key: str) -> bytes | None:
    """The entry of a key, or None; one that is damaged, or another's, is named on stderr and removed."""
    path = folder / key
    try:
        content = path.read_bytes()
    except OSError:
        return None
    head = MAGIC + key.encode()
    code = content[len(head) + 32 :]
    if content[: len(head)] == head and hashlib.sha256(code).digest() == content[len(head) : len(head) + 32]:
        with contextlib.suppress(OSError):  # a folder that is only read serves as well
            os.utime(path)
        return code
    print(f"{path} is damaged or was made for something else; compiling again", file=sys.stderr)
    return None


def save(folder: Path, key: str, code: bytes) -> None:
    """Keep an entry. Where that cannot be, it is said on stderr: the next process compiles again."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".", delete=False) as file:
            file.write(MAGIC + key.encode() + hashlib.sha256(code).digest() + code)
        os.replace(file.name, folder / key)
        _prune(folder)
    except OSError as error:
        print(f"compiled kernels are not kept: {error}", file=sys.stderr)


def _prune(folder: Path) -> None:
    def last_used(path: Path) -> float:
        try:
            return path.stat().st_mtime
        except OSError:
            return 0.0

    for path in sorted(folder.iterdir(), key=last_used)[:-MOST_ENTRIES]:
        path.unlink(missing_ok=True)
