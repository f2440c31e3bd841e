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

from es_service.dispatch.ray_cluster import knock
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


def require_head(address: str, *, is_auto: bool = False) -> None:
    """Raise EvaluationError unless the head of a Ray cluster is at HOST:PORT and accepts the token of this host.

    Ray itself would try for up to a minute, and not say which of these it is.

    Args:
        is_auto: whether the address was found and not given: then Ray uses a token also if RAY_AUTH_MODE is not set.
    """
    grpc = _grpc()
    if reason := _why_no_connection(grpc, address):
        raise EvaluationError(
            f"no Ray cluster answers at {address} ({reason}). Give the address of its head, HOST:PORT (usually port "
            "6379), or auto on a machine of the cluster",
            field="cluster",
            value=address,
        )
    code, token = _code(grpc, address, HEAD_CALL), _token(is_auto)
    if code == grpc.StatusCode.UNAUTHENTICATED and token is not None:
        code = _code(grpc, address, HEAD_CALL, token)
    if code == grpc.StatusCode.UNAUTHENTICATED:
        problem = "needs a token, and this host has none" if token is None else "refuses the token of this host"
        raise EvaluationError(
            f"the Ray cluster at {address} {problem}. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to the token of the "
            "cluster",
            field="cluster",
            value=address,
        )
    if code is not None:
        raise EvaluationError(
            f"the server at {address} does not answer as the head of a Ray cluster does ({code.name}). Give the port "
            "with which its head was started, usually 6379",
            field="cluster",
            value=address,
        )


def open_ports(calls: Sequence[tuple[str, str]]) -> list[bool]:
    """For each (HOST:PORT, call): whether that port answers the call although it has no token.

    A port that refuses the call is not open, nor is one that cannot be reached from here.
    """
    grpc = _grpc()
    with ThreadPoolExecutor(CALLS_AT_ONCE) as threads:
        codes = threads.map(lambda one: _code(grpc, *one), calls)
        return [code is None for code in codes]


def _why_no_connection(grpc: Any, address: str) -> str:
    """Why no gRPC server can be reached at an address; empty if one can."""
    try:
        knock(address)
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    with _channel(grpc, address) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=CALL_S)
        except grpc.FutureTimeoutError:
            tls = "this host uses TLS, so the cluster must" if uses_tls() else "if the cluster uses TLS, this host must"
            return f"the port is open, but gives no answer within {CALL_S:g} s; {tls}, too"
    return ""


def _code(grpc: Any, target: str, call: str, token: str | None = None) -> Any:
    """Status code with which a call with an empty message fails; None if it is answered."""
    metadata = None if token is None else [("authorization", f"Bearer {token}")]
    with _channel(grpc, target) as channel:
        try:
            channel.unary_unary(call)(b"", timeout=CALL_S, metadata=metadata)
        except grpc.RpcError as error:
            return error.code()
    return None


def _token(is_auto: bool) -> str | None:
    """The token that Ray sends from this host; None if it sends none."""
    if os.environ.get("RAY_AUTH_MODE", "token" if is_auto else "").lower() != "token":
        return None
    if token := os.environ.get("RAY_AUTH_TOKEN"):
        return token.strip()
    try:
        return Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or "~/.ray/auth_token").expanduser().read_text().strip()
    except OSError:
        return None


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
