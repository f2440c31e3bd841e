"""This machine: what the operating system says of it, its cores and GPUs, and the platform on which bits depend.

The driver and the workers each have a platform; a worker in a cluster reports its own when it has started.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any

# What the operating system says of this machine and process: in the way of Linux, or in that of macOS and others.
#
# Calls that only Linux has are made here and in `child.py`. A test runs those of other modules without them.


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
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime + sum(map(process_cpu_s, processes))


def process_cpu_s(process: int) -> float:
    """Seconds of processors of a process so far, and of what it has started and waited for; 0 if it is gone, or where
    only Linux says it."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return 0.0


VERSION = "0.38.0"
"""Version of es-service, written here because the metadata of an editable installation keep the version of the last
`pip install`."""
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "brax", "mujoco", "mujoco-mjx", "llvmlite")
"""Other packages whose version can change a bit of a result."""

CODE = "code"
"""Key under which a run's platform has the hashes of its code, `sources.Sources`."""


def platform_info() -> dict[str, str]:
    """Package versions and CPU kind of this machine, by name. Equal platforms give the same results bit for bit."""
    return {"python": platform.python_version(), "es-service": VERSION, **_versions(), "cpu": cpu_kind()}


@cache
def _versions() -> dict[str, str]:
    """Versions of other packages, read once: a process goes on with what it has imported."""
    return {name: metadata.version(name) for name in PACKAGES}


def platform_text(info: Mapping[str, Any]) -> str:
    """A platform as JSON; equal platforms have equal texts."""
    return json.dumps(info, sort_keys=True)


def computed_on(driver: Mapping[str, Any], workers: Collection[str]) -> dict[str, Any]:
    """The platform of a generation: the driver's, with the workers' under "workers" unless all equal the driver's.

    Args:
        driver: `platform_info` of the driver.
        workers: `platform_text` of each kind of worker so far.
    """
    if set(workers) <= {platform_text(driver)}:
        return dict(driver)
    return {**driver, "workers": [json.loads(text) for text in sorted(workers)]}


def is_mixed(platforms: Iterable[Mapping[str, Any]]) -> bool:
    """Whether generations were computed on several platforms or with several versions of the code, or one generation by
    workers on several platforms. Code that was not recorded, as in old runs, is not compared."""
    records = list(platforms)
    machines = {platform_text(without_code(record)) for record in records}
    codes = {platform_text(record[CODE]) for record in records if CODE in record}
    return max(len(machines), len(codes)) > 1 or any(len(record.get("workers", ())) > 1 for record in records)


def without_code(platform: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in platform.items() if name != CODE}


def code_text(code: Mapping[str, str]) -> str:
    """The hashes of a run's code in one line, such as `87 files, SHA-256 1f0c95d2ab37`; equal code has equal lines."""
    return f"{len(code)} files, SHA-256 {hashlib.sha256(platform_text(code).encode()).hexdigest()[:12]}"


def cpu_kind() -> str:
    """Kind of the first processor.

    On x86-64 vendor, family, model and widest vector extension, such as `AuthenticAMD 26/2 avx512f`. On Arm the
    numbers of maker and model and the architecture, such as `0x41/0xd0c aarch64`; on a Mac `Apple M1 aarch64`. Only the
    architecture where the system does not say more.
    """
    fields = processor_fields()
    if "vendor_id" in fields:
        flags = fields.get("flags", "").split()
        vectors = next((flag for flag in ("avx512f", "avx2", "avx", "sse2") if flag in flags), architecture())
        return f"{fields['vendor_id']} {fields.get('cpu family', '?')}/{fields.get('model', '?')} {vectors}"
    maker = [fields[name] for name in ("CPU implementer", "CPU part") if name in fields]
    return " ".join(filter(None, ["/".join(maker), fields.get("brand", ""), architecture()]))


# Cores and GPUs of this machine that this process may use: cores by its CPU affinity and the quotas of its control
# groups, GPUs as the workers of the engine inline share them.

CGROUP = Path("/sys/fs/cgroup")
"""Folder of the control groups, as this process sees it."""
MEMBERSHIP = Path("/proc/self/cgroup")
"""File that names the control groups of this process."""


def cores() -> int:
    """Cores in this process's CPU affinity (on macOS all), or the least quota of its control groups (`docker run
    --cpus`, `systemd-run -p CPUQuota=`, a Slurm job), rounded up, if that is less.

    The quota of a group also holds for all groups inside it, so the group of the process and all groups around it
    count, in both versions of control groups. A group without a readable quota has none.
    """
    return min([usable_cpus(), *_quotas()])


def _quotas() -> Iterator[int]:
    """Cores that each of the groups with a quota allows."""
    for top, files, inside in _memberships():
        for group in (inside, *inside.parents):
            try:
                texts = [(top / group / file).read_text() for file in files]
                quota, period = map(int, " ".join(texts).split())
            except (OSError, ValueError):  # without a limit, the quota of version 2 is "max"
                continue
            if quota > 0 and period > 0:  # without a limit, the quota of version 1 is -1
                yield -(-quota // period)


def _memberships() -> Iterator[tuple[Path, tuple[str, ...], PurePosixPath]]:
    """For each version: the folder of all groups, the files of a group whose texts are its quota and period, and the
    path of this process's group in that folder."""
    # Lines of the file are NUMBER:CONTROLLERS:PATH, without controllers for version 2. In a container, the path may be
    # that of the host, which the container does not see; then its own group is the folder itself.
    path = {"": "/", "cpu": "/"}
    try:
        lines = MEMBERSHIP.read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        controllers, _, group = line.partition(":")[2].partition(":")
        path |= {controller: group for controller in controllers.split(",") if controller in path}
    inside = {controller: PurePosixPath(group.lstrip("/")) for controller, group in path.items() if ".." not in group}
    yield CGROUP, ("cpu.max",), inside.get("", PurePosixPath())
    yield CGROUP / "cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us"), inside.get("cpu", PurePosixPath())


DEVICES = Path("/dev")
"""Folder with a file `nvidiaN` for each NVIDIA GPU that this process may use."""


def places(environment: Mapping[str, str], share: float) -> tuple[str, ...]:
    """What CUDA_VISIBLE_DEVICES must be for each worker for which this machine's GPUs have room.

    Args:
        environment: that of this process. The GPUs are those that its CUDA_VISIBLE_DEVICES names, or else all.
        share: number of GPUs of each worker, or its share of one.

    Returns:
        One text for each worker; of workers that share a GPU the same text. Empty if there is no GPU.
    """
    gpus = _gpus(environment)
    if share < 1:
        return tuple(gpu for gpu in gpus for _ in range(int(1 / share)))
    each = int(share)
    return tuple(",".join(gpus[first : first + each]) for first in range(0, len(gpus) - each + 1, each))


def _gpus(environment: Mapping[str, str]) -> list[str]:
    """The GPUs' names for CUDA_VISIBLE_DEVICES."""
    if (named := environment.get("CUDA_VISIBLE_DEVICES")) is None:
        return [str(index) for index, _ in enumerate(DEVICES.glob("nvidia[0-9]*"))]
    gpus: list[str] = []
    for name in map(str.strip, named.split(",")):
        if name in ("", "-1"):  # CUDA ignores this name and all that follow
            break
        gpus.append(name)
    return gpus
