"""Compiled episodes against a step-by-step NumPy episode, and the ways episodes have silently gone wrong elsewhere."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import (
    EpisodesResult,
    EvaluationChunk,
    GradientChunk,
    GradientResult,
    PolicySpec,
    TrainingChunk,
)
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, normals, stream_keys
from es_service.runs.view import Policy
from tests import helpers
from tests.helpers import PARAMETERS, centre, chunk_runner, random_parameters
from tests.references import noise as noise_reference
from tests.references import point_maze as maze_reference
from workers import environments
from workers.environments import Environment, make_environment
from workers.worker import episode_keys
from workers.xla import make_training_rollout

SHAPE = PolicySpec((2, 8, 8, 2))
MEAN, STD = np.float32([0.1, -0.4]), np.float32([0.3, 0.6])


def numpy_episode(parameters_D, reset_key, action_key, action_noise, steps=200):
    """One PointMaze episode with the scalar reference and the NumPy policy: returns, steps, end, observations."""
    policy = Policy(SHAPE, parameters_D, MEAN, STD, 5.0)
    x = -0.1 + 0.2 * noise_reference.uniform(reset_key, 0)
    y = -1.0 + 0.3 * noise_reference.uniform(reset_key, 1)
    total, seen, distances = 0.0, [], []
    for t in range(steps):
        seen.append((x, y))
        noise = np.array([noise_reference.normal_integer(action_key, 2 * t + i) for i in range(2)]) / NORMAL_STD
        action = policy(np.float32([x, y])) + action_noise * noise
        x, y, reward, done = maze_reference.step(x, y, (float(action[0]), float(action[1])))
        total += reward
        distances.append(-reward)
        if done:
            break
    return total, len(seen), (x, y), np.array(seen), (distances[-1], min(distances))


def run(chunk, worker_spec, parameters_D, sigma=0.1):
    point = centre(parameters_D, sigma=sigma)
    point = type(point)(point.generation, point.parameters_D, sigma, MEAN, STD)
    return chunk_runner(worker_spec)(point, chunk)


def test_training_chunk_equals_numpy_episodes(spec):
    worker_spec, parameters_D = spec(), random_parameters(1)
    result = run(TrainingChunk(1, 2), worker_spec, parameters_D)
    assert isinstance(result, EpisodesResult)
    observed = []
    for p, pair in enumerate(range(16, 24)):
        direction = normals(stream_keys(3, Domain.PARAMETER_NOISE, 1, pair), PARAMETERS)
        reset = noise_reference.stream_key(3, Domain.TRAINING_RESET, 1, pair, 0, 0)
        action = noise_reference.stream_key(3, Domain.ACTION_NOISE, 1, pair, 0, 0)
        for s, sign in enumerate((1.0, -1.0)):
            member = (parameters_D + sign * 0.1 * direction).astype(np.float32)
            total, steps, end, seen, distances = numpy_episode(member, reset, action, 0.01)
            assert result.fitness[p, s] == result.returns[p, s] == pytest.approx(total, abs=2e-2)
            assert result.steps[p, s] == steps
            np.testing.assert_allclose(result.descriptor[p, s], end, atol=1e-3)
            np.testing.assert_allclose(result.goal_distance[p, s], distances, atol=1e-3)
            observed.append(seen)
    seen = np.concatenate(observed)
    assert result.moments is not None
    assert result.moments.count == len(seen)
    np.testing.assert_allclose(result.moments.mean_O, seen.mean(0), atol=1e-4)
    np.testing.assert_allclose(result.moments.m2_O / len(seen), seen.var(0), rtol=1e-3)


def test_evaluation_chunk_equals_numpy_episodes_and_has_no_noise(spec):
    parameters_D = random_parameters(2)
    result = run(EvaluationChunk(4, 1), spec(action_noise=0.5), parameters_D)
    assert isinstance(result, EpisodesResult)
    assert result.moments is None
    for e, episode in enumerate(range(16, 32)):
        reset = noise_reference.stream_key(3, Domain.EVALUATION_RESET, 4, episode)
        total, steps, end, _, _ = numpy_episode(parameters_D, reset, [0, 0, 0, 0], 0.0)
        assert result.fitness[e] == pytest.approx(total, abs=2e-2)
        assert result.steps[e] == steps
        np.testing.assert_allclose(result.descriptor[e], end, atol=1e-3)


def test_an_evaluation_of_fewer_episodes_has_the_bits_of_the_first_ones(spec):
    parameters_D = random_parameters(2)
    whole, few = (run(EvaluationChunk(4, 1, episodes=count), spec(), parameters_D) for count in (16, 3))
    assert isinstance(whole, EpisodesResult)
    assert isinstance(few, EpisodesResult)
    for name in ("fitness", "returns", "descriptor", "steps", "goal_distance"):
        np.testing.assert_array_equal(getattr(few, name), getattr(whole, name)[:3])
    np.testing.assert_array_equal(few.trace_T_B, whole.trace_T_B)


def test_gradient_chunk_is_the_weighted_sum_of_the_rollout_s_noise(spec):
    weights = np.random.default_rng(0).normal(size=8).astype(np.float32)
    result = run(GradientChunk(1, 3, weights), spec(), random_parameters())
    assert isinstance(result, GradientResult)
    keys = stream_keys(3, Domain.PARAMETER_NOISE, 1, np.arange(24, 32))
    integers = np.stack([normal_integers(np, key, np.arange(PARAMETERS, dtype=np.uint32)) for key in keys])
    np.testing.assert_allclose(result.sum_D, weights.astype(float) @ integers / NORMAL_STD, rtol=1e-5, atol=1e-5)


def test_common_random_numbers_share_starts_within_a_pair_only(spec):
    """With sigma 0 and a common start both signs are the same episode; without, they differ; pairs always differ."""
    for common in (True, False):
        result = run(TrainingChunk(1, 0), spec(common_random_numbers=common), random_parameters(1), sigma=0.0)
        assert isinstance(result, EpisodesResult)
        assert np.array_equal(result.fitness[:, 0], result.fitness[:, 1]) is common
        assert len(np.unique(result.fitness[:, 0])) == 8


def test_episodes_per_member_average(spec):
    """Fitness and descriptor are means over the member's episodes, steps their sum, episodes start differently."""
    parameters_D = random_parameters(1)
    three = run(TrainingChunk(1, 0), spec(episodes_per_member=3), parameters_D)
    assert isinstance(three, EpisodesResult)
    singles = []
    for e in range(3):
        pairs = [
            numpy_episode(
                (parameters_D + 0.1 * normals(stream_keys(3, Domain.PARAMETER_NOISE, 1, p), PARAMETERS)),
                noise_reference.stream_key(3, Domain.TRAINING_RESET, 1, p, 0, e),
                noise_reference.stream_key(3, Domain.ACTION_NOISE, 1, p, 0, e),
                0.01,
            )
            for p in range(2)
        ]
        singles.append(pairs)
    for p in range(2):
        assert three.fitness[p, 0] == pytest.approx(np.mean([singles[e][p][0] for e in range(3)]), abs=2e-2)
        np.testing.assert_allclose(three.descriptor[p, 0], np.mean([singles[e][p][2] for e in range(3)], 0), atol=1e-3)
        assert three.steps[p, 0] == sum(singles[e][p][1] for e in range(3))


