"""Small tasks in Python with equal sizes, as other tasks for the policies of each other."""

from __future__ import annotations

import random

from es_service.protocol.options import Option


class Drift:
    """a point is to stay where it is"""

    observation_size, action_size, episode_steps = 2, 2, 20
    options = {"wind": Option(0.0), "observation_scale": Option(1.0), "push": Option(0.1)}  # noqa: RUF012

    def __init__(self, wind=0.0, observation_scale=1.0, push=0.1):
        self.wind, self.scale, self.push = wind, observation_scale, push

    def reset(self, seed):
        chance = random.Random(seed)
        self.place = [chance.uniform(-1.0, 1.0), chance.uniform(-1.0, 1.0)]
        return self._seen()

    def step(self, action):
        self.place = [at + self.push * float(move) + self.wind for at, move in zip(self.place, action, strict=True)]
        return self._seen(), -sum(at * at for at in self.place), False

    def _seen(self):
        return [self.scale * at for at in self.place]


class Slippery(Drift):
    """the same on ice, where the point moves on its own, too"""

    options = {"wind": Option(0.01), "observation_scale": Option(1.0), "push": Option(0.2)}  # noqa: RUF012

    def __init__(self, wind=0.01, observation_scale=1.0, push=0.2):
        super().__init__(wind, observation_scale, push)


class Strong(Drift):
    """the same with stronger actions"""

    action_bounds = (-2.0, 2.0)


class Blind(Drift):
    """the same without the second number of the place"""

    observation_size = 1

    def _seen(self):
        return super()._seen()[:1]


class Fails(Drift):
    """the same until it breaks"""

    tried = 0

    def step(self, action):
        Fails.tried += 1
        if Fails.tried > 100:
            raise ValueError("it broke")
        return super().step(action)
