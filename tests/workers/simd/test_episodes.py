"""Whole episodes by simd: held against xla's, the same bits at every width, and nothing but what the policy needs."""

from __future__ import annotations

import ctypes
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import workers.xla
from es_service.protocol.messages import PolicySpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, TEST_VECTORS, Domain, normal_integers, stream_keys
from tests.helpers import random_parameters, spec
from tests.workers.simd.rollouts import arguments, both, by_xla, every_target, targets, task_spec
from workers.environments import make_environment
from workers.episode import Episodes
from workers.simd.backend.function_builder import FunctionBuilder, module
from workers.simd.backend.native import load_compiled
from workers.simd.backend.target import Target, target_of
from workers.simd.episodes import rollout
from workers.simd.episodes.compiled import compile_episodes
from workers.simd.episodes.hidden import plan
from workers.simd.episodes.low_rank import make_low_rank_gradient_sum
from workers.simd.episodes.noise_kernels import UNROLLED, fill_function


@pytest.mark.slow
def test_episodes_of_point_maze_are_xlas():
    """10,000 of them. The few that end elsewhere are at a wall's end or the goal's edge between two last bits: as many
    of xla's own do when its weights change by their last bit."""
    worker_spec = task_spec("point_maze", chunk_pairs=1000, rollout_block_pairs=8, common_random_numbers=False)
    far = nudged = 0
    for generation, (scale, sigma) in enumerate([(1.0, 0.02), (1.0, 0.05), (1.0, 0.2), (3.0, 0.05), (5.0, 0.05)]):
        given = arguments(worker_spec, scale, generation, sigma)
        ours, theirs = both(worker_spec, *given)
        apart = distance(ours, theirs)
        for place in zip(*np.nonzero(apart > 1e-5), strict=True):
            print(f"{generation} {place}: {ours.returns[place]} {theirs.returns[place]} {ours.descriptor[place]}")
        far += int(np.count_nonzero(apart > 1e-5))
        other = by_xla(worker_spec, np.nextafter(given[0], np.float32(np.inf)), *given[1:])
        nudged += int(np.count_nonzero(distance(other, theirs) > 1e-5))
    print(f"of 10,000 episodes {far} differ by more than 1e-5; of xla's own, nudged by a last bit, {nudged}")
    assert far <= 100
    assert far <= 2 * nudged + 10


def distance(ours: Episodes, theirs: Episodes) -> np.ndarray:
    """Of returns (relative), places and lengths, the greatest, [P, S, E]."""
    apart = np.abs(ours.returns - theirs.returns) / np.maximum(1.0, np.abs(theirs.returns))
    apart = np.maximum(apart, np.abs(ours.descriptor - theirs.descriptor).max(axis=-1))
    return np.maximum(apart, ours.steps != theirs.steps)


def few_steps(task: str) -> WorkerSpec:
    return dataclasses.replace(task_spec(task, chunk_pairs=16, rollout_block_pairs=8), episode_steps=5)


@pytest.mark.long
@pytest.mark.parametrize("task", ["ant_trap", "ant_maze"])
def test_a_few_steps_of_the_ants_are_xlas(task: str):
    """Later they part, as xla's own do when a last bit changes; whole episodes: tests/benchmarks/episode_parity.py."""
    worker_spec = few_steps(task)
    ours, theirs = both(worker_spec, *arguments(worker_spec))
    np.testing.assert_array_equal(ours.steps, theirs.steps)
    np.testing.assert_allclose(ours.descriptor, theirs.descriptor, atol=1e-4)
    np.testing.assert_allclose(ours.returns, theirs.returns, rtol=1e-4, atol=5e-3)
    np.testing.assert_allclose(ours.goal_distance, theirs.goal_distance, atol=1e-4)
    np.testing.assert_allclose(ours.shifted_sum_O, theirs.shifted_sum_O, rtol=1e-3, atol=2e-2)
    np.testing.assert_allclose(ours.shifted_square_sum_O, theirs.shifted_square_sum_O, rtol=1e-2, atol=2e-2)


