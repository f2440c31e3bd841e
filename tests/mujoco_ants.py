"""Ants in MuJoCo's physics among walls: states of them, and control steps in C MuJoCo and by simd.

States come from C MuJoCo: ants that run into walls and corners and fall, driven by full torques.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np

from es_service.protocol.noise import Domain, stream_keys
from tests.mujoco_models import Example
from workers.environments import SHIPPED, make_environment
from workers.environments.ant_gymnasium import AntMazeEnv, AntTrapEnv, MujocoAntEnv
from workers.environments.ant_model import SUBSTEPS, boxes_of, compiled
from workers.environments.ant_mujoco import SLOTS, wall_contacts
from workers.environments.mujoco_parts import MujocoState, mujoco
from workers.simd.episodes.kernel import compile_kernel

ENVIRONMENTS: dict[str, type[MujocoAntEnv]] = {"ant_maze": AntMazeEnv, "ant_trap": AntTrapEnv}
REACH, NEAR = 0.85, 1.6
"""Distances in metres of a torso from a wall: no leg reaches further, and a state begins no further away."""
SPEED = 6.0
"""Metres per second towards the wall."""
LONGEST = 8
"""Most control steps that precede a state."""


class Steps(NamedTuple):
    """What control steps from N states give."""

    observation: np.ndarray
    reward: np.ndarray
    done: np.ndarray


class Given(NamedTuple):
    """States [N], in float32, and actions in [-1, 1] [N, 8]."""

    qpos: np.ndarray
    qvel: np.ndarray
    action: np.ndarray


def boxes(task: str) -> np.ndarray:
    """[W, 4] as `boxes_of`."""
    return boxes_of(SHIPPED[task].walls or ())


def apart(place_2: np.ndarray, box_W_4: np.ndarray) -> float:
    """Distance of a place from the nearest wall's surface; negative inside."""
    beyond_W_2 = np.abs(place_2 - box_W_4[:, :2]) - box_W_4[:, 2:]
    return float((np.linalg.norm(beyond_W_2.clip(0), axis=1) + beyond_W_2.max(axis=1).clip(max=0)).min())


def beside_walls(task: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(a place, beside a wall's corner or side, and out of reach of all; unit vector to that corner or side)."""
    box_W_4 = boxes(task)
    while True:
        x, y, half_x, half_y = box_W_4[rng.integers(len(box_W_4))]
        at = np.array([x, y]) + np.where(rng.random(2) < 0.7, rng.choice([-1, 1], 2), rng.uniform(-1, 1, 2)) * (
            half_x,
            half_y,
        )
        place = at + rng.uniform(-NEAR, NEAR, 2)
        is_inside = task == "ant_trap" or (np.abs(place - 2.5) < 37.0).all()
        if is_inside and REACH < apart(place, box_W_4) < NEAR:
            return place, (at - place) / np.linalg.norm(at - place)


def states(task: str, count: int, seed: int = 0) -> Given:
    """Ants beside walls; every third of them begins in the air, turned at random."""
    environment, rng, rows = ENVIRONMENTS[task](), np.random.default_rng(seed), []
    for number in range(count):
        environment.reset(seed=number)
        qpos, qvel = environment.data.qpos.copy(), environment.data.qvel.copy()
        qpos[:2], way_2 = beside_walls(task, rng)
        turn = rng.normal(size=4) * ([1, 1, 1, 1] if number % 3 == 0 else [1, 0, 0, 1])
        qpos[3:7] = turn / np.linalg.norm(turn)
        if number % 3 == 0:
            qpos[2] = rng.uniform(0.9, 2.0)
        qvel[:2] = SPEED * way_2
        environment.set_state(qpos, qvel)
        for _ in range(rng.integers(LONGEST)):
            environment.step(rng.choice([-1.0, 1.0], 8))
        rows.append((environment.data.qpos.copy(), environment.data.qvel.copy(), rng.uniform(-1, 1, 8)))
    return Given(*(np.array(column, np.float32) for column in zip(*rows, strict=True)))


def steps_in_c(task: str, given: Given, physics: str = "mujoco") -> tuple[Steps, np.ndarray]:
    """(control steps in C MuJoCo, [N] numbers of contacts with walls after them)."""
    environment, rows = ENVIRONMENTS[task](), []
    if physics == "mujoco_euler":
        environment.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    walls = {environment.model.geom(f"wall_{number}").id for number in range(len(boxes(task)))}
    for qpos, qvel, action in zip(*given, strict=True):
        environment.set_state(qpos.astype(float), qvel.astype(float))
        observation, reward, done, *_ = environment.step(action)
        touches = sum(not walls.isdisjoint(contact.geom.tolist()) for contact in environment.data.contact)
        rows.append((observation, reward, done, touches))
    *steps, touches = (np.array(column) for column in zip(*rows, strict=True))
    return Steps(*steps), touches


@cache
def kernel_of(task: str, physics: str = "mujoco") -> Callable[..., Any]:
    """Control step by simd: states and actions -> (states, observations, rewards, ends)."""
    environment = make_environment(task, {"physics": physics})

    def step(state: Any, action: Any) -> tuple[Any, ...]:
        after, reward, done = environment.step(state, action)
        return after, environment.observe(after), reward, done

    key, action = jax.ShapeDtypeStruct((4,), np.uint32), jax.ShapeDtypeStruct((8,), np.float32)
    return compile_kernel(step, jax.eval_shape(environment.reset, key), action)


@cache
def resets_of(task: str) -> Callable[..., Any]:
    """Reset by simd: keys [N, 4] -> states."""
    environment = make_environment(task, {"physics": "mujoco"})
    return compile_kernel(environment.reset, jax.ShapeDtypeStruct((4,), np.uint32))


def resets(task: str, count: int) -> Any:
    """States [N] of resets."""
    return resets_of(task)(stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(count)))


def example(task: str, integrator: str = "RK4") -> Example:
    """The model of a task for `tests.benchmarks.mujoco`, with its own integrator or another one."""
    box_W_4 = boxes(task)
    of_c, of_mjx = compiled(box_W_4), compiled(box_W_4[:SLOTS])
    for model in (of_c, of_mjx):
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")

    def states_of(count: int, seed: int) -> MujocoState:
        qpos, qvel, _ = states(task, count, seed)
        return MujocoState(
            qpos, qvel, np.zeros((count, 0), np.float32), np.zeros_like(qvel), np.zeros(count, np.float32)
        )

    return Example(of_c, SUBSTEPS, "", of_mjx, wall_contacts(box_W_4), states_of, task)


def put(state: Any, qpos: np.ndarray, qvel: np.ndarray) -> Any:
    """States of resets with other positions and velocities."""
    return state._replace(physics=state.physics._replace(qpos=qpos, qvel=qvel))


def steps_by_simd(task: str, given: Given, physics: str = "mujoco") -> Steps:
    state = put(resets(task, len(given.qpos)), given.qpos, given.qvel)
    return Steps(*kernel_of(task, physics)(state, given.action)[1:])
