"""What a search asks for: populations with sigmas, sizes and random streams of their own; and what it may not ask."""

from dataclasses import replace

import numpy as np
import pytest

from es_service.errors import EvaluationError
from es_service.protocol.messages import EvaluationChunk, GradientChunk, TrainingChunk
from es_service.protocol.noise import Domain, normals, stream_keys
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import Ask
from tests.helpers import DirectEvaluator, centre, random_parameters, spec
from tests.laws.me_es_runs import SHAPE, assert_near, config_of, first_centres, noise_of, points, run_in_memory
from tests.references import es as reference

# Random streams


@pytest.mark.parametrize(
    ("what", "sigma", "changes"),
    [
        ("noise", 0.1, {"action_noise": 0.0, "environment_options": {"start": "corner"}}),
        ("resets", 1e-30, {"action_noise": 0.0}),
        ("action noise", 1e-30, {"action_noise": 0.1, "environment_options": {"start": "corner"}}),
        ("nothing", 1e-30, {"action_noise": 0.0, "environment_options": {"start": "corner"}}),
    ],
)
def test_each_population_has_streams_of_its_own(what, sigma, changes):
    evaluator = DirectEvaluator(spec(episode_steps=20, rollout="simd", **changes))
    point = centre(random_parameters(), sigma=sigma)
    chunks = [TrainingChunk(3, 0), *(TrainingChunk(3, 0, ask) for ask in range(3)), TrainingChunk(3, 0, 1)]
    found = [r.fitness.tobytes() + r.descriptor.tobytes() for r in evaluator.evaluate([(point, c) for c in chunks])]
    assert found[0] == found[1]
    assert found[2] == found[4]
    assert len(set(found)) == (1 if what == "nothing" else 3)
    tests = [EvaluationChunk(3, 0), *(EvaluationChunk(3, 0, ask) for ask in range(3))]
    found = [r.fitness.tobytes() for r in evaluator.evaluate([(point, c) for c in tests])]
    assert found[0] == found[1]
    assert len(set(found)) == (3 if what == "resets" else 1)


def test_the_gradient_is_of_the_noise_of_its_population():
    evaluator, point = DirectEvaluator(spec()), centre(random_parameters())
    weights_P = np.arange(1.0, 9.0, dtype=np.float32)
    for ask in range(3):
        (result,) = evaluator.evaluate([(point, GradientChunk(1, 2, weights_P, ask))])
        ids = (np.arange(16, 24), ask) if ask else (np.arange(16, 24),)
        keys = stream_keys(3, Domain.PARAMETER_NOISE, 1, *ids)
        expected = sum(w * normals(k, SHAPE.parameters) for w, k in zip(weights_P, keys, strict=True))
        np.testing.assert_allclose(result.sum_D, expected, rtol=1e-4, atol=1e-4)


# Sigma, pairs, centres


def asking(config, *asks):
    """ES with several centres that asks for what it is told to: functions of a state."""
    return replace(ALGORITHMS["es"](config), ask=lambda state, generation: tuple(one(state) for one in asks))


def test_sigma_and_pairs_are_those_of_the_ask():
    config = config_of(generations=1, algorithm="nsr_es", centres=3, step={"learning_rate": 0.05})
    sizes = {2: (0.05, 16), 0: (0.4, 48)}
    asks = [lambda s, i=i, said=said: Ask(i, s.centres[i].centre_D, *said, 1.0) for i, said in sizes.items()]
    state, store, evaluator = run_in_memory(config, algorithm=asking(config, *asks))
    assert [row["centre"] for row in store.evaluated[1]] == [2, 0]
    first = first_centres(config)
    for ask, (index, (sigma, pairs)) in enumerate(sizes.items()):
        point, fitness, _ = points(evaluator, TrainingChunk, 1, ask)
        assert (point.sigma, len(fitness)) == (sigma, pairs)
        np.testing.assert_array_equal(point.parameters_D, first[index])
        other = reference.ES(first[index], 0.05, config.search.step.l2)
        other.generation(noise_of(1, ask, pairs), fitness)
        assert_near(state.search.centres[index].centre_D, other.centre)
    np.testing.assert_array_equal(state.search.centres[1].centre_D, first[1])


GOOD = Ask(0, np.zeros(SHAPE.parameters, np.float32), 0.1, 16, 1.0)
BAD_SIGMA, BAD_PAIRS = "it must be positive", r"must be a multiple of chunk_pairs \(16\)"


