"""Where episodes end: nothing after `done` counts, and nothing of an invalid episode."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import EpisodesResult, TrainingChunk
from tests.helpers import centre, chunk_runner, random_parameters
from workers import environments
from workers.environments import Environment
from workers.worker import episode_keys


def counting_environment(lifetimes, poison_after_done: bool, gets_up: bool = False) -> Environment:
    """State = (own lifetime, steps so far): reward is the step's number, done at the lifetime, NaN afterwards.

    With `gets_up` it is done in that step only, as a body that falls and stands up again.
    """

    def reset(key):
        return jnp.stack([jnp.asarray(lifetimes, jnp.float32)[key[0] % len(lifetimes)], jnp.float32(0)])

    def step(state, action):
        lifetime, t = state[0], state[1] + 1
        value = jnp.where((t > lifetime) & poison_after_done, jnp.nan, t)
        return jnp.stack([lifetime, t]), value, t == lifetime if gets_up else t >= lifetime

    return Environment(
        reset=reset,
        observe=lambda state: jnp.where((state[1] >= state[0]) & poison_after_done, jnp.nan, state),
        step=step,
        descriptor=lambda state: jnp.where((state[1] > state[0]) & poison_after_done, jnp.nan, state),
        goal_distance=lambda state: 100.0 - state[1],
    )


@pytest.mark.parametrize("fitness", ["sum", "final"])
def test_steps_after_done_never_count(spec, monkeypatch, fitness):
    """Nothing after `done` reaches return, descriptor, distances or statistics, even if it is NaN, or not done."""
    environment = counting_environment([1, 5, 17, 1000], poison_after_done=True, gets_up=True)
    monkeypatch.setattr(environments, "make_environment", lambda name, options: environment)
    result = chunk_runner(spec(episode_steps=30, fitness=fitness))(centre(random_parameters()), TrainingChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    n = result.steps.astype(float)
    assert set(n.ravel()) <= {1, 5, 17, 30}
    assert len(set(n.ravel())) >= 3
    np.testing.assert_array_equal(result.returns, n * (n + 1) / 2)
    np.testing.assert_array_equal(result.fitness, n * (n + 1) / 2 if fitness == "sum" else n)
    np.testing.assert_array_equal(result.descriptor[..., 1], n)
    np.testing.assert_array_equal(result.goal_distance, np.stack([100 - n, 100 - n], -1))
    assert result.moments is not None
    assert result.moments.count == n.sum()
    counted = np.concatenate([np.arange(k) for k in n.ravel()])  # the step number, observed before each step
    assert result.moments.mean_O[1] == pytest.approx(counted.mean())
    assert result.moments.m2_O[1] == pytest.approx(counted.var() * counted.size, rel=1e-5)


def test_a_chunk_stops_when_all_its_members_are_done(spec, monkeypatch):
    environment = counting_environment([1, 5, 17], poison_after_done=False)
    monkeypatch.setattr(environments, "make_environment", lambda name, options: environment)
    endless = spec(episode_steps=2_000_000_000)  # hours, if it did not
    result = chunk_runner(endless)(centre(random_parameters()), TrainingChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    assert result.steps.max() == 17


def test_a_member_that_returns_nan_is_seen_and_does_not_poison_the_statistics(spec, monkeypatch):
    environment = counting_environment([1, 5, 17, 1000], poison_after_done=False)
    broken = Environment(
        reset=environment.reset,
        observe=lambda state: jnp.where(state[0] == 5.0, jnp.nan, state),
        step=lambda state, action: (state + jnp.array([0.0, 1.0]), jnp.sum(action), state[1] + 1 >= state[0]),
        descriptor=environment.descriptor,
        goal_distance=environment.goal_distance,
    )
    monkeypatch.setattr(environments, "make_environment", lambda name, options: broken)
    result = chunk_runner(spec(episode_steps=30))(centre(random_parameters()), TrainingChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    assert result.moments is not None
    invalid = ~np.isfinite(result.fitness)
    assert 0 < invalid.sum() < invalid.size
    assert np.isfinite(result.moments.mean_O).all()
    assert result.moments.count == result.steps[~invalid].sum()


@pytest.mark.parametrize("broken", ["fitness", "descriptor"])
def test_what_an_invalid_episode_saw_is_left_out_though_it_is_finite(spec, monkeypatch, broken):
    """A member that blows up sees 1e12 for a while: in the run's statistics that would stay."""
    counting = counting_environment([1, 5, 17, 1000], poison_after_done=False)

    def step(state, action):
        state, reward, done = counting.step(state, action)
        return state, jnp.where((state[0] == 5.0) & (broken == "fitness"), jnp.nan, reward), done

    def descriptor(state):
        return jnp.where((state[0] == 5.0) & (broken == "descriptor"), jnp.inf, state)

    blows_up = dataclasses.replace(
        counting,
        observe=lambda state: jnp.where(state[0] == 5.0, 1e12 + state, state),
        step=step,
        descriptor=descriptor,
    )
    monkeypatch.setattr(environments, "make_environment", lambda name, options: blows_up)
    run_chunk = chunk_runner(spec(episode_steps=30, episodes_per_member=3))
    result = run_chunk(centre(random_parameters()), TrainingChunk(1, 0))
    assert isinstance(result, EpisodesResult)
    assert result.moments is not None
    assert not np.isfinite(getattr(result, broken)).all()
    assert (np.abs(result.moments.mean_O) < 1000).all()
    assert (result.moments.m2_O / result.moments.count < 1e6).all()
    assert 0 < result.moments.count < result.steps.sum()
    lifetimes = np.array([1, 5, 17, 1000])[episode_keys(spec(episodes_per_member=3), 1, np.arange(8))[0][..., 0] % 4]
    assert result.moments.count == np.minimum(lifetimes, 30)[lifetimes != 5].sum()
