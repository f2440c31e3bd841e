"""What goes into an episode kernel has the size that its code reads."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from es_service.protocol.noise import KEY_WORDS, Domain, stream_keys
from tests.helpers import SPEC, random_parameters
from workers.environments import make_environment
from workers.simd.backend.target import host_target
from workers.simd.episodes.compiled import compile_episodes
from workers.simd.episodes.program import write_episodes
from workers.simd.episodes.rollout import make_gradient_sum

LANES = 6


@pytest.mark.parametrize("training", [True, False])
def test_arrays_of_other_sizes_are_refused(training: bool) -> None:
    kernel = compile_episodes(make_environment("point_maze", {}), SPEC, np.arange(2), training=training)
    weights, mean_O, std_O = kernel.network.pack(random_parameters()), np.zeros(2, np.float32), np.ones(2, np.float32)

    def run(noise: int | None, resets: int = LANES, actions: int = LANES, words: int = KEY_WORDS) -> None:
        noise_keys_P = None if noise is None else np.zeros((noise, words), np.uint32)
        reset_keys_L, action_keys_L = (np.zeros((rows, KEY_WORDS), np.uint32) for rows in (resets, actions))
        kernel.run(weights, 0.01, mean_O, std_O, noise_keys_P, reset_keys_L, action_keys_L)

    enough = LANES // 2 if training else None
    run(enough)
    wrong = [(enough, LANES, LANES - 1), (enough, 1, LANES), (None if training else LANES // 2, LANES, LANES)]
    wrong += [(enough - 1, LANES, LANES), (enough, LANES, LANES, 3)] if enough else []
    for sizes in wrong:
        with pytest.raises(ValueError, match="must not be called with these arrays"):
            run(*sizes)


def test_code_that_keeps_other_outputs_of_steps_has_another_name() -> None:
    """`reward` is kept in every step and `last_reward` at the end; both are the same function."""

    def name(*outputs: str) -> str:
        spec = replace(SPEC, outputs=outputs)
        return write_episodes(
            make_environment("point_maze", {}), spec, np.arange(2), host_target(), training=False
        ).name

    assert name("reward") != name("last_reward")


def test_only_the_episodes_that_are_wanted_are_run() -> None:
    kernel = compile_episodes(make_environment("point_maze", {}), SPEC, np.arange(2), training=False)
    weights, lanes = kernel.network.pack(random_parameters()), 2 * kernel.network.width + 3
    keys_L = stream_keys(1, Domain.EVALUATION_RESET, 0, np.arange(lanes))
    wanted_L = np.isin(np.arange(lanes), (1, kernel.network.width, lanes - 1))
    given = (weights, 0.0, np.zeros(2, np.float32), np.ones(2, np.float32), None, keys_L, keys_L)
    every, some = kernel.run(*given), kernel.run(*given, wanted_L)
    assert not some.steps[~wanted_L].any()
    for found, whole in zip(jax.tree.leaves(some), jax.tree.leaves(every), strict=True):
        np.testing.assert_array_equal(found[wanted_L], whole[wanted_L])
    with pytest.raises(ValueError, match="a bool for each lane"):
        kernel.run(*given, wanted_L[1:])


@pytest.mark.slow
def test_memory_is_protected_without_assertions_too() -> None:
    """`python -O` removes assertions: arrays must stay alive during a call, and wrong ones must still be refused."""
    program = """
import numpy as np
assert False, "this is removed"
from tests.workers.simd.test_episode_kernel import test_arrays_of_other_sizes_are_refused as refused
from es_service.protocol.noise import Domain, stream_keys
from workers.simd.episodes.rollout import make_gradient_sum
for training in (True, False):
    refused(training)
gradient_sum, keys_P = make_gradient_sum(100), stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(3))
print(gradient_sum(np.ones(3, np.float32), keys_P).tobytes().hex())
try:
    gradient_sum(np.ones(4, np.float32), keys_P)
except ValueError:
    print("refused")
"""
    words = [sys.executable, "-O", "-c", program]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    keys_P = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(3))
    here = make_gradient_sum(100)(np.ones(3, np.float32), keys_P)
    assert printed == f"{here.tobytes().hex()}\nrefused\n"


def test_no_pair_and_no_step_is_nothing() -> None:
    """A loop without a trip runs none, where memory would be read that is not there."""
    weights_P, keys_P = np.ones(0, np.float32), np.zeros((0, KEY_WORDS), np.uint32)
    assert not make_gradient_sum(50)(weights_P, keys_P).any()
    kernel = compile_episodes(make_environment("point_maze", {}), SPEC, np.arange(2), training=False)
    keys_L, weights = (
        stream_keys(1, Domain.EVALUATION_RESET, 0, np.arange(LANES)),
        kernel.network.pack(random_parameters()),
    )
    carries, go = kernel.started(weights, 0.0, np.zeros(2, np.float32), np.ones(2, np.float32), None, keys_L, keys_L)
    before = carries.copy()
    go(0)
    np.testing.assert_array_equal(carries, before)
    go(1)
    assert (carries != before).any()
