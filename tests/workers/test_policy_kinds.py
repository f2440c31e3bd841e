"""What policies of every kind compute: activations, outputs, biases and a memory, by NumPy, xla and simd."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import EpisodesResult, EvaluationChunk, PolicySpec, TrainingChunk, WorkerSpec
from es_service.protocol.noise import Domain, evaluation_reset_keys, stream_keys
from es_service.runs.snapshot import Policy
from tests.examples.swing_up import SwingUp
from tests.helpers import centre, chunk_runner, random_parameters, spec
from tests.workers.numpy_rollout import NumPy
from workers.environments import SHIPPED
from workers.policy import action, drawn_action, initial_parameters
from workers.rollouts import BACKENDS

KINDS = [
    PolicySpec((2, 8, 2), activation="relu"),
    PolicySpec((2, 33, 5, 2), "relu", "linear", bias=False),
    PolicySpec((2, 2), bias=False),
    PolicySpec((2, 8, 2), output="argmax"),
    PolicySpec((2, 8, 2), output="categorical"),
    PolicySpec((2, 8, 2), output="gaussian", bias=False),
]


@pytest.fixture(autouse=True)
def numpy_is_registered(monkeypatch):
    monkeypatch.setitem(BACKENDS, "numpy", NumPy())


def kind(policy: PolicySpec, rollout: str = "xla") -> WorkerSpec:
    noise = 0.01 if policy.output in ("tanh", "linear") else 0.0
    return spec(policy=policy, rollout=rollout, action_noise=noise, episode_steps=10)


@pytest.mark.parametrize("policy", KINDS, ids=str)
def test_xla_and_simd_compute_what_numpy_does(policy: PolicySpec):
    """In training with the noise of its address, and in evaluations."""
    for chunk in (TrainingChunk(1, 0), EvaluationChunk(1, 0)):
        xla, simd, reference = (run(replace(kind(policy), rollout=name), chunk) for name in ("xla", "simd", "numpy"))
        assert len(np.unique(xla.returns)) > 4
        for found in (xla, simd):
            np.testing.assert_allclose(found.descriptor, reference.descriptor, atol=1e-4)
            np.testing.assert_allclose(found.returns, reference.returns, atol=1e-3)


def run(worker_spec: WorkerSpec, chunk: TrainingChunk | EvaluationChunk) -> EpisodesResult:
    parameters_D = random_parameters(1, worker_spec.policy.parameters)
    found = chunk_runner(worker_spec)(centre(parameters_D, sigma=0.1), chunk)
    assert isinstance(found, EpisodesResult)
    return found


def test_draws_are_those_of_their_addresses():
    first, again, other = (run(kind(KINDS[4]), TrainingChunk(1, number)) for number in (0, 0, 1))
    np.testing.assert_array_equal(first.returns, again.returns)
    assert not np.array_equal(first.returns, other.returns)


def test_a_categorical_action_is_drawn_with_the_probabilities_of_the_softmax():
    logits, draws = np.float32([0.0, 1.0, -1.0]), 20_000
    coordinates = np.arange(3 * draws, dtype=np.uint32).reshape(draws, 3)
    key = stream_keys(0, Domain.ACTION_NOISE, 0, 0)
    chosen = drawn_action(np, "categorical", np.broadcast_to(logits, (draws, 3)), key, coordinates)
    assert np.isin(chosen, (0.0, 1.0)).all()
    assert (chosen.sum(axis=1) == 1.0).all()
    wanted = np.exp(logits) / np.exp(logits).sum()
    np.testing.assert_allclose(chosen.mean(axis=0), wanted, atol=4.0 * 0.5 / np.sqrt(draws))
    np.testing.assert_array_equal(action(np, "categorical", logits), [0.0, 1.0, 0.0])


def test_a_gaussian_action_has_the_mean_and_the_spread_of_the_outputs():
    draws = 20_000
    outputs = np.broadcast_to(np.float32([0.3, np.log(0.5)]), (draws, 2))
    coordinates = np.arange(draws, dtype=np.uint32)[:, None]
    drawn = drawn_action(np, "gaussian", outputs, stream_keys(0, Domain.ACTION_NOISE, 0, 0), coordinates)
    normal = np.arctanh(np.float64(drawn))
    assert abs(normal.mean() - 0.3) < 4.0 * 0.5 / np.sqrt(draws)
    assert abs(normal.std() - 0.5) < 4.0 * 0.5 / np.sqrt(2.0 * draws)
    np.testing.assert_allclose(action(np, "gaussian", outputs[0]), [np.tanh(0.3)], rtol=1e-6)


def test_equal_outputs_choose_the_first_action():
    for xp in (np, jnp):
        np.testing.assert_array_equal(action(xp, "argmax", xp.asarray([1.0, 2.0, 2.0])), [0.0, 1.0, 0.0])


def gru(parameters_D: np.ndarray, size: int, memory: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The equations of Cho et al. 2014, weight by weight, in float64."""
    joined, at = len(x) + size, (len(x) + size) * 2 * size
    gates, gate_biases = parameters_D[:at].reshape(joined, 2 * size), parameters_D[at : at + 2 * size]
    candidate = parameters_D[at + 2 * size :][: joined * size].reshape(joined, size)
    candidate_biases = parameters_D[at + 2 * size + joined * size :][:size]
    found = np.zeros(size)
    sigmoid = lambda a: 1.0 / (1.0 + np.exp(-a))  # noqa: E731
    resets = [sigmoid(gates[:, j] @ np.concatenate([x, memory]) + gate_biases[j]) for j in range(size)]
    for j in range(size):
        keep = sigmoid(gates[:, size + j] @ np.concatenate([x, memory]) + gate_biases[size + j])
        new = np.tanh(candidate[:, j] @ np.concatenate([x, np.array(resets) * memory]) + candidate_biases[j])
        found[j] = keep * memory[j] + (1.0 - keep) * new
    return found


