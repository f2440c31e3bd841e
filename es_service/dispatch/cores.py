"""How many cores this process may use: what a container's quota leaves of those it may run on."""

from __future__ import annotations

import os
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")
"""The control group of a container, as it is seen inside."""


def cores() -> int:
    """Cores by affinity, or fewer where a quota (`docker run --cpus`) allows less time than theirs; a part of one
    counts as one."""
    usable = len(os.sched_getaffinity(0))
    quota, period = _quota()
    return min(usable, -(-quota // period)) if quota > 0 and period > 0 else usable


def _quota() -> tuple[int, int]:
    """(microseconds of one core, within how many); (0, 0) if there is no limit."""
    try:
        if (version_2 := CGROUP / "cpu.max").exists():
            quota, period = version_2.read_text().split()
        else:
            quota, period = ((CGROUP / "cpu" / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return int(quota), int(period)  # version 1 has -1 for no limit, version 2 max
    except (OSError, ValueError):
        return 0, 0
