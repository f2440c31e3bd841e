"""The platform of a run: package versions and kind of processor, on which its bits depend besides its config.

The driver and the workers each have a platform; a worker in a cluster reports its own when it has started.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from importlib import metadata
from typing import Any

from es_service.protocol.system import architecture, processor_fields

VERSION = "0.27.0"
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
    """A recorded platform without the hashes of the code."""
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
