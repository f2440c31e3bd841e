"""The rollouts by name. Importing them imports neither JAX nor a compiler, so the driver may ask what they declare."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from es_service.protocol.machine import platform_info, platform_text
from es_service.protocol.messages import WorkerSpec
from es_service.protocol.process_environment import on_gpu
from es_service.protocol.recordings import Recordings, RecordRequest
from workers.compiling import xla_cache_settings
from workers.rollouts.asked import AskedRollout
from workers.rollouts.backend import RolloutBackend
from workers.rollouts.host import Host
from workers.rollouts.simd import Simd
from workers.rollouts.xla import Xla

BACKENDS: dict[str, RolloutBackend] = {rollout.name: rollout for rollout in (AskedRollout(), Host(), Xla(), Simd())}
"""Name, as in `compute.rollout` -> rollout, from the slowest to the fastest. `protocol.rollouts.choose` is what `auto`
means."""


def platform_of_gpu(rollout: str) -> str:
    """`machine.platform_text` with the kind of GPU, if this process has been given one; else empty."""
    if not on_gpu():
        return ""
    return platform_text(platform_info() | {"device": BACKENDS[rollout].device()})


def recorder(name: str, spec: WorkerSpec) -> Callable[[Sequence[RecordRequest]], Recordings]:
    """Function that records evaluation episodes for replays with the run's rollout, so that they have its bits; for a
    process of its own, since most rollouts import JAX.

    Args:
        name: that of the task.
    """
    os.environ.update(xla_cache_settings())
    return lambda requests: BACKENDS[spec.rollout].record(spec, requests)
