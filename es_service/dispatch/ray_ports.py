"""Calls to the ports of a Ray cluster as a stranger makes them, without a token."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from es_service.dispatch.ray_head import grpc_module, status_code

NODE_CALL = "/ray.rpc.NodeManagerService/GetSystemConfig"
"""A call of Ray's protocol to each node that changes nothing and takes an empty message."""
CALLS_AT_ONCE = 32


def open_ports(calls: Sequence[tuple[str, str]]) -> list[bool]:
    """For each (HOST:PORT, call): whether that port answers the call although it has no token.

    A port that refuses the call is not open, nor is one that cannot be reached from here.
    """
    grpc = grpc_module()
    with ThreadPoolExecutor(CALLS_AT_ONCE) as threads:
        codes = threads.map(lambda one: status_code(grpc, *one), calls)
        return [code is None for code in codes]
