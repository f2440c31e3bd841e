"""A class in JAX whose methods change from trace to trace is refused, and the method is named."""

from __future__ import annotations

import itertools
import json

import jax
import numpy as np
import pytest

from workers import describe
from workers.environments import TaskError, user_task
from workers.step_checks import require_pure

calls = itertools.count()


class Still:
    """a point stays where it is"""

    observation_size = action_size = 1
    episode_steps = 3
    descriptor_names, descriptor_bounds = ("x",), ((0.0, 1.0),)

    def __init__(self):
        self.table = np.random.default_rng(0).normal(size=3)
        self.count = 0

    def reset(self, key):
        return jax.random.uniform(jax.random.wrap_key_data(key[:2]), (1,))

    def observe(self, state):
        return state

    def step(self, state, action):
        return state + self.table.sum(), state[0], False

    def descriptor(self, state):
        return state


class Noisy(Still):
    def step(self, state, action):
        return state + np.random.default_rng().normal(), state[0], False


class Counting(Still):
    def step(self, state, action):
        self.count += 1
        return state, state[0] * self.count, False


class Born(Still):
    def __init__(self):
        super().__init__()
        self.place = np.random.default_rng().normal(size=1).astype(np.float32)

    def observe(self, state):
        return state - self.place


@jax.jit
def jump(state):
    return state + next(calls)


class Jumping(Still):
    def reset(self, key):
        return jump(super().reset(key))


class Storing(Still):
    stored = None

    def step(self, state, action):
        self.stored = state if self.stored is None else self.stored
        return self.stored, state[0], False


class Measuring(Still):
    metric_names = ("luck",)

    def metrics(self, state):
        return np.random.default_rng().normal(size=1).astype(np.float32)


class Once(Still):
    def step(self, state, action):
        if self.count:
            raise ValueError("it has begun already")
        self.count = 1
        return state, state[0], False


def name_of(kind):
    return f"{__name__}:{kind.__name__}"


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        (Noisy, "step is not a pure function, since it computes something else when JAX traces it again, as"),
        (Counting, "step is not a pure function, since it computes something else when JAX traces it again, as"),
        (Born, "observe is not a pure function, since .* again in another object, as"),
        (Jumping, "reset is not a pure function, since .* again in another object, as"),
        (Storing, "step is not a pure function, since it computes something else when JAX traces it again, as"),
        (Measuring, "metrics is not a pure function, since it computes something else when JAX traces it again, as"),
        (Once, "cannot be traced by JAX again: ValueError: it has begun already"),
    ],
)
def test_a_method_that_changes_is_named(kind, what):
    with pytest.raises(TaskError, match=f"^{name_of(kind)}:? {what}"):
        require_pure(user_task.describe(name_of(kind)), {})


@pytest.mark.slow
def test_what_never_changes_is_described_and_what_does_is_a_problem():
    same, other = (json.loads(describe.descriptions(name_of(kind), {})("task")) for kind in (Still, Noisy))
    assert same["task"]["name"] == name_of(Still)
    assert other["problem"].startswith(f"{name_of(Noisy)}: step is not a pure function")
