"""Cache of compiled kernels on disk, by content, target and versions.

Its entries are executed. So the folder must belong to this user, and nobody else may write into it; incomplete entries
are not used.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import sys
import tempfile
from pathlib import Path

MAGIC = b"es-service kernel 1\n"
MOST_ENTRIES = 100
"""Most entries in the cache; when there are more, the least recently used ones are removed."""
KEY_LENGTH, UNFINISHED = 64, ".unfinished-"
_TOLD: set[Path] = set()


def cache_folder() -> Path | None:
    """Folder of the cache: `es-service/kernels` in XDG_CACHE_HOME or else in ~/.cache; None if neither is absolute."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(named) if os.path.isabs(named) else Path(os.path.expanduser("~"), ".cache")
    return base / "es-service" / "kernels" if base.is_absolute() else None


def why_not_trusted(folder: Path) -> str:
    """Why code from a folder must not be executed; empty if it may be, or if there is no such folder yet."""
    try:
        status = folder.stat()
    except OSError:
        return ""
    if status.st_uid != os.geteuid():
        return f"it belongs to user {status.st_uid}, not to this user ({os.geteuid()})"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"other users may write into it (mode {stat.S_IMODE(status.st_mode):o}); chmod 700 it"
    return ""


def trusted(folder: Path) -> bool:
    """Whether code from a folder may be executed; if not, the first call of a process says so on stderr."""
    why = why_not_trusted(folder)
    if why and folder not in _TOLD:
        _TOLD.add(folder)
        print(f"the cache of kernels {folder} is not used: {why}", file=sys.stderr)
    return not why


def load(folder: Path, key: str) -> bytes | None:
    """Machine code of the entry with a key, or None if there is none.

    An entry that is damaged or has another key is reported on stderr and not used.
    """
    path = folder / key
    try:
        content = path.read_bytes()
    except OSError:
        return None
    head = MAGIC + key.encode()
    code = content[len(head) + 32 :]
    if content[: len(head)] == head and hashlib.sha256(code).digest() == content[len(head) : len(head) + 32]:
        with contextlib.suppress(OSError):  # a read-only folder can be used as well
            os.utime(path)
        return code
    print(f"the cached kernel {path} is damaged or has another key; compiling it again", file=sys.stderr)
    return None


def save(folder: Path, key: str, code: bytes) -> None:
    """Save an entry. A failure is reported on stderr; the next process then compiles the kernel again."""
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
        print(f"could not save a compiled kernel in {folder}: {error}; it will be compiled again", file=sys.stderr)
        return
    with contextlib.suppress(OSError):
        _prune(folder)


def _prune(folder: Path) -> None:
    """Remove the least recently used of the cache's own files, including unfinished files of killed processes."""
    files = []
    for path in folder.iterdir():
        if len(path.name) == KEY_LENGTH or path.name.startswith(UNFINISHED):
            with contextlib.suppress(OSError):  # another process may be pruning at the same time
                files.append((path.stat().st_mtime, path))
    for _, path in sorted(files)[:-MOST_ENTRIES]:
        path.unlink(missing_ok=True)
