"""Tasks: what each is (plain data, read by the driver) and how it is made (imported only where rollouts run)."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from es_service.protocol.messages import TaskSpec


class TaskError(Exception):
    """A task that cannot be had; the message says why."""


ANT_CLEARANCE = 0.65
"""Half a wall and the torso's radius, less the tenth of a metre that a wall may give way."""

SHIPPED: Mapping[str, TaskSpec] = {
    "point_maze": TaskSpec(
        name="point_maze",
        observation_size=2,
        action_size=2,
        episode_steps=200,
        descriptor_names=("x", "y"),
        descriptor_bounds=((-1.0, 1.0), (-1.0, 1.0)),
        final_fitness=True,
        has_goal=True,
        options={"start": ("default", "corner")},
        walls=(((-0.5, -0.495), (1.0, -0.495)), ((-1.0, 0.205), (0.5, 0.205))),
        least_reward=-2.3431,  # from the corner (1, -1)
        summary="a point crosses a square behind two walls; the straight way to the goal is blocked twice",
    ),
    "ant_maze": TaskSpec(
        name="ant_maze",
        observation_size=29,
        action_size=8,
        episode_steps=3000,
        descriptor_names=("x", "y"),
        descriptor_bounds=((-35.0, 40.0), (-35.0, 40.0)),
        final_fitness=True,
        has_goal=True,
        walls=(
            ((-35.0, -35.0), (40.0, -35.0)),
            ((-35.0, 40.0), (40.0, 40.0)),
            ((-35.0, -35.0), (-35.0, 40.0)),
            ((40.0, -35.0), (40.0, 40.0)),
            ((-15.0, 3.0), (-15.0, 37.0)),
            ((-16.0, -15.0), (10.0, -15.0)),
            ((10.0, -35.0), (10.0, 0.0)),
        ),
        wall_clearance=ANT_CLEARANCE,
        least_reward=-95.6,  # from the corner (-35, 40)
        summary="an ant must go round three walls to a goal 60 m away; the straight way ends in a pocket",
    ),
    "ant_trap": TaskSpec(
        name="ant_trap",
        observation_size=113,
        action_size=8,
        episode_steps=1000,
        descriptor_names=("x", "y"),
        descriptor_bounds=((0.0, 30.0), (-8.0, 8.0)),
        final_fitness=False,
        has_goal=False,
        walls=(((12.0, -2.0), (12.0, 2.0)), ((7.0, 3.0), (12.0, 3.0)), ((7.0, -3.0), (12.0, -3.0))),
        wall_clearance=ANT_CLEARANCE,
        least_reward=-3.38,  # QDax's figure for an episode's mean, not a bound for this ant
        summary="an ant is rewarded for running straight into a trap; far ahead is only behind it",
    ),
}
"""Our own tasks by name. A test holds each entry against what its module does."""


@dataclass(frozen=True)
class Environment:
    """A task as pure functions of one environment's state; rollouts vmap and compile them.

    A state is any pytree of arrays. Nothing here knows of episodes, time limits, policies or statistics.
    """

    reset: Callable[[Any], Any]
    """Stream key (uint32 [4]) -> state."""
    observe: Callable[[Any], Any]
    """State -> observation [O], float32."""
    step: Callable[[Any, Any], tuple[Any, Any, Any]]
    """(state, action [A]) -> (next state, reward, done). The action may leave [-1, 1]; the task clips it."""
    descriptor: Callable[[Any], Any]
    """State -> descriptor [B] of an episode that ends here."""
    goal_distance: Callable[[Any], Any]
    """State -> distance to the goal, NaN where the task has none."""


def make_environment(name: str, options: Mapping[str, str]) -> Environment:
    """The functions of a named task; imports its module, and with it JAX and any physics engine it needs.

    Args:
        name: one of SHIPPED, `brax:NAME`, or `package.module:Class`. Raises TaskError if that cannot be had.
    """
    prefix, colon, rest = name.partition(":")
    if not colon:
        return importlib.import_module(f"workers.environments.{name}").make(**options)
    if prefix == "brax":
        from workers.environments import brax_task

        return brax_task.make(rest, **options)
    from workers.environments import user_task

    return user_task.make(name, options)


def describe_environment(name: str) -> TaskSpec:
    """What the driver must know of `brax:NAME` or `package.module:Class`, which only its module can tell.

    Imports JAX. Raises TaskError as `make_environment`.
    """
    prefix, _, rest = name.partition(":")
    if prefix == "brax":
        from workers.environments import brax_task

        return brax_task.describe(rest)
    from workers.environments import user_task

    return user_task.describe(name)
