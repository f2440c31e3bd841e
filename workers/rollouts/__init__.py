"""The rollouts by name. Importing them imports neither JAX nor a compiler, so the driver may ask what they declare."""

from __future__ import annotations

from workers.rollouts.asked import Asked
from workers.rollouts.backend import RolloutBackend
from workers.rollouts.host import Host
from workers.rollouts.simd import Simd
from workers.rollouts.xla import Xla

BACKENDS: dict[str, RolloutBackend] = {rollout.name: rollout for rollout in (Asked(), Host(), Xla(), Simd())}
"""Name, as in `compute.rollout` -> rollout, from the slowest to the fastest. `protocol.rollouts.choose` is what `auto`
means."""
