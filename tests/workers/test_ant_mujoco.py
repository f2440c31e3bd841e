"""AntMaze and AntTrap in MuJoCo's physics, by MJX, against C MuJoCo: contacts, control steps, episodes, walls.

A state that moves by one float32 ulp shows how exact a comparison can be: C MuJoCo's own answer moves, too.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco.mjx._src import collision_driver, smooth

from tests import mujoco_ants as ants
from tests.mujoco_models import relative_error
from workers.environments import (
    SHIPPED,
    TaskError,
    ant_model,
    describe_environment,
    make_environment,
    make_host_task,
)
from workers.environments.ant_mujoco import SLOTS, MujocoAntState, wall_contacts
from workers.environments.ant_tasks import STEP_S
from workers.environments.host_task import HostEnvironment
from workers.environments.mujoco_parts import contacts_as_c, mjx, mujoco, put_model
from workers.viewer import scene

pytestmark = pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated")
TASKS = ("ant_maze", "ant_trap")
ONE_TASK = pytest.mark.parametrize("task", [pytest.param("ant_maze", marks=pytest.mark.long), "ant_trap"])
"""The maze costs as much again, so its turn is with the heavy tests."""
TIMES = 2.0
"""99 % of errors are at most so many times as great as what one ulp of a state makes in C MuJoCo, before the step or
after it."""
GREATEST = {"observation": 8.0, "reward": 80.0}
"""The greatest error of 1,000 is at most so many times as great. In a few states in contact, MJX's solver ends with
accelerations that no last bit of the state explains: its line search takes only steps that lower the cost, of which
float32 has 24 bits, and a tolerance of 0 changes none of them. In double precision MJX is within 1e-6
(`test_in_double_precision_a_control_step_is_that_of_c_mujoco`). A reward divides what they move the ant by the seconds
of a step."""


def poses_in_walls(task: str, count: int) -> np.ndarray:
    """[N, 15] ants turned and bent at random, within and beyond the limits of their joints, most of them at corners,
    as deep in walls as no ant comes."""
    rng, box_W_4 = np.random.default_rng(0), ants.boxes(task)
    box_N_4 = box_W_4[rng.integers(len(box_W_4), size=count)]
    at_corner = rng.random((count, 2)) < 0.8
    share_N_2 = np.where(at_corner, rng.choice([-1, 1], (count, 2)), rng.uniform(-1, 1, (count, 2)))
    place_N_2 = box_N_4[:, :2] + share_N_2 * box_N_4[:, 2:] + rng.uniform(-1.2, 1.2, (count, 2))
    turn_N_4 = rng.normal(size=(count, 4))
    turn_N_4 /= np.linalg.norm(turn_N_4, axis=1, keepdims=True)
    height_N_1, joint_N_8 = rng.uniform(0.1, 1.2, (count, 1)), rng.uniform(-1.3, 1.3, (count, 8))
    return np.concatenate([place_N_2, height_N_1, turn_N_4, joint_N_8], axis=1, dtype=np.float32)


def contacts_of_c(task: str, qpos_N: np.ndarray) -> list[np.ndarray]:
    """[n, 13] distance, position and frame of each contact of each pose."""
    model = ant_model.ant_model(SHIPPED[task].walls or ())
    data, found = mujoco.MjData(model), []
    for qpos in qpos_N:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        found.append(np.array([[one.dist, *one.pos, *one.frame] for one in data.contact]).reshape(-1, 13))
    return found


def contacts_of_ours(task: str, qpos_N: np.ndarray) -> list[np.ndarray]:
    box_W_4 = ants.boxes(task)
    mx, contacts = put_model(ant_model.compiled(box_W_4[:SLOTS])), wall_contacts(box_W_4)

    def collide(qpos):
        with contacts_as_c(contacts):
            data: Any = smooth.kinematics(mx, mjx.make_data(mx).replace(qpos=qpos))
            collided: Any = collision_driver.collision(mx, data)
        found = collided._impl.contact
        return jnp.concatenate(
            [found.dist[:, None], found.pos, found.frame.reshape(-1, 9)], axis=1
        ), found.includemargin

    rows, margins = map(np.asarray, jax.jit(jax.vmap(collide))(qpos_N))
    return [row[row[:, 0] < margin] for row, margin in zip(rows, margins, strict=True)]


@pytest.mark.slow
@ONE_TASK
def test_contacts_with_walls_are_those_of_c_mujoco(task: str):
    """Each of C MuJoCo's contacts is found and no other, of ants anywhere at walls and in corners: the two nearest
    walls of a collider are enough."""
    qpos_N = poses_in_walls(task, 1000)
    of_c, of_ours = contacts_of_c(task, qpos_N), contacts_of_ours(task, qpos_N)
    assert np.mean([len(rows) > 4 for rows in of_c]) > 0.3
    # two contacts of an axis that only just comes past an edge may be one by float32, at the same place
    assert np.mean([len(right) == len(found) for right, found in zip(of_c, of_ours, strict=True)]) > 0.998
    errors = []
    for right, found in zip(of_c, of_ours, strict=True):
        assert bool(len(right)) == bool(len(found))
        if len(right):
            error = np.abs(right[:, None] - found).max(axis=2)
            errors.append(max(error.min(axis=0).max(), error.min(axis=1).max()))
    print("\n", sum(map(len, of_c)), "contacts", np.quantile(errors, [0.5, 0.99, 1.0]))
    assert np.quantile(errors, 0.99) < 1e-4
    assert np.max(errors) < 2e-3


@pytest.mark.long
@pytest.mark.parametrize("physics", ["mujoco", "mujoco_euler"])
@pytest.mark.parametrize("task", TASKS)
def test_a_control_step_is_that_of_c_mujoco(task: str, physics: str):
    """Of 1,000 states: 99 % of errors are at most TIMES, and all at most GREATEST times as great as the greatest that
    one ulp makes in C MuJoCo, with its unit 1e-6. The reward of AntTrap is a difference of two places, and the second
    is rounded to float32, too."""
    given, rng = ants.states(task, 1000), np.random.default_rng(1)
    truth, touches = ants.steps_in_c(task, given, physics)
    found, moved = ants.steps_by_simd(task, given, physics), []
    for _ in range(4):
        qpos, qvel = (
            np.nextafter(x, np.where(rng.random(x.shape) < 0.5, -9e9, 9e9).astype(x.dtype)) for x in given[:2]
        )
        moved.append(ants.steps_in_c(task, ants.Given(qpos, qvel, given.action), physics)[0])
    if task == "ant_trap":
        ulp = np.spacing(np.abs(given.qpos[:, 0])) / STEP_S
        moved.append(truth._replace(reward=truth.reward + ulp))
    print(
        f"\n{task}, {physics}: {int((touches > 0).sum())} touch a wall, {int((touches > 2).sum())} three times or more"
    )
    assert (touches > 0).mean() > 0.1
    for what in ("observation", "reward"):
        right = getattr(truth, what).reshape(len(touches), -1)
        error, *ulps = (relative_error(getattr(of, what).reshape(right.shape), right) for of in (found, *moved))
        ulp = np.maximum.reduce(ulps)
        print(what, *(f"{np.quantile(of, share):.1e}" for of in (error, ulp) for share in (0.5, 0.99, 1.0)))
        assert np.quantile(error, 0.99) <= TIMES * (ulp.max() + 1e-6), what
        assert error.max() <= GREATEST[what] * (ulp.max() + 1e-6), what
    at_the_edge = np.any([of.done != truth.done for of in moved], axis=0)
    np.testing.assert_array_equal(found.done[~at_the_edge], truth.done[~at_the_edge])


DOUBLE = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", True)
from tests import mujoco_ants as ants
from tests.mujoco_models import relative_error
from workers.environments import mujoco_parts
task, given = sys.argv[1], ants.states(sys.argv[1], 200)
example, (truth, touches) = ants.example(task), ants.steps_in_c(task, given)
mx = mujoco_parts.put_model(example.of_mjx)
def step(*of):
    state, look = mujoco_parts.start(mx, *of[:2]), lambda data: ()
    after, _ = mujoco_parts.step_and_look(mx, state, of[2], example.substeps, look, contacts=example.contacts)
    return jax.numpy.concatenate([after.qpos[2:], after.qvel])
found = np.asarray(jax.jit(jax.vmap(step))(*(x.astype(float) for x in given)))
error = relative_error(found, truth.observation[:, 2:29].astype(float))
print(found.dtype, (touches > 0).sum(), np.quantile(error, 0.5), error.max())
"""


