"""NS-ES, NSR-ES and NSRA-ES against their reference implementation; choice of centres, weight rule, invalid centres."""

import numpy as np
import pytest

from es_service.api import load_config
from es_service.config.parts import Ranks, Returns
from es_service.config.workload import worker_spec
from es_service.loop.blocks import state_of
from es_service.loop.checks import invalidate
from es_service.loop.state import no_observations
from es_service.protocol.messages import EpisodesResult, EvaluationChunk, TrainingChunk
from es_service.protocol.noise import Domain, normals, stream_keys, uniforms
from es_service.search.algorithms.base import CentreEvaluation, FitnessWeight
from es_service.search.algorithms.common import (
    CENTRE_CHOICE,
    add_to_archive,
    choose_centre,
    first_state,
    novelty_of_centres,
)
from es_service.search.algorithms.nsra_es import adapted_weight
from es_service.search.shaping import utilities, weighted
from tests.helpers import DirectEvaluator, MemoryStore
from tests.laws import me_es_runs
from tests.laws.me_es_runs import SHAPE
from tests.references import novelty_search as reference
from workers.environments import SHIPPED
from workers.policy import initial_parameters

RULE = {"fitness_weight_start": 0.6, "fitness_weight_step": 0.15, "fitness_weight_patience": 2}
STARTS = {"es": 1.0, "ns_es": 0.0, "nsr_es": 0.5, "nsra_es": 0.6}


def config_of(algorithm, distance="euclidean", **search):
    return load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8]},
            "search": {
                "algorithm": algorithm,
                "pairs": 32,
                "sigma": 0.1,
                "step": {"learning_rate": 0.05},
                "evaluation_episodes": 20,
                **(RULE if algorithm == "nsra_es" else {}),
                **search,
            },
            "novelty": {"neighbours": 3, "distance": distance},
            "budget": {"generations": 20},
            "compute": {"chunk_pairs": 16},
        }
    )


def run_in_memory(config, evaluator=None, store=None):
    evaluator = evaluator or DirectEvaluator(worker_spec(config, SHIPPED["point_maze"]))
    return me_es_runs.run_in_memory(config, evaluator, store)


def episodes(evaluator, kind, generation, centre_D=None):
    """Fitness and descriptors of all chunks of a kind, in the order of their ids."""
    found = [
        (chunk.chunk_id, result)
        for point, chunk, result in evaluator.recorded
        if isinstance(chunk, kind) and chunk.generation == generation
        if centre_D is None or np.array_equal(point.parameters_D, centre_D)
    ]
    results = [result for _, result in sorted(found, key=lambda item: item[0])]
    return np.concatenate([r.fitness for r in results]), np.concatenate([r.descriptor for r in results])


@pytest.mark.parametrize(
    ("algorithm", "distance", "shaping"),
    [
        ("ns_es", "euclidean", "ranks"),
        ("nsr_es", "euclidean", "ranks"),
        ("nsra_es", "euclidean", "ranks"),
        ("nsr_es", "squared_euclidean", "ranks"),
        ("nsr_es", "euclidean", "returns"),
        ("nsr_es", "euclidean", "signs"),
    ],
)
def test_twenty_generations_equal_the_reference(algorithm, distance, shaping):
    config, squared = config_of(algorithm, distance, shaping={"kind": shaping}), distance == "squared_euclidean"
    state, store, evaluator = run_in_memory(config)
    search = config.search
    rule = (search.fitness_weight_step, search.fitness_weight_patience, 0.0) if algorithm == "nsra_es" else None
    centres = [initial_parameters(SHAPE, config.policy.init, 0, index) for index in range(5)]
    other = reference.NoveltySearch(
        centres,
        search.step.learning_rate,
        search.step.l2,
        neighbours=3,
        weight=STARTS[algorithm],
        rule=rule,
        squared=squared,
        shaping=shaping,
    )
    for index, centre_D in enumerate(centres):
        _, descriptor = episodes(evaluator, EvaluationChunk, 0, centre_D)
        other.initial(index, descriptor[:20].astype(float).mean(axis=0))
    for generation in range(1, 21):
        row = store.rows[generation]
        drawn = uniforms(stream_keys(0, Domain.SELECTION, generation, CENTRE_CHOICE), np.zeros(1, np.uint32))[0]
        centre = other.chosen(float(drawn))
        assert row["centre"] == centre
        assert row["fitness_weight"] == other.weight
        noise = [
            normals(key, SHAPE.parameters) for key in stream_keys(0, Domain.PARAMETER_NOISE, generation, np.arange(32))
        ]
        other.generation(centre, noise, *episodes(evaluator, TrainingChunk, generation))
        fitness, descriptor = (x[:20] for x in episodes(evaluator, EvaluationChunk, generation))
        mean = descriptor.astype(float).mean(axis=0)
        assert row["centre_novelty"] == pytest.approx(reference.novelty(other.archive, mean, 3, squared), rel=1e-12)
        other.evaluated(centre, fitness.astype(float).mean(), mean)
        assert row["archive_size"] == len(other.archive) == 5 + generation
    for ours, theirs in zip(state.search.centres, other.centres, strict=True):
        assert np.linalg.norm(ours.centre_D - theirs.centre) < 1e-6 * np.linalg.norm(theirs.centre)
    assert len({row["centre"] for row in store.rows}) >= 3
    weights = len({row["fitness_weight"] for row in store.rows})
    assert weights >= 4 if algorithm == "nsra_es" else weights == 1
    np.testing.assert_allclose(state.search.archive.descriptor_N_B, other.archive, rtol=1e-12)


