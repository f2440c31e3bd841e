"""The runs of the systems of QDax and evorl: they go on from their checkpoints, and our workers run their policies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("qdax", reason="qdax is not installed: tests.learners.environment qdax")

from qdax.baselines.diayn import DIAYN, DiaynConfig
from qdax.core.neuroevolution.networks.networks import MLP

import es_service
from es_service.config.tasks import task_of
from es_service.config.workload import policy_spec
from tests.benchmarks.baselines.cem_run import CemRun
from tests.benchmarks.baselines.diayn_run import DiaynRun, Ring
from tests.benchmarks.baselines.map_run import MapRun, transitions_of
from tests.benchmarks.baselines.policies import flat, of_skills
from tests.benchmarks.baselines.rows import COLUMNS
from tests.benchmarks.baselines.run import Run, relu_config
from workers.policy import act, split_layers


def arrays(run: Run) -> list[np.ndarray]:
    """All that a run keeps, as arrays; QDax has a Python float among them, which JAX computes with as float32."""
    state = (run._repertoire, run._emitter, run._key) if isinstance(run, MapRun) else run._state
    return [np.array(jnp.asarray(leaf)) for leaf in jax.tree.leaves(state)]


def same(found: list[np.ndarray], expected: list[np.ndarray]) -> bool:
    return all(np.array_equal(*pair, equal_nan=True) for pair in zip(found, expected, strict=True))


RUNS = {
    "pga_me": (MapRun, {"buffer": 60_000}, 20_000, 20_000),
    "qd_pg": (MapRun, {"buffer": 60_000}, 20_000, 20_000),
    "diayn": (DiaynRun, {"buffer": 16_000}, 2_000, 800),
    "cem_rl": (CemRun, {"buffer": 20_000}, 10_000, 2_000),
}
"""Class, arguments, steps without learning and steps of learning of a short run."""


@pytest.mark.parametrize("system", RUNS)
def test_a_run_that_was_stopped_learns_the_same(tmp_path, system):
    kind, arguments, before, learning = RUNS[system]

    def begun(name: str) -> Run:
        run = kind("point_maze", system, 3, tmp_path / name, **arguments)
        run.chunk = min(run.chunk, learning)
        return run

    whole = begun("run")
    whole.work(before, 1e9)
    whole.keep()
    started = arrays(whole)
    whole.work(before + 2 * learning, 1e9)
    again = begun("run")
    assert again.steps == before
    assert same(arrays(again), started)
    again.work(before + 2 * learning, 1e9)
    assert again.steps == whole.steps
    assert same(arrays(again), arrays(whole))
    assert not same(arrays(again), started)
    row = again.row(is_finished=True, episodes=20)
    assert {*row} == {*COLUMNS}
    assert -500 < row["return_low"] <= row["return_mean"] <= row["return_high"] < 0


def ours(parameters_N_D: np.ndarray, observation_E_O: np.ndarray) -> np.ndarray:
    """Actions [N, E, A] of our policies."""
    config = es_service.load_config(relu_config("point_maze", 0))
    shape = policy_spec(config, task_of(config))
    return np.stack([act(np, shape, split_layers(shape, one), None, observation_E_O)[0] for one in parameters_N_D])


@pytest.fixture
def observations() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (6, 2)).astype(np.float32)


def test_policies_of_qdax_are_ours(observations):
    network = MLP((64, 64, 2), final_activation=jnp.tanh)
    policies = jax.vmap(network.init, in_axes=(0, None))(jax.random.split(jax.random.PRNGKey(1), 3), jnp.zeros(2))
    expected = jax.vmap(network.apply, in_axes=(0, None))(policies, observations)
    np.testing.assert_allclose(ours(flat(policies["params"]), observations), expected, atol=1e-6)


def test_a_skill_of_diayn_is_a_policy_of_ours(observations):
    sizes = {"critic_hidden_layer_size": (64, 64), "policy_hidden_layer_size": (64, 64)}
    learner = DIAYN(DiaynConfig(batch_size=8, episode_length=9, num_skills=3, **sizes), 2)
    policy = learner.init(jax.random.PRNGKey(2), 2, 2, 2).policy_params
    [layers] = policy["params"].values()
    layers = jax.tree.map(lambda array: array + 0.1, layers)  # biases begin at 0
    policy = {"params": dict.fromkeys(policy["params"], layers)}
    for skill, found in enumerate(ours(of_skills(layers, 3, 2), observations)):
        seen = np.concatenate([observations, np.tile(np.eye(3, dtype=np.float32)[skill], (6, 1))], axis=1)
        expected = learner.select_action(seen, policy, jax.random.PRNGKey(0), deterministic=True)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_transitions_are_those_of_the_episodes():
    config = es_service.load_config(relu_config("point_maze", 0))
    with es_service.evaluator(config, transitions=True) as evaluate:
        policies_N_D = np.random.default_rng(1).normal(size=(3, evaluate.parameters)).astype(np.float32)
        found = evaluate(policies_N_D).transitions
    assert found is not None
    steps, kept = int(found.steps.sum()), transitions_of(found, 700)
    assert (steps, len(kept.rewards)) == (600, 700)
    last = np.arange(1, steps + 1) % 200 == 0
    np.testing.assert_array_equal(kept.truncations[:steps], last)
    np.testing.assert_array_equal(kept.dones, 0)
    np.testing.assert_array_equal(kept.next_obs[:steps][~last], kept.obs[1 : steps + 1][~last])
    np.testing.assert_array_equal(kept.next_state_desc[:steps][~last], kept.state_desc[1 : steps + 1][~last])
    np.testing.assert_array_equal(kept.next_state_desc, kept.next_obs)  # PointMaze sees where it is
    np.testing.assert_array_equal(kept.rewards[steps:], kept.rewards[:100])


def test_a_full_ring_forgets_what_is_oldest():
    from qdax.core.neuroevolution.buffers.buffer import QDTransition

    one = QDTransition.init_dummy(2, 2, 2)
    ring = Ring.init(6, one)
    for number in range(5):
        ring = ring.insert(jax.tree.map(lambda array: jnp.full((2, *array.shape[1:]), float(number)), one))  # noqa: B023
    assert sorted(np.asarray(ring.data[:, 0]).tolist()) == [2.0, 2.0, 3.0, 3.0, 4.0, 4.0]
    assert int(ring.current_size) == 6
    with pytest.raises(ValueError, match="do not divide"):
        ring.insert(jax.tree.map(lambda array: jnp.zeros((4, *array.shape[1:])), one))
