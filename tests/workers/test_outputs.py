"""Outputs that a run names: what they are, and that the other results have the same bits with and without them."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.episodes import TRANSITIONS
from es_service.protocol.messages import EpisodesResult, EvaluationChunk, PolicySpec, TrainingChunk, WorkerSpec
from es_service.protocol.noise import evaluation_reset_keys
from es_service.runs.evaluator import Transitions, transitions_of
from tests.helpers import DirectEvaluator, centre, chunk_runner, random_parameters
from tests.workers.simd.rollouts import task_spec
from tests.workers.steps import environment_of, resets_of
from tests.workers.test_policies import bits, evaluate
from workers import environments
from workers.environments import SHIPPED, Environment
from workers.episode import OUTPUTS
from workers.policy import initial_parameters
from workers.worker import episode_keys


def counting(success) -> Environment:
    """State = (lifetime, steps so far); an episode is done at its lifetime."""
    return Environment(
        reset=lambda key: jnp.stack([1.0 + (key[0] % 9).astype(jnp.float32), jnp.float32(0.0)]),
        observe=lambda state: state,
        step=lambda state, action: (state + jnp.array([0.0, 1.0]), jnp.float32(0.0), state[1] + 1 >= state[0]),
        descriptor=lambda state: state,
        goal_distance=lambda state: jnp.float32(jnp.nan),
        success=success,
    )


@pytest.mark.parametrize(
    ("success", "wanted"),
    [
        (lambda state, before: state[1] == 4.0, lambda steps: steps == 4),
        (lambda state, before: before | (state[1] == 4.0), lambda steps: steps >= 4),
        (lambda state, before: before | (state[1] == 0.0), lambda steps: steps >= 0),
        (lambda state, before: before, lambda steps: steps < 0),
    ],
    ids=["at the end", "once", "in the reset", "not declared"],
)
def test_success_is_that_of_the_last_valid_state(spec, monkeypatch, success, wanted):
    """A finished episode goes on in its lane, and what it does there must not count."""
    monkeypatch.setattr(environments, "make_environment", lambda name, options: counting(success))
    run = chunk_runner(spec(episode_steps=8, outputs=("success",)))
    result = run(centre(random_parameters()), EvaluationChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    steps = result.steps
    assert len(set(steps)) > 3
    assert result.outputs["success"].dtype == bool
    np.testing.assert_array_equal(result.outputs["success"], wanted(steps))
    of_policies = evaluate(DirectEvaluator(spec(episode_steps=8, outputs=("success",))))
    np.testing.assert_array_equal(of_policies.outputs["success"], wanted(of_policies.steps))


def test_a_member_has_the_mean_of_its_episodes(spec, monkeypatch):
    monkeypatch.setattr(environments, "make_environment", lambda name, options: counting(lambda state, _: state[1] > 4))
    given = spec(episode_steps=8, outputs=("success",), episodes_per_member=3, common_random_numbers=False)
    result = chunk_runner(given)(centre(random_parameters()), TrainingChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    resets_P_S_E, _ = episode_keys(given, 1, np.arange(given.chunk_pairs))
    is_long_P_S_E = 1 + resets_P_S_E[..., 0] % 9 > 4
    assert result.outputs["success"].dtype == np.float32
    np.testing.assert_allclose(result.outputs["success"], is_long_P_S_E.mean(axis=-1), atol=1e-6)
    assert len(np.unique(result.outputs["success"])) > 2


def evaluated(worker_spec: WorkerSpec) -> tuple[EpisodesResult, Transitions]:
    result = evaluate(DirectEvaluator(worker_spec))
    return result, transitions_of(result)


def test_transitions_are_the_steps_of_the_task(spec):
    """Each episode again by the task's own functions, from its reset with the actions that it had."""
    short = spec(episode_steps=30, outputs=("first_observation", *TRANSITIONS))
    result, found = evaluated(short)
    task = environment_of("point_maze")
    step, observe = jax.jit(jax.vmap(task.step)), jax.jit(jax.vmap(task.observe))
    assert len(found.reward) == result.steps.sum()
    policy, episode = (index.reshape(-1) for index in np.indices(result.steps.shape))
    states = jax.vmap(task.reset)(evaluation_reset_keys(5, 9, episode, 0, policy))
    first = np.array([found.rows(*one).start for one in zip(policy, episode, strict=True)])
    for number in range(30):
        goes_on = result.steps.reshape(-1) > number
        at = first[goes_on] + number
        np.testing.assert_allclose(found.observation[at], np.asarray(observe(states))[goes_on], atol=1e-6)
        actions = np.zeros((len(first), 2), np.float32)
        actions[goes_on] = found.action[at]
        states, rewards, done = step(states, actions)
        np.testing.assert_allclose(found.reward[at], np.asarray(rewards)[goes_on], atol=1e-5)
        np.testing.assert_array_equal(found.done[at], np.asarray(done)[goes_on])
        np.testing.assert_allclose(found.descriptor[at], np.asarray(states)[goes_on], atol=1e-6)
    np.testing.assert_array_equal(result.outputs["first_observation"].reshape(-1, 2), found.observation[first])
    last = first + result.steps.reshape(-1) - 1
    np.testing.assert_array_equal(found.descriptor[last], result.descriptor.reshape(-1, 2))
    np.testing.assert_array_equal(found.last_observation.reshape(-1, 2), result.descriptor.reshape(-1, 2))
    following = found.next_observation()
    inner = np.setdiff1d(np.arange(len(found.reward)), last)
    np.testing.assert_array_equal(following[inner], found.observation[inner + 1])
    np.testing.assert_array_equal(following[last], found.descriptor[last])


