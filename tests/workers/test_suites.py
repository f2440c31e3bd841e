"""Environments of suites as tasks: the shared base with a small suite, and each suite's own first steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.noise import Domain, stream_keys
from workers.environments import TaskError, describe_environment, make_environment
from workers.environments.suite_task import (
    Actuators,
    Choices,
    Suite,
    describe_suite,
    make_suite,
    require_known,
    suite_package,
)
from workers.simd.episodes.kernel import compile_kernel

SEEDS, STEPS = 20, 50


class Seen(NamedTuple):
    places: Any
    counts: Any


def grid(**changes: Any) -> Suite:
    """A walker on a line of five places that slips at random; it may not walk beyond the ends."""

    def reset(key: Any) -> tuple[Any, Any]:
        place = jax.random.randint(key, (), 0, 5)
        return {"place": place, "steps": 0}, seen(place, 0)

    def seen(place: Any, steps: Any) -> Seen:
        return Seen(jax.nn.one_hot(place, 5).astype(bool), {"b": jnp.full((1, 2), steps), "a": jnp.int8(place)})

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        slips = jax.random.bernoulli(key, 0.25)
        place = jnp.clip(state["place"] + jnp.where(slips, 0, action - 1), 0, 4)
        return (
            {"place": place, "steps": state["steps"] + 1},
            seen(place, state["steps"] + 1),
            place,
            state["steps"] == 8,
        )

    def mask(state: Any) -> Any:
        return jnp.stack([state["place"] > 0, True, state["place"] < 4])

    return Suite(**{"name": "toys:Line", "reset": reset, "step": step, "actions": Choices((3,)), "episode_steps": 9,
                    "mask": mask} | changes)  # fmt: skip


def steps_of(environment: Any, actions_T_A: Any) -> Any:
    """Function of a reset key that gives (observations, rewards, ends) of these steps."""

    def run(key: Any) -> Any:
        def step(state: Any, action_A: Any) -> Any:
            state, reward, done = environment.step(state, action_A)
            return state, (environment.observe(state), reward, done)

        state = environment.reset(key)
        return environment.observe(state), jax.lax.scan(step, state, actions_T_A)[1]

    return run


def keys() -> np.ndarray:
    return stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(SEEDS))


def test_observations_keys_actions_and_masks_of_a_suite() -> None:
    """By hand: arrays in JAX's order, keys folded with the number of the step, forbidden choices not taken."""
    suite, environment = grid(), make_suite(grid(), [5, 0])
    task = describe_suite(suite, {}, {"descriptor": [5, 0]})
    assert (task.observation_size, task.action_size, task.episode_steps) == (8, 3, 9)
    assert task.descriptor_names == ("observation_5", "observation_0")
    assert not task.discrete_actions  # its outputs are preferences among what the mask allows
    key = keys()[0]
    raw = jnp.asarray(key[:2])
    state, place = environment.reset(key), int(jax.random.randint(jax.random.fold_in(raw, 0), (), 0, 5))
    preferences = jnp.array([0.1, -0.5, 0.9])
    for number in range(1, 10):
        state, reward, done = environment.step(state, preferences)
        wanted = 2 if place < 4 else 0
        slips = bool(jax.random.bernoulli(jax.random.fold_in(raw, number), 0.25))
        place += 0 if slips else wanted - 1
        seen = [*np.eye(5)[place], place, number, number]
        np.testing.assert_array_equal(environment.observe(state), np.array(seen, np.float32))
        np.testing.assert_array_equal(environment.descriptor(state), [place, place == 0])
        assert (float(reward), bool(done)) == (place, number == 9)


def test_several_choices_and_actuators() -> None:
    action = Choices((2, 3), single=False).of(jnp.array([0.1, 0.2, 0.5, 0.5, -1.0]), True)
    np.testing.assert_array_equal(action, [1, 0])
    actuators = Actuators(np.array([[0.0, -2.0]]), np.array([[4.0, 2.0]]))
    np.testing.assert_allclose(actuators.of(jnp.array([-1.0, 9.0]), True), [[0.0, 2.0]])
    np.testing.assert_allclose(actuators.of(jnp.array([0.5, 0.0]), True), [[3.0, 0.0]])


def test_what_the_actions_1_become_is_told_with_a_task() -> None:
    pushes = Actuators(np.array([-2.0, 0.0]), np.array([2.0, 1.0]))
    assert describe_suite(grid(actions=pushes, mask=None), {}, {}).action_bounds == ((-2.0, 2.0), (0.0, 1.0))
    assert describe_suite(grid(), {}, {}).action_bounds == ()


def test_simd_computes_the_steps_and_the_draws_of_a_suite() -> None:
    actions = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    run = steps_of(make_suite(grid()), actions)
    found = compile_kernel(run, jax.ShapeDtypeStruct((4,), jnp.uint32))(keys())
    wanted = jax.jit(jax.vmap(run))(keys())
    jax.tree.map(np.testing.assert_array_equal, found, jax.tree.map(np.asarray, wanted))


