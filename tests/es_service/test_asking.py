"""Ask and tell: the bits of the service's own episodes, interruptions anywhere, and what other readers say."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from typer.testing import CliRunner

from es_service import api, ask_tell, fork, load_config, resume
from es_service.asking import Asked
from es_service.cli.main import app
from es_service.config.tasks import task_of
from es_service.errors import ConfigError, EvaluationError
from es_service.loop.blocks import OBSERVATIONS, value_of
from es_service.protocol.messages import Moments
from es_service.report.summary import changed_settings
from es_service.runs.lineage import polish_config
from es_service.store.digest import digest_parts
from tests.examples import late_answers, own_loop
from tests.workers.host_tasks import CornerMaze
from workers.environments import make_host_task

PARAMETERS = {"environment": "caller", "options": {"parameters": 4}}
METHODS = ("es", "nsra_es", "me_es", "memes", "map_elites", "ars")


def bowl(parameters):
    return -float(((parameters - 0.5) ** 2).sum()), parameters[:2]


bowl.parameters = dict.fromkeys("abcd")
bowl.descriptor_names, bowl.descriptor_bounds = ("d0", "d1"), ((-1.0, 1.0), (-1.0, 1.0))


def config_of(method="me_es", task=PARAMETERS, **sections):
    small = {"batch": 12} if method == "map_elites" else {"pairs": 8, "sigma": 0.2}
    return {
        "task": task,
        "search": {"algorithm": method, "evaluation_episodes": 2, **small},
        "map": {"bounds": [[-1, 1], [-1, 1]], "cells": [4, 4]},
        "budget": {"generations": 6},
        "compute": {"engine": "inline", "workers": 1},
    } | sections


def told_of(asked: Asked):
    found = [bowl(row.astype(np.float64)) for row in asked.parameters]
    return np.array([one for one, _ in found]), np.array([place for _, place in found])


def finished(config, folder):
    with ask_tell(config, folder) as search:
        while (asked := search.ask()) is not None:
            search.tell(asked, *told_of(asked))
        assert search.outcome is not None
        assert search.ask() is None
        return search.run


@pytest.mark.usefixtures("workers_here")
@pytest.mark.parametrize("method", METHODS)
def test_it_has_the_bits_of_a_function_that_workers_call(method, tmp_path):
    ours = finished(config_of(method), tmp_path / "asked")
    name = "function:tests.es_service.test_asking:bowl"
    theirs = api.run(config_of(method, task={"environment": name}), tmp_path / "called").run
    for column in ("best_fitness", "centre_fitness_mean", "update_norm", "qd_score", "env_steps"):
        assert ours.history[column].equals(theirs.history[column]), column
    assert np.array_equal(ours.policy("best").parameters_D, theirs.policy("best").parameters_D)
    assert ours.map.equals(theirs.map)


@pytest.mark.usefixtures("workers_here")
@pytest.mark.parametrize("policy", [{}, {"memory": 3}, {"output": "gaussian", "action_noise": 0.0}], ids=str)
def test_policies_act_as_in_the_service_s_own_episodes(policy, tmp_path):
    sections = {"policy": {"hidden": [4], "observation_normalization": False, **policy}, "budget": {"generations": 3}}
    name, steps = "python:tests.workers.host_tasks:CornerMaze", 12
    sizes = {"observation_size": 2, "action_size": 2, "episode_steps": steps}
    made = make_host_task(name, {})
    with ask_tell(
        config_of(task={"environment": "caller", "options": sizes}, **sections), tmp_path / "asked"
    ) as search:
        while (asked := search.ask()) is not None:
            mazes = [CornerMaze() for _ in range(len(asked))]
            asked.act(np.ones((len(asked), 2)), 0)  # the first step of other episodes, which leaves no memory
            seen = np.array([maze.reset(int(seed)) for maze, seed in zip(mazes, asked.seed, strict=True)])
            returns = np.zeros(len(asked))
            for step in range(steps):
                taken = [maze.step(one) for maze, one in zip(mazes, made.actions(asked.act(seen, step)), strict=True)]
                seen = np.array([place for place, *_ in taken])
                returns += [reward for _, reward, _ in taken]
            search.tell(asked, returns, [maze.descriptor() for maze in mazes], steps=np.full(len(asked), steps))
        ours = search.run
    theirs = api.run(config_of(task={"environment": name, "episode_steps": steps}, **sections), tmp_path / "run").run
    for column in ("best_fitness", "centre_fitness_mean", "update_norm", "env_steps"):
        assert ours.history[column].equals(theirs.history[column]), column


@pytest.mark.parametrize("policy", [{"hidden": [64, 64]}, {"hidden": [16], "memory": 2}], ids=str)
def test_what_is_asked_acts_the_same_after_a_pickle_and_only_on_observations_of_all_rows(policy, tmp_path):
    task = {"environment": "caller", "options": {"observation_size": 8, "action_size": 2}}
    with ask_tell(config_of(task=task, policy=policy), tmp_path / "run") as search:
        for _ in range(3):  # initial centres, members, new centres
            asked = search.ask()
            assert asked is not None
            unused = pickle.dumps(asked)
            seen = np.random.default_rng(0).normal(size=(20, len(asked), 8))
            expected = [asked.act(one, 0) for one in seen]
            assert len(pickle.dumps(asked)) == len(unused), "what `act` has made does not travel"
            for copy in map(pickle.loads, (unused, pickle.dumps(asked))):
                np.testing.assert_array_equal([copy.act(one, 0) for one in seen], expected)
                assert not copy.parameters.flags.writeable
            for shape in ((8,), (1, 8), (len(asked), 1)):
                with pytest.raises(ConfigError, match="observations must have the shape"):
                    asked.act(np.zeros(shape), 0)
            search.tell(asked, np.arange(len(asked), dtype=float), np.zeros((len(asked), 2)))


def test_a_generation_may_be_a_number_of_numpy(tmp_path, workers_here):
    run = finished(config_of(), tmp_path / "run")
    newest = run.map.generation.max()
    assert isinstance(newest, np.int64)
    assert [row["generation"] for row in run.history_rows(np.int64(5))] == [5, 6]
    assert len(run.history_until(np.int64(2))) == 3
    assert run.evaluations_until(np.int64(2)).generation.max() == 2


def test_what_a_function_does_with_its_row_changes_no_run(tmp_path, workers_here):
    def clears(row):
        number = float(row["generation"])
        row.clear()
        return {"number": number}

    config = config_of("es", task={"environment": "function:tests.es_service.test_asking:bowl"})
    run = api.run(config, tmp_path / "run", on_generation=clears).run
    assert run.history.metric_number.tolist() == [*map(float, range(7))]


def test_left_anywhere_it_asks_the_same_again_and_ends_with_the_same_bits(tmp_path):
    whole, folder, seen = finished(config_of(), tmp_path / "whole"), tmp_path / "left", {}
    for leave_after in (0, 1, 2, 3, 2, 1, 4, 99):
        with ask_tell(config_of(), folder) as search:
            for number in range(leave_after + 1):
                if (asked := search.ask()) is None or number == leave_after:
                    break
                key = asked.generation, len(asked), bool(asked.trains.any())
                arrays = asked.parameters.tobytes(), asked.seed.tobytes()
                assert seen.setdefault(key, arrays) == arrays
                search.tell(asked, *told_of(asked))
    assert search.outcome is not None
    assert digest_parts(folder) == digest_parts(whole.folder)


OBSERVING = {
    "task": {
        "environment": "caller",
        "options": {"observation_size": 2, "action_size": 1, "descriptor_size": 1},
    },
    "map": {"bounds": [[-1, 1]], "cells": [4]},
}


def test_observations_that_are_told_normalise_later_ones(tmp_path):
    config = config_of("es", **OBSERVING)
    with ask_tell(config, tmp_path / "run") as search:
        while (asked := search.ask()) is not None and asked.generation < 3:
            count = len(asked)
            expected = ([0, 0], [1, 1]) if asked.generation < 2 else ([3, -1], [2, 0.5])
            np.testing.assert_allclose(asked.observation_mean, [expected[0]] * count, rtol=1e-4)
            np.testing.assert_allclose(asked.observation_std, [expected[1]] * count, rtol=1e-4)
            moments = (1e8, [3.0, -1.0], [4e8, 0.25e8]) if asked.trains.any() else None
            search.tell(asked, np.arange(count), np.zeros((count, 1)), moments=moments)


def test_of_several_populations_all_observations_are_told_once_or_not_at_all(tmp_path):
    def told(folder, moments):
        with ask_tell(config_of("memes", **OBSERVING), tmp_path / folder) as search:
            while (asked := search.ask()) is not None and asked.generation < 3:
                given = moments if asked.trains.any() else None
                steps = np.full(len(asked), 7)
                search.tell(asked, np.arange(len(asked)), np.zeros((len(asked), 1)), steps=steps, moments=given)
            return value_of(Moments, search.run.at(wanted=[OBSERVATIONS]).nodes, OBSERVATIONS)

    assert told("none", None).count == 0
    after = told("some", (1e8, [3.0, -1.0], [4e8, 0.25e8]))
    assert after.count == 2e8
    np.testing.assert_allclose(after.mean_O, [3.0, -1.0], rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(after.m2_O / after.count), [2.0, 0.5], rtol=1e-4)


def test_rows_that_are_not_valid_are_invalid_members(tmp_path):
    with ask_tell(config_of("es"), tmp_path / "run") as search:
        while (asked := search.ask()) is not None and asked.generation < 2:
            fitness, place = told_of(asked)
            if asked.trains.any():
                fitness[4] = np.nan
            search.tell(asked, fitness, place, valid=~asked.trains | (np.arange(len(asked)) != 3))
        assert search.run.history["invalid_members"].tolist()[-1] == 2


def test_results_are_told_once_and_only_of_what_is_asked_now(tmp_path):
    """In each of its two requests, a generation of these policies has as many rows as in the other."""
    config = config_of("es", search={"algorithm": "es", "pairs": 8, "sigma": 0.2, "evaluation_episodes": 16})
    whole, told, pickled = finished(config, tmp_path / "whole"), [], b""

    def refused(search, given, *rest):
        with pytest.raises(ConfigError) as caught:
            search.tell(given, *rest)
        assert caught.value.field == "asked"
        return caught.value.sentence

    def told_by(search):
        asked = search.ask()
        assert len(repr(asked)) < 200, "it is printed on one line, without its parameters"
        search.tell(asked, *told_of(asked))
        told.append(asked)

    with ask_tell(config, tmp_path / "run") as search:
        told_by(search)
        said = refused(search, told[-1], *told_of(told[-1]))
        assert "is request 0 of generation 0, whose results have been told already; " in said
        assert said.endswith("; this run waits for the results of request 0 of generation 1, which `ask` returns")
        told_by(search)
        assert len(search.ask()) == len(told[-1])
        for stale in told:
            assert f"{stale.token}, whose results have been told already" in refused(search, stale, *told_of(stale))
        for other in (np.zeros(16), None):
            assert "must be what `ask` returned, as in search.tell(asked, " in refused(search, other, np.zeros((16, 2)))
        with ask_tell(config, tmp_path / "twin") as twin:
            assert "belongs to another run" in refused(search, twin.ask(), np.zeros(16))
        pickled = pickle.dumps(search.ask())
    with ask_tell(config, tmp_path / "run") as search:  # which asks generation 1 again from its beginning
        ahead = pickle.loads(pickled)
        assert "request 1 of generation 1, whose results are not wanted yet" in refused(search, ahead, *told_of(ahead))
        told_by(search)
        search.tell(ahead, *told_of(ahead))
        while search.ask() is not None:
            told_by(search)
    assert digest_parts(tmp_path / "run") == digest_parts(whole.folder)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"fitness": [1.0]}, "fitness"),
        ({"fitness": ["a", "b"]}, "fitness"),
        ({"fitness": np.zeros(2), "descriptor": np.zeros((2, 3))}, "descriptor"),
        ({"fitness": np.zeros(2), "steps": [0, 1]}, "steps"),
        ({"fitness": np.zeros(2), "steps": [1, 2**31]}, "steps"),
        ({"fitness": np.zeros(2), "moments": (1.0, [0.0, 1.0], [0.0])}, "moments"),
        ({"fitness": [[1.0], [1.0, 2.0]]}, "fitness"),
        ({"fitness": np.zeros(2), "steps": [1.0, 1.5]}, "steps"),
        ({"fitness": np.zeros(2), "steps": [1.0, np.nan]}, "steps"),
        ({"fitness": np.zeros(2), "valid": [1.0, np.nan]}, "valid"),
        ({"fitness": np.zeros(2), "moments": (np.nan, [0.0], [1.0])}, "moments"),
        ({"fitness": np.zeros(2), "moments": (-1.0, [0.0], [1.0])}, "moments"),
        ({"fitness": np.zeros(2), "moments": (1.0, [np.inf], [1.0])}, "moments"),
        ({"fitness": np.zeros(2), "moments": (1.0, [0.0], [-1.0])}, "moments"),
        ({"fitness": np.zeros(2), "moments": 3}, "moments"),
        ({"fitness": np.zeros(2), "moments": ("many", [0.0, 1.0], [0.0, 1.0])}, "moments"),
    ],
)
def test_a_wrong_argument_is_named_and_the_next_call_works(arguments, field, tmp_path):
    with ask_tell(config_of("es"), tmp_path / "run") as search:
        with pytest.raises(ConfigError) as caught:
            search.tell(search.ask(), **arguments)
        assert caught.value.field == field
        asked = search.ask()
        assert asked is not None
        assert len(asked) == 2
        for array in (asked.parameters, asked.observation_mean, asked.observation_std, asked.seed, asked.trains):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0
        search.tell(asked, *told_of(asked))
        assert search.run.generation == 0


def test_what_is_no_task_of_the_caller_is_refused_and_so_is_telling_after_the_end(tmp_path):
    with pytest.raises(ConfigError, match=r"task\.environment is point_maze; must be caller"):
        ask_tell(config_of(task={"environment": "point_maze"}), tmp_path / "run").__enter__()
    with ask_tell(config_of("es", budget={"generations": 1}), tmp_path / "run") as search:
        while (asked := search.ask()) is not None:
            search.tell(asked, *told_of(asked))
        with pytest.raises(EvaluationError, match="the run has ended, so nothing is asked"):
            search.tell(asked, [0.0])
    for asks in (0, 1):
        with ask_tell(config_of("es"), tmp_path / "left") as search:
            for _ in range(asks):
                search.ask()
        for _ in range(2):
            with pytest.raises(EvaluationError, match="the block of ask_tell was left"):
                search.ask()


def test_what_stops_a_run_and_how_it_goes_on_is_told_in_the_caller_s_words(tmp_path):
    folder = tmp_path / "run"
    call = f"ask_tell(config, {str(folder)!r})"
    with ask_tell(config_of("es"), folder) as search:
        asked = search.ask()
        with pytest.raises(EvaluationError) as caught:
            search.tell(asked, np.full(len(asked), np.nan))
    assert f"continue with its first generation after the cause is fixed: {call}" in str(caught.value)
    with ask_tell(config_of("es"), folder) as search:
        search.tell(asked, *told_of(asked))
    said = CliRunner().invoke(app, ["status", str(folder)]).output
    assert "its caller has left the block of ask_tell" in " ".join(said.split())
    assert call in "".join(said.split("\n")).replace(" ", "").replace(",", ", ")
    with pytest.raises(ConfigError) as refused, ask_tell(config_of("es", seed=5), folder) as search:
        search.ask()
    assert [way.action for way in refused.value.ways_out] == ["ask_tell"]


def test_readers_know_the_run_and_whoever_would_compute_episodes_says_whose_they_are(tmp_path):
    run = finished(config_of(), tmp_path / "run")
    for words in (["status"], ["report"], ["digest"], ["export", "--to", "csv"]):
        done = CliRunner().invoke(app, [words[0], str(run.folder), *words[1:]])
        assert done.exit_code == 0, done.output
    again = (
        ["resume", "--set", "budget.generations=9"],
        ["evaluate"],
        ["evaluate", "--certify"],
        ["verify"],
        ["polish"],
    )
    for words in again:
        done = CliRunner().invoke(app, [words[0], str(run.folder), *words[1:]])
        assert done.exit_code, words
        said = " ".join(str(done.exception or done.output).split())
        assert "the episodes of this run are those of the program that asks it" in said, (words, said)


def test_a_call_that_is_refused_since_the_episodes_are_the_caller_s_leaves_everything_as_it_was(tmp_path):
    run = finished(config_of(), tmp_path / "run")
    before = run.digest(), (run.folder / "config.yaml").read_text()
    calls = (
        lambda: resume(run.folder, {"budget.generations": 50}),
        lambda: fork(run.folder, {"budget.generations": 50}, out=tmp_path / "new"),
        lambda: api.run(config_of(), tmp_path / "new"),
        lambda: api.run(polish_config(run.folder), tmp_path / "new"),
    )
    for call in calls:
        with pytest.raises(ConfigError, match=r"that program calls es_service\.ask_tell"):
            call()
        assert not (tmp_path / "new").exists()
        assert (run.digest(), (run.folder / "config.yaml").read_text()) == before


def test_a_report_shows_the_settings_of_a_run_whose_bounds_have_no_default(tmp_path):
    run = finished(config_of("es"), tmp_path / "run")
    keys = {setting.key for setting in changed_settings(run.meta.config, task_of(load_config(run.meta.config)))}
    assert {"map.cells", "search.sigma", "task.options.parameters"} <= keys
    assert not any(key.startswith("compute.") for key in keys)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({}, "task.options.parameters"),
        ({"observation_size": 3}, "task.options.parameters"),
        ({"parameters": 10**10}, "task.options.parameters"),
        ({"parameters": 3, "descriptor_size": 10**9}, "task.options.descriptor_size"),
        ({"parameters": 3, "start": [1.0, 2.0]}, "task.options.start"),
        ({"parameters": 2, "start": [1.0, 1e300]}, "task.options.start"),
        ({"observation_size": 3, "action_size": 1, "start": []}, "task.options.start"),
    ],
)
def test_episodes_without_a_size_or_with_too_large_a_one_are_refused(options, field):
    with pytest.raises(ConfigError) as caught:
        load_config(config_of(task={"environment": "caller", "options": options}))
    assert {problem.field for problem in caught.value.problems} == {field}


def test_a_search_begins_at_the_start_that_the_caller_gives(tmp_path):
    start = [3.0, -1.0, 0.5, 10]
    task = {"environment": "caller", "options": {"parameters": 4, "start": start}}
    with ask_tell(config_of("es", task=task), tmp_path / "run") as search:
        asked = search.ask()
    assert asked is not None
    np.testing.assert_allclose(asked.parameters.mean(axis=0), start, atol=1e-6)  # of pairs, or of the centre


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_target_that_only_new_episodes_can_confirm_is_refused_before_a_run_begins(method, tmp_path):
    """The first best centre that reached it would end every session: no episodes can be run for the caller."""
    config = config_of(method, budget={"generations": 3, "target_certified": -10})
    with (
        pytest.raises(
            ConfigError, match=r"target_certified: -10 is not allowed for caller.*budget\.target_fitness"
        ) as at,
        ask_tell(config, tmp_path / "run"),
    ):
        pass
    assert at.value.problems[0].field == "budget.target_certified"
    assert not (tmp_path / "run").exists()
    reached = finished(config_of(method, budget={"generations": 3, "target_fitness": -1000}), tmp_path / "other")
    assert reached.generation == 0


def test_no_worker_is_counted_or_missed_where_the_caller_computes(tmp_path):
    notices: list[str] = []
    config = config_of("es", compute={"engine": "inline", "workers": 1000})
    with ask_tell(config, tmp_path / "run", on_notice=notices.append) as search:
        assert search.ask() is not None
    with ask_tell(config, tmp_path / "run", on_notice=notices.append) as search:
        assert search.ask() is not None
    assert notices == []


def test_the_examples_are_what_they_say(tmp_path):
    assert len(late_answers.search(tmp_path / "late").map) > 8
    assert np.isfinite(own_loop.search(tmp_path / "loop").history["best_fitness"]).all()