def recurrent(policy: PolicySpec, scale: float = 1.0) -> Policy:
    size = policy.widths[0]
    zero, one = np.zeros(size, np.float32), np.ones(size, np.float32)
    return Policy(policy, random_parameters(3, policy.parameters, scale), zero, one, None)


def test_a_memory_is_that_of_the_definition():
    policy, memory = recurrent(PolicySpec((2, 1), output="linear", memory=3)), np.zeros(3)
    parameters_D, step = policy.parameters_D.astype(float), policy.start()
    assert policy.parameters_D.size == (2 + 3 + 1) * 9 + 4
    for x in np.random.default_rng(0).normal(size=(5, 2)):
        memory = gru(parameters_D, 3, memory, x)
        np.testing.assert_allclose(step(x), memory @ parameters_D[-4:-1].reshape(3, 1) + parameters_D[-1], atol=1e-5)


def test_a_policy_with_a_memory_is_called_through_start():
    policy = recurrent(PolicySpec((2, 4, 1), "relu", memory=3))
    with pytest.raises(ValueError, match=r"has a memory .* call act = policy.start\(\)"):
        policy(np.zeros(2))
    seen_T_N_O = np.random.default_rng(0).normal(size=(4, 3, 2))
    together, alone = policy.start(), [policy.start() for _ in range(3)]
    for seen_N_O in seen_T_N_O:
        np.testing.assert_array_equal(together(seen_N_O), [act(x) for act, x in zip(alone, seen_N_O, strict=True)])
    again = policy.start()
    assert not np.allclose(again(seen_T_N_O[0]), together(seen_T_N_O[0])), "the other one remembers"
    plain = recurrent(PolicySpec((2, 1)))
    np.testing.assert_array_equal(plain.start()([0.1, 0.2]), plain([0.1, 0.2]))


def test_a_policy_is_shown_without_its_weights():
    shown = repr(recurrent(PolicySpec((2, 4, 1))))
    assert shown == f"Policy(spec={PolicySpec((2, 4, 1))!r}, observation_clip=None)"


