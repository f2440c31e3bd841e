"""What the operating system says of this machine and process: in the way of Linux, or in that of macOS and others.

Calls that only Linux has are made here and in `parent.py`. A test runs those of other modules without them.
"""

from __future__ import annotations

import os
import platform
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path


def given_path(path: str | os.PathLike[str]) -> Path:
    """The path that a person or a caller means: a leading `~` or `~user` is a home folder, as in a shell. A file of
    this name is `./~`."""
    return Path(os.path.expanduser(path))


def usable_cpus() -> int:
    """CPUs that this process may run on: its affinity, or all of the machine where there is none (macOS)."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def architecture() -> str:
    """The processor's architecture, with one name on all systems: x86_64, aarch64, ..."""
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine())


@cache
def processor_fields() -> dict[str, str]:
    """What Linux says of the first processor in /proc/cpuinfo, by name; on macOS its name under "brand"; else empty."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n", 1)[0].splitlines()
    except OSError:
        brand = _said("sysctl", "-n", "machdep.cpu.brand_string").strip()
        return {"brand": brand} if brand else {}
    return {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}


def memory_bytes() -> tuple[int, bool]:
    """(bytes of memory, whether they are those that are free); all of it where the system does not say what is free."""
    try:
        pages, is_free = os.sysconf("SC_AVPHYS_PAGES"), True
    except ValueError:
        pages, is_free = os.sysconf("SC_PHYS_PAGES"), False
    return os.sysconf("SC_PAGE_SIZE") * pages, is_free


def peak_memory_mib() -> int:
    """The most memory that this process has had so far, in MiB."""
    with suppress(OSError, IndexError):  # the kernel's count for getrusage begins with that of the process before it
        return round(int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) / 1024)
    unit = 1024 if sys.platform == "darwin" else 1  # bytes there, KiB elsewhere
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit / 1024)


def memory_of_tree_bytes() -> int:
    """Memory of this process and of all that it has started, directly or not; 0 where only Linux says it."""
    parents: dict[int, int] = {}
    pages: dict[int, int] = {}
    with suppress(OSError):
        for entry in os.scandir("/proc"):
            if entry.name.isdigit():
                with suppress(OSError, ValueError, IndexError):  # it has just ended
                    fields = Path(entry.path, "stat").read_text().rpartition(")")[2].split()
                    parents[int(entry.name)], pages[int(entry.name)] = int(fields[1]), int(fields[21])
    ours = {os.getpid()}
    while found := {process for process, parent in parents.items() if parent in ours} - ours:
        ours |= found
    return os.sysconf("SC_PAGE_SIZE") * sum(pages.get(process, 0) for process in ours)


def process_start_s() -> float:
    """When this process started, in seconds since the epoch; up to a second too early where only `ps` says it."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])  # since boot; 22nd in proc(5)
    except OSError:
        parts = [int(part) for part in re.findall(r"\d+", _said("ps", "-o", "etime=", "-p", str(os.getpid())))]
        units = (1, 60, 3600, 86400)  # etime is [[DD-]HH:]MM:SS
        # Where not even `ps` is there, everything has changed since this process started.
        return time.time() - 1 - sum(map(int.__mul__, reversed(parts), units)) if parts else 0.0
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + ticks / os.sysconf("SC_CLK_TCK")


def mounts() -> Iterator[tuple[Path, str]]:
    """(folder, type of its file system) of everything that is mounted, in the order of mounting."""
    try:
        return mounts_of_linux(Path("/proc/self/mountinfo").read_text(errors="surrogateescape"))
    except OSError:
        return mounts_of_macos(_said("mount"))


def mounts_of_linux(mountinfo: str) -> Iterator[tuple[Path, str]]:
    """`mounts` from the text of a `/proc/<pid>/mountinfo`."""
    for line in mountinfo.splitlines():
        fields, separator, source = line.partition(" - ")
        if separator and len(fields.split()) >= 5 and source.split():
            folder = re.sub(r"\\([0-7]{3})", lambda octal: chr(int(octal[1], 8)), fields.split()[4])
            yield Path(folder), source.split()[0].lower()


def mounts_of_macos(said: str) -> Iterator[tuple[Path, str]]:
    """`mounts` from what the command `mount` of macOS prints: `//me@host/share on /Volumes/share (smbfs, nodev)`."""
    for match in re.finditer(r"^.* on (/.*) \(([^,)]+)[^()]*\)$", said, re.MULTILINE):
        yield Path(match[1]), match[2].lower()


def _said(*command: str) -> str:
    """What a command prints; nothing if it is missing or fails."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout
    except (OSError, subprocess.SubprocessError):
        return ""


def cpu_seconds(processes: Iterable[int]) -> float:
    """Seconds of processors of this process so far, of its children that have ended, and of some that are running."""
    ended, tick = resource.getrusage(resource.RUSAGE_CHILDREN), os.sysconf("SC_CLK_TCK")
    total = time.process_time() + ended.ru_utime + ended.ru_stime
    for process in processes:
        with suppress(OSError, ValueError, IndexError):  # it has just ended
            fields_of = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
            total += (int(fields_of[11]) + int(fields_of[12])) / tick
    return total
