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

import workers.rollout
import workers.simd.episodes
from es_service.noise import NORMAL_STD, TEST_VECTORS, Domain, normal_integers, stream_keys
from es_service.protocol import EvaluationChunk, PolicyShape, TrainingChunk, WorkerSpec
from tests.helpers import centre, random_parameters, spec
from workers.environments import TASKS, describe_environment, make_environment
from workers.episode import Episodes
from workers.policy import initial_parameters
from workers.simd import noise, rollout
from workers.simd.code import Code, module
from workers.simd.episodes import compile_episodes
from workers.simd.kernel import load_compiled
from workers.simd.layout import plan
from workers.simd.noise import UNROLLED, fill_function
from workers.simd.primitives import UnsupportedError
from workers.simd.target import NoVectorsError, host_target
from workers.worker import make_worker

WIDTHS = ("avx512", "avx2", "four")


def targets() -> list[Any]:
    """Of this processor, the widest first."""
    found = []
    for kind in WIDTHS:
        try:
            found.append(host_target(kind))
        except NoVectorsError:
            continue
    return found


def task_spec(task: str, **changes: Any) -> WorkerSpec:
    size = TASKS[task]
    hidden = (64, 64) if task == "point_maze" else (256, 256)
    shape = PolicyShape((size.observation_size, *hidden, size.action_size))
    return spec(environment=task, policy=shape, episode_steps=size.episode_steps, **changes)


def arguments(worker_spec: WorkerSpec, scale: float = 1.0, generation: int = 1, sigma: float = 0.05) -> tuple[Any, ...]:
    """Of a training rollout; the centre is a random policy, statistics not trivial."""
    shape, pairs = worker_spec.policy, np.arange(worker_spec.chunk_pairs)
    centre_D = scale * initial_parameters(shape, "unit_columns", 5)
    rng = np.random.default_rng(generation)
    mean_O = rng.normal(0, 0.1, shape.widths[0]).astype(np.float32)
    std_O = rng.uniform(0.5, 2.0, shape.widths[0]).astype(np.float32)
    keys = stream_keys(3, Domain.PARAMETER_NOISE, generation, pairs)
    resets = stream_keys(
        3, Domain.TRAINING_RESET, generation, pairs[:, None, None], np.arange(2)[None, :, None], np.arange(1)
    )
    actions = stream_keys(
        3, Domain.ACTION_NOISE, generation, pairs[:, None, None], np.arange(2)[None, :, None], np.arange(1)
    )
    return centre_D, np.float32(sigma / NORMAL_STD), mean_O, std_O, keys, resets, actions


def both(worker_spec: WorkerSpec, *given: Any) -> tuple[Episodes, Episodes]:
    """(simd's, xla's)."""
    environment = make_environment(worker_spec.environment, {})
    ours = rollout.make_training_rollout(environment, worker_spec)(*given)
    theirs = workers.rollout.make_training_rollout(environment, worker_spec)(*given)
    return ours, Episodes(*map(np.asarray, theirs))


def test_episodes_of_point_maze_are_xlas():
    """10,000 of them. The few that end elsewhere are at a wall's end or the goal's edge between two last bits: as many
    of xla's own do when its weights change by their last bit."""
    worker_spec = task_spec("point_maze", chunk_pairs=1000, rollout_block_pairs=8, common_random_numbers=False)
    rollout_again = workers.rollout.make_training_rollout(make_environment("point_maze", {}), worker_spec)
    far = nudged = 0
    for generation, (scale, sigma) in enumerate([(1.0, 0.02), (1.0, 0.05), (1.0, 0.2), (3.0, 0.05), (5.0, 0.05)]):
        given = arguments(worker_spec, scale, generation, sigma)
        ours, theirs = both(worker_spec, *given)
        apart = distance(ours, theirs)
        for place in zip(*np.nonzero(apart > 1e-5), strict=True):
            print(f"{generation} {place}: {ours.returns[place]} {theirs.returns[place]} {ours.descriptor[place]}")
        far += int(np.count_nonzero(apart > 1e-5))
        other = Episodes(*map(np.asarray, rollout_again(np.nextafter(given[0], np.float32(np.inf)), *given[1:])))
        nudged += int(np.count_nonzero(distance(other, theirs) > 1e-5))
    print(f"of 10,000 episodes {far} differ by more than 1e-5; of xla's own, nudged by a last bit, {nudged}")
    assert far <= 100
    assert far <= 2 * nudged + 10


def distance(ours: Episodes, theirs: Episodes) -> np.ndarray:
    """Of returns (relative), places and lengths, the greatest, [P, S, E]."""
    apart = np.abs(ours.returns - theirs.returns) / np.maximum(1.0, np.abs(theirs.returns))
    apart = np.maximum(apart, np.abs(ours.descriptor - theirs.descriptor).max(axis=-1))
    return np.maximum(apart, ours.steps != theirs.steps)


