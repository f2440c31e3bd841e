"""A task in plain Python: a lander falls towards the ground, and its two engines decide where and how it lands.

es-service run my_config.yaml --set task.environment=python:lander:Lander
"""

from __future__ import annotations

import random


class Lander:
    """a lander is to touch the ground slowly; the places and the times of its landings are the map"""

    observation_size, action_size, episode_steps = 4, 2, 150
    action_bounds = ((-1.0, 1.0), (0.0, 2.0))  # to the side, and up
    descriptor_names, descriptor_bounds = ("place", "time"), ((-3.0, 3.0), (0.0, 15.0))
    step_s = 0.1

    def reset(self, seed):
        chance = random.Random(seed)
        self.x, self.y = chance.uniform(-0.1, 0.1), 3.0
        self.vx, self.vy, self.time = chance.uniform(-0.2, 0.2), 0.0, 0.0
        return self.x, self.y, self.vx, self.vy

    def step(self, action):
        side, up = map(float, action)
        self.vx += self.step_s * side
        self.vy += self.step_s * (up - 1.0)  # gravity is 1
        self.x += self.step_s * self.vx
        self.y += self.step_s * self.vy
        self.time += self.step_s
        landed = self.y <= 0.0
        reward = -0.01 * (abs(side) + up) - (abs(self.vx) + abs(self.vy) if landed else 0.0)
        return (self.x, self.y, self.vx, self.vy), reward, landed

    def descriptor(self):
        return self.x, self.time

    def success(self):
        """it has touched the ground with less than half a metre a second"""
        return self.y <= 0.0 and abs(self.vx) + abs(self.vy) < 0.5
