"""Platform of a worker with a GPU."""

from __future__ import annotations

from es_service.protocol.machine import platform_info, platform_text
from es_service.protocol.process_environment import on_gpu
from workers.rollouts import BACKENDS


def platform_of_gpu(rollout: str) -> str:
    """`machine.platform_text` with the kind of GPU, if this process has been given one; else empty."""
    if not on_gpu():
        return ""
    return platform_text(platform_info() | {"device": BACKENDS[rollout].device()})
