"""`budget.target_certified`: a run ends when new episodes, and not the evaluation alone, reach the target."""

from __future__ import annotations

import numpy as np
import pytest

from es_service import api
from es_service.runs import run_status, targets
from es_service.runs.certification import certify_run
from es_service.runs.certified import certified_policies, target_reached
from es_service.runs.sweep import INSIDE, run_planned
from es_service.runs.sweep_plan import plan

pytestmark = pytest.mark.usefixtures("workers_here")
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 30},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 16, "sigma": 0.2, "step": {"learning_rate": 0.2}, "evaluation_episodes": 2},
    "map": {"enabled": False},
    "budget": {"generations": 40},
    "compute": {"engine": "inline", "workers": 1},
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, workers_here):
    """The run without a target."""
    return api.run(api.load_config(CONFIG), tmp_path_factory.mktemp("run") / "whole").run


def test_it_ends_at_the_first_best_centre_that_new_episodes_confirm_and_its_bits_are_those_of_the_whole(
    whole, tmp_path
):
    target = float(whole.history["best_fitness"].iloc[0]) - 0.5
    outcome = api.run(api.load_config(CONFIG, [f"budget.target_certified={target}"]), tmp_path / "run")
    run, tested = outcome.run, certified_policies(tmp_path / "run")
    assert f"the target {target:g} is reached: a policy of generation {tested[-1].generation}" in outcome.reason
    assert run.generation < 40
    means = [one.row()["return_mean"] for one in tested]
    assert means[-1] >= target > max(means[:-1], default=-np.inf)
    assert [one.stored_fitness for one in tested] == sorted({one.stored_fitness for one in tested})
    until = run.generation
    assert run.history["centre_fitness_mean"].tolist() == whole.history["centre_fitness_mean"].tolist()[: until + 1]
    assert run_status.state(run_status.read_status(run)) == f"finished: {outcome.reason}"
    again = api.resume(run.folder)
    assert (again.reason, again.run.generation) == (outcome.reason, until)
    further = api.resume(run.folder, run_status.more(run_status.read_status(run)))
    assert further.run.generation == 40
    assert further.run.digest() == whole.digest()


def test_lucky_evaluations_do_not_end_a_run(whole, tmp_path):
    target = float(np.quantile(whole.history["best_fitness"], 0.4))
    outcome = api.run(api.load_config(CONFIG, [f"budget.target_certified={target}"]), tmp_path / "run")
    tested = certified_policies(tmp_path / "run")
    assert len(tested) > 1
    assert all(one.row()["return_mean"] < target <= one.stored_fitness for one in tested)
    assert outcome.reason == "the budget of 40 generations is spent"
    assert outcome.run.digest() == whole.digest()


def test_a_run_that_was_interrupted_before_its_certification_begins_with_it(whole, tmp_path, monkeypatch):
    target = float(whole.history["best_fitness"].iloc[0]) - 0.5
    config = api.load_config(CONFIG, [f"budget.target_certified={target}"])
    expected = api.run(config, tmp_path / "expected")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(targets, "certify_best", interrupted)
        with pytest.raises(KeyboardInterrupt):
            api.run(config, tmp_path / "run")
    outcome = api.resume(tmp_path / "run")
    assert (outcome.reason, outcome.run.digest()) == (expected.reason, expected.run.digest())


def test_the_last_generation_of_a_budget_is_certified_too(whole, tmp_path):
    config = api.load_config(CONFIG, ["budget.generations=1"])
    api.run(config, tmp_path / "run")
    outcome = api.resume(tmp_path / "run", ["budget.target_certified=-1000"])
    assert "the target -1000 is reached" in outcome.reason
    assert outcome.run.generation == 1


def test_a_run_that_only_a_certified_target_has_ended_can_go_on(tmp_path):
    config = CONFIG | {"budget": {"target_certified": -1000}}
    run = api.run(api.load_config(config), tmp_path / "run").run
    more = run_status.more(run_status.read_status(run))
    assert more == {"budget.target_certified": None, "budget.generations": 2}
    assert api.resume(run.folder, more).run.generation == 2


def test_a_target_out_of_reach_certifies_nothing_and_the_budget_ends_the_run(whole, tmp_path):
    outcome = api.run(api.load_config(CONFIG, ["budget.target_certified=0"]), tmp_path / "run")
    assert outcome.reason == "the budget of 40 generations is spent"
    assert certified_policies(tmp_path / "run") == []
    assert outcome.run.digest() == whole.digest()


def test_a_stop_of_the_caller_comes_first(whole, tmp_path):
    target = float(whole.history["best_fitness"].iloc[1])
    config = api.load_config(CONFIG, [f"budget.target_certified={target}"])
    outcome = api.run(config, tmp_path / "run", on_generation=lambda row: api.Stop("enough"))
    assert (outcome.reason, outcome.run.generation) == ("enough", 0)


@pytest.mark.parametrize("by", ["success", "goal_distance"])
def test_a_policy_that_was_selected_by_something_else_reaches_the_target_by_its_fitness(by, tmp_path):
    config = api.load_config(CONFIG, ["budget.target_certified=-1", "budget.generations=1"])
    run = api.run(config, tmp_path / "run").run
    [policy] = certify_run(run.folder, by=by)
    assert policy.row()["return_mean"] < -1, "while goal distances are above it"
    assert run_status.state(run_status.read_status(run)).startswith("finished: the budget of 1 generations")


def test_a_certification_of_few_episodes_neither_reaches_the_target_nor_stands_for_the_run_s_own(tmp_path):
    run = api.run(api.load_config(CONFIG, ["budget.generations=1"]), tmp_path / "run").run
    target = float(run.history["best_fitness"].iloc[-1]) - 1.0
    [few] = certify_run(run.folder, top=0, episodes=16)
    assert few.row()["return_mean"] >= target
    assert target_reached(run.folder, target, "sum") == ""
    outcome = api.resume(run.folder, {"budget.target_certified": target, "budget.generations": 2})
    assert outcome.reason.startswith(f"the target {target:g} is reached")
    assert [one.episodes.count for one in certified_policies(run.folder)] == [16, 256]


def test_a_sweep_leaves_alone_what_has_reached_its_target(whole, tmp_path):
    target = float(whole.history["best_fitness"].iloc[0]) - 0.5
    [planned] = plan(CONFIG, tmp_path, seeds=[0], overrides=[f"budget.target_certified={target}"])
    reason = api.run(planned.config, planned.folder).reason
    assert reason.startswith("the target")
    [left] = run_planned([planned], tmp_path)
    assert (left.state, left.reason) == ("finished", reason)
    assert not any((tmp_path / INSIDE).glob("*.yaml")), "no process was started"