def require_bits_of_each() -> None:
    """An observation has the same action alone, in a batch, and as every second number of a longer array."""
    for policy in (PolicySpec((2, 6, 2), "relu", "linear"), PolicySpec((29, 256, 8)), PolicySpec((7, 5, 3), memory=6)):
        policy = recurrent(policy)
        seen_N_2O = np.random.default_rng(0).normal(size=(50, 2 * policy.spec.widths[0])).astype(np.float32)
        seen_N_O = np.ascontiguousarray(seen_N_2O[:, ::2])
        each_N_A = np.stack([policy.start()(seen_O) for seen_O in seen_N_O])
        for same_N_O in (seen_N_O, seen_N_2O[:, ::2], np.asfortranarray(seen_N_O)):
            assert policy.start()(same_N_O).tobytes() == each_N_A.tobytes()
            assert policy.start()(same_N_O[7]).tobytes() == each_N_A[7].tobytes()
        assert policy.start()(seen_N_O.reshape(5, 10, -1)).tobytes() == each_N_A.tobytes()
        assert policy.start()(seen_N_O[:0]).shape == (0, each_N_A.shape[1])


@pytest.mark.parametrize("kernels", [None, "Haswell"])
def test_the_bits_of_an_action_do_not_depend_on_other_observations(kernels):
    """With the kernels that OpenBLAS has for this processor, and those for AVX2, where matrices and vectors differ."""
    program = "from tests.workers.test_policy_kinds import require_bits_of_each; require_bits_of_each()"
    if kernels is None:
        require_bits_of_each()
    else:
        subprocess.run([sys.executable, "-c", program], env=os.environ | {"OPENBLAS_CORETYPE": kernels}, check=True)


def test_an_episode_of_xla_threads_the_memory_as_numpy_does():
    policy, task = recurrent(PolicySpec((2, 1), memory=4), 1.5), SwingUp()
    name = "tests.examples.swing_up:SwingUp"
    worker_spec = spec(environment=name, policy=policy.spec, episode_steps=12, action_noise=0.0)
    given = centre(policy.parameters_D)
    found = chunk_runner(worker_spec)(given, EvaluationChunk(1, 0))
    assert isinstance(found, EpisodesResult)
    for episode in range(2):
        state, act, total = task.reset(evaluation_reset_keys(worker_spec.seed, 1, episode, 0)), policy.start(), 0.0
        for _ in range(12):
            state, reward, _ = task.step(state, act(task.observe(state)))
            total += float(reward)
        np.testing.assert_allclose(found.returns[episode], total, rtol=1e-4)
    without = replace(policy.spec, memory=0)
    other = chunk_runner(replace(worker_spec, policy=without))(
        centre(given.parameters_D[: without.parameters]), EvaluationChunk(1, 0)
    )
    assert not np.allclose(found.returns, other.returns)


def test_simd_says_why_it_has_no_memory():
    assert "has no memory (policy.memory)" in BACKENDS["simd"].why_not(
        SHIPPED["point_maze"], PolicySpec((2, 2), memory=4)
    )
    assert BACKENDS["xla"].why_not(SHIPPED["point_maze"], PolicySpec((2, 2), memory=4)) == ""


@pytest.mark.parametrize(("init", "first_norm"), [("unit_columns", 1.0), ("small_columns", 0.01)])
def test_initial_weights_of_every_kind_have_their_norms(init: str, first_norm: float):
    for policy in (*KINDS, PolicySpec((2, 8, 2), memory=4), PolicySpec((2, 2), bias=False, memory=4)):
        flat_D, start = initial_parameters(policy, init, 0), 0
        for number, (inputs, outputs) in enumerate(policy.layers, 1):
            weights, start = flat_D[start : start + inputs * outputs].reshape(inputs, outputs), start + inputs * outputs
            norm = 0.01 if number == len(policy.layers) else first_norm
            np.testing.assert_allclose(np.linalg.norm(weights, axis=0), norm, rtol=1e-5)
            if policy.bias:
                assert not flat_D[start : start + outputs].any()
                start += outputs
        assert start == policy.parameters == flat_D.size


def test_initial_weights_of_layers_and_of_centres_differ():
    """In layers of equal shapes, which one key for all would make equal."""
    first_D, other_D = (initial_parameters(PolicySpec((8, 8, 8, 8)), "unit_columns", 0, centre) for centre in (0, 1))
    assert not np.allclose(first_D[:64], first_D[72:136])
    assert not np.allclose(first_D, other_D)
