"""What a run's bits depend on besides its config: package versions and the kind of processor.

The driver's and the workers': a worker of a cluster says what it is when it has come up.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Collection, Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

VERSION = "0.6.0"
"""Of es-service itself: of the code that runs. What an editable installation says of it is as old as its last `pip
install`."""
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "brax", "mujoco", "mujoco-mjx", "llvmlite")
"""Others whose version can change a bit of a result."""


def platform_info() -> dict[str, str]:
    """Versions and CPU kind of this machine; the same text wherever results repeat bit for bit."""
    versions = {name: metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), "es-service": VERSION, **versions, "cpu": cpu_kind()}


def platform_text(info: Mapping[str, Any]) -> str:
    """One text for equal platforms."""
    return json.dumps(info, sort_keys=True)


def computed_on(driver: Mapping[str, Any], workers: Collection[str]) -> dict[str, Any]:
    """What a generation was computed on: the driver's platform, and those of the workers unless all are like it.

    Args:
        workers: `platform_text` of each kind of worker there has been.
    """
    if set(workers) <= {platform_text(driver)}:
        return dict(driver)
    return {**driver, "workers": [json.loads(text) for text in sorted(workers)]}


def is_mixed(platforms: Iterable[Mapping[str, Any]]) -> bool:
    """Whether generations were computed on more than one platform, or one of them by workers of more than one."""
    found = list(platforms)
    return len({platform_text(one) for one in found}) > 1 or any(len(one.get("workers", ())) > 1 for one in found)


def cpu_kind() -> str:
    """Vendor, family, model and widest vectors of the first processor, such as `AuthenticAMD 26/2 avx512f`."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n", 1)[0].splitlines()
    except OSError:
        return platform.machine()
    fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = fields.get("flags", "").split()
    vectors = next((flag for flag in ("avx512f", "avx2", "avx", "sse2") if flag in flags), platform.machine())
    return f"{fields.get('vendor_id', '?')} {fields.get('cpu family', '?')}/{fields.get('model', '?')} {vectors}"
