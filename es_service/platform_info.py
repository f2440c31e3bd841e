"""What a run's bits depend on besides its config: package versions and the kind of processor."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

PACKAGES = ("es-service", "jax", "jaxlib", "numpy", "brax", "mujoco", "mujoco-mjx", "llvmlite")
"""Packages whose version can change a bit of a result."""


def platform_info() -> dict[str, str]:
    """Versions and CPU kind of this machine; the same text wherever results repeat bit for bit."""
    versions = {name: metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **versions, "cpu": cpu_kind()}


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
