"""Brax's environments as tasks, against Brax itself; classes of users; what cannot be had is named."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.config.tasks import TASKS
from es_service.errors import ConfigError
from es_service.protocol.messages import EpisodesResult, EvaluationChunk, PolicySpec, with_options
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.options import Option
from tests.helpers import centre, chunk_runner, random_parameters, spec
from tests.workers.steps import control_step, of_many
from workers.environments import TaskError, brax_task, declared, describe_environment, make_environment, user_task
from workers.simd.episodes import rollout
from workers.simd.episodes.kernel import compile_kernel

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated"),
]
EXAMPLE = "tests.examples.ant_slalom:AntSlalom"
KEYS = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(3))


class Slalom:
    """a point runs far along +x, around walls"""

    observation_size, action_size, episode_steps = 2, 2, 10
    descriptor_names, descriptor_bounds = ("x", "y"), ((-5.0, 25.0), (-12.0, 12.0))
    options = {"walls": ("both", "first")}  # noqa: RUF012

    def __init__(self, walls="both"):
        self.walls_used = walls

    def reset(self, key):
        return jnp.zeros(2)

    def observe(self, state):
        return state

    def step(self, state, action):
        return state + action, action[0], state[0] > 20.0

    def descriptor(self, state):
        return state


POINT = f"{__name__}:Slalom"


def test_rewards_and_observations_are_brax_s():
    """Both in one program, of which XLA compiles what they share once."""
    name = "inverted_double_pendulum"
    task, environment = brax_task.describe(name), brax_task.make(name)
    theirs = brax_task._make_brax(name, "spring")
    key_of = partial(jax.random.wrap_key_data, impl="threefry2x32")
    both = of_many(lambda key: (environment.reset(key), theirs.reset(key_of(key[:2]))))
    step = control_step(environment)
    both_steps = of_many(lambda mine, raw, action: (step(mine, action), theirs.step(raw, jnp.clip(action, -1, 1))))
    (state, raw), rewards = both(KEYS), []
    rng = np.random.default_rng(0)
    assert environment.observe(state).shape == (3, task.observation_size)
    for _ in range(10):
        action = rng.uniform(-1.5, 1.5, (3, task.action_size)).astype(np.float32)
        (state, reward, done, observation, descriptor, _), raw = both_steps(state, raw, action)
        np.testing.assert_allclose(reward, raw.reward, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(done, raw.done > 0.5)
        np.testing.assert_allclose(observation, raw.obs, rtol=1e-3, atol=1e-4)
        rewards += reward.tolist()
    assert len(set(rewards)) > 10
    assert descriptor.shape == (3, len(task.descriptor_names))


def test_feet_that_touch_the_floor():
    """Four feet of an ant that stands, none of one in the air."""
    environment, theirs = brax_task.make("ant", descriptor="feet_contact"), brax_task._make_brax("ant", "spring")
    step = compile_kernel(
        environment.step, *jax.eval_shape(lambda key: (environment.reset(key), jnp.zeros(8)), KEYS[0])
    )
    state = jax.tree.map(lambda leaf: np.zeros((3, *leaf.shape), leaf.dtype), step.in_tree.unflatten(step.in_avals)[0])
    q, qd = theirs.sys.init_q, np.zeros(14, np.float32)
    stand = compile_kernel(lambda up: theirs.pipeline_init(q.at[2].add(up), qd), jax.ShapeDtypeStruct((), np.float32))
    standing, above = (
        state._replace(brax=state.brax.replace(pipeline_state=stand(np.full(3, up, np.float32)))) for up in (0.0, 1.0)
    )
    in_the_air, _, _ = step(above, np.zeros((3, 8), np.float32))
    assert not np.asarray(jax.vmap(environment.descriptor)(in_the_air)).any()
    for _ in range(80):
        standing, _, _ = step(standing, np.zeros((3, 8), np.float32))
    share = np.asarray(jax.vmap(environment.descriptor)(standing))
    assert share.shape == (3, 4)
    assert (share > 0.5).all()


def test_what_each_environment_can_tell_of_an_episode():
    assert tuple(brax_task.describe("ant").descriptors) == ("final_xy", "final_x", "feet_contact", "final_joints")
    assert tuple(brax_task.describe("halfcheetah").descriptors) == ("final_x", "feet_contact", "final_joints")
    assert tuple(brax_task.describe("reacher").descriptors) == ("final_joints",)
    assert brax_task.describe("swimmer").options["backend"].choices == ("generalized",)
    for name in ("ant", "halfcheetah", "reacher"):
        for names, _ in brax_task.describe(name).descriptors.values():
            assert not declared.clashes(names)
    ant = with_options(brax_task.describe("ant"), {"descriptor": "feet_contact"})
    assert ant.descriptor_names == ("foot_1", "foot_2", "foot_3", "foot_4")
    assert ant.descriptor_bounds == ((0.0, 1.0),) * 4


@pytest.mark.parametrize(
    ("name", "coordinates"),
    [("ant", (7, 8)), ("halfcheetah", (3, 4)), ("inverted_pendulum", (1,)), ("reacher", (0, 1))],
)
def test_joints_are_not_where_the_base_is(name, coordinates):
    """An ant's place and quaternion, a half cheetah's x, z and pitch, a cart's x come before them."""
    environment = brax_task.make(name, descriptor="final_joints")
    shapes = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
    state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    physics = state.brax.pipeline_state
    physics = physics.replace(q=jnp.arange(physics.q.size, dtype=jnp.float32))
    numbered = state._replace(brax=state.brax.replace(pipeline_state=physics))
    np.testing.assert_array_equal(environment.descriptor(numbered), coordinates)
    names, bounds = brax_task.describe(name).descriptors["final_joints"]
    assert names == ("joint_1", "joint_2")[: len(coordinates)]
    assert len(bounds) == len(coordinates)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("brax:ants", r"brax:ants is not in the installed Brax, which has ant, .*; did you mean brax:ant\?"),
        ("no_such_module:Class", r"cannot import no_such_module .*start in the folder that contains it, or install it"),
        ("tests.examples.ant_slalom:Slalom", r"the module tests\.examples\.ant_slalom has no class Slalom"),
        ("pathlib:Path", r"pathlib:Path has no observation_size, .* reset, observe, step, descriptor"),
    ],
)
def test_what_cannot_be_had_is_named(name, message):
    with pytest.raises(TaskError, match=message):
        describe_environment(name)


