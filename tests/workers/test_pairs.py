"""Policies computed in pairs, as on a GPU, are those of the members whose weights are added first."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from es_service.protocol.messages import PolicySpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from tests import helpers
from workers.environments import make_environment
from workers.policy import act, initial_memory, initial_parameters, split_layers
from workers.worker import episode_keys
from workers.xla import act_in_pairs, make_training_rollout

PAIRS, UNIT = 3, np.float32(0.05 / NORMAL_STD)


@pytest.mark.parametrize(
    "changes",
    [{}, {"activation": "relu"}, {"bias": False}, {"output": "linear"}, {"memory": 6}, {"widths": (5, 2)}],
    ids=str,
)
def test_the_outputs_are_those_of_numpy(changes):
    policy = replace(PolicySpec(widths=(5, 7, 4, 2)), **changes)
    centre_D = initial_parameters(policy, "unit_columns", 0)
    keys_P = stream_keys(0, Domain.PARAMETER_NOISE, 0, np.arange(PAIRS))
    noise_P_D = np.stack([normal_integers(np, key, np.arange(centre_D.size, dtype=np.uint32)) for key in keys_P])
    observation_M_O = np.random.default_rng(0).normal(size=(2 * PAIRS, 5)).astype(np.float32)
    memory_M_H = initial_memory(np, policy, 2 * PAIRS)
    given = None if memory_M_H is None else memory_M_H + np.float32(0.5)
    found_M_A, after_M_H = jax.jit(act_in_pairs(policy, centre_D, UNIT, noise_P_D))(given, observation_M_O)
    for member in range(2 * PAIRS):
        sign = 1.0 if member % 2 == 0 else -1.0
        layers = split_layers(policy, centre_D.astype(np.float64) + sign * float(UNIT) * noise_P_D[member // 2])
        memory_H = None if given is None else given[member]
        expected_A, expected_H = act(np, policy, layers, memory_H, observation_M_O[member].astype(np.float64))
        np.testing.assert_allclose(found_M_A[member], expected_A, rtol=2e-5, atol=2e-5)
        if given is not None:
            np.testing.assert_allclose(after_M_H[member], expected_H, rtol=2e-5, atol=2e-5)


def test_a_training_chunk_has_nearly_the_results_of_separate_members():
    spec = helpers.spec(rollout="xla")
    environment = make_environment("point_maze", {})
    pairs_P = np.arange(spec.chunk_pairs)
    given = (
        initial_parameters(spec.policy, "unit_columns", 0),
        UNIT,
        np.zeros(spec.policy.widths[0], np.float32),
        np.ones(spec.policy.widths[0], np.float32),
        stream_keys(spec.seed, Domain.PARAMETER_NOISE, 3, pairs_P),
        *episode_keys(spec, 3, pairs_P),
    )
    each, in_pairs = (make_training_rollout(environment, spec, in_pairs=way)(*given) for way in (False, True))
    np.testing.assert_array_equal(each.steps, in_pairs.steps)
    np.testing.assert_allclose(each.descriptor, in_pairs.descriptor, atol=1e-3)
    np.testing.assert_allclose(each.returns, in_pairs.returns, rtol=1e-4)
