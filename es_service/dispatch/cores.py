"""Cores and GPUs of this machine that this process may use: cores by its CPU affinity and the quotas of its control
groups, GPUs as the workers of the engine inline share them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from es_service.protocol.system import usable_cpus

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