def test_a_class_with_contradictions_is_refused(monkeypatch):
    monkeypatch.setattr(Slalom, "descriptor_bounds", ((0.0, 1.0),))
    monkeypatch.setattr(Slalom, "episode_steps", 0)
    with pytest.raises(
        TaskError, match=r"2 descriptor_names but 1 descriptor_bounds; episode_steps = 0 is not positive"
    ):
        user_task.describe(POINT)
    monkeypatch.setattr(Slalom, "descriptor_bounds", 3)
    with pytest.raises(TaskError, match=r"descriptor_bounds = 3 is not of type tuple"):
        user_task.describe(POINT)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("observation_size", 30, r"observe has the shape \(2,\), not \(30,\)"),
        ("descriptor_names", ("x", "y", "z"), r"descriptor has the shape \(2,\), not \(3,\)"),
        ("action_size", 7, r"cannot be traced by JAX: "),
        ("descriptor_bounds", ((1.0, 0.0), (0.0, 1.0)), r"\(1.0, 0.0\) is not a pair \(low, high\)"),
        ("walls", ((0.0, 1.0),), r"is not a tuple of segments"),
        ("walls", 5, r"is not a tuple of segments"),
        ("walls", (((0.0, 1.0), (0.0, 1.0)),), r"is not a tuple of segments"),
        ("least_reward", "low", r"least_reward = 'low' is not a finite number"),
        ("least_reward", "", r"least_reward = '' is not a finite number"),
        ("wall_clearance", float("nan"), r"wall_clearance = nan is not a finite number"),
        ("wall_clearance", None, r"wall_clearance = None is not a finite number"),
        ("goal", (1.0, None), r"goal = \(1.0, None\) is not a place"),
        ("goal_distance", lambda self, state: jnp.zeros(2), r"goal_distance has the shape \(2,\), not \(\)"),
        ("goal_distance", None, r"cannot be traced by JAX: "),
        ("options", {"walls": "both"}, r"option 'walls' = 'both' is neither an Option nor a tuple"),
        ("options", {"walls": ("both", 1)}, r"option 'walls' = Option\(.*\) has values that are not all of one type"),
        ("options", {"size": Option(2.0, low=3.0)}, r"option 'size' = Option\(.*\) has a number outside its bounds"),
        ("options", ("walls",), r"options = \('walls',\) is not a mapping from names to options"),
        (
            "step",
            lambda self, state, action: (0, jnp.zeros(2), True),
            r"the reward of step .*; step returns a state of",
        ),
    ],
)
def test_methods_that_do_not_fit_what_is_declared_are_named(monkeypatch, name, value, message):
    if name == "descriptor_names":
        monkeypatch.setattr(Slalom, "descriptor_bounds", ((0.0, 1.0),) * 3, raising=False)
    monkeypatch.setattr(Slalom, name, value, raising=False)
    with pytest.raises(TaskError, match=message):
        user_task.describe(POINT)


