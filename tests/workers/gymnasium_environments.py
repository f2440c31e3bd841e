"""Environments that are registered in Gymnasium by the import of this module, and descriptors of their episodes."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces


class Reach(gymnasium.Env):
    """A point in the plane is to come near the place (1, 1); its info has the place only once it has moved."""

    observation_space = spaces.Box(-2.0, 2.0, (2, 1), np.float64)
    action_space = spaces.Box(np.array([[-0.1, 0.0]]), np.array([[0.1, 0.4]]), dtype=np.float64)

    def __init__(self, reach: float = 0.2, limit: int | None = None):
        self.reach, self.limit = reach, limit

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1.0, 0.0, 2), 0
        return self.place.reshape(2, 1), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.place, self.steps = np.clip(self.place + action[0], -2.0, 2.0), self.steps + 1
        distance = float(np.abs(self.place - 1.0).max())
        info = {"is_success": distance < self.reach, "place": self.place.copy()}
        return self.place.reshape(2, 1), -distance, False, self.steps == self.limit, info


class Told(Reach):
    """It has arguments whose defaults are no plain values."""

    def __init__(self, size: int = 2, goal: tuple[float, ...] = (0.5, np.inf), scales: dict | None = None):
        super().__init__(limit=size + 5)
        self.goal, self.scales = goal, scales

    def step(self, action):
        if "here" in self.goal:
            raise TypeError("must be numbers")
        return super().step(action)


class Words(gymnasium.Env):
    """Its observations are words, and its actions pairs."""

    observation_space, action_space = spaces.Text(5), spaces.Discrete(2)


class Pairs(Words):
    """Its actions are pairs."""

    observation_space, action_space = spaces.Discrete(2), spaces.MultiDiscrete([2, 2])


class Unseen(Words):
    """It has nothing to see."""

    observation_space = spaces.Box(0.0, 1.0, (0,))


class Still(Unseen):
    """It has nothing to do."""

    observation_space, action_space = spaces.Discrete(2), spaces.Box(0.0, 1.0, (0,))


class Parts(Reach):
    """Its observation has parts, also inside of others, and its info says by 1.0 that it has arrived."""

    observation_space = spaces.Dict(
        {
            "pose": spaces.Dict({"place": spaces.Box(-2.0, 2.0, (2, 1), np.float64), "far": spaces.MultiBinary(2)}),
            "leg": spaces.Tuple((spaces.Discrete(3, start=5), spaces.Box(0.0, 1.0, (1,)))),
        }
    )

    def _seen(self, place):
        far = (place[:, 0] < -0.5).astype(np.int8)
        return {"pose": {"place": place, "far": far}, "leg": (5 + self.steps % 3, np.array([0.25], np.float32))}

    def reset(self, *, seed=None, options=None):
        place, info = super().reset(seed=seed)
        return self._seen(place), info

    def step(self, action):
        place, reward, terminated, truncated, info = super().step(action)
        return self._seen(place), reward, terminated, truncated, {"arrived": float(info["is_success"])}


gymnasium.register("tests/Parts-v0", Parts, max_episode_steps=25)
gymnasium.register("tests/Unseen-v0", Unseen)
gymnasium.register("tests/Still-v0", Still)
gymnasium.register("tests/Reach-v0", Reach, max_episode_steps=25)
gymnasium.register("tests/Told-v0", Told)
gymnasium.register("tests/Words-v0", Words)
gymnasium.register("tests/Pairs-v0", Pairs)


def turning(episode) -> tuple[float, float]:
    """Sums of all rewards and of all observed places."""
    assert len(episode.observations) == episode.steps + 1
    return sum(episode.rewards), float(np.sum(episode.observations))


turning.descriptor_names = ("rewards", "places")
turning.descriptor_bounds = ((-60.0, 0.0), (-60.0, 60.0))
