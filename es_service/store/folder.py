"""A run's folder: the names of its files, the file system under it, and what its errors mean to a user."""

from __future__ import annotations

import errno
import os
import re
import shutil
import sqlite3
from pathlib import Path

from es_service.errors import StoreError, WayOut

CONFIG = "config.yaml"
DATABASE = "run.db"
LOCK = "run.lock"
COPY = "run.db.copy"
"""The verified copy: what opening turns to when `run.db` itself is damaged, and what readers on a network read."""
DAMAGED = "run.db.damaged"
"""Where a `run.db` that could not be used is kept for whoever wants to look into it."""

# fmt: off
NETWORK_FILE_SYSTEMS = frozenset((
    "9p", "acfs", "afs", "beegfs", "ceph", "cifs", "coda", "fhgfs", "fuse", "gfs2", "glusterfs", "gpfs", "lustre",
    "ncpfs", "nfs", "nfs4", "ocfs2", "orangefs", "panfs", "prl_fs", "pvfs2", "smb3", "smbfs", "vboxsf",
    "virtiofs", "vmhgfs", "wekafs",
))
# fmt: on
"""Types on which other hosts see the files, or on which shared memory cannot be relied upon: no WAL there."""
LOCAL_FUSE = frozenset({"fuse.fuse-overlayfs", "fuse.ntfs-3g", "fuse.fuse2fs"})
_LITTLE_SPACE = 256 * 1024


def is_network_filesystem(path: Path, mountinfo: str | None = None) -> bool:
    """Whether `path` lies on a network or shared file system; an unknown FUSE type counts as one, to be safe.

    Args:
        path: need not exist; its nearest existing ancestors decide.
        mountinfo: text of a `/proc/<pid>/mountinfo`; this process's own if None. Where there is none, all is local.
    """
    if mountinfo is None:
        try:
            mountinfo = Path("/proc/self/mountinfo").read_text(errors="surrogateescape")
        except OSError:
            return False
    target = Path(path).resolve()
    depth, kind = -1, ""
    for line in mountinfo.splitlines():
        fields, separator, source = line.partition(" - ")
        if not separator or len(fields.split()) < 5 or not source.split():
            continue
        mount_point = Path(re.sub(r"\\([0-7]{3})", lambda octal: chr(int(octal[1], 8)), fields.split()[4]))
        # Of two mounts on one point the later one lies on top, hence >=.
        if target.is_relative_to(mount_point) and len(mount_point.parts) >= depth:
            depth, kind = len(mount_point.parts), source.split()[0].lower()
    return kind in NETWORK_FILE_SYSTEMS or (kind.startswith("fuse.") and kind not in LOCAL_FUSE)


def sync_folder(folder: Path) -> None:
    """Make renames inside `folder` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network file systems cannot fsync a folder; there its rename is synchronous anyway.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def sync_file(path: Path) -> None:
    """Make the content of `path` survive a power cut. Never for a database that is open: closing drops its locks."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_config(folder: Path, text: str) -> None:
    """Write the run's `config.yaml`, replacing a former one in one step."""
    new = folder / f"{CONFIG}.new"
    new.write_text(text, encoding="utf-8")
    sync_file(new)
    os.replace(new, folder / CONFIG)
    sync_folder(folder)


def remove_database(path: Path) -> None:
    """Delete a database file and whatever SQLite may have left beside it."""
    for suffix in ("", "-journal", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def holds_run(folder: Path) -> bool:
    """Whether there is a run in `folder`: its database, or the copy that opening puts in the place of a lost one.

    Raises StoreError where that cannot be told.
    """
    try:
        return (folder / DATABASE).exists() or (folder / COPY).exists()
    except OSError as error:
        raise explained(error, folder, "looking for a run", "try again") from error


def require_run_folder(folder: Path) -> None:
    """Raises StoreError unless `folder` holds a run."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise StoreError(
            f"{folder} is not a run folder: it {what}",
            run=folder,
            ways_out=[WayOut("run", "start a run there", out=str(folder))],
        )
    if not holds_run(folder):
        raise StoreError(
            f"{folder} is not a run folder: it holds no {DATABASE}. If its creation was stopped, nothing was lost: "
            f"start it again.",
            run=folder,
        )


def is_disk_full(error: BaseException, folder: Path) -> bool:
    """Whether an error of SQLite or the operating system came from lack of space (or of quota) under `folder`."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code == sqlite3.SQLITE_IOERR:
        # Growing the shared memory of the WAL reports lack of space as a plain I/O error.
        try:
            return shutil.disk_usage(folder).free < _LITTLE_SPACE
        except OSError:
            return False
    return code == sqlite3.SQLITE_FULL


def explained(error: sqlite3.Error | OSError, folder: Path, doing: str, then: str | None = None) -> StoreError:
    """The StoreError to raise for a failure of SQLite or the operating system while `doing` something in `folder`.

    `then` is what to do after the cause is gone; resuming if None.
    """
    ways_out = [] if then else [WayOut("resume", "go on once the cause is gone", str(folder))]
    ending = f", then {then}." if then else "."
    if is_disk_full(error, folder):
        return StoreError(
            f"{folder}: disk full while {doing} ({error}). Everything stored before is safe; free space{ending}",
            run=folder,
            ways_out=ways_out,
        )
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        hint = f"Another program keeps {folder / DATABASE} open; close it"
    elif code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_CANTOPEN) or isinstance(error, OSError):
        hint = "Check that the folder and its files exist and may be read and written"
    else:
        hint = "Everything stored before is safe; check the disk"
    return StoreError(f"{folder}: error while {doing}: {error}. {hint}{ending}", run=folder, ways_out=ways_out)