def test_a_state_put_together_again_is_the_same_and_only_the_moved_centre_is_written():
    config = config_of("nsra_es")

    class Recording(MemoryStore):
        def commit(self, generations):
            super().commit(generations)
            [(generation, parts, history, *_)] = generations
            centres = {name for name in parts if name.startswith("centres/")}
            wanted = range(5) if generation == 0 else [history["centre"]]
            steps = [f"centres/{centre}/step" for centre in wanted]
            assert centres == {*steps, *(f"centres/{centre}" for centre in wanted)}

    state, store, _ = run_in_memory(config, store=Recording())
    again = state_of(store.load(), 20, state.wall_clock_s)
    assert again.search.weight == state.search.weight
    for name in ("descriptor_N_B", "generation_N", "centre_N"):
        np.testing.assert_array_equal(getattr(again.search.archive, name), getattr(state.search.archive, name))
    for ours, theirs in zip(state.search.centres, again.search.centres, strict=True):
        assert ours.entry == theirs.entry
        np.testing.assert_array_equal(ours.centre_D, theirs.centre_D)
        assert ours.step.keys() == theirs.step.keys()
        for name in ours.step:
            np.testing.assert_array_equal(ours.step[name], theirs.step[name])
    assert sum(centre.step["adam_step"] for centre in again.search.centres) == 20  # each has an optimiser of its own


def test_initial_members_differ_and_are_evaluated_on_resets_of_their_own():
    _, store, evaluator = run_in_memory(config_of("ns_es").model_copy(update={"budget": config_of("es").budget}))
    first = [(point.parameters_D, chunk.chunk_id) for point, chunk, _ in evaluator.recorded if chunk.generation == 0]
    assert len({centre.tobytes() for centre, _ in first}) == 5
    assert sorted(chunk_id for _, chunk_id in first) == list(range(10))  # two chunks for each
    assert store.rows[0]["episodes"] == 100


# Choice of the centre to update


def state_with(descriptors, dimensions=2):
    """A state whose centres' newest entries are these; None for a centre without one."""
    state = first_state([np.zeros(3, np.float32)] * len(descriptors), dimensions, 0.0)
    for centre, descriptor in enumerate(descriptors):
        if descriptor is not None:
            state = add_to_archive(state, CentreEvaluation(0, centre, True, 0.0, np.array(descriptor, float)))
    return state


def choices(state, generations=4000, **search):
    config = config_of("ns_es", centres=len(state.centres), **search)
    picked = [choose_centre(state, generation, config) for generation in range(1, generations + 1)]
    return np.bincount(picked, minlength=len(state.centres)) / generations, picked


def test_members_are_chosen_in_proportion_to_their_novelty():
    state = state_with([(0, 0), (1, 0), (7, 0)])
    novelty_M = novelty_of_centres(state, config_of("ns_es").novelty)
    assert novelty_M.tolist() == [4.0, 3.5, 6.5]  # itself is no neighbour
    share, _ = choices(state)
    np.testing.assert_allclose(share, novelty_M / 14.0, atol=4 * np.sqrt(0.25 / 4000))


def test_novelty_is_that_of_today_s_archive_and_of_the_centre_s_newest_entry():
    state = state_with([(0, 0), (10, 0)])
    for _ in range(3):  # others crowd around the first centre
        state = add_to_archive(state, CentreEvaluation(1, 1, True, 0.0, np.array([0.0, 0.0])))
    state = add_to_archive(state, CentreEvaluation(2, 1, True, 0.0, np.array([5.0, 0.0])))
    assert novelty_of_centres(state, config_of("ns_es").novelty).tolist() == [0.0, 5.0]
    share, _ = choices(state, 200)
    assert share.tolist() == [0.0, 1.0]


def test_all_novelties_zero_is_a_uniform_choice():
    for state in (state_with([(1, 1)] * 4), state_with([None] * 4)):
        share, _ = choices(state)
        np.testing.assert_allclose(share, 0.25, atol=0.03)


def test_a_centre_that_was_never_valid_has_no_novelty():
    assert novelty_of_centres(state_with([(0, 0), None, (2, 0)]), config_of("ns_es").novelty).tolist() == [
        2.0,
        0.0,
        2.0,
    ]


def test_a_centre_that_was_never_valid_is_chosen_like_the_most_novel_one():
    share, _ = choices(state_with([(0, 0), None, (2, 0), (2, 1)]))  # novelties 2.1, none, 1.5, 1.6
    np.testing.assert_allclose(share, np.array([2.118, 2.118, 1.5, 1.618]) / 7.354, atol=0.03)


