"""Noise of low rank: its definition, and members and gradients of every rollout, which are those of NumPy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

import workers.xla
from es_service.protocol.messages import EpisodesResult, GradientChunk, GradientResult, PolicySpec, TrainingChunk
from es_service.protocol.noise import NORMAL_STD, Domain, normals, stream_keys
from es_service.protocol.policy_spec import LayerNoise, layers_of_noise, noise_integers, numbers
from tests import helpers
from tests.helpers import centre, chunk_runner, random_parameters
from workers.policy import act, gradient_summer, initial_memory, initial_parameters, members, split_layers
from workers.simd.episodes.low_rank import make_low_rank_gradient_sum
from workers.xla import act_low_rank

PAIRS, UNIT = 3, np.float32(0.05 / NORMAL_STD)
POLICY = PolicySpec((5, 7, 4, 2))


def keys(pairs: int = PAIRS) -> Any:
    return stream_keys(0, Domain.PARAMETER_NOISE, 0, np.arange(pairs))


def by_hand(policy: PolicySpec, rank: int, key: Any) -> np.ndarray:
    """Standard normal noise of a pair, weight by weight."""
    drawn = iter(normals(key, numbers(policy, rank)).astype(float))
    found: list[float] = []
    for inputs, outputs in policy.layers:
        a = [[next(drawn) for _ in range(inputs)] for _ in range(rank)]
        b = [[next(drawn) for _ in range(outputs)] for _ in range(rank)]
        for i in range(inputs):
            found += [sum(a[r][i] * b[r][j] for r in range(rank)) / rank**0.5 for j in range(outputs)]
        found += [next(drawn) for _ in range(outputs * policy.bias)]
    assert next(drawn, None) is None
    return np.array(found)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("rank", [1, 2, 5])
def test_the_noise_is_a_product_of_thin_matrices(rank, bias):
    policy = replace(POLICY, bias=bias)
    found_P_D = noise_integers(policy, rank, keys())
    for key, found_D in zip(keys(), found_P_D, strict=True):
        np.testing.assert_allclose(found_D / NORMAL_STD, by_hand(policy, rank, key), rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(noise_integers(policy, rank, key), found_D)
        weights = split_layers(policy, found_D)[0][0]
        assert np.linalg.matrix_rank(weights, tol=1e-2) == min(rank, *weights.shape)


def test_rank_0_is_a_number_for_each_parameter():
    found_P_D = noise_integers(POLICY, 0, keys())
    np.testing.assert_allclose(found_P_D / NORMAL_STD, normals(keys(), POLICY.parameters), rtol=1e-6)


def test_no_two_numbers_have_one_coordinate():
    layers = layers_of_noise(POLICY, 3)
    assert all(isinstance(one, LayerNoise) and one.bias is not None for one in layers)
    used = np.concatenate([array.reshape(-1) for one in layers for array in one if array is not None])
    np.testing.assert_array_equal(np.sort(used), np.arange(numbers(POLICY, 3)))


@pytest.mark.parametrize("rank", [1, 4])
def test_the_noise_has_mean_0_variance_1_and_no_correlations(rank):
    """Of 20,000 pairs, between weights of one row, of one column and of neither, and of a bias."""
    policy = PolicySpec((3, 2))
    noise_P_D = noise_integers(policy, rank, keys(20_000)) / NORMAL_STD
    np.testing.assert_allclose(noise_P_D.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(noise_P_D.var(axis=0), 1.0, atol=0.07)
    correlations = np.corrcoef(noise_P_D.T) - np.eye(policy.parameters)
    np.testing.assert_allclose(correlations, 0.0, atol=0.04)


@pytest.mark.parametrize("rank", [1, 3])
@pytest.mark.parametrize(
    "changes",
    [{}, {"activation": "relu"}, {"bias": False}, {"output": "linear"}, {"memory": 6}, {"widths": (5, 2)}],
    ids=str,
)
def test_outputs_of_members_are_those_of_their_weights(changes, rank):
    policy = replace(POLICY, **changes)
    centre_D = initial_parameters(policy, "unit_columns", 0)
    drawn_P_N = np.rint(normals(keys(), numbers(policy, rank)) * np.float32(NORMAL_STD))
    observation_M_O = np.random.default_rng(0).normal(size=(2 * PAIRS, 5)).astype(np.float32)
    memory_M_H = initial_memory(np, policy, 2 * PAIRS)
    given = None if memory_M_H is None else memory_M_H + np.float32(0.5)
    found_M_A, after_M_H = jax.jit(act_low_rank(policy, rank, centre_D, UNIT, drawn_P_N))(given, observation_M_O)
    parameters_M_D = members(helpers.spec(policy=policy, noise_rank=rank), centre_D, UNIT, keys())
    for member, parameters_D in enumerate(parameters_M_D.reshape(-1, policy.parameters)):
        layers, memory_H = split_layers(policy, parameters_D), None if given is None else given[member]
        expected_A, expected_H = act(np, policy, layers, memory_H, observation_M_O[member])
        np.testing.assert_allclose(found_M_A[member], expected_A, rtol=2e-5, atol=2e-5)
        if given is not None:
            np.testing.assert_allclose(after_M_H[member], expected_H, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("widths", "rank"), [((5, 7, 4, 2), 1), ((3, 2), 3), ((2, 70, 130, 8), 2)])
def test_gradients_are_sums_of_the_members_noise(widths, rank, bias):
    policy, pairs = PolicySpec(widths, bias=bias), 9
    weights_P = np.random.default_rng(0).normal(size=pairs).astype(np.float32)
    wanted_D = weights_P.astype(float) @ noise_integers(policy, rank, keys(pairs)) / NORMAL_STD
    spec = helpers.spec(policy=policy, noise_rank=rank)
    found = [
        gradient_summer(spec)(weights_P, keys(pairs)),
        workers.xla.make_low_rank_gradient_sum(policy, rank)(weights_P, keys(pairs)),
        make_low_rank_gradient_sum(policy, rank)(weights_P, keys(pairs)),
    ]
    for one in found:
        np.testing.assert_allclose(one, wanted_D, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("rank", [1, 2])
@pytest.mark.parametrize("hidden", [(), (8, 8), (40,)], ids=str)
def test_simd_and_xla_compute_what_explicit_members_do(hidden, rank):
    policy = PolicySpec((2, *hidden, 2))
    spec = helpers.spec(policy=policy, noise_rank=rank, action_noise=0.0, episode_steps=30)
    parameters_D, chunk = random_parameters(1, policy.parameters), TrainingChunk(1, 1)
    around = centre(parameters_D, sigma=0.1)
    noise_keys = stream_keys(spec.seed, Domain.PARAMETER_NOISE, 1, np.arange(8, 16))
    parameters_P_S_D = members(spec, parameters_D, np.float32(0.1 / NORMAL_STD), noise_keys)
    xla, simd = (chunk_runner(replace(spec, rollout=name))(around, chunk) for name in ("xla", "simd"))
    assert isinstance(xla, EpisodesResult)
    assert isinstance(simd, EpisodesResult)
    assert len(np.unique(xla.returns)) > 8
    np.testing.assert_allclose(simd.returns, xla.returns, atol=1e-3)
    for pair, sign in ((0, 0), (3, 1), (7, 0)):
        # The centre of a population with the same streams and no noise is that member.
        same = replace(spec, noise_rank=0)
        alone = chunk_runner(same)(centre(parameters_P_S_D[pair, sign], sigma=1e-12), chunk)
        assert isinstance(alone, EpisodesResult)
        np.testing.assert_allclose(alone.returns[pair, sign], xla.returns[pair, sign], atol=1e-3)


def test_gradient_chunks_of_all_rollouts_are_those_of_the_members():
    spec, weights_P = helpers.spec(noise_rank=2), np.random.default_rng(0).normal(size=8).astype(np.float32)
    noise_P_D = noise_integers(spec.policy, 2, stream_keys(spec.seed, Domain.PARAMETER_NOISE, 1, np.arange(24, 32)))
    for name in ("xla", "simd"):
        found = chunk_runner(replace(spec, rollout=name))(centre(random_parameters()), GradientChunk(1, 3, weights_P))
        assert isinstance(found, GradientResult)
        np.testing.assert_allclose(found.sum_D, weights_P.astype(float) @ noise_P_D / NORMAL_STD, rtol=1e-5, atol=1e-5)
