"""The folder of a run: the names of its files, the kind of its file system, and the messages of its errors."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from pathlib import Path

from es_service.errors import DatabaseHeldError, StoreError, WayOut
from es_service.protocol.machine import mounts, mounts_of_linux

CONFIG = "config.yaml"
DATABASE = "run.db"
LOG = "run.db-wal"
"""SQLite's write-ahead log beside `run.db`, while a driver writes on a local disk."""
LOCK = "run.lock"
COPY = "run.db.copy"
"""Verified copy of `run.db`. It replaces a damaged `run.db`, and readers on a network file system read it."""
DAMAGED = "run.db.damaged"
"""Name under which a damaged `run.db` is kept, so that it can be examined."""

# fmt: off
NETWORK_FILE_SYSTEMS = frozenset((
    "9p", "acfs", "afs", "beegfs", "ceph", "cifs", "coda", "fhgfs", "fuse", "gfs2", "glusterfs", "gpfs", "lustre",
    "ncpfs", "nfs", "nfs4", "ocfs2", "orangefs", "panfs", "prl_fs", "pvfs2", "smb3", "smbfs", "vboxsf",
    "virtiofs", "vmhgfs", "wekafs",
    "afpfs", "macfuse", "osxfuse", "webdav",  # of macOS
))
# fmt: on
"""File systems without WAL, because other hosts can use the files or shared memory may not work."""
LOCAL_FUSE = frozenset({"fuse.fuse-overlayfs", "fuse.ntfs-3g", "fuse.fuse2fs"})
"""FUSE file systems that are local."""
_LITTLE_SPACE = 256 * 1024
"""Free bytes below which a plain I/O error is taken for a full disk."""
_BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
_NO_ACCESS = {sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_CANTOPEN}
_NOT_DAMAGE = _BUSY | _NO_ACCESS | {sqlite3.SQLITE_FULL, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_INTERRUPT}
"""SQLite errors that do not mean that the file is damaged, so the file must not be replaced because of them."""


def is_network_filesystem(path: Path, mountinfo: str | None = None) -> bool:
    """Whether a path is on a network or shared file system. An unknown FUSE type counts as one, to be safe.

    Args:
        path: a path, which need not exist.
        mountinfo: text of a `/proc/<pid>/mountinfo`; None for what this process sees. Where neither Linux nor the
            command `mount` says what is mounted, the result is false.
    """
    target = Path(path).resolve()
    depth, kind = -1, ""
    for mount_point, type_there in mounts() if mountinfo is None else mounts_of_linux(mountinfo):
        # If there are two mounts on one point, the later one hides the other; therefore >=.
        if target.is_relative_to(mount_point) and len(mount_point.parts) >= depth:
            depth, kind = len(mount_point.parts), type_there
    return kind in NETWORK_FILE_SYSTEMS or (kind.startswith("fuse.") and kind not in LOCAL_FUSE)


def sync_file(path: Path) -> None:
    """Make the content of a file, or the renames inside a folder, survive a power cut. Do not use it for an open
    database: closing drops its locks."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network file systems cannot fsync a folder, but there, renames are synchronous anyway.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def write_config(folder: Path, text: str) -> None:
    """Write the run's `config.yaml`, or replace it atomically."""
    new = folder / f"{CONFIG}.new"
    new.write_text(text, encoding="utf-8")
    sync_file(new)
    os.replace(new, folder / CONFIG)
    sync_file(folder)


def remove_database(path: Path) -> None:
    """Delete a database file and the files of SQLite beside it."""
    for suffix in ("", "-journal", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def holds_run(folder: Path) -> bool:
    """Whether a folder contains a run: its database, or the copy from which opening restores a lost database. Raises
    StoreError if the folder cannot be accessed."""
    try:
        return (folder / DATABASE).exists() or (folder / COPY).exists()
    except OSError as error:
        raise explained(error, folder, "looking for a run", "try again") from error


def runs_inside(folder: Path) -> set[Path]:
    """The run folders directly inside a folder, except hidden ones: these are runs whose creation was interrupted."""
    runs = {file.parent for name in (DATABASE, COPY) for file in folder.glob(f"*/{name}")}
    return {run for run in runs if not run.name.startswith(".")}


def leads_out(path: Path, root: Path) -> bool:
    """Whether a path below a folder leads out of it, by a link or by `..`."""
    return not path.resolve().is_relative_to(root.resolve())


def require_run_folder(folder: Path) -> None:
    """Raise StoreError unless a folder contains a run."""
    if folder.is_file():
        raise StoreError(f"{folder} is not a run folder: it is a file", run=folder)
    if not folder.exists():
        raise StoreError(
            f"{folder} is not a run folder: it does not exist",
            run=folder,
            ways_out=[WayOut("run", "start a run there", out=str(folder))],
        )
    if not holds_run(folder):
        if inside := sorted(runs_inside(folder)):
            several = f"{len(inside)} run folders, such as {inside[-1]}"
            runs = several if len(inside) > 1 else f"the run folder {inside[0]}"
            raise StoreError(f"{folder} is not a run folder, but contains {runs}", run=folder)
        raise StoreError(
            f"{folder} is not a run folder: it contains no {DATABASE}, and no run folders, as a sweep does. If the "
            "creation of a run was interrupted here, nothing was lost; start the run again.",
            run=folder,
        )


def is_disk_full(error: BaseException, folder: Path) -> bool:
    """Whether lack of disk space or quota in `folder` caused an error of SQLite or the operating system."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code == sqlite3.SQLITE_IOERR:
        # If there is no space for the shared memory of the WAL, SQLite reports a plain I/O error.
        try:
            return shutil.disk_usage(folder).free < _LITTLE_SPACE
        except OSError:
            return False
    return code == sqlite3.SQLITE_FULL


def is_no_damage(error: BaseException, folder: Path) -> bool:
    """Whether an error does not mean that the database in `folder` is damaged: it may have been busy or not accessible,
    or the disk too full for the files that SQLite writes beside it."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    return isinstance(error, OSError) or code in _NOT_DAMAGE or is_disk_full(error, folder)


def explained(error: sqlite3.Error | OSError, folder: Path, doing: str, then: str | None = None) -> StoreError:
    """The StoreError for a failure of SQLite or the operating system in a run folder.

    Args:
        doing: the operation that failed, after "while": "reading the run".
        then: what the user should do after removing the cause, as an imperative; None to suggest resuming the run.
    """
    ways_out = [] if then else [WayOut("resume", "continue after the cause is removed", str(folder))]
    ending = f", then {then}." if then else "."
    if is_disk_full(error, folder):
        return StoreError(
            f"{folder}: disk full while {doing} ({error}). Everything stored before is safe; free space{ending}",
            run=folder,
            ways_out=ways_out,
        )
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    kind = StoreError
    if code in _BUSY:
        kind, hint = DatabaseHeldError, f"Another program has {folder / DATABASE} open; close that program"
    elif code in _NO_ACCESS or isinstance(error, OSError):
        hint = "Check that the folder and its files exist and can be read and written"
    else:
        hint = "Everything stored before is safe; check the disk"
    return kind(f"{folder}: error while {doing}: {error}. {hint}{ending}", run=folder, ways_out=ways_out)
