"""Our tasks as environments of Brax: the same functions, and a start of its own for every episode."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.environments.brax_env import TaskBraxEnv, wrap
from es_service.environments.vector import TaskVectorEnv
from es_service.protocol.noise import Domain, stream_keys
from workers.environments import TaskError
from workers.environments.brax_task import quietly

ENDING = "tests.examples.cart_pole:CartPole"


def keys_of(count: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(seed), count)  # Brax takes old keys only


def test_its_steps_are_those_of_the_compiled_environments(monkeypatch):
    env, envs = TaskBraxEnv("point_maze"), TaskVectorEnv("point_maze", 3)
    keys = stream_keys(0, Domain.ENVIRONMENT_RESET, 0, np.arange(3, dtype=np.uint64), np.zeros(3, np.int64))
    observation, _ = envs.reset(seed=0)
    with monkeypatch.context() as patch:
        patch.setattr(jax.random, "bits", lambda key, shape, dtype: key)
        state = jax.vmap(env.reset)(keys)
    assert (env.observation_size, env.action_size) == (2, 2)
    step, rng = jax.jit(jax.vmap(env.step)), np.random.default_rng(0)
    for _ in range(4):
        np.testing.assert_allclose(observation, state.obs, atol=1e-6)
        actions = rng.uniform(-1.5, 1.5, (3, 2)).astype(np.float32)
        observation, reward, _, _, info = envs.step(actions)
        state = step(state, actions)
        np.testing.assert_allclose(reward, state.reward, atol=1e-6)
        for name in ("descriptor", "success", "goal_distance"):
            np.testing.assert_allclose(info[name], state.info[name], atol=1e-6)


@pytest.mark.parametrize("task", [pytest.param("point_maze", marks=pytest.mark.long), ENDING])
def test_each_episode_has_a_start_of_its_own_that_depends_on_the_key_alone(task):
    count, length = 4, 30
    env = wrap(TaskBraxEnv(task), length)
    reset, step = jax.jit(env.reset), jax.jit(env.step)

    def played(seed: int) -> tuple[list, list]:
        state = reset(keys_of(count, seed))
        starts: list[list] = [[one] for one in np.asarray(state.obs)]
        ends = []
        for _ in range(100):
            before = state
            state = step(state, jnp.ones((count, env.action_size)) * jnp.array([1.0, -1.0]))
            over = np.asarray(state.done) > 0.5
            for lane in np.flatnonzero(over):
                starts[lane].append(np.asarray(state.obs)[lane])
                ends.append((int(state.info["steps"][lane]), float(state.info["truncation"][lane])))
            kept = state.info["reset_key"] == before.info["reset_key"]
            assert (np.asarray(kept).all(axis=1) == ~over).all()
        return starts, ends

    starts, ends = played(0)
    again, _ = played(0)
    flat = [one.tobytes() for lane in starts for one in lane]
    assert len(set(flat)) == len(flat) >= 4 * count
    assert flat == [one.tobytes() for lane in again for one in lane]
    if task == ENDING:
        assert all(steps < length and not truncated for steps, truncated in ends)
    else:
        assert set(ends) == {(length, 1.0)}


def test_brax_s_own_wrapper_takes_it_but_returns_to_the_first_start():
    with quietly():
        from brax.envs.wrappers.training import wrap as brax_wrap
    env = brax_wrap(TaskBraxEnv("point_maze"), 3)
    state = first = jax.jit(env.reset)(keys_of(2))
    step = jax.jit(env.step)
    for _ in range(3):
        state = step(state, jnp.ones((2, 2)))
    assert np.array_equal(state.obs, first.obs)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Brax's own
def test_a_trainer_of_brax_trains_on_it():
    with quietly():
        from brax.training.agents.es.train import train

    seen = []
    train(
        TaskBraxEnv("point_maze"),
        wrap_env_fn=wrap,
        episode_length=200,
        num_timesteps=200_000,
        population_size=64,
        num_eval_envs=16,
        num_evals=2,
        progress_fn=lambda steps, metrics: seen.append(float(metrics["eval/episode_reward"])),
    )
    assert len(seen) >= 2
    assert np.isfinite(seen).all()


def test_wrong_arguments_are_errors():
    with pytest.raises(TaskError, match="'point_mase' is not shipped"):
        TaskBraxEnv("point_mase")
    with pytest.raises(TaskError, match="no option 'begin'; its options: start"):
        TaskBraxEnv("point_maze", task_options={"begin": 1})
    with pytest.raises(ValueError, match="randomization_fn must be None"):
        wrap(TaskBraxEnv("point_maze"), randomization_fn=lambda system: system)  # pyright: ignore[reportArgumentType]
