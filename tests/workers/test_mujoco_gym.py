"""Gymnasium's environments of MuJoCo by MJX, one control step against Gymnasium itself; what is not supported is named.

A state that moves by one float32 ulp shows how exact a comparison can be: Gymnasium's own answer moves, too.
"""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import with_options
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.sources import sha256, user_sources
from tests.mujoco_models import c_step, relative_error
from workers.environments import (
    TaskError,
    describe_environment,
    make_environment,
    make_host_task,
    mujoco_gym,
    mujoco_parts,
)
from workers.environments.mujoco_gym_parts import Feet, GymState
from workers.environments.mujoco_gym_tasks import TASKS
from workers.environments.mujoco_parts import MujocoState, mujoco
from workers.simd.episodes.kernel import compile_kernel

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated")]
KEYS = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(256))
TIMES = 8.0
"""Errors may be so many times as great as what one ulp of a state makes in Gymnasium: a step rounds thousands of
times."""
LONGEST = 60
"""Most steps with random actions after which a state is compared."""
WALKERS = ("Ant", "HalfCheetah", "Hopper", "Walker2d")
"""Robots that have feet."""
HUMANOIDS = ("Humanoid-v5", "HumanoidStandup-v5")
NAMED = {"Pusher-v5": 5e-3, **dict.fromkeys(HUMANOIDS, 2e-3)}
"""Greatest error where physics is known to differ: C MuJoCo has two contacts instead of one with a capsule that lies on
a cylinder, and PGS ends after the 50 iterations of the humanoids' files, before it has converged."""
NOT_OURS = {"self", "xml_file", "default_camera_config", "frame_skip", "kwargs"}


class Steps(NamedTuple):
    """What control steps from N states give."""

    observation: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    feet: np.ndarray
    """[N, foot] whether each foot touches the floor."""


def random_states(name: str, count: int) -> list[np.ndarray]:
    """[qpos, qvel, action in [-1, 1]] of random episodes of Gymnasium, in float32."""
    environment, rng = gymnasium.make(name).unwrapped, np.random.default_rng(0)
    space, rows = environment.action_space, []
    for seed in range(count):
        environment.reset(seed=seed)
        for _ in range(rng.integers(LONGEST)):
            environment.step(rng.uniform(space.low, space.high))
        if name == "Pusher-v5":
            reach_for_object(environment, rng)
        rows.append((environment.data.qpos.copy(), environment.data.qvel.copy(), rng.uniform(-1, 1, space.shape)))
    return [np.array(column, np.float32) for column in zip(*rows, strict=True)]


def reach_for_object(environment: Any, rng: np.random.Generator) -> None:
    """Move the arm of Pusher, and the object to where its side touches a tip, with no contact deeper than 5 mm."""
    model, data = environment.model, environment.data
    (low, high), tip = model.jnt_range[:7].T, model.geom("tip_arml").id
    thing = model.body("object").id
    while True:
        data.qpos[:7] = rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        turn, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.055, 0.08)
        x, y = data.geom_xpos[tip, :2] + away * np.array([np.cos(turn), np.sin(turn)])
        data.qpos[-4:-2] += (y, x) - data.xpos[thing, 1::-1]
        mujoco.mj_forward(model, data)
        bodies = model.geom_bodyid[data.contact.geom]
        upright = data.contact.frame[(bodies == thing).any(axis=1) & (bodies != 0).all(axis=1), 2]
        if upright.size and np.abs(upright).max() < 0.5 and data.contact.dist.min() > -0.005:
            return


@pytest.mark.parametrize("name", sorted({*TASKS} - {"Reacher-v5", "Pusher-v5"}))
def test_gymnasium_begins_as_mjx_if_it_draws_from_the_noise_of_the_key(name):
    """Reacher and Pusher draw a place until it is near, or far, enough, and the tasks do not."""
    task, start = make_host_task(f"gymnasium:{name}", {}), mujoco_gym.build(name).parts.start
    made = task.make()
    assert task.reset_by_key is not None
    for key in KEYS[:3]:
        observation, _ = task.reset_by_key(made, key)
        qpos, qvel = start(key)
        np.testing.assert_allclose(made.data.qpos, qpos, atol=1e-6)
        np.testing.assert_allclose(made.data.qvel, qvel, atol=1e-6)
        again, _ = task.reset_by_key(made, key)
        np.testing.assert_array_equal(again, observation)
    seeded, _ = made.reset(seed=7)
    np.testing.assert_array_equal(seeded, task.make().reset(seed=7)[0], err_msg="a seed is what it was")


