"""What a node of a Ray cluster says about itself, for `cluster_facts`.

Ray sends this module's functions themselves to each node, so that they also run where es-service is missing or has
another version. They return plain data, and need only the standard library and psutil, which is part of Ray.
"""

from __future__ import annotations

import http.client
import importlib
import platform
from collections.abc import Collection
from pathlib import Path
from typing import Any

HTTP_S = 5.0
"""Longest wait for an answer to a request, in seconds."""
PATH = "/api/version"
"""A path that needs a token; a few others, such as that of the dashboard's page, need none."""
ANY_TASK = "point_maze"
"""A shipped task: the sources of a shipped task are those of every worker."""


def facts(
    ports: Collection[int], http_calls: Collection[tuple[str, str, int]], file: tuple[str, str] | None
) -> dict[str, Any]:
    """Facts about the node on which this runs.

    Args:
        ports: Ray's ports on this node.
        http_calls: name, host and port of each of Ray's HTTP servers on this node.
        file: path and content of a file that the driver has written.
    """
    return {
        "software": software(),
        "listening": listening(ports),
        "addresses": addresses(),
        "open": [name for name, host, port in http_calls if is_open(host, port)],
        "not_shared": "" if file is None else why_not_shared(*file),
    }


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


def listening(ports: Collection[int]) -> list[tuple[str, int]]:
    """(address, port) of each socket of this host that listens on one of the ports; 0.0.0.0 and :: are all addresses
    of the host."""
    psutil: Any = importlib.import_module("psutil")
    sockets = [one.laddr for one in psutil.net_connections("tcp") if one.status == psutil.CONN_LISTEN]
    return sorted({(one.ip, one.port) for one in sockets if one.port in ports})


def addresses() -> list[str]:
    """The IP addresses of this host."""
    psutil: Any = importlib.import_module("psutil")
    found = [one for many in psutil.net_if_addrs().values() for one in many if one.family != psutil.AF_LINK]
    return sorted({one.address.partition("%")[0] for one in found})  # without the name of the interface


def is_open(host: str, port: int) -> bool:
    """Whether an HTTP server of Ray answers a request that has no token, be it that it does not know the path."""
    connection = http.client.HTTPConnection(host, port, timeout=HTTP_S)
    try:
        connection.request("GET", PATH)
        return connection.getresponse().status not in (http.client.UNAUTHORIZED, http.client.FORBIDDEN)
    except (OSError, http.client.HTTPException):  # nothing answers there
        return False
    finally:
        connection.close()


def why_not_shared(path: str, content: str) -> str:
    """Why a file is not the one that the driver has written; "" if it is."""
    try:
        return "" if Path(path).read_text() == content else "another file is there"
    except (OSError, UnicodeDecodeError) as error:
        return getattr(error, "strerror", None) or str(error)