WIDTHS = [
    ("point_maze", True, 8, (64, 64)),
    ("point_maze", True, 3, (64, 64)),
    ("point_maze", False, 3, (64, 64)),
    ("point_maze", True, 8, (48, 33)),
    ("point_maze", False, 8, (96,)),
    ("point_maze", True, 8, (5, 144)),
    ("point_maze", True, 8, (1,)),
    ("point_maze", True, 8, ()),
    ("point_maze", True, 8, (80, 112)),
]
XLA_S = (64, 64), (48, 33)
"""Hidden layers with which episodes are held against those of xla; `test_check.py` holds all shapes against the
reference implementation."""


@pytest.mark.parametrize(
    ("task", "training", "pairs", "hidden", "rank"),
    [
        *((*kind, rank) for kind in WIDTHS for rank in (0, 2)),
        *(pytest.param("ant_trap", True, 5, (256, 256), rank, marks=pytest.mark.long) for rank in (0, 2)),
    ],
)
def test_bits_are_the_same_at_every_width(task: str, training: bool, pairs: int, hidden: tuple[int, ...], rank: int):
    """AVX-512 and AVX2 give one digest; and an episode does not see who is beside it, or that a lane is empty."""
    environment = make_environment(task, {})
    worker_spec = dataclasses.replace(task_spec(task), episode_steps=20)
    shape = PolicySpec((worker_spec.policy.widths[0], *hidden, worker_spec.policy.widths[-1]))
    worker_spec = dataclasses.replace(worker_spec, policy=shape, noise_rank=rank)
    centre_D, unit, mean_O, std_O, keys, resets, actions = arguments(worker_spec, 3.0)
    found = []
    for target in targets():
        kernel = compile_episodes(environment, worker_spec, np.arange(len(mean_O)), training=training, target=target)
        lanes = (keys.reshape(-1, 4)[: 2 * pairs] for keys in (resets, actions))
        weights = kernel.network.pack(centre_D)
        found.append(kernel.run(weights, float(unit), mean_O, std_O, keys if training else None, *lanes))
    assert len(found[0].returns) == 2 * pairs
    assert len(np.unique(found[0].returns)) > pairs
    if hidden in XLA_S and training and pairs == worker_spec.chunk_pairs:
        theirs = workers.xla.make_training_rollout(environment, worker_spec)
        theirs = theirs(centre_D, unit, mean_O, std_O, keys, resets, actions)
        np.testing.assert_allclose(found[0].returns, np.asarray(theirs.returns).ravel(), rtol=1e-3)
    for other in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, found[0], other)