def feet_on_floor(environment: Any) -> list[bool]:
    """Whether each body without children has a contact with the floor in C MuJoCo, of robots that walk."""
    model, data = environment.model, environment.data
    leaves = [body for body in range(model.nbody) if body not in model.body_parentid]
    pairs = [{*model.geom_bodyid[contact.geom]} for contact in data.contact]
    return [{0, leaf} in pairs for leaf in leaves] if environment.spec.id.startswith(WALKERS) else []


def steps_of_gymnasium(name: str, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> tuple[Steps, np.ndarray]:
    """(control steps, numbers of contacts after them)."""
    environment, rows = gymnasium.make(name).unwrapped, []
    low, high = environment.action_space.low, environment.action_space.high
    for q, v, a in zip(qpos, qvel, action, strict=True):
        environment.reset(seed=0)
        environment.set_state(q.astype(float), v.astype(float))
        observation, reward, done, _, _ = environment.step((low + high) / 2 + (high - low) / 2 * a)
        rows.append((observation, reward, done, feet_on_floor(environment), environment.data.ncon))
    *steps, contacts = (np.array(column) for column in zip(*rows, strict=True))
    return Steps(*steps), contacts


def steps_of_ours(name: str, given: list[np.ndarray], **options: Any) -> Steps:
    """By simd, in float32."""
    built, walks = mujoco_gym.build(name, **options), name.startswith(WALKERS)
    descriptor = {"descriptor": "feet_contact"} if walks else {}
    environment = make_environment(f"mujoco:{name}", options | descriptor)
    feet = len(mujoco_gym.feet_of(built.simulated.c)) if walks else 0
    of_qpos, of_qvel, of_action = (jax.ShapeDtypeStruct(x.shape[1:], np.float32) for x in given)

    def begin(qpos: Any, qvel: Any) -> GymState:
        """A state after two control steps in which no foot touched the floor."""
        counts = Feet(jnp.zeros(feet), jnp.float32(2.0)) if walks else None
        return built.at(qpos, qvel)._replace(feet=counts)

    def step(state: Any, action: Any) -> tuple[Any, ...]:
        after, reward, done = environment.step(state, action)
        return environment.observe(after), reward, done, 3.0 * environment.descriptor(after)[:feet]

    before = compile_kernel(begin, of_qpos, of_qvel)(*given[:2])
    kernel = compile_kernel(step, jax.eval_shape(begin, of_qpos, of_qvel), of_action)
    return Steps(*map(np.asarray, kernel(before, given[2])))


def compare(name: str, count: int) -> None:
    """99 % of the errors, and the greatest, are at most TIMES what one ulp makes in Gymnasium, with its unit 1e-6.

    Where physics is known to differ, so are 90 %, and the greatest is at most that in NAMED.
    """
    given, rng = random_states(name, count), np.random.default_rng(1)
    (truth, contacts), found, moved = steps_of_gymnasium(name, *given), steps_of_ours(name, given), []
    for _ in range(4):
        qpos, qvel = (
            np.nextafter(x, np.where(rng.random(x.shape) < 0.5, -9e9, 9e9).astype(x.dtype)) for x in given[:2]
        )
        moved.append(steps_of_gymnasium(name, qpos, qvel, given[2])[0])
    print(f"\n{name}: {count} states, {int((contacts > 0).sum())} in contact, {int(truth.done.sum())} ends")
    for what in ("observation", "reward"):
        right = getattr(truth, what).reshape(count, -1)
        error, *ulps = (relative_error(getattr(of, what).reshape(count, -1), right) for of in (found, *moved))
        ulp = np.maximum.reduce(ulps)
        print(what, *(f"{np.quantile(of, share):.1e}" for of in (error, ulp) for share in (0.5, 0.99, 1.0)))
        assert error.max() <= NAMED.get(name, np.inf), what
        for share in (0.9,) if name in NAMED else (0.99, 1.0):
            assert np.quantile(error, share) <= TIMES * (np.quantile(ulp, share) + 1e-6), (what, share)
    for what in ("done", "feet"):
        right = getattr(truth, what)
        at_the_edge = np.any([getattr(of, what) != right for of in moved], axis=0)
        np.testing.assert_allclose(getattr(found, what)[~at_the_edge], right[~at_the_edge], atol=1e-6)
    assert not name.startswith(WALKERS) or 0.02 < found.feet.mean() < 0.98


@pytest.mark.parametrize("name", ["InvertedDoublePendulum-v5", pytest.param("HalfCheetah-v5", marks=pytest.mark.long)])
def test_a_control_step_is_gymnasiums(name: str):
    compare(name, 50)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", TASKS)
def test_a_control_step_of_any_task_is_gymnasiums(name: str):
    compare(name, 1000)


@pytest.mark.parametrize("name", TASKS)
def test_options_have_the_names_and_defaults_of_gymnasium(name: str):
    of_class = inspect.signature(type(gymnasium.make(name).unwrapped).__init__).parameters
    gyms = {key: one.default for key, one in of_class.items() if key not in NOT_OURS}
    ours = inspect.signature(TASKS[name].parts).parameters
    assert {key: one.default for key, one in ours.items() if key != "model"} == gyms
    assert TASKS[name].frame_skip == of_class["frame_skip"].default
    assert TASKS[name].episode_steps == gymnasium.spec(name).max_episode_steps


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "Swimmer-v5", "Reacher-v5", "Pusher-v5"])
def test_resets_have_gymnasiums_distributions(name: str):
    """The range, the mean and the spread of each number of an observation, in as many resets of both."""
    environment, theirs = make_environment(f"mujoco:{name}", {}), gymnasium.make(name).unwrapped
    observed = compile_kernel(lambda key: environment.observe(environment.reset(key)), KEYS[0])(KEYS).astype(float)
    gyms = np.array([theirs.reset(seed=seed)[0] for seed in range(len(KEYS))])
    assert observed.shape == gyms.shape
    spread = gyms.std(0)
    np.testing.assert_allclose(observed.std(0), spread, rtol=0.2, atol=1e-6)
    assert (np.abs(observed.mean(0) - gyms.mean(0)) <= 0.4 * spread + 1e-6).all()
    assert (np.abs(observed).max(0) <= np.abs(gyms).max(0) + spread + 1e-6).all()