def test_transitions_end_with_the_step_that_is_done(spec, monkeypatch):
    monkeypatch.setattr(environments, "make_environment", lambda name, options: counting(lambda state, before: before))
    result, found = evaluated(spec(episode_steps=6, outputs=TRANSITIONS))
    assert set(result.steps.reshape(-1)) == {1, 2, 3, 4, 5, 6}
    for policy, episode in np.ndindex(result.steps.shape):
        rows, steps = found.rows(policy, episode), result.steps[policy, episode]
        lifetime = found.observation[rows][0, 0]
        np.testing.assert_array_equal(found.observation[rows, 1], np.arange(steps))
        np.testing.assert_array_equal(found.descriptor[rows, 1], np.arange(1, steps + 1))
        np.testing.assert_array_equal(found.done[rows], np.arange(1, steps + 1) >= lifetime)
        assert found.last_observation[policy, episode].tolist() == [lifetime, steps]


def test_actions_of_training_steps_have_their_noise(spec):
    quiet, noisy = (
        chunk_runner(spec(episode_steps=5, outputs=TRANSITIONS, action_noise=noise))(
            centre(random_parameters()), TrainingChunk(1, 0)
        )
        for noise in (0.0, 0.1)
    )
    assert isinstance(quiet, EpisodesResult)
    assert isinstance(noisy, EpisodesResult)
    assert len(noisy.of_steps["action"]) == noisy.steps.sum()
    first = np.cumsum(noisy.steps.reshape(-1)) - noisy.steps.reshape(-1)
    noise = (noisy.of_steps["action"] - quiet.of_steps["action"])[first]
    assert 0.05 < noise.std() < 0.2


@pytest.mark.parametrize("names", [("success",), ("last_reward", *TRANSITIONS)])
def test_an_output_changes_no_bit_of_the_other_results_of_a_small_task(spec, names):
    without, with_it = (evaluate(DirectEvaluator(spec(outputs=named))) for named in ((), names))
    assert bits(without) == bits(with_it)


def test_an_output_that_does_not_exist_is_named(spec):
    with pytest.raises(ValueError, match=r"no output of episodes has the name 'succes'; choose among success, "):
        chunk_runner(spec(outputs=("succes",)))(centre(random_parameters()), EvaluationChunk(1, 0))


@pytest.mark.long
@pytest.mark.parametrize("rollout", ["simd", "xla"])
@pytest.mark.parametrize("task", ["ant_trap", "ant_maze"])
def test_an_output_changes_no_bit_of_the_other_results_of_an_ant(task, rollout):
    shape = PolicySpec((SHIPPED[task].observation_size, 8, SHIPPED[task].action_size))
    worker_spec = replace(task_spec(task), policy=shape, episode_steps=50, rollout=rollout)
    parameters_D = initial_parameters(shape, "unit_columns", 3)
    size = SHIPPED[task].observation_size
    ant = replace(
        centre(parameters_D),
        observation_mean_O=np.zeros(size, np.float32),
        observation_std_O=np.ones(size, np.float32),
    )
    names = tuple(OUTPUTS.keys() - {"metrics"})  # which ants do not have
    found = [chunk_runner(replace(worker_spec, outputs=named))(ant, EvaluationChunk(1, 0)) for named in ((), names)]
    without, with_success = (result for result in found if isinstance(result, EpisodesResult))
    for name in ("fitness", "returns", "descriptor", "steps", "trace_T_B"):
        np.testing.assert_array_equal(getattr(without, name), getattr(with_success, name))
    assert not with_success.outputs["success"].any()


def at(task: str, x: float, y: float):
    """A state of an ant at a place."""
    ant = resets_of(task)(np.zeros((1, 4), np.uint32))
    return ant._replace(q=jnp.asarray(ant.q[0]).at[:2].set(jnp.array([x, y])))


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize(
    ("task", "place", "alone"),
    [
        ("ant_maze", (35.0, -20.01), True),
        ("ant_maze", (31.0, -28.1), False),
        ("ant_trap", (20.01, 7.0), True),
        ("ant_trap", (19.99, 0.0), False),
    ],
)
def test_success_of_the_ants(task, place, alone, before):
    """AntMaze: within 5 m of the goal (35, -25) at the end. AntTrap: beyond x = 20 at any time."""
    found = environment_of(task).success(at(task, *place), jnp.array(before))
    assert bool(found) == (alone or (before and task == "ant_trap"))


@pytest.mark.parametrize(("x", "y", "inside"), [(-0.5, 0.8, True), (-0.46, 0.84, True), (-0.44, 0.8, False)])
def test_success_of_point_maze(x, y, inside):
    position = jnp.array([x, y], jnp.float32)
    assert bool(environment_of("point_maze").success(position, jnp.array(False))) == inside


def test_the_tasks_say_which_episodes_succeed():
    assert all(task.success for task in SHIPPED.values())