@pytest.mark.long
def test_inputs_that_are_always_zero_are_left_out_and_missed_by_nobody():
    environment, worker_spec = make_environment("ant_trap", {}), few_steps("ant_trap")
    zero_O = rollout.always_zero(environment)
    assert zero_O.sum() == 54
    centre_D, unit, mean_O, std_O, keys, resets, actions = arguments(worker_spec)
    mean_O[zero_O] = 0.0
    found = []
    for inputs_O in (np.flatnonzero(~zero_O), np.arange(zero_O.size)):
        kernel = compile_episodes(environment, worker_spec, inputs_O, training=True)
        lanes = (keys.reshape(-1, 4) for keys in (resets, actions))
        found.append(kernel.run(kernel.network.pack(centre_D), float(unit), mean_O, std_O, keys, *lanes))
    jax.tree.map(np.testing.assert_array_equal, *found)
    assert plan(worker_spec.policy, np.flatnonzero(~zero_O), target_of("avx512")).hidden[0].inputs == 59
    # Statistics from elsewhere, for which 0 is not the mean: then those inputs count.
    mean_O[zero_O] = 1.0
    ours, theirs = both(worker_spec, centre_D, unit, mean_O, std_O, keys, resets, actions)
    np.testing.assert_allclose(ours.descriptor, theirs.descriptor, atol=2e-3)
    np.testing.assert_allclose(ours.shifted_sum_O[..., zero_O], -worker_spec.episode_steps)


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_noise_is_the_published_generator_s(target: Target, tmp_path: Path):
    pairs, singles = target.width // 2, 5
    fill = fill_function(3, singles, target)
    builder = FunctionBuilder("inside", fill.parameters, target)
    builder.do("call void @fill(ptr %keys, ptr %places, ptr %noise)")
    native = load_compiled("noise", lambda: module([fill, builder]), target, tmp_path)
    places = np.array([0, 1000, 2**32 - 5, 0, 1, 2, 77, 2**32 - 1], np.uint32)
    for (seed, domain, generation, ids), expected in TEST_VECTORS:
        keys = stream_keys(1, Domain.SELECTION, 2, np.arange(pairs))
        keys[0] = stream_keys(seed, domain, generation, *ids)
        noise = np.zeros((3 * pairs + singles) * target.width, np.int8)
        native.function(*[ctypes.c_void_p] * 3)(keys, places, noise)
        k = 2 * noise.astype(int) + 1
        of_vectors = k[: 3 * pairs * target.width].reshape(pairs, 3, target.width)
        of_singles = k[of_vectors.size :].reshape(singles, target.width)
        assert tuple(of_vectors[0, 0, :3]) == tuple(of_singles[:3, 0]) == tuple(of_singles[:3, 1]) == expected
        coordinates = places[:3, None] + np.arange(target.width, dtype=np.uint32)
        for member in range(target.width):
            key = keys[member // 2]
            np.testing.assert_array_equal(of_vectors[member // 2], normal_integers(np, key, coordinates))
            np.testing.assert_array_equal(of_singles[:, member], normal_integers(np, key, places[3:]))


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("parameters", [1, UNROLLED * 16, 4482])
def test_gradient_sums_are_the_same_on_every_target_and_right(parameters: int, target: Target):
    weights_P = np.random.default_rng(0).normal(size=5).astype(np.float32)
    keys_P = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(5))
    first, found = (rollout.make_gradient_sum(parameters, one)(weights_P, keys_P) for one in (targets()[0], target))
    k = np.stack([normal_integers(np, key, np.arange(parameters, dtype=np.uint32)) for key in keys_P])
    np.testing.assert_allclose(found, weights_P.astype(float) @ k / NORMAL_STD, atol=1e-5)
    np.testing.assert_array_equal(found, first)


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize(("widths", "rank"), [((3, 2), 2), ((2, 70, 8), 1)], ids=str)
def test_gradients_of_low_rank_are_the_same_on_every_target(widths: tuple[int, ...], rank: int, target: Target):
    policy, weights_P = PolicySpec(widths), np.random.default_rng(0).normal(size=5).astype(np.float32)
    keys_P = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(5))
    first, found = (make_low_rank_gradient_sum(policy, rank, one)(weights_P, keys_P) for one in (targets()[0], target))
    np.testing.assert_array_equal(found, first)


def test_a_reset_that_cannot_be_compiled_is_jaxs():
    """Brax's draws with JAX's own keys; steps are compiled all the same."""
    environment = make_environment("point_maze", {})

    def reset(key: Any) -> Any:
        return jnp.fft.ifft(jnp.fft.fft(environment.reset(key))).real  # Fourier transforms are not compiled

    transforming = dataclasses.replace(environment, reset=reset)
    worker_spec = spec(policy=PolicySpec((2, 8, 2)))
    given = arguments(worker_spec)
    ours = rollout.make_training_rollout(transforming, worker_spec)(*given)
    theirs = workers.xla.make_training_rollout(transforming, worker_spec)(*given)
    np.testing.assert_allclose(ours.returns, np.asarray(theirs.returns), rtol=1e-4)


def test_a_centre_that_changes_in_place_is_seen():
    environment, worker_spec = make_environment("point_maze", {}), spec()
    given = list(arguments(worker_spec))
    given[0] = random_parameters(1)
    training = rollout.make_training_rollout(environment, worker_spec)
    first = training(*given)
    given[0][:] = random_parameters(2)
    second = training(*given)
    assert not np.array_equal(first.returns, second.returns)
    np.testing.assert_array_equal(
        second.returns, rollout.make_training_rollout(environment, worker_spec)(*given).returns
    )
