"""Number of cores that this process may use, by its CPU affinity and the quota of its container."""

from __future__ import annotations

import os
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")
"""Path of a container's control group inside the container."""


def cores() -> int:
    """Cores in this process's CPU affinity, or the quota of its container (`docker run --cpus`), rounded up, if that is
    less."""
    usable = len(os.sched_getaffinity(0))
    quota, period = _quota()
    return min(usable, -(-quota // period)) if quota > 0 and period > 0 else usable


def _quota() -> tuple[int, int]:
    """(microseconds of core time allowed per period, microseconds of a period); without a limit, the first is not
    positive."""
    try:
        if (version_2 := CGROUP / "cpu.max").exists():
            quota, period = version_2.read_text().split()
        else:
            quota, period = ((CGROUP / "cpu" / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return int(quota), int(period)  # without a limit, the quota is -1 in version 1 and "max" in version 2
    except (OSError, ValueError):
        return 0, 0