@pytest.mark.parametrize("kind", [TrainingChunk, EvaluationChunk])
def test_results_do_not_alias_each_other(spec, kind):
    """The fault this guards: descriptors or traces that are views of memory which the next rollout overwrites."""
    worker = chunk_runner(spec())
    first = worker(centre(random_parameters(1)), kind(1, 0))
    arrays = {name: value for name, value in vars(first).items() if isinstance(value, np.ndarray)}
    assert arrays.keys() >= {"descriptor", *(["trace_T_B"] if kind is EvaluationChunk else [])}
    kept = {name: value.copy() for name, value in arrays.items()}
    worker(centre(random_parameters(2)), kind(2, 1))
    np.testing.assert_equal(arrays, kept)
    assert [name for name, value in arrays.items() if not value.flags.owndata] == []


def test_memory_of_xla_does_not_grow_with_the_length_of_episodes():
    """What XLA sets aside for a chunk is the same for 200 steps and for 20,000."""
    sizes = []
    for steps in (200, 20_000):
        worker_spec = helpers.spec(episode_steps=steps)
        rollout = make_training_rollout(make_environment("point_maze", {}), worker_spec)
        pairs = np.arange(8)
        keys = stream_keys(0, Domain.PARAMETER_NOISE, 1, pairs)
        episodes = episode_keys(worker_spec, 1, pairs)[0]
        arguments = (random_parameters(), np.float32(0.1), MEAN, STD, keys, episodes, episodes)
        compiled = jax.jit(rollout).lower(*arguments).compile()
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
    assert sizes[0] == sizes[1] > 0


def test_every_function_is_traced_once(spec, monkeypatch):
    """Recompiling for a new generation, chunk or centre would cost more than the rollout."""
    traces = []
    original = make_environment("point_maze", {})

    def step(state, action):
        traces.append(1)
        return original.step(state, action)

    counted = dataclasses.replace(original, step=step)
    monkeypatch.setattr(environments, "make_environment", lambda name, options: counted)
    worker = chunk_runner(spec())
    for generation in range(1, 4):
        for chunk in (0, 1):
            worker(centre(random_parameters(generation), generation), TrainingChunk(generation, chunk))
            worker(centre(random_parameters(generation), generation), EvaluationChunk(generation, chunk))
        if generation == 1:
            first = len(traces)
    assert len(traces) == first


def test_numpy_policy_equals_the_rollout_s(spec, monkeypatch):
    """One step of an environment whose reward is its first action: the exported policy says the same."""
    one_step = Environment(
        reset=lambda key: jnp.stack([(key[0] % 7).astype(jnp.float32) - 3.0, jnp.float32(0.5)]),
        observe=lambda state: state,
        step=lambda state, action: (state, action[0], jnp.bool_(True)),
        descriptor=lambda state: state,
        goal_distance=lambda state: jnp.float32(jnp.nan),
    )
    monkeypatch.setattr(environments, "make_environment", lambda name, options: one_step)
    parameters_D = random_parameters(5)
    result = run(EvaluationChunk(1, 0), spec(), parameters_D)
    assert isinstance(result, EpisodesResult)
    policy = Policy(SHAPE, parameters_D, MEAN, STD, 5.0)
    np.testing.assert_allclose(result.returns, policy(result.descriptor)[:, 0], atol=1e-6)
    assert np.isnan(result.goal_distance).all()