@pytest.mark.parametrize("descriptor", [[], [8], [-1], [0.5], "x", [True]])
def test_a_descriptor_that_is_no_place_in_an_observation_is_refused(descriptor: Any) -> None:
    with pytest.raises(TaskError, match=r"task\.options\.descriptor = .* must be a list of .* 0 to 7"):
        describe_suite(grid(), {}, {"descriptor": descriptor})


def test_what_is_missing_is_said_with_what_to_do() -> None:
    with pytest.raises(TaskError, match=r"toys_that_nobody_has is not installed; install it with pip install toys"):
        suite_package("toys_that_nobody_has", "pip install toys")
    with pytest.raises(
        TaskError, match=r"toys:Lin is not in the installed suite, which has .*; did you mean toys:Line"
    ):
        require_known("toys", "Lin", ["Line", "Grid"])


GYMNAX = ["CartPole-v1", "Pendulum-v1", "MountainCar-v0", "Acrobot-v1", "Breakout-MinAtar"]


@pytest.mark.slow
@pytest.mark.parametrize("name", GYMNAX)
def test_the_first_steps_of_gymnax_are_its_own_and_simds(name: str) -> None:
    gymnax = pytest.importorskip("gymnax")
    own, parameters = gymnax.make(name)
    task, environment = describe_environment(f"gymnax:{name}"), make_environment(f"gymnax:{name}", {})
    numbers = np.random.default_rng(0).uniform(-1, 1, (STEPS, task.action_size)).astype(np.float32)
    actions = np.argmax(numbers, 1) if task.discrete_actions else 2.0 * numbers  # the torque of Pendulum is within 2
    assert task.episode_steps == parameters.max_steps_in_episode

    def of_gymnax(key: Any) -> Any:
        def step(state: Any, given: Any) -> Any:
            number, action = given
            _, state, reward, terminated, truncated, info = own.step(
                jax.random.fold_in(key[:2], number), state, action, parameters
            )
            return state, (info["final_observation"].reshape(-1), reward, terminated | truncated)

        observation, state = own.reset(jax.random.fold_in(key[:2], 0), parameters)
        return observation.reshape(-1), jax.lax.scan(step, state, (np.arange(1, STEPS + 1), actions))[1]

    run = steps_of(environment, numbers)
    compare(jax.jit(jax.vmap(run))(keys()), jax.jit(jax.vmap(of_gymnax))(keys()))
    compare(compile_kernel(run, jax.ShapeDtypeStruct((4,), jnp.uint32))(keys()), jax.jit(jax.vmap(run))(keys()))


@pytest.mark.slow
def test_the_bounds_of_a_gymnax_descriptor_follow_its_options() -> None:
    pytest.importorskip("gymnax")
    for options, most in ({}, 8.0), ({"max_speed": 3.0}, 3.0):
        task = describe_environment("gymnax:Pendulum-v1", {"options": {"descriptor": [2], **options}})
        assert (task.descriptor_bounds, task.action_bounds) == (((-most, most),), ((-2.0, 2.0),))


@pytest.mark.long
@pytest.mark.parametrize("name", ["CartpoleBalance", "PendulumSwingup", "ReacherEasy"])
def test_the_first_steps_of_playground_are_its_own_and_simds(name: str) -> None:
    registry = pytest.importorskip("mujoco_playground").registry
    own = registry.load(name, config_overrides={"impl": "jax"})
    task, environment = describe_environment(f"playground:{name}"), make_environment(f"playground:{name}", {})
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, task.action_size)).astype(np.float32)

    def of_playground(key: Any) -> Any:
        def step(state: Any, action: Any) -> Any:
            state = own.step(state, action)
            return state, (state.obs, state.reward, state.done > 0.5)

        first = own.reset(jax.random.fold_in(key[:2], 0))
        return first.obs, jax.lax.scan(step, first, actions)[1]

    run = steps_of(environment, actions)
    wanted = jax.jit(jax.vmap(of_playground))(keys())
    compare(jax.jit(jax.vmap(run))(keys()), wanted, 1e-3)
    compare(compile_kernel(run, jax.ShapeDtypeStruct((4,), jnp.uint32))(keys()), wanted, 1e-2)


def compare(found: Any, wanted: Any, tolerance: float = 2e-4) -> None:
    """Compare observations, rewards and ends until each episode's end, after which the two go on differently."""
    (first, (seen, reward, done)), (own_first, (own_seen, own_reward, own_done)) = (
        jax.tree.map(np.asarray, one) for one in (found, wanted)
    )
    np.testing.assert_allclose(first, own_first, rtol=tolerance, atol=tolerance)
    counts = np.cumsum(own_done, 1) - own_done == 0
    np.testing.assert_array_equal(done & counts, own_done & counts)
    np.testing.assert_allclose(reward[counts], own_reward[counts], rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(seen[counts], own_seen[counts], rtol=tolerance, atol=tolerance)
