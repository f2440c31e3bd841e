"""Training episodes of the code for GPUs, run by this processor, have the bits of those of simd."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from es_service.protocol.messages import PolicySpec
from es_service.protocol.noise import NORMAL_STD, Domain, stream_keys
from tests import helpers
from tests.workers.simd.host_gpu import HostGpu, single_lanes
from workers.environments import make_environment
from workers.policy import initial_parameters
from workers.simd.backend.native import WrongCodeError
from workers.simd.episodes.rollout import make_training_rollout
from workers.simd.gpu.training import episodes_on_gpu
from workers.worker import episode_keys

POLICY = PolicySpec(widths=(2, 7, 9, 2))
PAIRS = 5


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"policy": replace(POLICY, bias=False, activation="relu", output="linear")},
        {"policy": PolicySpec(widths=(2, 2)), "outputs": ("success",)},
        {"policy": replace(POLICY, widths=(2, 16, 2))},
        {"policy": replace(POLICY, output="gaussian"), "action_noise": 0.1, "episodes_per_member": 2},
        pytest.param(
            {"environment": "brax:inverted_pendulum", "policy": PolicySpec(widths=(4, 8, 1)), "episode_steps": 60},
            marks=pytest.mark.long,
        ),
        pytest.param(
            {"environment": "ant_trap", "policy": PolicySpec(widths=(113, 20, 8)), "episode_steps": 30},
            marks=pytest.mark.long,
        ),
    ],
    ids=str,
)
def test_training_episodes_have_the_bits_of_simd(changes):
    spec = helpers.spec(rollout="simd", **({"policy": POLICY} | changes))
    environment, given = make_environment(spec.environment, {}), arguments(spec)
    expected = make_training_rollout(environment, spec)(*given)
    with single_lanes() as target:
        elsewhere = episodes_on_gpu(environment, spec, HostGpu(target))
        found = make_training_rollout(environment, spec, elsewhere)(*given)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


class WrongGpu(HostGpu):
    """It changes a bit of what is copied to it: of the centre and the statistics."""

    def copied(self, array):
        return super().copied(np.nextafter(array, np.float32(9.0)) if array.dtype == np.float32 else array)


def test_episodes_that_differ_from_those_of_the_processor_are_refused():
    spec = helpers.spec(rollout="simd", policy=POLICY)
    environment = make_environment(spec.environment, {})
    with single_lanes() as target, pytest.raises(WrongCodeError, match="machine code for this processor as a GPU is"):
        make_training_rollout(environment, spec, episodes_on_gpu(environment, spec, WrongGpu(target)))(*arguments(spec))


def arguments(spec):
    """Arguments of a training rollout around a random centre."""
    pairs_P, observations, rng = np.arange(PAIRS), spec.policy.widths[0], np.random.default_rng(0)
    return (
        initial_parameters(spec.policy, "unit_columns", 0),
        np.float32(0.2 / NORMAL_STD),
        np.zeros(observations, np.float32),
        rng.uniform(0.5, 2.0, observations).astype(np.float32),
        stream_keys(spec.seed, Domain.PARAMETER_NOISE, 3, pairs_P),
        *episode_keys(spec, 3, pairs_P),
    )
