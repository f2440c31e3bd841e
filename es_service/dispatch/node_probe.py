"""What a node of a Ray cluster says about its software, for `cluster_findings`.

Ray sends this module's function itself to each node, so that it also runs where es-service is missing or has another
version. It returns plain data.
"""

from __future__ import annotations

import importlib
import platform
from typing import Any

ANY_TASK = "point_maze"
"""A shipped task: the sources of a shipped task are those of every worker."""


def software() -> dict[str, Any]:
    """Versions by name, hashes of the sources of workers, and why es-service cannot be used here, or ""."""
    versions = {"ray": importlib.import_module("ray").__version__, "python": platform.python_version()}
    sources: dict[str, str] = {}
    problem = ""
    try:
        from es_service.protocol.machine import platform_info

        versions |= platform_info()
        from es_service.protocol.sources import worker_sources

        sources = worker_sources(ANY_TASK)
    except Exception as error:  # no es-service, an old one, or a file that cannot be imported
        problem = f"{type(error).__name__}: {error}"
    return {"versions": versions, "sources": sources, "problem": problem}
