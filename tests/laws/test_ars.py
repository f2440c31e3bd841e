"""ARS against its reference implementation, its weights by hand, and invalid members; its policy is linear."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from es_service.config.parts import PlainStep, TopPairs
from es_service.config.workload import policy_spec, worker_spec
from es_service.protocol.messages import TrainingChunk
from es_service.protocol.noise import Domain, normals, stream_keys
from es_service.search.shaping import pair_weights, shaped
from es_service.search.steps import STEPS
from tests.laws.es_runs import Tampering, run_in_memory, small_config
from tests.references import ars as reference
from workers.environments import SHIPPED
from workers.policy import initial_parameters

LINEAR = {"hidden": [], "action_noise": 0.0}


def config_of(policy=LINEAR, l2=0.0, **search):
    return small_config(policy, **{"algorithm": "ars", "step": {"learning_rate": 0.1, "l2": l2}, **search})


def top_pair_weights(fitness_P_S, count):
    """Weight of each pair's noise, [P], with shaping by this number of best pairs."""
    return pair_weights(shaped(TopPairs(count=count), fitness_P_S))


def spoil(chunk, result):
    """One member without a finite fitness, one that ended nowhere."""
    if isinstance(chunk, TrainingChunk) and chunk.chunk_id == 1:
        result.fitness[0, 0] = np.nan
        result.descriptor[1, 1] = np.inf
    return result


@pytest.mark.parametrize(
    ("policy", "search", "tampered"),
    [
        (LINEAR, {"shaping": {"count": 12}}, False),
        (LINEAR | {"observation_normalization": False}, {"shaping": {"kind": "top_pairs", "count": 1}}, False),
        (LINEAR, {"l2": 0.05}, False),
        ({}, {"shaping": {"count": 20}}, True),
    ],
    ids=["V2-t", "V1-t", "V2, all pairs, l2", "two layers, invalid members"],
)
def test_twenty_generations_equal_the_reference(policy, search, tampered):
    config = config_of(policy, **search)
    task = SHIPPED["point_maze"]
    state, store, evaluator, _ = run_in_memory(
        config, Tampering(worker_spec(config, task), spoil) if tampered else None
    )
    shape, search = policy_spec(config, task), config.search
    first = initial_parameters(shape, config.policy.init, 0)
    other = reference.ARS(first, search.step.learning_rate, search.step.l2, search.shaping.count or search.pairs)
    for generation in range(1, 21):
        results = {
            chunk.chunk_id: np.where(np.isfinite(result.descriptor).all(axis=-1), result.fitness, np.nan)
            for _, chunk, result in evaluator.recorded
            if isinstance(chunk, TrainingChunk) and chunk.generation == generation
        }
        keys = stream_keys(0, Domain.PARAMETER_NOISE, generation, np.arange(48))
        fitness_P_S = np.concatenate([results[chunk_id] for chunk_id in sorted(results)])
        assert np.isnan(fitness_P_S).sum() == 2 * tampered
        other.generation([normals(key, shape.parameters) for key in keys], fitness_P_S)
    (centre,) = state.search.centres
    assert np.linalg.norm(centre.centre_D - other.centre) < 1e-6 * np.linalg.norm(other.centre)
    assert centre.step == {}, "a plain step remembers nothing"
    assert np.linalg.norm(centre.centre_D - first) > 0.3
    assert store.rows[-1]["archive_size"] == 21, "kept for comparison, as for es"


def test_weights_by_hand():
    # better members 9, 5, 4 and 8: the first pair and the last, whose values have mean 4 and variance 166 / 4
    found = top_pair_weights([[9.0, -7.0], [1.0, 5.0], [4.0, -8.0], [6.0, 8.0]], 2)
    np.testing.assert_allclose(found, np.array([16.0, 0.0, 0.0, -2.0]) * 4 / (2 * np.sqrt(166 / 4)), rtol=1e-6)
    # the invalid member counts as -8, the lowest: mean -1, variance 204 / 4
    found = top_pair_weights([[8.0, np.nan], [-8.0, 4.0]], 2)
    np.testing.assert_allclose(found, np.array([16.0, -12.0]) / np.sqrt(204 / 4), rtol=1e-6)


def test_of_equally_good_pairs_the_first_are_taken():
    fitness = np.zeros((100, 2))
    fitness[1::2, 1] = 9.0
    assert np.flatnonzero(top_pair_weights(fitness, 7)).tolist() == [1, 3, 5, 7, 9, 11, 13]


@pytest.mark.parametrize("value", [0.1, np.nan])
def test_without_a_difference_there_is_no_step(value):
    np.testing.assert_array_equal(top_pair_weights([[value] * 2] * 3, 3), np.zeros(3))
    np.testing.assert_array_equal(top_pair_weights([[value] * 2] * 3, 2), np.zeros(3))


@given(
    hnp.arrays(np.float64, (6, 2), elements=st.integers(-50, 50).map(float)),
    st.integers(1, 6),
    st.sampled_from([0.25, 8.0]),
)
def test_only_differences_count_and_neither_scale_nor_shift_of_the_fitness(fitness, count, scale):
    weights = top_pair_weights(fitness, count)
    assert np.count_nonzero(weights) <= count
    np.testing.assert_array_equal(top_pair_weights(fitness[:, ::-1], count), -weights)
    np.testing.assert_array_equal(top_pair_weights(fitness * scale, count), weights)
    np.testing.assert_allclose(top_pair_weights(fitness + 1000.0, count), weights, rtol=1e-6, atol=1e-9)


def test_a_plain_step_by_hand():
    settings = PlainStep(learning_rate=0.5, l2=0.25)
    state, found = STEPS["plain"].take(settings, {}, np.float32([1.0, -2.0]), np.float32([4.0, 0.0]))
    assert state == STEPS["plain"].fresh(2) == {}
    np.testing.assert_array_equal(found, np.float32([1.0 + 0.5 * (4.0 - 0.25), -2.0 + 0.5 * 0.5]))


def test_es_with_its_parts_is_ars():
    """But for the name of the method in its config, nothing differs."""
    config = config_of(shaping={"count": 12})
    parts = config.search.model_dump(include={"step", "shaping"})
    other = small_config(LINEAR, algorithm="es", **parts)
    (one,), (two,) = (run_in_memory(each)[0].search.centres for each in (config, other))
    np.testing.assert_array_equal(one.centre_D, two.centre_D)


def test_by_default_there_is_neither_weight_decay_nor_action_noise():
    config = small_config(algorithm="ars")
    assert (config.search.step.l2, config.policy.action_noise) == (0.0, 0.0)
