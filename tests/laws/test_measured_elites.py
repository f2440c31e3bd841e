"""Elites that are measured again: MAP-Elites, ME-ES and MEMES with `search.elites`, and the corrected columns."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from es_service import api
from es_service.api import load_config
from es_service.errors import ConfigError
from es_service.loop.blocks import joined
from es_service.protocol.content import as_bytes
from es_service.protocol.messages import PolicyChunk
from es_service.protocol.noise import Domain, normals, stream_keys, uniforms
from es_service.runs.lineage import fork_config, forked
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.map_elites import PARENT_CHOICE
from es_service.search.algorithms.measured import (
    AGAIN_CHOICE,
    KEPT,
    LAYER_CHOICE,
    PLACE_CHOICE,
    SAMPLES,
    kept_of,
    shares,
)
from es_service.search.maps.behaviour_map import empty_map
from tests.helpers import map_of
from tests.laws.me_es_runs import CELLS, SHAPE, Sharing, first_centres, run_in_memory
from tests.laws.me_es_runs import config_of as config_of_centres
from tests.laws.test_map_elites import ISO, LINE
from tests.references.measured_map_elites import MeasuredMapElites, Policy

BATCH, CENTRES, GENERATIONS = 24, 6, 8
KINDS = {
    "eme": {"kind": "eme", "depth": 3},
    "eme by medians": {"kind": "eme", "depth": 2, "estimate": "median", "draw": "linear", "again": 0.5},
    "archive_sampling": {"kind": "archive_sampling"},
    "me_sampling": {"kind": "me_sampling", "first_samples": 4},
    "deep_grid": {"kind": "deep_grid", "depth": 3},
}


def config_of(name, generations=GENERATIONS, **more):
    search = {"algorithm": "map_elites", "batch": BATCH, "centres": CENTRES, "iso_sigma": ISO, "line_sigma": LINE}
    return load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8]},
            "search": {**search, "evaluation_episodes": 2, "elites": KINDS.get(name), **more},
            "map": {"cells": list(CELLS)},
            "budget": {"generations": generations},
        }
    )


class Spoiling(Sharing):
    """Every policy chunk of some generations has one episode that ends nowhere: that of its fourth slot."""

    def evaluate(self, work):
        results = super().evaluate(work)
        for (_, chunk), result in zip(work, results, strict=True):
            if isinstance(chunk, PolicyChunk) and chunk.generation in (4, 5):
                result.descriptor[min(3, len(result.descriptor) - 1)] = np.nan
        return results


def asked_in(evaluator, generation):
    """The parameters of each policy of a generation, by ask."""
    found = {}
    for policies, chunk, _ in evaluator.recorded:
        if isinstance(chunk, PolicyChunk) and chunk.generation == generation:
            found.setdefault(chunk.ask, {})[policies.first] = policies.parameters_N_D.made()
    return [np.concatenate([parts[first] for first in sorted(parts)]) for _, parts in sorted(found.items())]


def drawn(generation, stream, count):
    return uniforms(stream_keys(0, Domain.SELECTION, generation, stream), np.arange(count, dtype=np.uint32)).tolist()


@pytest.mark.parametrize("name", KINDS)
def test_map_elites_equals_the_reference(name):
    config = config_of(name)
    elites = config.search.elites
    _, store, evaluator = run_in_memory(config, Spoiling())
    bounds = ((-1.0, 1.0), (-1.0, 1.0))
    other = MeasuredMapElites(bounds, CELLS, elites.depth, elites.draw, elites.estimate, elites.replaces)
    samples_of = [[(row["fitness_mean"], (row["x"], row["y"])) for row in rows] for rows in store.evaluated]
    first = [
        Policy(0, 0, index, centre_D.astype(float), [sample])
        for index, (centre_D, sample) in enumerate(zip(first_centres(config), samples_of[0], strict=True))
    ]
    other.told([], first)
    moved = spoiled = 0
    for generation in range(1, GENERATIONS + 1):
        samples = samples_of[generation]
        kept = len(other.all())
        count, again = shares(elites, BATCH, kept)
        measured = other.drawn(again, drawn(generation, AGAIN_CHOICE, kept)) if again else []
        assert len(samples) == count * elites.first_samples + len(measured)
        by_parent = drawn(generation, PARENT_CHOICE, 2 * count)
        layer = drawn(generation, LAYER_CHOICE, 2 * BATCH)
        asked, children = asked_in(evaluator, generation), []
        for n in range(count):
            x, y = (
                other.parent(other.filled[int(by_parent[2 * n + k] * len(other.filled))], layer[2 * n + k])
                for k in (0, 1)
            )
            noise = normals(stream_keys(0, Domain.VARIATION, generation, n), SHAPE.parameters + 1).astype(float)
            child = x.parameters + ISO * noise[:-1] + LINE * noise[-1] * (y.parameters - x.parameters)
            rows = [n + s * count for s in range(elites.first_samples)]
            for row in rows:
                np.testing.assert_allclose(asked[0][row], child, rtol=0, atol=2e-6 * np.abs(child).max())
            policy = Policy(0, generation, CENTRES + n, asked[0][n].astype(float), [samples[row] for row in rows])
            if all(None not in (fitness, *place) for fitness, place in policy.samples):
                children.append(policy)
            else:
                spoiled += 1
        told = []
        for row, policy in enumerate(measured, count * elites.first_samples):
            np.testing.assert_array_equal(asked[1][row - count * elites.first_samples], policy.parameters)
            fitness, place = samples[row]
            told.append((policy, fitness, place, None not in (fitness, *place)))
            spoiled += not told[-1][-1]
        before = {one.serial: one.cell for one in measured}
        other.told(told, children, drawn(generation, PLACE_CHOICE, kept))
        moved += sum(one.cell != before[one.serial] for one in measured)
        parts = store.after[generation]
        map_, arrays = map_of(parts), joined(parts)["extra/kept"]
        assert arrays["serial_K"].tolist() == [one.serial for one in other.all()]
        assert arrays["cell_K"].tolist() == [one.cell for one in other.all()]
        assert arrays["samples_K"].tolist() == [len(one.samples) for one in other.all()]
        np.testing.assert_allclose(arrays["fitness_K"], [other.fitness(one) for one in other.all()], rtol=1e-12)
        assert map_.cell_N.tolist() == other.filled
        for row, cell in enumerate(other.filled):
            top = other.cells[cell][0]
            assert (map_.generation_N[row], map_.centre_N[row]) == (top.generation, top.number)
            assert map_.samples_N[row] == len(top.samples)
            np.testing.assert_array_equal(store.elite(cell, parts).parameters_D, top.parameters)
    assert spoiled
    assert moved or not elites.again
    deepest = max(len(ranked) for ranked in other.cells.values())
    assert deepest == elites.depth


# Searches that move centres


def centres_config(algorithm, kind="eme", **more):
    of_method = {"me_es": {"emitters": 2}, "memes": {"emitters": 3, "stagnation_generations": 1}}[algorithm]
    return config_of_centres(
        generations=12,
        cells=(60, 60),
        algorithm=algorithm,
        elites={"kind": kind, "depth": 2, "again": 0.3 if kind == "eme" else "all"},
        **of_method,
        **more,
    )


@pytest.mark.parametrize(("algorithm", "kind"), [("me_es", "eme"), ("memes", "eme"), ("memes", "archive_sampling")])
def test_the_maps_of_emitters_equal_the_reference(algorithm, kind):
    """Each centre is a new policy with one sample, the mean of its evaluation episodes."""
    config = centres_config(algorithm, kind)
    emitters, elites = config.search.emitters, config.search.elites
    _, store, evaluator = run_in_memory(config)
    other = MeasuredMapElites(((-1.0, 1.0), (-1.0, 1.0)), (60, 60), 2, elites.draw, "mean", "worst")
    wanted = round(0.3 / 0.7 * emitters * (2 * 32 + 20) / 20)
    assert wanted in (4, 5)
    moved = restarted = 0
    for generation, (parts, rows) in enumerate(zip(store.after, store.evaluated, strict=True)):
        samples = [(row["fitness_mean"], (row["x"], row["y"])) for row in rows]
        kept = len(other.all())
        again = (kept if kind == "archive_sampling" else wanted) if generation else 0
        measured = other.drawn(again, drawn(generation, AGAIN_CHOICE, kept))
        assert [row["centre"] for row in rows] == list(range(emitters + len(measured)))
        centres = [parts[f"centres/{index}"] for index in range(emitters)]
        new = [
            Policy(0, generation, index, centre["centre_D"].tolist(), [samples[index]])
            for index, centre in enumerate(centres)
        ]
        for asked, policy in zip(asked_in(evaluator, generation)[0] if measured else [], measured, strict=True):
            assert asked.tolist() == policy.parameters
        before = {one.serial: one.cell for one in measured}
        told = zip(measured, samples[emitters:], strict=True)
        other.told([(policy, *sample, True) for policy, sample in told], new)
        moved += sum(one.cell != before[one.serial] for one in measured)
        restarted += sum(row["start_cell"] is not None for row in rows)
        arrays = joined(parts)["extra/kept"]
        assert arrays["serial_K"].tolist() == [one.serial for one in other.all()]
        np.testing.assert_allclose(arrays["fitness_K"], [other.fitness(one) for one in other.all()], rtol=1e-12)
        tops = {cell: ranked[0] for cell, ranked in other.cells.items()}
        map_, names = map_of(parts), dict(zip(arrays["serial_K"].tolist(), as_bytes(arrays["policy_K"]), strict=True))
        assert dict(zip(map_.cell_N.tolist(), as_bytes(map_.policy_N), strict=True)) == {
            cell: names[top.serial] for cell, top in tops.items()
        }
        for cell, top in tops.items():
            assert store.elite(cell, parts).parameters_D.tolist() == top.parameters
        for index, centre in enumerate(centres):
            mine = [cell for cell, top in tops.items() if (top.generation, top.number) == (generation, index)]
            assert centre["cell"] == (mine[0] if mine else -1)
    assert moved
    assert restarted


def test_a_population_around_an_elite_gives_it_its_score():
    config = centres_config("memes")
    _, store, _ = run_in_memory(config)
    scored = 0
    for before, after in pairwise(store.after):
        then, now = joined(before)["extra/kept"], joined(after)["extra/kept"]
        for index in range(config.search.emitters):
            cell = int(before[f"centres/{index}"]["cell"])
            if cell < 0:
                continue
            row = then["cell_K"].tolist().index(cell)  # the first of the cell is its elite
            same = [(now[name] == then[name][row]) for name in ("generation_K", "centre_K")]
            score = now["score_K"][np.logical_and(*same)]
            scored += int((np.isfinite(score) & (score != then["score_K"][row])).sum())
    assert scored


# The state


def test_after_a_fork_that_emptied_the_map_nothing_is_kept():
    config = config_of("eme")
    state, _, _ = run_in_memory(config)
    emptied = replace(state.search, map=empty_map(state.search.map.geometry, counts_samples=True))
    assert kept_of(emptied).size == 0
    asked = ALGORITHMS["map_elites"](config).ask(emptied, GENERATIONS + 1)
    assert len(asked) == 1
    parents = {parent.tobytes() for parent in asked[0].parameters_N_D.parents}
    assert parents <= {centre.centre_D.tobytes() for centre in state.search.centres}


@pytest.mark.slow
@pytest.mark.usefixtures("workers_here")
def test_after_a_fork_with_other_populations_no_policy_has_a_score(tmp_path):
    """The highest fitness of a population says nothing of one with another sigma."""
    config = centres_config("memes", pairs=16, evaluation_episodes=2)
    run = api.run(config, tmp_path / "run", progress=False).run
    for name, value, remain in (("map.correct_every", 9, True), ("search.sigma", 0.1, False)):
        config = fork_config(run.folder, {name: value, "budget.generations": 14})
        nodes = joined(forked(run, config, None)[1].parts)
        for scores in (nodes["extra/kept"]["score_K"], nodes["map"]["score_N"]):
            assert np.isfinite(scores).any() == remain


def test_only_what_is_measured_again_counts_samples_and_keeps_policies():
    for name, elites in {"once": {"kind": "once"}, "eme": {"kind": "eme", "estimate": "median"}}.items():
        state, _, _ = run_in_memory(config_of("eme", generations=2, elites=elites))
        assert state.search.extra.keys() == ({KEPT, SAMPLES} if name == "eme" else set())
        assert (state.search.map.samples_N is None) == (name == "once")


# The config


def test_presets_are_the_methods_of_the_literature():
    found = {}
    for kind in ("eme", "archive_sampling", "me_sampling", "deep_grid"):
        elites = config_of("eme", elites={"kind": kind}).search.elites
        found[kind] = (elites.depth, elites.again, elites.first_samples, elites.replaces, elites.estimate)
        assert elites.draw == "exponential"
    assert found == {
        "eme": (8, 0.25, 2, "worst", "mean"),
        "archive_sampling": (2, "all", 1, "worst", "mean"),
        "me_sampling": (1, 0.0, 32, "worst", "mean"),
        "deep_grid": (32, 0.0, 1, "any", "mean"),
    }
    assert [shares(config_of("eme", elites={"kind": kind}).search.elites, 256, 700) for kind in found] == [
        (96, 64),
        (256, 700),
        (8, 0),
        (256, 0),
    ]
    assert shares(config_of("eme", elites={"kind": "eme"}).search.elites, 256, 10) == (123, 10)


@pytest.mark.parametrize(
    ("elites", "problem"),
    [
        ({"kind": "once", "depth": 3}, "search.elites.depth: 3 has no effect with search.elites.kind = once"),
        (
            {"kind": "eme", "again": 1.0},
            "search.elites.again: 1.0 is not allowed; must be a number from 0 to below 1 or all",
        ),
        ({"kind": "extract"}, "must be once, eme, archive_sampling, me_sampling or deep_grid"),
    ],
)
def test_a_wrong_key_is_named(elites, problem):
    with pytest.raises(ConfigError) as caught:
        config_of("eme", elites=elites)
    assert problem in str(caught.value)


def test_kinds_of_newcomers_are_not_for_centres():
    for elites in ({"kind": "deep_grid"}, {"kind": "eme", "first_samples": 2}):
        with pytest.raises(ConfigError, match=r"search\.elites"):
            config_of_centres(algorithm="memes", elites=elites)


# Corrected columns


def run_of(tmp_path, name="eme", *, corner=False, generations=6, correct=3, episodes=40, workers="threads"):
    config = {
        "task": {"environment": "point_maze", "options": {"start": "corner"} if corner else {}},
        "policy": {"hidden": [8, 8]},
        "search": {"algorithm": "map_elites", "batch": 64, "iso_sigma": 0.2, "elites": {"kind": name}},
        "map": {"cells": [10, 10], "correct_every": correct, "correct_episodes": episodes},
        "budget": {"generations": generations},
        "compute": {"engine": "inline", "workers": 1, "inline_workers": workers},
    }
    return api.run(load_config(config), tmp_path / f"{name} {corner}").run


def columns(run):
    names = ["coverage", "qd_score", "map_fitness_max"]
    last = run.history.iloc[-1]
    return [
        [last[f"{prefix}{name}"] for name in of]
        for prefix, of in (("", names), ("corrected_", [*names[:2], "fitness_max"]))
    ]


@pytest.mark.usefixtures("workers_here")
@pytest.mark.parametrize("name", ["once", "eme"])
def test_without_noise_the_corrected_values_are_the_stored_ones(tmp_path, name):
    stored, corrected = columns(run_of(tmp_path, name, corner=True, episodes=3))
    np.testing.assert_allclose(corrected, stored, rtol=1e-6)


@pytest.mark.usefixtures("workers_here")
def test_a_fork_may_change_the_container_but_not_what_it_is(tmp_path):
    run = run_of(tmp_path, generations=4, correct=None)
    assert run.at().nodes["extra/kept"]["serial_K"].size > len(run.map)
    further = ["budget.generations=6"]
    flat = api.fork(run.folder, [*further, "search.elites.depth=1"], out=tmp_path / "flat").run
    assert flat.at().nodes["extra/kept"]["serial_K"].size == len(flat.map)
    for change in ("kind=once", "estimate=median"):
        with pytest.raises(ConfigError, match=r"its state does not fit these changes:\n  search\.elites\."):
            api.fork(run.folder, [*further, f"search.elites.{change}"], out=tmp_path / "other")
    shorter = api.fork(run.folder, [*further, "task.episode_steps=100"], out=tmp_path / "shorter").run
    assert shorter.map["generation"].min() > 4
    assert len(shorter.map) < len(run.map)
    assert "corrected_coverage" not in run.history
    corrected = api.fork(run.folder, [*further, "map.correct_every=6"], out=tmp_path / "corrected").run
    assert corrected.history["corrected_coverage"].notna().tolist() == [False] * 6 + [True]


@pytest.mark.usefixtures("workers_here")
def test_corrected_values_agree_with_fresh_episodes_and_count_as_steps(tmp_path):
    from es_service.runs import evaluation

    run = run_of(tmp_path, "once")
    history = run.history
    assert history.index[history["corrected_qd_score"].notna()].tolist() == [0, 3, 6]
    chosen = evaluation.candidates(run, best=False, centre=False, cells=[], every=True)
    fresh = list(evaluation.evaluate(run, chosen, 400, workers=1))
    best, errors = {}, {}
    for one in fresh:
        if one.mean > best.get(one.cell, -np.inf):
            best[one.cell], errors[one.cell] = one.mean, one.standard_error
    offset = run.constants["map.qd_offset"]
    (coverage, qd_score, _), corrected = columns(run)
    expected = sum(value - offset for value in best.values())
    assert corrected[0] == pytest.approx(len(best) / 100, abs=0.04)
    assert corrected[1] == pytest.approx(expected, rel=0.08)
    assert corrected[2] == pytest.approx(max(best.values()), abs=5 * max(errors.values()) * np.sqrt(10))
    assert corrected[0] < coverage
    assert corrected[1] < qd_score

    counted = run.evaluations.groupby("generation")["env_steps"].sum().cumsum()
    elites = run.behaviour_map.size
    without = history["env_steps"].diff() - counted.diff()
    assert set(without.drop([0, 3, 6])) == {0}
    assert without[6] == pytest.approx(elites * 40 * 200, rel=0.05)
    assert (history["episodes"].diff() - 64)[6] == elites * 40
