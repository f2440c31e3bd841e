"""Mazes of Kheperax 0.2 as tasks, such as `kheperax:standard`: a robot with two wheels, three lasers and two bumpers.

The robot and its maze are Kheperax's own. Its options are those of Kheperax's configuration, with its names and
defaults; besides, `reward` chooses between the task of its base class (minus the squared speed of the wheels) and that
with a target (minus the distance to it, until the robot is there), and `quad` mirrors the maze into four quarters. The
descriptor is where the robot is at the end.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.options import Option, OptionValue, choice, option_values
from workers.environments.suite_task import Actuators, Package, Suite, suite_module

PACKAGE = Package("kheperax", "es-service with its extra, 140 MB with qdax,")
ROBOT = ("laser_ranges", "std_noise_sensor_measures", "lasers_return_minus_one_if_out_of_range")
"""Options that are fields of the robot; the others are fields of the configuration."""
OPTIONS: Mapping[str, Option] = {
    "reward": choice("energy", "target"),
    "quad": Option(False),
    "action_scale": Option(0.025, low=0.0),
    "std_noise_wheel_velocities": Option(0.0, low=0.0),
    "laser_ranges": Option(0.2, low=0.0),
    "std_noise_sensor_measures": Option(0.0, low=0.0),
    "lasers_return_minus_one_if_out_of_range": Option(False),
}


def names() -> tuple[str, ...]:
    """Names of the mazes."""
    return tuple(_module("envs.maze_maps").KHEPERAX_MAZES)


def suite(name: str, given: Mapping[str, OptionValue]) -> Suite:
    """Kheperax's task in the maze `name`."""
    options = option_values(OPTIONS, given)
    has_target = options["reward"] == "target"
    config = _config(name, options, has_target)
    task = _module("tasks.target").TargetKheperaxTask if has_target else _module("tasks.main").KheperaxTask
    task = task(config)

    def reset(key: Any) -> tuple[Any, Any]:
        state = task.reset(key)
        return (state.robot.posture, state.random_key), state.obs

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        posture, own_key = state
        before = _module("envs.kheperax_state").KheperaxState(
            robot=config.robot.replace(posture=posture),
            maze=config.maze,
            obs=None,
            reward=None,
            done=False,
            random_key=own_key,
            info={},
        )
        after = task.step(before, action)
        return (after.robot.posture, after.random_key), after.obs, after.reward, after.done

    def position(state: Any) -> Any:
        return jnp.stack([state[0].x, state[0].y])

    def target_distance(state: Any) -> Any:
        return jnp.linalg.norm(jnp.asarray(config.target_pos) - position(state))

    low, high = config.limits
    least = -math.hypot(*np.subtract(high, low)) if has_target else -2.0 * config.action_scale**2
    described = {"position": (("x", "y"), tuple(zip(map(float, low), map(float, high), strict=True)))}
    plain = Suite(
        f"kheperax:{name}",
        reset,
        step,
        Actuators(np.full(2, -1.0), np.ones(2)),
        config.episode_length,
        OPTIONS,
        measures=lambda state: {"position": position(state)},
        described=described,
        facts={"walls": _walls(config.maze), "wall_clearance": float(config.robot.radius), "least_reward": least},
    )
    if not has_target:
        return plain
    return dataclasses.replace(
        plain,
        goal_distance=target_distance,
        success=lambda state, before: before | (target_distance(state) < config.target_radius),
        facts={
            **plain.facts,
            "has_goal": True,
            "final_fitness": True,
            "goal": tuple(map(float, config.target_pos)),
            "success": "the robot is in the target",
        },
    )


def _config(name: str, options: Mapping[str, OptionValue], has_target: bool) -> Any:
    """Kheperax's configuration of a maze with these options."""
    module = _module("tasks.target" if has_target else "tasks.config")
    kind = module.TargetKheperaxConfig if has_target else module.KheperaxConfig
    config = kind.get_default_for_map(name)
    if options["quad"]:
        config = _module("tasks.quad").make_quad_config(config)
    own = {key: value for key, value in options.items() if key not in ("reward", "quad", *ROBOT)}
    robot = config.robot.replace(**{key: options[key] for key in ROBOT})
    return dataclasses.replace(config, robot=robot, **own)


def _walls(maze: Any) -> tuple[tuple[tuple[float, float], tuple[float, float]], ...]:
    """All walls as segments."""
    walls = jax.tree.map(np.asarray, maze.walls)
    ends = np.stack([walls.p1.x, walls.p1.y, walls.p2.x, walls.p2.y], 1).tolist()
    return tuple(((x, y), (other_x, other_y)) for x, y, other_x, other_y in ends)


def _module(name: str) -> Any:
    """A module of Kheperax, in which its robot counts lasers by a function that JAX still has."""
    suite_module("kheperax", PACKAGE)
    suite_module("kheperax", PACKAGE, "kheperax.simu.robot").get_batch_size = lambda tree: len(jax.tree.leaves(tree)[0])
    return suite_module("kheperax", PACKAGE, f"kheperax.{name}")