def test_the_driver_asks_a_process_and_gets_the_same_answer():
    assert TASKS["brax:inverted_pendulum"] == brax_task.describe("inverted_pendulum")
    assert TASKS[POINT] == user_task.describe(POINT)
    assert TASKS.get("no_such_task") is None
    with pytest.raises(ConfigError, match=r"brax:nope is not in the installed Brax"):
        TASKS.get("brax:nope")


@pytest.mark.long
def test_a_worker_runs_the_example():
    task = user_task.describe(EXAMPLE)
    shape = PolicySpec((task.observation_size, 8, task.action_size))
    worker_spec = spec(
        environment=EXAMPLE, environment_options={"walls": "first"}, policy=shape, episode_steps=20,
        chunk_pairs=2, rollout_block_pairs=2, gradient_block_pairs=2,
    )  # fmt: skip
    from es_service.protocol.messages import TrainingChunk

    point = centre(random_parameters(size=shape.parameters), observation_size=task.observation_size)
    result = chunk_runner(worker_spec)(point, TrainingChunk(1, 0))
    assert result.descriptor.shape == (2, 2, 2)
    assert np.isfinite(result.fitness).all()
    environment = make_environment(EXAMPLE, {})
    assert np.isnan(environment.goal_distance(None))


def test_versions_that_do_not_work_are_named(monkeypatch):
    monkeypatch.setitem(brax_task.WORKS_WITH, "mujoco", ("3.2.", "3.3."))
    with pytest.raises(
        TaskError, match=r"mujoco \S+ is installed, but mujoco 3\.2\.\* or 3\.3\.\* is required: pip install"
    ):
        brax_task.check_versions()
    monkeypatch.setitem(brax_task.WORKS_WITH, "no-such-package", ("1.",))
    monkeypatch.delitem(brax_task.WORKS_WITH, "mujoco")
    with pytest.raises(TaskError, match=r"no-such-package is not installed"):
        brax_task.check_versions()


def test_an_ant_of_mjx_runs_with_simd():
    """The check of a run with `compute.rollout: auto`."""
    options = {"backend": "mjx"}
    assert rollout.why_not(describe_environment("brax:ant", {"options": options}), options) == ""


@pytest.mark.long
def test_episodes_of_an_ant_of_mjx_are_those_of_xla():
    options = {"descriptor": "final_xy", "backend": "mjx"}
    shape = PolicySpec((27, 8))
    given = {"environment": "brax:ant", "environment_options": options, "policy": shape, "episode_steps": 10}
    point = centre(random_parameters(size=shape.parameters), observation_size=27)
    runners = (chunk_runner(spec(rollout=name, **given)) for name in ("simd", "xla"))
    ours, theirs = (run(point, EvaluationChunk(1, 0)) for run in runners)
    assert isinstance(ours, EpisodesResult)
    assert isinstance(theirs, EpisodesResult)
    np.testing.assert_allclose(ours.returns, theirs.returns, rtol=1e-3)
    np.testing.assert_allclose(ours.descriptor, theirs.descriptor, atol=1e-3)  # paths separate after contacts
