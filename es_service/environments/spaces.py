"""What the single and the vector environment of a task share: spaces, seeds, and what `info` has."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box

from es_service.protocol.messages import TaskSpec
from workers.lanes import Seen


def observation_space(task: TaskSpec) -> Box:
    """Observations have no bounds."""
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def action_space(task: TaskSpec) -> Box:
    """Each number of an action is from -1 to 1."""
    return Box(-1.0, 1.0, (task.action_size,), np.float32)


def info_of(task: TaskSpec, seen: Seen) -> dict[str, Any]:
    """The entries of `info`, with the axes of what is seen."""
    distance = {"goal_distance": seen.goal_distance} if task.has_goal else {}
    return {"descriptor": seen.descriptor, "success": seen.success} | distance


def seed_given(seed: int) -> int:
    """A seed that a caller gives. Raises ValueError if it is negative or has more than 63 bits."""
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed = {seed}; must be from 0 to 2**63 - 1")
    return seed


def random_seed() -> int:
    """A seed for an environment that was given none."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(1))
