"""Messages about policies that are evaluated as they are, without noise in parameters or actions: explicit ones, whose
parameters travel, and those that are made of recipes where they are evaluated.

Axes: N policies that travel together, L slots of a chunk, D policy parameters, O observation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import Domain
from es_service.protocol.recipes import Recipes

POLICY_SLOTS = 16
"""Slots of a policy chunk, each of which is one episode of one policy. This is a constant so that the shape that is
compiled never changes."""
POLICIES_TOGETHER = 8 * POLICY_SLOTS
"""Most slots in one call of a kernel: a call costs little then, and the memory of the weights stays small."""


@dataclass(frozen=True)
class Policies:
    """Policies that travel together, once to each worker that runs chunks of them: up to POLICY_SLOTS, or those of
    several chunks that are sent as one."""

    first: int
    """Number of the first of them among the policies of their ask."""
    episodes: int
    """Episodes of each policy."""
    seed: int
    """Seed of the resets. In a run it is the seed of the run."""
    traces: bool
    """Whether the results have the trace of the first episode of each policy."""
    parameters_N_D: NDArray[np.float32] | Recipes
    """Parameters of each policy, or recipes by which they are made."""
    observation_mean_N_O: NDArray[np.float32] | None = None
    observation_std_N_O: NDArray[np.float32] | None = None
    """Observation statistics of each policy; None stands for 0 and 1."""
    domain: Domain = Domain.EVALUATION_RESET
    """Purpose of the episodes, which is part of the addresses of their resets."""


@dataclass(frozen=True)
class PolicyChunk:
    """Request to roll out the policies that it is sent with, from slot `POLICY_SLOTS * part` on.

    Slots count the policies first: slot s is episode s // N of policy s % N, so that one episode of each wastes
    nothing. The last chunk may have fewer slots. The reset of an episode is addressed by seed, generation, episode,
    number of the policy and ask, so neither the chunk nor the number of policies has an influence on it.
    """

    generation: int
    chunk_id: int
    """Number of the chunk among those of its ask."""
    ask: int = 0
    """Index of the policies' ask among those of its generation that are for policies."""
    part: int = 0
    """Number of the chunk among those of the policies that it is sent with."""
    first: int = 0
    count: int = POLICY_SLOTS
    """First wanted slot and number of wanted slots, if this is a piece of a chunk, or several chunks in one
    (`protocol.episodes`)."""
    request: int = 0
    """As of a training chunk."""


def chunks_of(policies: int, episodes: int) -> int:
    """Number of chunks of policies that travel together."""
    return -(-policies * episodes // POLICY_SLOTS)


def slots(policies: Policies, chunk: PolicyChunk) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(index of the policy [L], number of the episode [L]) of each slot of a chunk."""
    count, first = len(policies.parameters_N_D), chunk.part * POLICY_SLOTS + chunk.first
    slot_L = np.arange(first, min(first + chunk.count, count * policies.episodes))
    return slot_L % count, slot_L // count
