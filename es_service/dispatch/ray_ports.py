"""Calls to the ports of a Ray cluster as a stranger makes them, without a token.

If this host uses TLS, the calls do so, too, because Ray accepts only the certificates of its own authority then.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from es_service.errors import EvaluationError, WayOut

HEAD_CALL = "/ray.rpc.NodeInfoGcsService/CheckAlive"
NODE_CALL = "/ray.rpc.NodeManagerService/GetSystemConfig"
"""Calls of Ray's protocol, to its head and to each node, that change nothing and take an empty message."""
CALL_S = 5.0
"""Longest wait for an answer, in seconds."""
CALLS_AT_ONCE = 32


def uses_tls() -> bool:
    """Whether Ray uses TLS on this host."""
    return os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true")


def require_answer(address: str) -> None:
    """Raise EvaluationError if no gRPC server answers at HOST:PORT. Ray itself would try for more than a minute."""
    grpc = _grpc()
    with _channel(grpc, address) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=CALL_S)
        except grpc.FutureTimeoutError:
            raise EvaluationError(
                f"no Ray cluster answers at {address} within {CALL_S:g} s. Give the address of its head, HOST:PORT "
                "(usually port 6379), or auto on one of its machines. If the cluster uses TLS, set RAY_USE_TLS and the "
                "variables of its certificates here, too",
                field="cluster",
                value=address,
            ) from None


def open_ports(calls: Sequence[tuple[str, str]]) -> list[bool]:
    """For each (HOST:PORT, call): whether that port answers the call although it has no token.

    A port that refuses the call is not open, nor is one that cannot be reached from here.
    """
    grpc = _grpc()

    def is_open(target: str, call: str) -> bool:
        with _channel(grpc, target) as channel:
            try:
                channel.unary_unary(call)(b"", timeout=CALL_S)
            except grpc.RpcError:
                return False
        return True

    with ThreadPoolExecutor(CALLS_AT_ONCE) as threads:
        return list(threads.map(is_open, *zip(*calls, strict=True)))


def _channel(grpc: Any, target: str) -> Any:
    if not uses_tls():
        return grpc.insecure_channel(target)
    names = ("RAY_TLS_CA_CERT", "RAY_TLS_SERVER_KEY", "RAY_TLS_SERVER_CERT")
    try:
        read = [Path(os.environ[name]).read_bytes() for name in names]
    except (KeyError, OSError) as error:
        raise EvaluationError(
            f"RAY_USE_TLS is set, so {', '.join(names)} must name the files of certificates ({error})"
        ) from error
    return grpc.secure_channel(target, grpc.ssl_channel_credentials(*read))


def _grpc() -> Any:
    """The module `grpc`, which the extra installs."""
    try:
        return importlib.import_module("grpc")
    except ImportError as error:
        ways_out = [WayOut("install", "install it", extra="cluster")]
        raise EvaluationError(f"checks of a cluster need the extra `cluster` ({error})", ways_out=ways_out) from error
