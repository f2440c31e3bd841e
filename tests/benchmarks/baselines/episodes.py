"""Certification episodes of any policy: those of `es_service.certify`, for networks that are not ours.

Axes: E episodes, O observation, A action.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import Domain, evaluation_reset_keys
from es_service.runs.certification import EPISODES, OTHER_PROGRAMS
from es_service.runs.selection import StoredEpisodes
from workers.lanes import Lanes

Policy = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Function from observations [E, O] to actions [E, A]."""


def certification_episodes(
    policy: Policy, task: str, seed: int, number: int = 0, count: int = EPISODES
) -> StoredEpisodes:
    """Fresh episodes of a policy, with the resets that `es_service.certify` gives a single candidate.

    Args:
        seed: that of the config whose episodes are meant.
        number: number of the certification, as for `certify`.
        count: number of episodes.
    """
    keys_E = evaluation_reset_keys(
        seed, OTHER_PROGRAMS + number, np.arange(count), 0, 0, domain=Domain.CERTIFICATION_RESET
    )
    with closing(Lanes(task, {}, count)) as lanes:
        seen = lanes.reset(np.arange(count), keys_E)
        alive_E = np.ones(count, bool)
        return_E, last_reward_E = np.zeros((2, count))
        distance_E, success_E = np.full(count, np.nan), np.zeros(count, bool)
        steps_E, descriptor_E_B = np.zeros(count, np.int64), np.zeros(seen.descriptor.shape)
        for _ in range(lanes.task.episode_steps):
            if not alive_E.any():
                break
            seen = lanes.step(np.asarray(policy(seen.observation), np.float32))
            return_E[alive_E] += seen.reward[alive_E]
            distance_E[alive_E] = np.fmin(distance_E, seen.goal_distance)[alive_E]
            for kept, now in (
                (last_reward_E, seen.reward),
                (success_E, seen.success),
                (descriptor_E_B, seen.descriptor),
            ):
                kept[alive_E] = now[alive_E]
            steps_E[alive_E] += 1
            alive_E &= ~seen.done
        success = success_E if lanes.task.success else None
    return StoredEpisodes(return_E, last_reward_E, distance_E, success, steps_E, descriptor_E_B)
