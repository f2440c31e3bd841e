"""Explicit policies: their episodes are those of a centre with the same parameters, wherever and with whomever they
run."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.episodes import gathered
from es_service.protocol.messages import EpisodesResult, EvaluationChunk, PolicySpec, WorkerSpec
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.policies import POLICIES_TOGETHER, POLICY_SLOTS
from tests.helpers import PARAMETERS, SPEC, DirectEvaluator, centre, random_parameters, spec
from tests.workers.simd.rollouts import targets, task_spec
from workers.environments import make_environment
from workers.policy import initial_parameters
from workers.simd.backend.native import aligned
from workers.simd.episodes import rollout
from workers.simd.episodes.compiled import compile_episodes
from workers.worker import make_worker

N, E = 37, 3
POLICIES = np.stack([random_parameters(seed) for seed in range(N)])
STATISTICS = (
    np.random.default_rng(1).normal(0.0, 0.1, (N, 2)).astype(np.float32),
    np.random.default_rng(2).uniform(0.5, 2.0, (N, 2)).astype(np.float32),
)


def evaluate(evaluator: Any, chosen: Any = slice(None), episodes: int = E, **address: int) -> EpisodesResult:
    """Results [N, E] of some of the policies."""
    given = {"seed": 5, "generation": 9, **address}
    asked = policy_work(POLICIES[chosen], tuple(x[chosen] for x in STATISTICS), episodes, traces=True, **given)
    return gathered([asked.shape], evaluator.evaluate(asked.work))[0]


def bits(result: EpisodesResult, chosen: Any = slice(None), episodes: Any = slice(None)) -> list[bytes]:
    names = ("fitness", "returns", "descriptor", "steps", "goal_distance")
    return [getattr(result, name)[chosen, episodes].tobytes() for name in names] + [result.trace_T_B[chosen].tobytes()]


@pytest.fixture(scope="module", params=["simd", "xla"])
def evaluator(request):
    return DirectEvaluator(spec(rollout=request.param, episode_steps=40))


# With simd, the kernel


@pytest.mark.parametrize("hidden", [(64, 64), (48, 33), (96,), (5, 144), (1,), (), (80, 112), (256, 128)])
def test_a_lane_with_weights_of_its_own_has_the_bits_of_a_centre_at_every_width(hidden: tuple[int, ...]):
    shape, lanes = PolicySpec((2, *hidden, 2)), 19
    worker_spec = dataclasses.replace(SPEC, policy=shape, episode_steps=20)
    policies = np.stack([3 * initial_parameters(shape, "unit_columns", seed) for seed in range(5)])
    owner_L, keys_L = np.arange(lanes) % 5, stream_keys(1, Domain.EVALUATION_RESET, 2, np.arange(lanes))
    mean_L, std_L = (x[:lanes] for x in STATISTICS)
    found = []
    for target in targets():
        rows = aligned((5, (shape.parameters // 16 + 2) * 16)).view(np.float32)
        rows[:] = np.nan  # what is beyond the parameters has no influence
        rows[:, : shape.parameters] = policies
        addresses_L = (rows.ctypes.data + owner_L * rows.strides[0]).astype(np.uint64)
        environment = make_environment("point_maze", {})
        own, shared = (
            compile_episodes(
                environment, worker_spec, np.arange(2), training=False, per_lane_weights=per_lane_weights, target=target
            )
            for per_lane_weights in (True, False)
        )
        found.append(own.run(addresses_L, 0.0, mean_L, std_L, None, keys_L, keys_L))
        for lane, policy in enumerate(owner_L):
            key = keys_L[lane : lane + 1]
            weights = shared.network.pack(policies[policy])
            alone = shared.run(weights, 0.0, mean_L[lane], std_L[lane], None, key, key)
            jax.tree.map(lambda x, y, lane=lane: np.testing.assert_array_equal(x[lane], y[0]), found[-1], alone)
    assert len(np.unique(found[0].returns)) == lanes
    for other in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, found[0], other)


@pytest.mark.long
def test_policies_of_an_ant_whose_inputs_that_are_always_zero_are_left_out_have_the_bits_of_a_centre():
    worker_spec = dataclasses.replace(task_spec("ant_trap"), episode_steps=5)
    environment, shape = make_environment("ant_trap", {}), worker_spec.policy
    policies = np.stack([initial_parameters(shape, "unit_columns", seed) for seed in range(17)])
    keys_L = stream_keys(1, Domain.EVALUATION_RESET, 2, np.arange(17))
    mean_L, std_L = no_statistics(17, shape.widths[0])
    of_policies = rollout.make_policy_rollout(environment, worker_spec)
    of_centre = rollout.make_evaluation_rollout(environment, worker_spec)
    few = of_policies([policies[:4], policies[4:]], mean_L, std_L, np.arange(17), keys_L)
    for lane in range(17):
        alone = of_centre(policies[lane], mean_L[0], std_L[0], keys_L[lane : lane + 1], np.ones(1, bool))
        jax.tree.map(lambda x, y, lane=lane: np.testing.assert_array_equal(x[lane], y[0]), few, alone)
    mean_L = mean_L.copy()
    mean_L[3] = 1.0  # the zeros count for one policy, so all run with all inputs
    every = of_policies([policies], mean_L, std_L, np.arange(17), keys_L)
    others = np.arange(17) != 3
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[others], y[others]), few, every)
    assert few.returns[3] != every.returns[3]


# The law of addresses, with both rollouts


def test_an_episode_depends_on_neither_chunk_nor_slot_nor_number_of_policies_and_episodes(evaluator):
    whole = evaluate(evaluator)
    assert len(np.unique(whole.returns)) == N * E
    for count in (1, 15, POLICY_SLOTS, 17, 33):
        assert bits(evaluate(evaluator, slice(count))) == bits(whole, slice(count))
    for episodes in (1, 2):
        assert bits(evaluate(evaluator, episodes=episodes)) == bits(whole, episodes=slice(episodes))
    swapped = np.arange(N)[::-1]
    other = evaluate(evaluator, swapped)
    assert bits(other, slice(N // 2, N // 2 + 1)) == bits(whole, slice(N // 2, N // 2 + 1))  # the one in the middle
    assert other.returns[0, 0] != whole.returns[-1, 0]  # in another place it has another reset


def test_policies_of_one_kind_in_any_order_of_chunks_give_the_same_bits(evaluator):
    """Chunks in several groups, and each alone."""
    asked = policy_work(POLICIES, STATISTICS, 9, seed=5, generation=9, traces=True)
    assert len(asked.work) == -(-N * 9 // POLICY_SLOTS) > 2 * POLICIES_TOGETHER // POLICY_SLOTS
    together = evaluator.evaluate(asked.work)
    alone = [evaluator.evaluate([one])[0] for one in asked.work]
    order = np.random.default_rng(0).permutation(len(asked.work))
    shuffled = evaluator.evaluate([asked.work[at] for at in order])
    whole = bits(gathered([asked.shape], together)[0])
    assert bits(gathered([asked.shape], alone)[0]) == whole
    assert bits(gathered([asked.shape], [shuffled[at] for at in np.argsort(order)])[0]) == whole


def test_each_part_of_an_address_gives_other_resets_and_none_is_that_of_a_centre(evaluator):
    """Policies are all the same, without statistics, so that only resets differ; they are more than travel together."""
    first = np.repeat(POLICIES[:1], POLICY_SLOTS + 4, axis=0)

    def returns(**address: int) -> list[float]:
        asked = policy_work(first, no_statistics(len(first), 2), 4, **{"seed": 3, "generation": 1, **address})
        return gathered([asked.shape], evaluator.evaluate(asked.work))[0].returns.ravel().tolist()

    found = [*returns(), *returns(seed=4), *returns(generation=2), *returns(ask=1)]
    centres = [(centre(first[0]), EvaluationChunk(1, 0, ask)) for ask in range(5)]
    found += [value for result in evaluator.evaluate(centres) for value in result.returns.tolist()]
    assert len(set(found)) == len(found)
    assert returns() == found[: 4 * len(first)]


def test_several_generations_seeds_and_asks_in_one_work_item_are_kept_apart(evaluator):
    addresses = [{}, {"seed": 6}, {"generation": 8}, {"ask": 2}, {}]
    given = [{"seed": 5, "generation": 9, "traces": True} | address for address in addresses]
    asked = [policy_work(POLICIES[:3], tuple(x[:3] for x in STATISTICS), 2, **one) for one in given]
    results = evaluator.evaluate([one.work[0] for one in asked])
    for one, result, address in zip(asked, results, addresses, strict=True):
        assert bits(gathered([one.shape], [result])[0]) == bits(evaluate(evaluator, slice(3), 2, **address))


def test_xla_and_simd_agree(evaluator):
    worker_spec: WorkerSpec = spec(rollout="simd", episode_steps=40)
    reference = evaluate(DirectEvaluator(worker_spec))
    found = evaluate(evaluator)
    apart = ~np.isclose(found.returns, reference.returns, rtol=1e-4)  # a wall's end may fall between two last bits
    assert apart.mean() < 0.05
    np.testing.assert_allclose(found.trace_T_B[~apart[:, 0]], reference.trace_T_B[~apart[:, 0]], atol=1e-3)


def test_policies_feed_no_statistics_and_have_traces_only_if_asked(evaluator):
    asked = policy_work(POLICIES, STATISTICS, 1, seed=5, generation=9)
    results = evaluator.evaluate(asked.work)
    assert all(result.moments is None and result.trace_T_B is None for result in results)
    traced = evaluate(evaluator)
    assert traced.trace_T_B.shape == (N, 41, 2)
    np.testing.assert_array_equal(traced.trace_T_B[:, -1], traced.descriptor[:, 0])


def test_there_is_no_action_noise():
    found = [evaluate(DirectEvaluator(spec(episode_steps=20, action_noise=noise)), slice(3)) for noise in (0.0, 0.5)]
    assert bits(found[0]) == bits(found[1])


def test_an_exception_names_the_policy_chunk_that_raised_it():
    asked = policy_work(POLICIES, STATISTICS, 1, seed=5, generation=9)
    (good, _), (policies, chunk) = asked.work[0], asked.work[1]
    bad = dataclasses.replace(policies, parameters_N_D=policies.parameters_N_D[:, : PARAMETERS - 1])
    with pytest.raises(ValueError, match="wrong shape") as raised:
        make_worker(spec(rollout="simd"))([(good, asked.work[0][1]), (bad, chunk)])
    assert raised.value.__notes__ == ["raised in PolicyChunk 1 of generation 9"]
