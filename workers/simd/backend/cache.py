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
KEY_LENGTH, UNFINISHED = 64, ".unfinished-"


def cache_folder() -> Path | None:
    """Where kernels are kept: `es-service/kernels` in the user's cache (XDG_CACHE_HOME, else ~/.cache); None if there
    is no such place."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(named) if os.path.isabs(named) else Path(os.path.expanduser("~"), ".cache")
    return base / "es-service" / "kernels" if base.is_absolute() else None


def load(folder: Path, key: str) -> bytes | None:
    """The entry of a key, or None; one that is damaged, or another's, is named on stderr."""
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
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        file = tempfile.NamedTemporaryFile(dir=folder, prefix=UNFINISHED, delete=False)  # noqa: SIM115
        try:
            with file:
                file.write(MAGIC + key.encode() + hashlib.sha256(code).digest() + code)
            os.replace(file.name, folder / key)
        except OSError:
            os.unlink(file.name)
            raise
    except OSError as error:
        print(f"compiled kernels are not kept: {error}", file=sys.stderr)
        return
    with contextlib.suppress(OSError):
        _prune(folder)


def _prune(folder: Path) -> None:
    """Remove our own files that were used longest ago; what was left unfinished by killed processes ages with them."""
    found = []
    for path in folder.iterdir():
        if len(path.name) == KEY_LENGTH or path.name.startswith(UNFINISHED):
            with contextlib.suppress(OSError):  # another process may be pruning, too
                found.append((path.stat().st_mtime, path))
    for _, path in sorted(found)[:-MOST_ENTRIES]:
        path.unlink(missing_ok=True)