@pytest.mark.parametrize("task", ["ant_maze", "ant_trap"])
def test_a_few_steps_of_the_ants_are_xlas(task: str):
    """Later they part, as xla's own do when a last bit changes; whole episodes: tests/benchmarks/episode_parity.py."""
    worker_spec = dataclasses.replace(task_spec(task, chunk_pairs=16, rollout_block_pairs=8), episode_steps=5)
    ours, theirs = both(worker_spec, *arguments(worker_spec))
    np.testing.assert_array_equal(ours.steps, theirs.steps)
    np.testing.assert_allclose(ours.descriptor, theirs.descriptor, atol=1e-4)
    np.testing.assert_allclose(ours.returns, theirs.returns, rtol=1e-4, atol=5e-3)
    np.testing.assert_allclose(ours.goal_distance, theirs.goal_distance, atol=1e-4)
    np.testing.assert_allclose(ours.shifted_sum_O, theirs.shifted_sum_O, rtol=1e-3, atol=2e-2)
    np.testing.assert_allclose(ours.shifted_square_sum_O, theirs.shifted_square_sum_O, rtol=1e-2, atol=2e-2)


@pytest.mark.parametrize(
    ("task", "training", "pairs", "hidden"),
    [
        ("point_maze", True, 8, (64, 64)),
        ("point_maze", True, 3, (64, 64)),
        ("point_maze", False, 3, (64, 64)),
        ("point_maze", True, 8, (48, 33)),
        ("point_maze", False, 8, (96,)),
        ("point_maze", True, 8, (5, 144)),
        ("point_maze", True, 8, (1,)),
        ("point_maze", True, 8, ()),
        ("point_maze", True, 8, (80, 112)),
        ("ant_trap", True, 5, (256, 256)),
    ],
)
def test_bits_are_the_same_at_every_width(task: str, training: bool, pairs: int, hidden: tuple[int, ...]):
    """AVX-512 and AVX2 give one digest; and an episode does not see who is beside it, or that a lane is empty."""
    environment = make_environment(task, {})
    worker_spec = dataclasses.replace(task_spec(task), episode_steps=20)
    shape = PolicyShape((worker_spec.policy.widths[0], *hidden, worker_spec.policy.widths[-1]))
    worker_spec = dataclasses.replace(worker_spec, policy=shape)
    centre_D, unit, mean_O, std_O, keys, resets, actions = arguments(worker_spec, 3.0)
    found = []
    for target in targets():
        kernel = compile_episodes(environment, worker_spec, np.arange(len(mean_O)), training=training, target=target)
        lanes = (keys.reshape(-1, 4)[: 2 * pairs] for keys in (resets, actions))
        weights = kernel.network.pack(centre_D)
        found.append(kernel.run(weights, float(unit), mean_O, std_O, keys if training else None, *lanes))
    assert len(found[0].returns) == 2 * pairs
    assert len(np.unique(found[0].returns)) > pairs
    if training and pairs == worker_spec.chunk_pairs:
        theirs = workers.rollout.make_training_rollout(environment, worker_spec)
        theirs = theirs(centre_D, unit, mean_O, std_O, keys, resets, actions)
        np.testing.assert_allclose(found[0].returns, np.asarray(theirs.returns).ravel(), rtol=1e-3)
    for other in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, found[0], other)


def test_inputs_that_are_always_zero_are_left_out_and_missed_by_nobody():
    environment, worker_spec = (
        make_environment("ant_trap", {}),
        dataclasses.replace(task_spec("ant_trap"), episode_steps=10),
    )
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
    assert plan(worker_spec.policy, np.flatnonzero(~zero_O), 16).hidden[0].inputs == 59
    # Statistics from elsewhere, for which 0 is not the mean: then those inputs count.
    mean_O[zero_O] = 1.0
    ours, theirs = both(worker_spec, centre_D, unit, mean_O, std_O, keys, resets, actions)
    np.testing.assert_allclose(ours.descriptor, theirs.descriptor, atol=2e-3)
    np.testing.assert_allclose(ours.shifted_sum_O[..., zero_O], -10.0)


