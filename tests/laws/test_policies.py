"""A generation that asks for explicit policies, alone or beside populations: what is told, counted and refused."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from es_service import api
from es_service.errors import EvaluationError
from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.episodes import gathered, in_blocks
from es_service.protocol.messages import PolicyChunk
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import Ask, PolicyAsk
from es_service.search.algorithms.common import add_to_archive, insert_into_map
from es_service.search.maps.behaviour_map import insert
from tests.helpers import workers_in_this_process
from tests.laws.me_es_runs import SHAPE, Sharing, config_of, run_in_memory

POLICIES, OTHERS = (
    np.random.default_rng(seed).normal(size=(count, SHAPE.parameters)).astype(np.float32)
    for seed, count in ((0, 18), (1, 3))
)
MEAN, STD = (np.full((3, 2), value, np.float32) for value in (0.3, 2.0))
EPISODES = 20


def around(config, *policies: np.ndarray, mean=MEAN, std=STD):
    """NSR-ES with two centres, both updated, that asks besides for policies: the first before, the others behind."""
    shipped = ALGORITHMS["nsr_es"](config)

    def ask(state, generation):
        first, *others = [
            PolicyAsk(of, mean, std) if of is OTHERS else PolicyAsk(of + np.float32(generation)) for of in policies
        ]
        return first, *shipped.ask(state, generation), *others

    def tell(state, told):
        count = len(state.centres)
        state = shipped.tell(state, tuple(one for one in told if one.centre < count))
        for one in told:
            if one.centre >= count and one.valid:
                map_, _, _ = insert(
                    state.map, one.descriptor_B, one.fitness, one.generation, one.centre, one.population_max
                )
                state = replace(state, map=map_)
        return state

    return replace(shipped, ask=ask, tell=tell)


def mixed(config):
    """The search of the runs on engines below."""
    return around(config, POLICIES, OTHERS)


def config(**changes):
    return config_of(generations=2, algorithm="nsr_es", centres=2, update="all", **changes)


@pytest.fixture(scope="module")
def finished():
    return run_in_memory(config(), algorithm=mixed(config()))


def evaluated_alone(generation):
    """Results [N, E] of both asks of a generation, each evaluated by itself."""
    found = []
    given = (POLICIES + np.float32(generation), no_statistics(18, 2)), (OTHERS, (MEAN, STD))
    for ask, (policies, statistics) in enumerate(given):
        asked = policy_work(policies, statistics, EPISODES, seed=0, generation=generation, ask=ask, traces=True)
        found.append(gathered([asked.shape], Sharing().evaluate(asked.work))[0])
    return found


def test_policies_are_told_in_the_order_of_the_asks_with_the_means_of_their_episodes(finished):
    _, store, _ = finished
    for generation in (1, 2):
        rows = store.evaluated[generation]
        assert [row["centre"] for row in rows] == [*range(2, 20), 0, 1, *range(20, 23)]
        of_policies = [row for row in rows if row["centre"] > 1]
        fitness = np.concatenate([result.fitness for result in evaluated_alone(generation)])
        np.testing.assert_array_equal([row["fitness_mean"] for row in of_policies], fitness.mean(1, dtype=np.float64))
        assert all(row["update_norm"] is None and row["env_steps"] > 0 for row in of_policies)
        assert all(row["update_norm"] > 0 for row in rows if row["centre"] < 2)


def test_policies_change_neither_populations_nor_statistics_nor_the_other_way_round(finished):
    state, store, evaluator = finished
    alone, store_alone, evaluator_alone = run_in_memory(config())
    np.testing.assert_array_equal(state.search.centres[0].centre_D, alone.search.centres[0].centre_D)
    np.testing.assert_array_equal(state.search.centres[1].centre_D, alone.search.centres[1].centre_D)
    np.testing.assert_equal(dataclasses.asdict(state.observations), dataclasses.asdict(alone.observations))
    first = [row for row in store.evaluated[1] if row["centre"] < 2]
    fields = ("fitness_mean", "novelty", "update_norm", "env_steps")
    assert [[row[name] for name in fields] for row in first] == [
        [row[name] for name in fields] for row in store_alone.evaluated[1]
    ]
    both = np.concatenate([result.steps.ravel() for generation in (1, 2) for result in evaluated_alone(generation)])
    assert state.env_steps == alone.env_steps + both.sum()
    assert state.episodes == alone.episodes + both.size == alone.episodes + 2 * 21 * EPISODES
    chunks = -(-18 * EPISODES // 16) + -(-3 * EPISODES // 16)
    assert len(evaluator.recorded) - len(evaluator_alone.recorded) == 2 * chunks


def test_an_elite_that_was_a_policy_has_its_parameters_statistics_and_trace(finished):
    state, store, _ = finished
    results = {generation: evaluated_alone(generation) for generation in (1, 2)}
    seen = set()
    for cell, generation, centre in zip(
        state.search.map.cell_N, state.search.map.generation_N, state.search.map.centre_N, strict=True
    ):
        if centre < 2:
            continue
        elite = store.elite(cell)
        ask, number = (0, centre - 2) if centre < 20 else (1, centre - 20)
        policies = (POLICIES + np.float32(generation), OTHERS)[ask]
        np.testing.assert_array_equal(elite.parameters_D, policies[number])
        mean, std = (no_statistics(18, 2), (MEAN, STD))[ask]
        np.testing.assert_array_equal(elite.observation_mean_O, mean[number])
        np.testing.assert_array_equal(elite.observation_std_O, std[number])
        np.testing.assert_array_equal(elite.trace_T_B, results[generation][ask].trace_T_B[number])
        seen.add(ask)
    assert seen == {0, 1}


class Joining(Sharing):
    """Workers with several cores: the chunks of each work item, of random lengths, are joined as they travel."""

    random = np.random.default_rng(0)

    def evaluate(self, work):
        results, answered = super().evaluate(work), []
        while results:
            size = int(self.random.integers(1, 12))
            answered += in_blocks(results[:size])
            results = results[size:]
        return answered


def test_results_that_are_joined_as_they_travel_are_those_of_the_chunks(finished):
    _, store, evaluator = finished
    _, joined, joining = run_in_memory(config(), Joining(), algorithm=mixed(config()))
    assert joined.evaluated == store.evaluated
    assert len(joined.after) == len(store.after) == 3
    for before, after in zip(store.after, joined.after, strict=True):
        np.testing.assert_equal(after, before)
    assert len(joining.recorded) == len(evaluator.recorded)


@pytest.mark.parametrize("episodes", [1, 3, 20])
def test_all_rows_and_traces_of_joined_results_are_in_their_places(episodes):
    policies = np.tile(POLICIES, (3, 1)) + np.arange(54, dtype=np.float32)[:, None] / 50
    asked = policy_work(policies, no_statistics(54, 2), episodes, seed=0, generation=1, ask=0, traces=True)
    (alone,), (joined,) = (gathered([asked.shape], one.evaluate(asked.work)) for one in (Sharing(), Joining()))
    np.testing.assert_equal(dataclasses.asdict(joined), dataclasses.asdict(alone))
    assert alone.trace_T_B is not None
    assert len(np.unique(alone.trace_T_B, axis=0)) == 54


def test_a_policy_can_be_the_best_and_the_row_of_the_history_is_then_about_it(finished):
    state, store, _ = finished
    for generation, row in enumerate(store.rows):
        if not generation:
            continue
        rows = store.evaluated[generation]
        fittest = max(rows, key=lambda one: one["fitness_mean"])
        assert (row["centre"], row["centre_fitness_mean"]) == (fittest["centre"], fittest["fitness_mean"])
        assert row["update_norm"] == fittest["update_norm"]
        assert row["population_fitness_max"] >= max(one["fitness_mean"] for one in rows if one["centre"] > 1) - 1e-3
    assert state.best.fitness == max(row["centre_fitness_mean"] for row in store.rows)


def only(policies):
    """A search that asks for policies and nothing else, and forgets them."""
    shipped = ALGORITHMS["es"](config_of(algorithm="es"))

    def tell(state, told):
        for one in told:
            state = insert_into_map(add_to_archive(state, one), one) if one.centre == 0 else state
        return state

    return replace(shipped, ask=lambda state, generation: (PolicyAsk(policies),), tell=tell)


def test_a_generation_of_policies_alone_asks_for_nothing_else():
    few = config_of(generations=1, algorithm="es")
    state, store, evaluator = run_in_memory(few, algorithm=only(POLICIES))
    assert {type(chunk) for _, chunk, _ in evaluator.recorded if chunk.generation} == {PolicyChunk}
    assert state.observations.count == 0
    assert store.rows[1]["invalid_members"] == 0
    assert np.isfinite(store.rows[1]["population_fitness_median"])


class Failing(Sharing):
    """Some episodes of policies end nowhere: the first of the policies given."""

    def __init__(self, policies):
        super().__init__()
        self.policies = policies

    def evaluate(self, work):
        results = super().evaluate(work)
        for (subject, chunk), result in zip(work, results, strict=True):
            if isinstance(chunk, PolicyChunk) and chunk.part == 0:
                for policy in self.policies:
                    if 0 <= policy - subject.first < len(subject.parameters_N_D):
                        result.fitness[policy - subject.first] = np.nan
        return results


def test_an_invalid_policy_is_counted_and_told_as_invalid_and_too_many_end_the_run():
    few, told = config_of(generations=1, algorithm="es", max_invalid_fraction=0.1), []
    search = only(POLICIES)
    search = replace(search, tell=lambda state, all_: told.append(all_) or state)
    _, store, _ = run_in_memory(few, Failing([17]), algorithm=search)
    assert [one.centre for one in told[1] if not one.valid] == [1 + 17]
    assert store.rows[1]["invalid_members"] == 1
    with pytest.raises(EvaluationError, match="generation 1: 2 of 18 members"):
        run_in_memory(few, Failing([3, 17]), algorithm=search)


GOOD = PolicyAsk(POLICIES)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (PolicyAsk(POLICIES.astype(float)), "parameters of the policies are float64 .*; must be a float32 array"),
        (PolicyAsk(POLICIES[0]), rf"policies are float32 .*; must be .* \({SHAPE.parameters}, {SHAPE.parameters}\)"),
        (
            PolicyAsk(POLICIES[:0]),
            rf"policies are float32 .*; must be a float32 array of shape \(1, {SHAPE.parameters}\)",
        ),
        (PolicyAsk(POLICIES[:, 1:]), rf"must be a float32 array of shape \(18, {SHAPE.parameters}\)"),
        (PolicyAsk(None), "policies are NoneType; must be"),
        (PolicyAsk(np.where(np.arange(18)[:, None] == 7, np.float32(np.nan), POLICIES)), "are not all finite"),
        (replace(GOOD, observation_mean_N_O=np.zeros((18, 2), np.float32)), "standard deviation .* are NoneType"),
        (PolicyAsk(OTHERS, MEAN[:2], STD), r"observation mean .* float32 \(2, 2\); must be .* \(3, 2\)"),
        (PolicyAsk(OTHERS, MEAN, STD[0]), r"observation standard deviation .*; must be .* \(3, 2\)"),
        (PolicyAsk(OTHERS, MEAN, 0 * STD), "standard deviation of the policies must be finite and positive"),
        (PolicyAsk(OTHERS, MEAN * np.float32(np.inf), STD), "mean of the policies must be finite"),
    ],
)
def test_policies_that_cannot_be_evaluated_are_an_error_with_a_sentence(asked, sentence):
    few = config_of(generations=1, algorithm="es")
    algorithm = replace(only(POLICIES), ask=lambda state, generation: (asked,))
    with pytest.raises(EvaluationError, match=f"generation 1: .*{sentence}") as error:
        run_in_memory(few, algorithm=algorithm)
    assert error.value.field == "search.algorithm"


def test_asks_of_both_kinds_are_checked():
    few = config_of(generations=1, algorithm="es")
    bad = Ask(0, np.zeros(SHAPE.parameters, np.float32), 0.1, 24, 1.0)
    algorithm = replace(only(POLICIES), ask=lambda state, generation: (GOOD, bad))
    with pytest.raises(EvaluationError, match="centre 0 has 24 pairs"):
        run_in_memory(few, algorithm=algorithm)


GIVEN = {
    "task": {"environment": "point_maze", "episode_steps": 40},
    "policy": {"hidden": [8, 8]},
    "search": {"algorithm": f"{__name__}:mixed", "centres": 2, "pairs": 32, "evaluation_episodes": 5},
    "budget": {"generations": 4},
    "compute": {"engine": "inline", "workers": 1, "chunk_pairs": 8},
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run without a stop, whose one worker is this process."""
    with workers_in_this_process():
        return api.run(GIVEN, tmp_path_factory.mktemp("whole") / "run").run


@pytest.mark.slow
@pytest.mark.parametrize("compute", [{"workers": 3}, {"workers": 2, "inline_workers": "threads"}], ids=str)
def test_runs_with_policies_have_the_same_bits_on_any_workers_and_when_resumed(whole, tmp_path, compute):
    other = api.load_config(GIVEN | {"compute": GIVEN["compute"] | compute, "budget": {"generations": 2}})
    api.run(other, tmp_path / "parts")
    assert api.resume(tmp_path / "parts", ["budget.generations=4"]).run.digest() == whole.digest()
    assert (whole.evaluations["centre"] > 1).sum() == 4 * 21
