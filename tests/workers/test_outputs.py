"""Outputs that a run names: what they are, and that the other results have the same bits with and without them."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import EpisodesResult, EvaluationChunk, PolicySpec, TrainingChunk
from tests.helpers import DirectEvaluator, centre, chunk_runner, random_parameters
from tests.workers.simd.rollouts import task_spec
from tests.workers.steps import environment_of, resets_of
from tests.workers.test_policies import bits, evaluate
from workers import environments
from workers.environments import SHIPPED, Environment
from workers.policies.policy import initial_parameters


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


def test_training_episodes_have_no_such_outputs(spec):
    result = chunk_runner(spec(episode_steps=8, outputs=("success",)))(centre(random_parameters()), TrainingChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    assert not result.outputs


def test_an_output_changes_no_bit_of_the_other_results_of_a_small_task(spec):
    without, with_success = (evaluate(DirectEvaluator(spec(outputs=names))) for names in ((), ("success",)))
    assert bits(without) == bits(with_success)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "rollout"),
    [
        ("ant_trap", "simd"),
        pytest.param("ant_maze", "simd", marks=pytest.mark.long),
        pytest.param("ant_trap", "xla", marks=pytest.mark.long),
        pytest.param("ant_maze", "xla", marks=pytest.mark.long),
    ],
)
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
    found = [
        chunk_runner(replace(worker_spec, outputs=names))(ant, EvaluationChunk(1, 0)) for names in ((), ("success",))
    ]
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