def test_other_choices():
    state = state_with([(0, 0), (0, 0), (9, 9)])
    share, _ = choices(state, centre_choice="uniform")
    np.testing.assert_allclose(share, 1 / 3, atol=0.03)
    _, picked = choices(state, 7, centre_choice="round_robin")
    assert picked == [0, 1, 2, 0, 1, 2, 0]


# The adaptive weight


def weights_of(fitnesses, start, **rule):
    search = config_of("nsra_es", fitness_weight_start=start, **rule).search
    weight, values = FitnessWeight(start), []
    for generation, fitness in enumerate(fitnesses, 1):
        valid = fitness is not None
        weight = adapted_weight(search, weight, (CentreEvaluation(generation, 0, valid, fitness or 0.0, np.zeros(2)),))
        values.append(round(weight.value, 10))
    return values, weight


def test_weight_by_hand():
    rule = {"fitness_weight_step": 0.25, "fitness_weight_patience": 2, "fitness_weight_min_gain": 0.0}
    values, weight = weights_of([-9, -9, -10, -11, None, -8, -8], 0.5, **rule)
    #     first always; equal is no gain; 2nd: down; 1; invalid: 2nd, down; gain: up; 1
    assert values == [0.75, 0.75, 0.5, 0.5, 0.25, 0.5, 0.5]
    assert (weight.record, weight.stagnant) == (-8, 1)
    assert weights_of(range(9), 0.5, **rule)[0][-1] == 1.0
    assert weights_of([0] * 20, 0.5, **rule)[0][-1] == 0.0


def test_the_least_gain_is_relative_to_the_record_s_size():
    rule = {"fitness_weight_step": 0.125, "fitness_weight_patience": 9, "fitness_weight_min_gain": 0.1}
    assert weights_of([-100, -91, -90, -89.9, -81, -80.9], 0.0, **rule)[0] == [0.125, 0.125, 0.125, 0.25, 0.25, 0.375]


def test_presets_are_the_published_rules():
    """literature: w0 1, patience 50, any gain; uber: w0 0.5, patience 20, a tenth; 0.05 in both."""
    for preset, expected in (("literature", (1.0, 0.05, 50, 0.0)), ("uber", (0.5, 0.05, 20, 0.1))):
        search = load_config(
            {
                "task": {"environment": "point_maze"},
                "search": {"algorithm": "nsra_es", "preset": preset},
                "budget": {"generations": 1},
            }
        ).search
        assert expected == (
            search.fitness_weight_start,
            search.fitness_weight_step,
            search.fitness_weight_patience,
            search.fitness_weight_min_gain,
        )


# Invalid results


KINDS = {"ranks": Ranks(), "returns": Returns()}


@pytest.mark.parametrize("shaping", KINDS)
@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_invalid_members_are_last_whatever_is_climbed(weight, shaping):
    """One would be the most novel, but its fitness is NaN; one would be the fittest, but ended nowhere."""
    fitness = np.array([[1.0, np.nan], [9.0, 2.0]], np.float32)
    descriptor = np.array([[(1.0, 0.0), (50.0, 0.0)], [(np.inf, 0.0), (2.0, 0.0)]], np.float32)
    population = EpisodesResult(fitness, fitness, descriptor, np.ones((2, 2), np.int32), fitness, no_observations(2))
    (population,), _ = invalidate([population], config_of("nsr_es").search, 1)
    assert np.isnan(population.fitness).sum() == 2
    state = add_to_archive(
        first_state([np.zeros(1, np.float32)], 2, weight), CentreEvaluation(0, 0, True, 0.0, np.zeros(2))
    )
    novelty = config_of("nsr_es").novelty
    utility = utilities(weighted(weight), population, state.archive, novelty, KINDS[shaping])
    assert utility[0, 1] == utility[1, 0] == utility.min() <= utility[0, 0] < utility[1, 1] == utility.max()
    assert (utility.min() < utility[0, 0]) == (shaping == "ranks")  # with returns, as low as the worst valid member


class Spoiling(DirectEvaluator):
    """Evaluations of some generations end nowhere."""

    def evaluate(self, work):
        results = super().evaluate(work)
        for (_, chunk), result in zip(work, results, strict=True):
            if isinstance(chunk, EvaluationChunk) and chunk.generation in (0, 3):
                result.descriptor[1] = np.nan
            if isinstance(chunk, TrainingChunk):
                result.descriptor[0, 0] = np.inf
        return results


def test_an_invalid_centre_never_enters_the_archive():
    config = config_of("nsra_es")
    state, store, _ = run_in_memory(config, Spoiling(worker_spec(config, SHIPPED["point_maze"])))
    assert [row["archive_size"] for row in store.rows[:6]] == [0, 1, 2, 2, 3, 4]
    assert store.rows[3]["centre_novelty"] is None
    assert 3 not in state.search.archive.generation_N
    assert all(row["invalid_members"] == 2 for row in store.rows[1:])
    assert all(np.isfinite(centre.centre_D).all() for centre in state.search.centres)