@pytest.mark.parametrize(
    ("asks", "sentence"),
    [
        ([GOOD], "`ask` returned list; it must return a tuple of one or more Ask"),
        (GOOD, "`ask` returned Ask; it must return a tuple of one or more Ask"),
        ((), "`ask` returned an empty tuple; it must"),
        ((GOOD, None), "`ask` returned tuple of Ask, NoneType; it must"),
        ((GOOD, GOOD), r"the asks are for the centres \[0, 0\]; each of the 2 may occur once"),
        ((replace(GOOD, centre=2),), r"the centres \[2\]; each of the 2 may occur once"),
        ((GOOD, replace(GOOD, centre=-1)), r"the centres \[0, -1\]"),
        ((replace(GOOD, centre=1.0),), r"the centres \[1\.0\]"),
        ((replace(GOOD, centre=[0]),), r"the centres \[\[0\]\]"),
        ((replace(GOOD, sigma=0.0),), f"the sigma of centre 0 is 0.0; {BAD_SIGMA}"),
        ((GOOD, replace(GOOD, centre=1, sigma=-0.1)), f"the sigma of centre 1 is -0.1; {BAD_SIGMA}"),
        ((replace(GOOD, sigma=np.nan),), f"the sigma of centre 0 is nan; {BAD_SIGMA}"),
        ((replace(GOOD, sigma=np.inf),), f"the sigma of centre 0 is inf; {BAD_SIGMA}"),
        ((replace(GOOD, sigma="0.1"),), f"the sigma of centre 0 is 0.1; {BAD_SIGMA}"),
        ((replace(GOOD, pairs=24),), f"centre 0 has 24 pairs; {BAD_PAIRS}"),
        ((replace(GOOD, pairs=0),), f"centre 0 has 0 pairs; {BAD_PAIRS}"),
        ((replace(GOOD, pairs=-16),), f"centre 0 has -16 pairs; {BAD_PAIRS}"),
        ((replace(GOOD, pairs=16.0),), f"centre 0 has 16.0 pairs; {BAD_PAIRS}"),
        ((replace(GOOD, centre_D=GOOD.centre_D[1:]),), rf"centre 0 are float32 .*; must be .* \({SHAPE.parameters},\)"),
        ((replace(GOOD, centre_D=GOOD.centre_D.astype(float)),), "centre 0 are float64 .*; must be a float32 array"),
        ((replace(GOOD, centre_D=None),), "the parameters of centre 0 are NoneType; must be a float32 array"),
    ],
)
def test_what_cannot_be_evaluated_is_an_error_with_a_sentence(asks, sentence):
    config = config_of(generations=1, algorithm="nsr_es", centres=2)
    algorithm = replace(ALGORITHMS["es"](config), ask=lambda state, generation: asks)
    with pytest.raises(EvaluationError, match=f"generation 1: .*{sentence}") as error:
        run_in_memory(config, algorithm=algorithm)
    assert error.value.field == "search.algorithm"


WEIGHTS = np.linspace(-0.5, 0.5, 16, dtype=np.float32)


@pytest.mark.parametrize(
    ("weights", "sentence"),
    [
        (WEIGHTS[:-1], r"are float32 \(15,\); must be a float32 array of shape \(16,\)"),
        (WEIGHTS[:, None], r"are float32 \(16, 1\); must be a float32 array of shape \(16,\)"),
        (WEIGHTS.astype(float), r"are float64 \(16,\); must be a float32 array"),
        (WEIGHTS.tolist(), "are list; must be a float32 array"),
        (None, "are NoneType; must be a float32 array"),
        (np.where(np.arange(16) < 3, np.float32(np.nan), WEIGHTS), "are not finite for 3 of 16 pairs"),
        (np.where(np.arange(16) < 1, np.float32(np.inf), WEIGHTS), "are not finite for 1 of 16 pairs"),
    ],
)
def test_weights_that_make_no_gradient_are_an_error_with_a_sentence(weights, sentence):
    config = config_of(generations=1, algorithm="nsr_es", centres=2, pairs=16)
    algorithm = replace(ALGORITHMS["nsr_es"](config), weights=lambda state, asked, population: weights)
    with pytest.raises(EvaluationError, match=f"generation 1: the `weights` of centre [01] {sentence}") as error:
        run_in_memory(config, algorithm=algorithm)
    assert error.value.field == "search.algorithm"


@pytest.mark.parametrize("function", ["step", "tell"])
@pytest.mark.parametrize("returned", [None, "state"])
def test_what_is_no_state_is_an_error_with_a_sentence(function, returned):
    config = config_of(generations=1, algorithm="nsr_es", centres=2)
    algorithm = replace(ALGORITHMS["nsr_es"](config), **{function: lambda *given: returned})
    generation, kind = {"step": 1, "tell": 0}[function], type(returned).__name__
    with pytest.raises(EvaluationError, match=f"generation {generation}: `{function}` returned {kind}; it must return"):
        run_in_memory(config, algorithm=algorithm)