def test_physics_is_traced_once_for_all_kernels(monkeypatch):
    """Training and evaluation share a step's trace, in which MuJoCo's forward stands once, though RK4 in a loop of
    substeps needs it for shapes and for code; the numbers are those of the undecorated function."""
    unsolved, traces = mujoco_parts._unsolved, []
    monkeypatch.setattr(mujoco_parts, "_unsolved", lambda *given: traces.append(1) or unsolved(*given))
    environment = make_environment("mujoco:InvertedPendulum-v5", {"frame_skip": 2})
    state, action = jax.eval_shape(environment.reset, KEYS[0]), jax.ShapeDtypeStruct((1,), jnp.float32)
    traces.clear()
    plain = jax.make_jaxpr(lambda state, action: environment.step.__wrapped__(state, action))(state, action)
    again = jax.make_jaxpr(lambda state, action: environment.step(state, action))(state, action)
    jax.make_jaxpr(lambda state, action: environment.step(state, action)[0])(state, action)
    assert len(traces) == 2
    assert str(plain) == str(again)


@pytest.mark.parametrize("name", HUMANOIDS)
def test_newtons_method_finds_the_forces_of_pgs(name: str):
    """MJX lacks PGS, the solver of the humanoids: in C MuJoCo, nine of ten control steps in contact by the other are
    the same to 1e-5, and all are to 1e-6 once PGS has converged."""
    of_file, ours = mujoco_gym.load(TASKS[name]), mujoco_gym.build(name).simulated.c
    assert (of_file.opt.solver, ours.opt.solver) == (mujoco.mjtSolver.mjSOL_PGS, mujoco.mjtSolver.mjSOL_NEWTON)
    qpos_N, qvel_N, action_N = random_states(name, 30)
    state_N = MujocoState(qpos_N, qvel_N, np.zeros((30, 0)), np.zeros_like(qvel_N), np.zeros(30))
    by_newton = c_step(ours, 5, state_N, 0.4 * action_N)
    in_contact = by_newton.contacts > 0
    assert in_contact.sum() > 10
    errors = []
    for iterations, tolerance in ((of_file.opt.iterations, of_file.opt.tolerance), (5000, 1e-14)):
        of_file.opt.iterations, of_file.opt.tolerance = iterations, tolerance
        by_pgs = c_step(of_file, 5, state_N, 0.4 * action_N)
        errors.append(relative_error(by_newton.qvel, by_pgs.qvel)[in_contact])
    assert np.quantile(errors[0], 0.9) < 1e-5
    assert errors[1].max() < 1e-6


@pytest.mark.long
def test_a_humanoid_observes_after_a_reset_what_gymnasium_does():
    """Inertias, velocities and forces of actuators, which MuJoCo computes, and forces of contacts, which are 0."""
    built, environment = mujoco_gym.build("Humanoid-v5"), gymnasium.make("Humanoid-v5").unwrapped
    qpos_N, qvel_N, _ = random_states("Humanoid-v5", 16)
    kernel = compile_kernel(lambda qpos, qvel: built.parts.observe(built.at(qpos, qvel)), qpos_N[0], qvel_N[0])
    truth = []
    for qpos, qvel in zip(qpos_N.astype(float), qvel_N.astype(float), strict=True):
        environment.reset(seed=0)
        environment.set_state(qpos, qvel)
        truth.append(environment._get_obs())
    assert relative_error(kernel(qpos_N, qvel_N), np.array(truth)).max() < 1e-6


