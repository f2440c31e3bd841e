"""Whether the head of a Ray cluster is at an address and accepts this process, which Ray itself takes a minute to say.

If this host uses TLS, the calls do so, too, because Ray accepts only the certificates of its own authority then.
"""

from __future__ import annotations

import importlib
import os
import socket
from pathlib import Path
from typing import Any

from es_service.errors import StartError, WayOut
from es_service.protocol.machine import given_path

HEAD_CALL = "/ray.rpc.NodeInfoGcsService/CheckAlive"
"""A call of Ray's protocol to its head that changes nothing and takes an empty message."""
CONNECT_S = 3.0
"""Longest time in seconds to connect to a port; a lost packet is sent again after one second."""
CALL_S = 4.0
"""Longest wait for an answer, in seconds."""


def uses_tls() -> bool:
    """Whether Ray uses TLS on this host."""
    return os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true")


def require_head(address: str, *, is_auto: bool = False) -> None:
    """Raise StartError unless the head of a Ray cluster is at HOST:PORT and accepts the token of this process.

    Args:
        is_auto: whether the address was found and not given: then Ray uses a token also if RAY_AUTH_MODE is not set.
    """
    grpc = grpc_module()
    problem = _why_no_connection(grpc, address) or _why_refused(grpc, address, is_auto)
    if problem:
        text = f"could not connect to a Ray cluster at {address}: {problem}"
        raise StartError(text, field="compute.address", value=address)


def status_code(grpc: Any, target: str, call: str, token: str | None = None) -> Any:
    """Status code with which a call with an empty message fails; None if it is answered."""
    metadata = None if token is None else [("authorization", f"Bearer {token}")]
    with _channel(grpc, target) as channel:
        try:
            channel.unary_unary(call)(b"", timeout=CALL_S, metadata=metadata)
        except grpc.RpcError as error:
            return error.code()
    return None


def grpc_module() -> Any:
    """The module `grpc`, which the extra installs."""
    try:
        return importlib.import_module("grpc")
    except ImportError as error:
        ways_out = [WayOut("install", "install it", extra="cluster")]
        raise StartError(f"checks of a cluster need the extra `cluster` ({error})", ways_out=ways_out) from error


def _why_no_connection(grpc: Any, address: str) -> str:
    """Why no gRPC server can be reached at an address; empty if one can."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdecimal() or "://" in host:
        return "an address is HOST:PORT, or auto on a machine of the cluster"
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
    except (OSError, OverflowError) as error:  # a port above 65535 overflows
        return (
            f"nothing listens at that address ({getattr(error, 'strerror', None) or error}). Give the address of "
            "its head, HOST:PORT (usually port 6379), or auto on a machine of the cluster"
        )
    with _channel(grpc, address) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=CALL_S)
        except grpc.FutureTimeoutError:
            tls = "this host uses TLS, so the cluster must" if uses_tls() else "if the cluster uses TLS, this host must"
            return f"its port is open, but gives no answer within {CALL_S:g} s; {tls}, too"
    return ""


def _why_refused(grpc: Any, address: str, is_auto: bool) -> str:
    """Why the server at an address accepts no call of this process; empty if it does."""
    code, (token, source) = status_code(grpc, address, HEAD_CALL), _token(is_auto)
    asks = code == grpc.StatusCode.UNAUTHENTICATED
    if asks and token is None:
        return (
            f"the cluster asks for a token, and {source}. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to the token of "
            "the cluster"
        )
    if asks:
        code = status_code(grpc, address, HEAD_CALL, token)
    if code == grpc.StatusCode.UNAUTHENTICATED:
        return f"the token in {source} is not the cluster's. Set RAY_AUTH_TOKEN to the token of the cluster"
    if code is not None:
        return (
            f"the server there does not answer as the head of a Ray cluster does ({code.name}). Give the port with "
            "which its head was started, usually 6379"
        )
    if not asks and _mode() == "token":
        return (
            "the cluster uses no token, but RAY_AUTH_MODE=token is set here, with which no worker would start there. "
            "Unset RAY_AUTH_MODE, or start the cluster with a token, which is safer"
        )
    return ""


def _mode(default: str = "") -> str:
    return os.environ.get("RAY_AUTH_MODE", default).lower()


def _token(is_auto: bool) -> tuple[str | None, str]:
    """The token that Ray sends from this process, and where it is from; or None, and why it sends none."""
    given = os.environ.get("RAY_AUTH_TOKEN")
    if _mode("token" if is_auto else "") != "token":
        return (
            None,
            f"this process sends {'that in RAY_AUTH_TOKEN only if RAY_AUTH_MODE is token' if given else 'none'}",
        )
    if given:
        return given.strip(), "RAY_AUTH_TOKEN"
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or "~/.ray/auth_token"
    try:
        return given_path(path).read_text().strip(), path
    except OSError:
        return None, f"there is none in RAY_AUTH_TOKEN or {path}"


def _channel(grpc: Any, target: str) -> Any:
    if not uses_tls():
        return grpc.insecure_channel(target)
    names = ("RAY_TLS_CA_CERT", "RAY_TLS_SERVER_KEY", "RAY_TLS_SERVER_CERT")
    try:
        read = [Path(os.environ[name]).read_bytes() for name in names]
    except (KeyError, OSError) as error:
        raise StartError(
            f"RAY_USE_TLS is set, so {', '.join(names)} must name the files of certificates ({error})"
        ) from error
    return grpc.secure_channel(target, grpc.ssl_channel_credentials(*read))