@pytest.mark.long
@pytest.mark.parametrize("task", TASKS)
def test_in_double_precision_a_control_step_is_that_of_c_mujoco(task: str):
    """Of all of 200 states, to the float32 of C's observations: what is further away in float32 is rounding."""
    command = [sys.executable, "-c", DOUBLE, task]
    child = subprocess.run(command, capture_output=True, text=True, check=True, timeout=1200)
    dtype, touches, median, most = child.stdout.split()[-4:]
    assert dtype == "float64"
    assert int(touches) > 20
    assert float(median) < 1e-7
    assert float(most) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_an_episode_begins_as_with_springs(task: str):
    """With the same positions and velocities of the joints, so both physics, and both sizes, can be compared."""
    keys = ants.stream_keys(0, ants.Domain.TRAINING_RESET, 0, np.arange(16))
    spring, ours = (make_environment(task, {"physics": physics}) for physics in ("spring", "mujoco"))
    of_spring, of_ours = (ants.compile_kernel(one.reset, keys[0])(keys) for one in (spring, ours))
    assert isinstance(of_ours, MujocoAntState)
    np.testing.assert_array_equal(of_ours.q, of_spring.q)
    np.testing.assert_array_equal(of_ours.qd, of_spring.qd)


@pytest.mark.parametrize("task", TASKS)
def test_the_environment_in_c_is_found_by_its_name_and_begins_with_the_noise_of_a_key(task: str):
    """Certification draws starts from keys in both tasks."""
    name = f"gymnasium:es_service/{''.join(map(str.capitalize, task.split('_')))}Mujoco-v0"
    found = describe_environment(name, {"descriptor": "descriptor"})
    shipped = SHIPPED[task]
    same = ("observation_size", "action_size", "episode_steps")
    assert [getattr(found, key) for key in same] == [getattr(shipped, key) for key in same]
    (key,) = ants.stream_keys(0, ants.Domain.TRAINING_RESET, 0, np.arange(1))
    first = HostEnvironment(make_host_task(name, {})).reset(0, key)
    state = ants.resets(task, 1)
    np.testing.assert_allclose(
        first, jax.vmap(make_environment(task, {"physics": "mujoco"}).observe)(state)[0], atol=1e-6
    )