def test_a_task_says_its_sizes_and_options():
    task = describe_environment("mujoco:HalfCheetah-v5")
    assert (task.observation_size, task.action_size, task.episode_steps) == (17, 6, 1000)
    assert tuple(task.descriptors) == ("final_x", "feet_contact", "final_joints")
    assert task.options["solver_iterations"].default == 100
    assert with_options(task, {"descriptor": "final_joints"}).descriptor_names == ("joint_1", "joint_2")
    more = describe_environment(
        "mujoco:HalfCheetah-v5", {"options": {"exclude_current_positions_from_observation": False}}
    )
    assert more.observation_size == 18
    assert tuple(describe_environment("mujoco:Swimmer-v5").descriptors) == ("final_xy", "final_x", "final_joints")
    for name in ("Reacher-v5", "Pusher-v5"):
        assert tuple(describe_environment(f"mujoco:{name}").descriptors) == ("final_joints",)
    of_ant = mujoco_gym._descriptors(mujoco_gym.load(TASKS["Ant-v5"]))
    assert tuple(of_ant) == ("final_xy", "final_x", "feet_contact", "final_joints")
    assert of_ant["feet_contact"][:2] == (("foot_1", "foot_2", "foot_3", "foot_4"), ((0.0, 1.0),) * 4)


DOUBLE = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from tests.workers import test_mujoco_gym as tests
from workers.environments import mujoco_gym, mujoco_parts
given = [x.astype(float) for x in tests.random_states(sys.argv[1], 40)]
truth, contacts = tests.steps_of_gymnasium(sys.argv[1], *given)
of = mujoco_gym.build(sys.argv[1])
low, high = of.simulated.c.actuator_ctrlrange.T
def step(qpos, qvel, action):
    state = of.at(qpos, qvel)
    action = (low + high) / 2 + (high - low) / 2 * action
    found, seen = mujoco_parts.step_and_look(
        of.simulated.mx, state.physics, action, of.simulated.frame_skip, lambda data: of.parts.look(data, True))
    return of.parts.observe(state._replace(physics=found, seen=seen))
found = np.asarray(jax.jit(jax.vmap(step))(*given))
error = tests.relative_error(found, truth.observation)
print(found.dtype, (contacts > 0).sum(), np.quantile(error, 0.5), np.quantile(error, 0.9))
"""


@pytest.mark.long
@pytest.mark.parametrize("name", ["HalfCheetah-v5", "Reacher-v5"])
def test_what_differs_from_gymnasium_is_float32s(name: str):
    """In double precision, nine of ten control steps are Gymnasium's to 1e-9."""
    command = [sys.executable, "-c", DOUBLE, name]
    child = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    dtype, _, median, most = child.stdout.split()[-4:]
    assert dtype == "float64"
    assert float(median) < 1e-11
    assert float(most) < 1e-9


def test_the_files_of_the_models_are_part_of_the_code():
    """Hosts of a cluster may have other versions of Gymnasium's package."""
    sources = user_sources("mujoco:Ant-v5")
    file = Path(gymnasium.__file__).parent / "envs/mujoco/assets" / TASKS["Ant-v5"].file
    assert sources["gymnasium/envs/mujoco/assets/ant.xml"] == sha256(file.read_bytes())
    assert len(sources) >= len({task.file for task in TASKS.values()})
    assert not user_sources("brax:ant")


def test_what_cannot_be_had_is_named(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(
        TaskError, match=r"mujoco:Ants-v5 is not known; must be Ant-v5, .*; did you mean mujoco:Ant-v5\?"
    ):
        describe_environment("mujoco:Ants-v5")
    with pytest.raises(TaskError, match=r"task\.options\.healthy_z_range = \[1\] is not allowed; must be two numbers"):
        describe_environment("mujoco:Walker2d-v5", {"options": {"healthy_z_range": [1]}})
    with pytest.raises(TaskError, match=r"task\.options\.main_body = -1 is not allowed; must be 1 to 13, the bodies"):
        describe_environment("mujoco:Ant-v5", {"options": {"main_body": -1}})
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(
        TaskError, match=r"the package gymnasium is not installed; .*pip install 'es-service\[gymnasium\]'"
    ):
        describe_environment("mujoco:Swimmer-v5")
