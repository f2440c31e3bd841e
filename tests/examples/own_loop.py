"""Ask and tell with a loop of one's own over a vector environment of Gymnasium.

python tests/examples/own_loop.py FOLDER
"""

import sys

import gymnasium
import numpy as np

from es_service import ask_tell

STEPS = 200
CONFIG = {
    "task": {
        "environment": "caller",
        "options": {"observation_size": 3, "action_size": 1, "descriptor_size": 2, "episode_steps": STEPS},
    },
    "policy": {"hidden": [16], "observation_normalization": False},
    "search": {"algorithm": "es", "pairs": 16, "sigma": 0.1, "evaluation_episodes": 4},
    "map": {"bounds": [[-1, 1], [-1, 1]], "cells": [8, 8]},
    "budget": {"generations": 5},
}


def episodes(asked):
    """Return and last direction of the pendulum in an episode of each policy, all side by side."""
    envs = gymnasium.make_vec("Pendulum-v1", num_envs=len(asked), vectorization_mode="sync")
    observation, _ = envs.reset(seed=asked.seed.tolist())
    returns = np.zeros(len(asked))
    for step in range(STEPS):
        if step == STEPS - 1:
            last = observation[:, :2]
        observation, reward, *_ = envs.step(2.0 * np.clip(asked.act(observation, step), -1.0, 1.0))
        returns += reward
    envs.close()
    return returns, last


def search(folder):
    """The run, in `folder`; a call that was interrupted goes on."""
    with ask_tell(CONFIG, folder) as asking:
        while (asked := asking.ask()) is not None:
            asking.tell(asked, *episodes(asked), steps=np.full(len(asked), STEPS))
        return asking.run


if __name__ == "__main__":
    print(search(sys.argv[1]).history[["best_fitness", "centre_return_mean"]])
