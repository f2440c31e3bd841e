"""Polish: which policies it starts from, which candidates remain, and that it improves what it is given."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from es_service import api
from es_service.cli.main import app
from es_service.errors import ConfigError
from es_service.protocol.messages import EpisodesResult
from es_service.runs.certification import certify_run
from es_service.runs.certified import EPISODES
from es_service.runs.lineage import certified_for, polish_config
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import CentreEvaluation
from es_service.search.algorithms.common import first_state
from es_service.search.algorithms.polish import mean_ranks
from tests.laws.test_objectives import results_of

pytestmark = pytest.mark.usefixtures("workers_here")
TASK = {"environment": "point_maze", "episode_steps": 60}
PARENT = {
    "task": TASK,
    "policy": {"hidden": [8], "observation_normalization": True},
    "search": {"algorithm": "memes", "emitters": 3, "pairs": 16, "sigma": 0.2, "evaluation_episodes": 2},
    "map": {"cells": [10, 10]},
    "budget": {"generations": 6},
    "compute": {"engine": "inline", "workers": 1},
}
SETTINGS = {"screened": 5, "candidates": 3, "round_generations": 4, "pairs": 16, "sigma": 0.1}


@pytest.fixture(scope="module")
def parent(tmp_path_factory, workers_here):
    return api.run(api.load_config(PARENT), tmp_path_factory.mktemp("run") / "parent").run


def config_of(parent, generations=1, task=TASK, **search):
    settings = {"algorithm": "polish", "init_from": str(parent.folder), **SETTINGS, **search}
    return api.load_config(PARENT | {"task": task, "search": settings, "budget": {"generations": generations}})


def policies_of(run, count):
    """Parameters, mean and standard deviation of the initial centres."""
    names = ("centre_D", "own_mean_O", "own_std_O")
    parts = run.at(0).nodes
    return [tuple(parts[f"centres/{index}"][name] for name in names) for index in range(count)]


def test_it_starts_from_the_best_centre_and_the_fittest_elites_each_with_its_own_statistics(parent, tmp_path):
    run = api.run(config_of(parent, 1, evaluation_episodes=2), tmp_path / "run").run
    cells = parent.map.sort_values("fitness", ascending=False, kind="stable")[["cell_x", "cell_y"]].head(6)
    places = ["best", *cells.itertuples(index=False, name=None)]
    wanted = [parent.policy(place) for place in places]
    wanted = [
        one for k, one in enumerate(wanted) if not any((one.parameters_D == w.parameters_D).all() for w in wanted[:k])
    ]
    for policy, (centre_D, mean_O, std_O) in zip(wanted, policies_of(run, 5), strict=False):
        assert (policy.parameters_D == centre_D).all()
        assert (policy.observation_mean_O == mean_O).all()
        assert (policy.observation_std_O == std_O).all()


def test_elites_may_be_chosen_by_place_and_by_novelty(parent, tmp_path):
    goal = {"kind": "target", "descriptor": [-0.5, 0.8], "radius": 0.3}
    near = config_of(parent, candidate_choice="place", objective=goal)
    run = api.run(near, tmp_path / "near").run
    distance = np.hypot(parent.map["x"] + 0.5, parent.map["y"] - 0.8)
    nearest = parent.map.iloc[int(distance.argmin())]
    elite = parent.policy((int(nearest["cell_x"]), int(nearest["cell_y"])))
    starts = [centre_D for centre_D, _, _ in policies_of(run, 5)]
    assert (starts[0] == parent.policy("best").parameters_D).all()
    assert any((centre_D == elite.parameters_D).all() for centre_D in starts[:2])
    novel = api.run(config_of(parent, candidate_choice="novelty"), tmp_path / "novel").run
    assert [one[0].tobytes() for one in policies_of(novel, 5)] != [one.tobytes() for one in starts]


def evaluations(generation, fitness):
    """Evaluations of candidates {index: fitness of its episodes}."""

    def told(index, values):
        results: EpisodesResult = results_of(values, np.zeros((len(values), 2)))
        return CentreEvaluation(generation, index, True, float(np.mean(values)), np.zeros(2), results=results)

    return tuple(told(index, values) for index, values in fitness.items())


def test_candidates_leave_by_mean_ranks_after_the_first_evaluation_and_after_each_round(parent):
    config = config_of(parent)
    method = ALGORITHMS["polish"](config)
    state = first_state([np.zeros(3, np.float32)] * 5, 2, 1.0, extra=method.extra, search=config.search)

    def left(state, generation):
        return [one.centre for one in method.ask(state, generation)]

    assert left(state, 1) == [0, 1, 2, 3, 4]
    # The median episode counts, not the mean: 3 is the best by its mean, and the worst by its ranks.
    first = {0: [5, 5, 5], 1: [1, 1, 1], 2: [4, 4, 4], 3: [99, 0, 0], 4: [3, 3, 3]}
    state = method.tell(state, evaluations(0, first))
    assert left(state, 1) == [0, 2, 4]
    for generation, fitness in ((1, {0: [9], 2: [0], 4: [0]}), (2, {0: [9], 2: [0], 4: [0]})):  # not compared
        state = method.tell(state, evaluations(generation, fitness))
    for generation in (3, 4):
        assert left(state, generation) == [0, 2, 4]
        state = method.tell(state, evaluations(generation, {0: [0], 2: [1], 4: [2]}))
    assert left(state, 5) == [2, 4]
    for generation in range(5, 9):
        state = method.tell(state, evaluations(generation, {2: [1], 4: [1]}))
    assert left(state, 9) == [2]  # the earlier of equal ones
    for generation in range(9, 20):
        state = method.tell(state, evaluations(generation, {2: [-7]}))
    assert left(state, 20) == [2]


def test_invalid_episodes_rank_last_by_every_objective(parent):
    nan, inf = np.nan, np.inf

    def ranks(objective, *candidates):
        results = [
            replace(results_of([fitness], np.array([[x, 0.0]])), goal_distance=np.full((1, 3), distance, np.float32))
            for fitness, x, distance in candidates
        ]
        return mean_ranks(results, config_of(parent, objective={"kind": objective}).search)

    assert list(ranks("fitness", (1.0, 0.0, 5.0), (9.0, nan, 1.0))) == [0.5, -0.5]
    assert list(ranks("goal_distance", (1.0, 0.0, 5.0), (-inf, 0.0, 1.0))) == [0.5, -0.5]


def test_fewer_elites_than_screened_are_all_taken(parent, tmp_path):
    run = api.run(config_of(parent, 1, screened=99, candidates=2), tmp_path / "run").run
    assert (
        len([name for name in run.at(0).nodes if name.startswith("centres/") and name.count("/") == 1])
        <= len(parent.map) + 1
    )
    assert run.evaluations.query("generation == 1").shape[0] == 2


def test_a_resumed_run_equals_an_uninterrupted_one_across_rounds(parent, tmp_path):
    whole = api.run(config_of(parent, 9), tmp_path / "whole").run
    part = api.run(config_of(parent, 3), tmp_path / "part").run
    assert api.resume(part.folder, ["budget.generations=9"]).run.digest() == whole.digest()
    centres = whole.evaluations.groupby("generation").size()
    assert centres.iloc[1:].tolist() == [3] * 4 + [2] * 4 + [1]


def test_another_fitness_than_that_of_the_parent_is_allowed(parent, tmp_path):
    run = api.run(config_of(parent, 1, task=TASK | {"fitness": "final"}), tmp_path / "run").run
    assert run.history["best_fitness"].iloc[-1] > -3.0  # a distance, not the sum of sixty


def test_a_policy_of_a_cell_is_refused_and_so_are_objectives_that_do_not_fit(parent, tmp_path):
    with pytest.raises(ConfigError, match="names one policy, but polish chooses 5 of a run by itself"):
        api.run(config_of(parent, init_from=f"{parent.folder}:best"), tmp_path / "run")
    with pytest.raises(ConfigError, match="has 1 numbers, but the descriptor of point_maze has 2, x, y"):
        config_of(parent, objective={"kind": "target", "descriptor": [1.0]})
    with pytest.raises(ConfigError, match=r"place needs search.objective.kind = target"):
        config_of(parent, candidate_choice="place")
    with pytest.raises(ConfigError, match="goal_distance is not known in ant_trap, which has no goal"):
        config_of(parent, task={"environment": "ant_trap"}, objective={"kind": "goal_distance"})
    with pytest.raises(ConfigError, match="null is not allowed for polish, which improves policies of another run"):
        api.load_config(PARENT | {"search": {"algorithm": "polish"}})


def test_the_command_polishes_a_run_and_shows_certified_values_before_and_after(parent, tmp_path):
    words = ["polish", parent.folder, "--candidates", 2, "--out", tmp_path / "run"]
    settings = ["search.screened=4", "search.pairs=16", "budget.generations=3"]
    result = CliRunner().invoke(app, [*map(str, words), *(word for one in settings for word in ("--set", one))])
    assert result.exit_code == 0, (result.output, result.exception)
    before, after = result.stdout.split("certified before polishing:")[1].split("certified after polishing:")
    run = api.open_run(tmp_path / "run")
    for lines, of in ((before, parent), (after, run)):
        [row] = of.certified.to_dict("records")
        assert f"return {row['return_mean']:,.2f}" in lines
    assert run.constants["search.candidates"] == 2
    assert run.config["task"] == parent.config["task"]
    assert run.config["policy"] == parent.config["policy"]
    assert run.config["map"] == parent.config["map"]
    assert (run.generation, run.config["budget"]["env_steps"]) == (3, None)


def test_the_budget_is_the_other_run_s_steps_unless_a_limit_is_given(parent):
    steps = parent.history["env_steps"].iloc[-1]
    assert polish_config(parent.folder).budget.env_steps == steps
    assert polish_config(parent.folder, ["budget.target_fitness=3"]).budget.env_steps == steps
    assert polish_config(parent.folder, {"budget.generations": 3}).budget.env_steps is None


def test_values_that_decided_that_a_run_is_over_are_not_compared(tmp_path):
    """Of a parent that ended by `target_certified`, the further episodes are."""
    run = api.run(api.load_config(PARENT, ["budget.target_certified=-1000"]), tmp_path / "run").run
    config = polish_config(run.folder)
    [reported] = certified_for(run, config, pytest.fail, workers=1)
    assert (reported.number, reported.decides, reported.tries) == (1, False, 1)


def test_a_certification_of_an_earlier_state_is_not_compared(parent, tmp_path):
    run = api.open_run(shutil.copytree(parent.folder, tmp_path / "run"))
    [old] = certify_run(run.folder, workers=1)
    run = api.resume(run.folder, ["budget.generations=7"]).run
    [new] = certified_for(run, polish_config(run.folder), lambda notice: None, workers=1)
    assert (new.number, new.env_steps) == (old.number + 1, run.history["env_steps"].iloc[-1])


def test_a_certification_of_chosen_policies_is_not_compared(parent, tmp_path):
    run = api.open_run(shutil.copytree(parent.folder, tmp_path / "run"))
    cell = run.map.iloc[-1][["cell_x", "cell_y"]].astype(int).tolist()
    [chosen] = certify_run(run.folder, best=False, cells=[cell], top=0, workers=1)
    [compared] = certified_for(run, polish_config(run.folder), lambda notice: None, workers=1)
    assert compared.number != chosen.number
    assert compared.candidates > chosen.candidates == 1
    assert certified_for(run, polish_config(run.folder), pytest.fail, workers=1)[0].number == compared.number


def test_nothing_is_certified_before_what_is_wrong_is_told(parent, tmp_path):
    run = api.open_run(shutil.copytree(parent.folder, tmp_path / "run"))
    certified = len(run.certified)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/notes.txt").touch()
    for words in (["--log", "nope"], ["--out", tmp_path / "taken"]):
        assert CliRunner().invoke(app, ["polish", *map(str, (run.folder, *words))]).exit_code != 0
    assert len(run.certified) == certified


def test_ways_out_repeat_the_command(parent, tmp_path):
    words = ["polish", parent.folder, "--candidates", 2, "--set", "compute.workers=100000", "--out", tmp_path / "run"]
    result = CliRunner().invoke(app, [*map(str, words)])
    assert isinstance(result.exception, ConfigError)
    ways = [(way.action, way.run, way.out, way.settings) for way in result.exception.ways_out]
    given = {"search.candidates": 2, "compute.workers": "auto"}
    assert ("polish", str(parent.folder), str(tmp_path / "run"), given) in ways


def test_a_polish_that_a_target_ends_says_how_often_it_was_tried(parent, tmp_path):
    words = ["polish", parent.folder, "--out", tmp_path / "run", "--set", "search.screened=4", "--candidates", 2]
    words += ["--set", "search.pairs=16", "--set", "budget.generations=3", "--set", "budget.target_certified=-1000"]
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == 0, (result.output, result.exception)
    run = api.open_run(tmp_path / "run")
    [row] = run.certified.to_dict("records")
    after = result.stdout.split("certified after polishing:")[1]
    assert f"return {row['return_mean']:,.2f}" in after
    assert f"return {run.decisions['return_mean'][0]:,.2f}" not in after
    assert (
        "try 1 of the tries so far, with any target (a policy 0.1 standard deviations below it would pass with 5.5 %)"
        in after
    )


def test_with_a_target_set_policies_are_selected_by_success(parent, tmp_path):
    target = {"kind": "target", "descriptor": [-0.5, 0.8], "radius": 0.1}
    config = polish_config(parent.folder, {f"search.objective.{key}": value for key, value in target.items()})
    run = api.run(
        config.model_copy(update={"budget": config.budget.model_copy(update={"generations": 1})}), tmp_path / "run"
    ).run
    [short] = certify_run(run.folder, episodes=3, by="success", workers=1)  # its number follows those of the parent
    number = short.number + 1
    certified = certified_for(run, config, lambda notice: None, workers=1, centre=True)
    assert [(one.selected_by, one.episodes.count, one.number) for one in certified] == [("success", EPISODES, number)]
    assert certified_for(run, config, pytest.fail, workers=1)[0].number == number, "it is not certified again"
