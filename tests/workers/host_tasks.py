"""Tasks of Python objects for tests: PointMaze from the corner, as another rollout computes it, and small ones."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from es_service.protocol.options import Option
from tests.references import point_maze


class CornerMaze:
    """a point must reach a goal in a square; it starts in a corner"""

    observation_size = action_size = 2
    episode_steps = 200
    descriptor_names, descriptor_bounds = ("x", "y"), ((-1.0, 1.0), (-1.0, 1.0))
    final_fitness = True
    least_reward = -2.3431

    def __init__(self):
        self.place, self.distance, self.reached = (0.9, -0.9), 0.0, False

    def reset(self, seed):
        self.__init__()
        return self.place

    def step(self, action):
        x, y, reward, self.reached = point_maze.step(*self.place, tuple(map(float, action)))
        self.place, self.distance = (x, y), -reward
        return self.place, reward, self.reached

    def descriptor(self):
        return self.place

    def goal_distance(self):
        return self.distance

    def success(self):
        """The point is in the goal square."""
        return self.reached


class Drift:
    """A point on a line is to come near 0; its start depends on the seed, and its episode ends where it leaves."""

    observation_size, action_size, episode_steps = 3, 1, 40
    action_bounds = (-0.5, 1.5)
    descriptor_names, descriptor_bounds = ("place",), ((-3.0, 3.0),)
    options = {"wind": Option(0.05, low=0.0)}  # noqa: RUF012

    def __init__(self, wind=0.05):
        self.wind = wind

    def reset(self, seed):
        self.random = np.random.default_rng(seed)
        self.place, self.steps = self.random.normal(), 0
        return self.look(), {"why": "a pair, as Gymnasium returns"}

    def look(self):
        return np.array([self.place, self.place**2, self.steps])

    def step(self, action):
        assert -0.5 <= action[0] <= 1.5
        self.place += 0.3 * float(action[0]) - self.wind + 0.05 * self.random.normal()
        self.steps += 1
        return self.look(), -abs(self.place), abs(self.place) > 3.0, False, {"is_success": abs(self.place) < 0.1}

    def descriptor(self):
        return [self.place]


class Loud(Drift):
    """A drift that prints in each step, as code in C and a program beside it would."""

    def step(self, action):
        os.write(1, b"joint limit reached\n" * 500)
        os.write(2, b"step %d is done\n" % self.steps)
        return super().step(action)


class Leaky(Drift):
    """A drift that takes more memory in each episode and gives none back, and prints in colour."""

    leaked: list[bytearray] = []  # noqa: RUF012

    def reset(self, seed):
        os.write(1, b"\x1b[31mreset with %d\x1b[0m\n" % seed)
        self.leaked.append(bytearray(os.urandom(2**20)))
        return super().reset(seed)


class Slow(Drift):
    """A drift whose first step in a worker that finds a file with this process's kind of fault has that fault."""

    def step(self, action):
        if sys.argv[0].endswith("describe.py"):  # a task is described before there are workers
            return super().step(action)
        fault = Path(os.environ["HOST_FAULT"])
        try:
            kind = fault.read_text()
            fault.unlink()  # only one worker finds it
        except FileNotFoundError:
            kind = ""
        if kind.startswith("hang"):
            sleeper = subprocess.Popen(["sleep", "1000"])  # a process of the simulator's own
            Path(os.environ["HOST_FAULT"] + "_process").write_text(str(sleeper.pid))
            time.sleep(1000.0)
        elif kind == "exit":
            os._exit(7)
        elif kind == "leak":  # until the memory monitor of its node ends it
            leaked = []
            for _ in range(64):
                leaked.append(bytearray(os.urandom(2**20) * 128))
                time.sleep(0.05)
            time.sleep(1000.0)
        elif kind:
            raise ValueError(kind)
        return super().step(action)


class Fragile(Drift):
    """A drift that cannot do the fifth step."""

    def step(self, action):
        if self.steps == 4:
            raise ValueError("the fifth step cannot be done")
        return super().step(action)


class Narrow(Drift):
    """A drift that refuses actions above 0.5."""

    def step(self, action):
        if action[0] > 0.5:
            raise ValueError("the action is too large")
        return super().step(action)


class Undefined(Drift):
    """A drift whose fifth reward is no number, where the place is below 0."""

    def step(self, action):
        seen, reward, *ends = super().step(action)
        return seen, float("nan") if self.steps == 5 and self.place < 0.0 else reward, *ends


class Deadly(Drift):
    """A drift that ends its process in the fourth step, and says why."""

    def step(self, action):
        if self.steps == 3:
            os.write(1, b"the licence has expired\n")
            os._exit(9)
        return super().step(action)


class Wordless(Drift):
    """A drift whose reward was forgotten."""

    def step(self, action):
        seen, _, *ends = super().step(action)
        return seen, None if self.steps == 7 else 0.0, *ends


class Forgetful(Drift):
    """A drift whose seed is not all that it depends on: it goes on with the random numbers of the episode before."""

    def reset(self, seed):
        before = getattr(self, "random", None)
        seen, info = super().reset(seed)
        if before is not None:
            self.random = before
        return seen, info
