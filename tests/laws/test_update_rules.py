"""Ranks, the gradient estimate, the tree sum and Adam, worked by hand and against their reference implementations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from es_service.api import load_config
from es_service.config.parts import AdamStep, AdamWStep, ClipUpStep, Ranks, Returns, Signs, TopPairs
from es_service.config.workload import worker_spec
from es_service.loop.generation import estimate_gradients
from es_service.protocol.episodes import completed
from es_service.protocol.messages import GradientResult
from es_service.protocol.noise import Domain, normals, stream_keys
from es_service.search.shaping import centred_ranks, pair_signs, pair_weights, shaped, standardised
from es_service.search.steps import adam_step, adamw_step, clipup_step, fresh_adam, fresh_clipup
from tests.helpers import DirectEvaluator
from tests.laws.es_runs import SHAPE, small_config
from tests.references import es as reference
from workers.environments import SHIPPED

KINDS = {"ranks": Ranks(), "signs": Signs(), "returns": Returns(), "top_pairs": TopPairs(count=5)}
fitness_arrays = hnp.arrays(
    np.float64,
    st.tuples(st.integers(1, 12), st.just(2)),
    elements=st.integers(-5, 5).map(float) | st.floats(-1e6, 1e6, width=32),
)


def test_ranks_by_hand():
    # three pairs; 2.0 occurs twice (ranks 2 and 3), NaN and -inf share the lowest two ranks
    fitness = [[1e9, 2.0], [np.nan, 2.0], [-np.inf, 5.0]]
    np.testing.assert_allclose(centred_ranks(fitness), [[0.5, 0.0], [-0.4, 0.0], [-0.4, 0.3]])
    np.testing.assert_allclose(pair_weights(centred_ranks(fitness)), [0.5, -0.4, -0.7], rtol=1e-6)


def test_signs_by_hand():
    # an invalid member is the worse one; of two, as of equal ones, neither is better
    fitness = [[3.0, 1e9], [np.nan, -1e9], [2.0, 2.0], [-np.inf, np.nan]]
    np.testing.assert_array_equal(pair_signs(fitness), [[-0.5, 0.5], [-0.5, 0.5], [0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(pair_weights(pair_signs(fitness)), [-1.0, -1.0, 0.0, 0.0])


def test_standardised_returns_by_hand():
    # the invalid member counts as -2: mean 1, standard deviation sqrt((9 + 9 + 9 + 1 + 4 + 16) / 6)
    found = standardised([[-2.0, np.nan], [4.0, 2.0], [-1.0, 5.0]])
    np.testing.assert_allclose(found, np.array([[-3.0, -3.0], [3.0, 1.0], [-2.0, 4.0]]) / np.sqrt(8.0))
    for without_a_difference in ([[0.1] * 2] * 3, [[np.nan, np.inf]], [[7.0, np.nan]]):
        np.testing.assert_array_equal(standardised(without_a_difference), np.zeros_like(without_a_difference))


@given(fitness_arrays, st.sampled_from(["signs", "returns"]), st.randoms(use_true_random=False))
def test_other_shapings_equal_the_reference_and_no_order_of_pairs_matters(fitness, shaping, random):
    utilities = shaped(KINDS[shaping], fitness)
    np.testing.assert_allclose(utilities.ravel(), reference.SHAPINGS[shaping](fitness.ravel()), rtol=1e-6, atol=1e-9)
    order = random.sample(range(len(fitness)), len(fitness))
    np.testing.assert_array_equal(shaped(KINDS[shaping], fitness[order]), utilities[order])


@given(fitness_arrays)
def test_ranks_equal_the_reference_and_sum_to_zero(fitness):
    ranks = centred_ranks(fitness)
    np.testing.assert_allclose(ranks.ravel(), reference.averaged_centred_ranks(fitness.ravel()), atol=1e-12)
    assert abs(ranks.sum()) < 1e-9


@given(hnp.arrays(np.float64, (6, 2), elements=st.integers(-50, 50).map(float)))
def test_an_increasing_map_of_the_fitness_changes_nothing(fitness):
    for mapped in (fitness * 3.0 - 7.0, np.exp(fitness / 10.0), fitness**3):
        np.testing.assert_array_equal(centred_ranks(mapped), centred_ranks(fitness))


@pytest.mark.parametrize("shaping", KINDS)
def test_swapping_signs_negates_the_gradient_estimate_exactly(shaping):
    config = small_config()
    evaluator = DirectEvaluator(worker_spec(config, SHIPPED["point_maze"]))
    fitness = np.random.default_rng(0).normal(size=(48, 2))
    estimates = [
        completed(estimate_gradients(1, [pair_weights(shaped(KINDS[shaping], values))], 20), evaluator.evaluate)[0]
        for values in (fitness, fitness[:, ::-1])
    ]
    assert np.abs(estimates[0]).max() > 0
    np.testing.assert_array_equal(estimates[0], -estimates[1])


def test_gradient_by_hand_three_pairs():
    """Worked through: weights of three pairs times their noise, over three; blocks of two leave one padded pair."""
    config = load_config(
        small_config().model_dump(mode="json")
        | {"search": {"algorithm": "es", "pairs": 3}, "compute": {"gradient_block_pairs": 2}}
    )
    weights = np.float32([1.0, -0.5, 0.25])
    evaluator = DirectEvaluator(worker_spec(config, SHIPPED["point_maze"]))
    (found,) = completed(estimate_gradients(1, [weights], 2), evaluator.evaluate)
    noise = [normals(key, SHAPE.parameters) for key in stream_keys(0, Domain.PARAMETER_NOISE, 1, np.arange(3))]
    np.testing.assert_allclose(found, (noise[0] - 0.5 * noise[1] + 0.25 * noise[2]) / 3, rtol=1e-5, atol=1e-6)


def test_adam_by_hand():
    """First step: m = 0.1 g, v = 0.001 g^2, so the step is lr * sqrt(0.001)/0.1 * 0.1 g / (sqrt(0.001)|g| + 1e-8)."""
    gradient, start = np.float32([2.0, -0.5, 0.0]), np.float32([1.0, 1.0, 1.0])
    free, decaying = AdamStep(learning_rate=0.01, l2=0.0), AdamStep(learning_rate=0.01, l2=0.005)
    state, moved = adam_step(free, fresh_adam(3), start, gradient)
    np.testing.assert_allclose(moved, [1.01, 0.99, 1.0], rtol=1e-6)
    assert state["adam_step"] == 1
    _, pulled = adam_step(decaying, fresh_adam(3), start, np.zeros(3, np.float32))
    np.testing.assert_allclose(pulled, start - 0.01, rtol=1e-4)  # the penalty alone, through Adam
    tiny = np.float32([1e-7, 0.0, 0.0])  # epsilon sits inside the bias correction: visible for tiny gradients only
    _, crept = adam_step(free, fresh_adam(3), np.zeros(3, np.float32), tiny)
    expected = 0.01 * np.sqrt(0.001) / 0.1 * 0.1 * 1e-7 / (np.sqrt(0.001) * 1e-7 + 1e-8)
    assert crept[0] == pytest.approx(expected, rel=1e-4)


def test_adamw_by_hand():
    """The first step of Adam is the learning rate, whatever the decay; that takes a share of the centre besides."""
    gradient, start = np.float32([2.0, -0.5, 0.0]), np.float32([1.0, 2.0, -4.0])
    step = AdamWStep(learning_rate=0.01, l2=0.5)
    state, moved = adamw_step(step, fresh_adam(3), start, gradient)
    np.testing.assert_allclose(moved, [1.01 - 0.005, 1.99 - 0.01, -4.0 + 0.02], rtol=1e-6)
    alone, _ = adam_step(AdamStep(l2=0.0), fresh_adam(3), start, gradient)
    for name, values in alone.items():
        np.testing.assert_array_equal(state[name], values)


def test_clipup_by_hand():
    """Two steps along (3, 4), whose norm is 5; the second would be 0.19 long and is shortened to 0.15."""
    step = ClipUpStep(learning_rate=0.1, l2=0.0, max_speed=0.15)
    start = np.zeros(2, np.float32)
    state, once = clipup_step(step, fresh_clipup(2), start, np.float32([3.0, 4.0]))
    np.testing.assert_allclose(once, [0.06, 0.08], rtol=1e-6)
    state, twice = clipup_step(step, state, once, np.float32([300.0, 400.0]))
    np.testing.assert_allclose(twice - once, [0.09, 0.12], rtol=1e-6)
    state, without_a_signal = clipup_step(step, state, twice, np.zeros(2, np.float32))
    np.testing.assert_allclose(without_a_signal - twice, [0.081, 0.108], rtol=1e-6)  # 0.9 of the velocity
    _, braked = clipup_step(step.model_copy(update={"momentum": 0.5}), state, twice, np.zeros(2, np.float32))
    np.testing.assert_allclose(braked - twice, [0.0405, 0.054], rtol=1e-6)  # half of the velocity after that step
    _, pulled = clipup_step(
        ClipUpStep(learning_rate=0.1, l2=1.0), fresh_clipup(2), np.float32([3.0, 4.0]), np.zeros(2, np.float32)
    )
    np.testing.assert_allclose(pulled, [2.94, 3.92], rtol=1e-6)  # the penalty alone, normalised


@given(hnp.arrays(np.float32, 5, elements=st.floats(-1e3, 1e3, width=32)), st.floats(1e-3, 1e3))
def test_clipup_sees_the_direction_alone_and_keeps_to_its_speed(gradient, factor):
    step, start = ClipUpStep(learning_rate=0.1, l2=0.0), np.ones(5, np.float32)
    scaled = gradient * np.float32(factor)
    if not (np.square(gradient).sum() > 1e-20 and np.square(scaled).sum() > 1e-20):
        return
    state, moved = clipup_step(step, fresh_clipup(5), start, gradient)
    np.testing.assert_allclose(clipup_step(step, fresh_clipup(5), start, scaled)[1], moved, atol=1e-5)
    for _ in range(20):
        before = moved
        state, moved = clipup_step(step, state, moved, gradient)
        assert np.linalg.norm(moved - before) <= 0.1 / 0.75 + 1e-5


def test_blocks_of_the_gradient_are_added_in_the_tree():
    class Answers:
        def evaluate(self, work):
            return [GradientResult(np.float32([x])) for x in (1e8, 1.0, -1e8, 1.0, 3.0)]

    (found,) = completed(estimate_gradients(1, [np.ones(5, np.float32)], 1), Answers().evaluate)
    assert found[0] == np.float32(3.0) * np.float32(1 / 5)  # one by one it is 4 / 5


@pytest.mark.parametrize("invalid", [np.inf, -np.inf])
def test_infinities_share_the_lowest_rank(invalid):
    np.testing.assert_allclose(centred_ranks([[invalid, 1.0], [np.nan, 2.0]]), [[-1 / 3, 1 / 6], [-1 / 3, 1 / 2]])