def driven_at_walls(task: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places beside walls [N, 2] and velocities of 6 m/s towards these [N, 2]."""
    rng = np.random.default_rng(3)
    places, ways = zip(*(ants.beside_walls(task, rng) for _ in range(count)), strict=True)
    return np.array(places, np.float32), 6.0 * np.array(ways, np.float32)


def torques(step: int, count: int) -> np.ndarray:
    """[N, 8] full torques, which turn round every five steps."""
    return np.random.default_rng(step // 5).choice(np.array([-1, 1], np.float32), (count, 8))


def test_no_ant_gets_through_a_wall_in_c_mujoco():
    """60 episodes with full torques, thrown at walls."""
    for task in TASKS:
        environment, box_W_4, nearest = ants.ENVIRONMENTS[task](), ants.boxes(task), []
        for number, (place, way) in enumerate(zip(*driven_at_walls(task, 30), strict=True)):
            environment.reset(seed=number)
            environment.data.qpos[:2], environment.data.qvel[:2] = place, way
            for step in range(40):
                environment.step(torques(step, 30)[number])
                nearest.append(ants.apart(environment.data.qpos[:2], box_W_4))
        check_torsos(np.array(nearest))


def check_torsos(apart: np.ndarray) -> None:
    """Torsos, of radius 0.25 m, come to walls, and give way by less than 0.1 m: so none crosses one, which is 1 m
    thick, since in a step an ant moves by less."""
    print("\nleast distance of a torso's middle from a wall", apart.min())
    assert np.isfinite(apart).all()
    assert 0.15 < apart.min() < 0.3


@pytest.mark.long
@pytest.mark.parametrize("task", TASKS)
def test_no_ant_gets_through_a_wall(task: str):
    """2,000 episodes of 300 steps with full torques, thrown at walls, by simd."""
    count = 2000
    box_W_4, kernel, state = ants.boxes(task), ants.kernel_of(task), ants.resets(task, count)
    qpos, qvel = state.q.copy(), state.qd.copy()
    qpos[:, :2], qvel[:, :2] = driven_at_walls(task, count)
    state, nearest = ants.put(state, qpos, qvel), []
    for step in range(300):
        before = state.q
        state, *_ = kernel(state, torques(step, count))
        assert np.linalg.norm((state.q - before)[:, :2], axis=1).max() < 1.0
        beyond = np.abs(state.q[:, None, :2] - box_W_4[:, :2]) - box_W_4[:, 2:]
        outside = np.linalg.norm(beyond.clip(0), axis=2)
        nearest.append((outside + beyond.max(axis=2).clip(max=0)).min(axis=1))
    check_torsos(np.array(nearest))


@pytest.mark.long
@ONE_TASK
def test_replays_show_the_bodies_and_the_walls_as_high_as_those_of_springs(task: str):
    environment = make_environment(task, {"physics": "mujoco"})
    assert environment.viewer is not None
    shown = scene(environment.viewer).shapes
    boxes = [shape for shape in shown if shape.kind == "box"]
    assert [shape.size[2] for shape in boxes] == [0.5] * len(ants.boxes(task))
    assert [shape.position[2] for shape in boxes] == [0.5] * len(boxes)
    assert sum(shape.kind == "capsule" for shape in shown) == 12
    state = jax.tree.map(lambda x: jnp.asarray(x[0]), ants.resets(task, 1))
    poses = environment.viewer.poses(state)
    data = mujoco.MjData(environment.viewer.model)
    data.qpos[:] = state.q
    mujoco.mj_kinematics(environment.viewer.model, data)
    np.testing.assert_allclose(poses.pos, data.xpos[1:], atol=1e-5)
    np.testing.assert_allclose(poses.rot, data.xquat[1:], atol=1e-5)


def test_walls_are_parallel_to_an_axis():
    with pytest.raises(ValueError, match="parallel to an axis"):
        ant_model.boxes_of((((0.0, 0.0), (1.0, 1.0)),))


def test_without_gymnasium_its_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(TaskError, match=r"pip install 'es-service\[gymnasium\]'"):
        make_environment("ant_trap", {"physics": "mujoco"})


@pytest.mark.slow
def test_an_ant_that_is_thrown_does_not_go_on_at_the_origin_in_c_mujoco(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    ant: Any = gymnasium.make("es_service.gymnasium:es_service/AntMazeMujoco-v0").unwrapped
    ant.reset(seed=0)
    thrown = ant.data.qvel.copy()
    thrown[0] = 1e11
    ant.set_state(ant.data.qpos.copy(), thrown)
    observation, reward, *_ = ant.step(np.zeros(8))
    assert not np.isfinite([reward, *observation]).all()
    assert np.isfinite(ant.reset(seed=0)[0]).all()