@pytest.mark.parametrize("kind", WIDTHS)
def test_noise_is_the_published_generator_s(kind: str, tmp_path: Path):
    if kind not in [target.kind for target in targets()]:
        pytest.skip(f"no {kind}")
    target = host_target(kind)
    pairs, singles = target.width // 2, 5
    fill = fill_function(3, singles, target.width)
    code = Code("inside", fill.parameters, target.width)
    code.do("call void @fill(ptr %keys, ptr %places, ptr %noise)")
    address, alive = load_compiled(f"noise {kind}", lambda: module([fill, code]), target, tmp_path)
    places = np.array([0, 1000, 2**32 - 5, 0, 1, 2, 77, 2**32 - 1], np.uint32)
    for (seed, domain, generation, ids), expected in TEST_VECTORS:
        keys = stream_keys(1, Domain.SELECTION, 2, np.arange(pairs))
        keys[0] = stream_keys(seed, domain, generation, *ids)
        noise = np.zeros((3 * pairs + singles) * target.width, np.int8)
        pointers = [array.ctypes.data for array in (keys, places, noise)]
        ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3)(address)(*pointers)
        k = 2 * noise.astype(int) + 1
        of_vectors = k[: 3 * pairs * target.width].reshape(pairs, 3, target.width)
        of_singles = k[of_vectors.size :].reshape(singles, target.width)
        assert tuple(of_vectors[0, 0, :3]) == tuple(of_singles[:3, 0]) == tuple(of_singles[:3, 1]) == expected
        coordinates = places[:3, None] + np.arange(target.width, dtype=np.uint32)
        for member in range(target.width):
            key = keys[member // 2]
            np.testing.assert_array_equal(of_vectors[member // 2], normal_integers(np, key, coordinates))
            np.testing.assert_array_equal(of_singles[:, member], normal_integers(np, key, places[3:]))
    assert alive


@pytest.mark.parametrize("parameters", [1, UNROLLED * 16, 4482])
def test_gradient_sums_are_the_same_at_every_width_and_right(parameters: int):
    weights_P = np.random.default_rng(0).normal(size=5).astype(np.float32)
    keys_P = stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(5))
    sums = [rollout.make_gradient_sum(parameters, target)(weights_P, keys_P) for target in targets()]
    k = np.stack([normal_integers(np, key, np.arange(parameters, dtype=np.uint32)) for key in keys_P])
    np.testing.assert_allclose(sums[0], weights_P.astype(float) @ k / NORMAL_STD, atol=1e-5)
    for other in sums[1:]:
        np.testing.assert_array_equal(sums[0], other)


def test_a_reset_that_cannot_be_compiled_is_jaxs():
    """Brax's draws with JAX's own keys; steps are compiled all the same."""
    environment = make_environment("point_maze", {})

    def reset(key: Any) -> Any:
        return jnp.sort(environment.reset(key))  # sorting is not compiled

    sorting = dataclasses.replace(environment, reset=reset)
    worker_spec = spec(policy=PolicyShape((2, 8, 2)))
    given = arguments(worker_spec)
    ours = rollout.make_training_rollout(sorting, worker_spec)(*given)
    theirs = workers.rollout.make_training_rollout(sorting, worker_spec)(*given)
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


def test_another_generator_is_not_what_was_compiled(monkeypatch: pytest.MonkeyPatch):
    """Kernels are kept on disk; the noise's definition stands outside of the compiler's own files."""
    weights_P, keys_P = np.ones(1, np.float32), stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(1))
    before = rollout.make_gradient_sum(50)(weights_P, keys_P)
    monkeypatch.setattr(noise, "normal_integers", lambda xp, key, at: 3 * normal_integers(xp, key, at))
    np.testing.assert_allclose(rollout.make_gradient_sum(50)(weights_P, keys_P), 3 * before, rtol=1e-6)


def test_a_step_that_makes_other_arrays_than_a_reset_is_refused():
    wider = dataclasses.replace(
        make_environment("point_maze", {}),
        observe=lambda state: state[:2],
        descriptor=lambda state: state[:2],
        step=lambda state, action: (jnp.zeros(3), jnp.float32(0.0), jnp.array(False)),
    )
    with pytest.raises(TypeError, match="other arrays than a reset"):
        compile_episodes(wider, spec(), np.arange(2), training=True)


def test_why_a_task_cannot_have_it():
    assert rollout.why_not(TASKS["point_maze"]) == ""
    sorting = describe_environment("tests.examples.sorting:Sorting")
    assert "the primitive sort, from" in rollout.why_not(sorting)


class Heat:
    """a plate is heated, and its heat spreads: the loop carries more than fits on a stack"""

    observation_size, action_size, episode_steps = 1, 1, 5
    descriptor_names, descriptor_bounds = ("corner",), ((0.0, 1.0),)

    def reset(self, key: Any) -> Any:
        return jnp.zeros((96, 96))

    def observe(self, state: Any) -> Any:
        return state[0, :1]

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = jax.lax.fori_loop(0, 50, lambda _, at: 0.9 * at + 0.1 * jnp.roll(at, 1, 0), state) + action[0]
        return state, state[0, 0], False

    def descriptor(self, state: Any) -> Any:
        return state[0, :1]


def test_what_the_compiler_refuses_after_tracing_is_refused_beforehand():
    task = describe_environment(f"{__name__}:Heat")
    why = rollout.why_not(task)
    assert why == "9,216 values that loops carry and look at; 8,192 fit"
    worker = make_worker(spec(environment=task.name, policy=PolicyShape((1, 8, 1)), episode_steps=5, rollout="simd"))
    point = centre(random_parameters(size=25), observation_size=1)
    for chunk in (TrainingChunk(1, 0), EvaluationChunk(1, 0)):
        with pytest.raises(UnsupportedError, match=why):
            worker(point, chunk)


def test_a_step_without_a_text_of_its_own_is_refused_beforehand(monkeypatch: pytest.MonkeyPatch):
    """Kernels are kept under what they compute, so what has no such name is not compiled either."""

    def nameless(*_: Any) -> str:
        raise ValueError("<function at 0x7f>")

    monkeypatch.setattr(workers.simd.episodes, "jaxpr_digest", nameless)
    assert rollout.why_not(TASKS["point_maze"]) == "ValueError: <function at 0x7f>"