@pytest.mark.parametrize(
    ("function", "returned", "sentence"),
    [
        ("start_cells", None, "returned NoneType; it must return a mapping from indices of centres to cells"),
        ("start_cells", [(0, 3)], "returned list; it must return a mapping"),
        ("start_cells", {2: 0}, r"names the centres \[2\]; the indices of centres are 0 to 1"),
        ("start_cells", {-1: 0}, r"names the centres \[-1\]"),
        ("start_cells", {0.0: 0}, r"names the centres \[0\.0\]"),
        ("start_cells", {0: 400}, "names the cells 400, which have no elite; [12] cells of the map have one"),
        ("start_cells", {0: -1}, "names the cells -1, which have no elite"),
        ("start_cells", {0: 1.5}, r"returned \[1\.5\] as cells; it must return whole numbers"),
        ("start_cells", {0: None}, r"returned \[None\] as cells"),
        ("start_cells", {0: [3]}, r"returned \[\[3\]\] as cells"),
    ],
)
def test_centres_and_elites_that_are_not_there_are_an_error_with_a_sentence(function, returned, sentence):
    config = config_of(generations=1, algorithm="nsr_es", centres=2)
    algorithm = replace(ALGORITHMS["nsr_es"](config), **{function: lambda state, generation: returned})
    with pytest.raises(EvaluationError, match=f"generation 1: `{function}` {sentence}") as error:
        run_in_memory(config, algorithm=algorithm)
    assert error.value.field == "search.algorithm"


def test_without_a_map_no_cell_can_be_named():
    config = config_of(generations=1, algorithm="es")
    config = config.model_copy(update={"map": config.map.model_copy(update={"enabled": False})})
    algorithm = replace(ALGORITHMS["es"](config), start_cells=lambda state, generation: {0: 0})
    with pytest.raises(EvaluationError, match=r"`start_cells` names the cells 0, .*; the run has no map"):
        run_in_memory(config, algorithm=algorithm)


def _without_last(state, *_):
    return replace(state, centres=state.centres[:-1])


def _with_three_parameters(state, index, *_):
    wrong = replace(state.centres[index], centre_D=np.zeros(3, np.float32))
    return replace(state, centres=(*state.centres[:index], wrong, *state.centres[index + 1 :]))


@pytest.mark.parametrize(
    ("restart", "sentence"),
    [
        (lambda *_: None, "returned NoneType; it must return a SearchState"),
        (_without_last, "returned a state without centre 1, which it was called for; it has 1 centres"),
        (_with_three_parameters, r"returned a state in which the parameters of centre 1 are float32 \(3,\); must be"),
    ],
)
def test_a_restart_that_leaves_no_centre_is_an_error_with_a_sentence(restart, sentence):
    config = config_of(generations=1, algorithm="nsr_es", centres=2)
    begun = {"start_cells": lambda state, generation: {1: state.map.cell_N[0]}, "restart": restart}
    algorithm = replace(ALGORITHMS["nsr_es"](config), **begun)
    with pytest.raises(EvaluationError, match=f"generation 1: `restart` {sentence}"):
        run_in_memory(config, algorithm=algorithm)


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (_without_last, "returned a state without centre 1"),
        (
            lambda state, asked, gradient: _with_three_parameters(state, asked.centre),
            r"returned a state in which the parameters of centre 1 are float32 \(3,\)",
        ),
    ],
)
def test_a_step_that_leaves_no_centre_is_an_error_with_a_sentence(step, sentence):
    config = config_of(generations=1, algorithm="nsr_es", centres=2)
    one = lambda state, generation: (Ask(1, state.centres[1].centre_D, 0.1, 16, 1.0),)  # noqa: E731
    algorithm = replace(ALGORITHMS["nsr_es"](config), ask=one, step=step)
    with pytest.raises(EvaluationError, match=f"generation 1: `step` {sentence}"):
        run_in_memory(config, algorithm=algorithm)


def test_numbers_of_numpy_name_cells_and_centres_as_those_of_python_do():
    config = config_of(generations=1, algorithm="nsr_es", centres=2)
    ours, seen = ALGORITHMS["nsr_es"](config), []

    def restart(state, index, cell, elite):
        seen.append((index, cell))
        return ours.restart(state, index, cell, elite)

    begun = lambda state, generation: {np.int64(1): state.map.cell_N[0]}  # noqa: E731
    run_in_memory(config, algorithm=replace(ours, start_cells=begun, restart=restart))
    assert [type(number) for number in seen[0]] == [int, int]
