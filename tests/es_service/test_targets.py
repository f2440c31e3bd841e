"""`budget.target_certified`: a run ends when new episodes, and not the evaluation alone, reach the target."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from es_service import api
from es_service.cli.common import text_console
from es_service.cli.status import print_status, print_summary, status_data
from es_service.protocol.noise import Domain
from es_service.report.data import read_run
from es_service.report.summary import what_was_run
from es_service.runs import run_status, sessions
from es_service.runs.certification import NamedPolicy, certify_run
from es_service.runs.certified import (
    EPISODES,
    Certified,
    all_certifications,
    certified_policies,
    failed_sentence,
    target_reached,
    tries_sentence,
)
from es_service.runs.selection import StoredEpisodes, false_pass_share, mean_interval
from es_service.runs.sweep import INSIDE, run_planned
from es_service.runs.sweep_plan import plan
from tests.helpers import policy_with

pytestmark = pytest.mark.usefixtures("workers_here")
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 30},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 16, "sigma": 0.2, "step": {"learning_rate": 0.2}, "evaluation_episodes": 2},
    "map": {"enabled": False},
    "budget": {"generations": 40},
    "compute": {"engine": "inline", "workers": 1},
}


RUNS = 2000


def decided(folder):
    """The decisions of a run."""
    return [one for one in all_certifications(folder) if one.decides]


@pytest.fixture(scope="module")
def whole(tmp_path_factory, workers_here):
    """The run without a target."""
    return api.run(api.load_config(CONFIG), tmp_path_factory.mktemp("run") / "whole").run


def test_it_ends_at_the_first_best_centre_that_new_episodes_confirm_and_its_bits_are_those_of_the_whole(
    whole, tmp_path
):
    target = float(whole.history["best_fitness"].iloc[0]) - 0.5
    outcome = api.run(api.load_config(CONFIG, [f"budget.target_certified={target}"]), tmp_path / "run")
    run, tested, [report] = outcome.run, decided(tmp_path / "run"), certified_policies(tmp_path / "run")
    assert f"the target {target:g} is reached: a policy of generation {tested[-1].generation}" in outcome.reason
    assert run.generation < 40
    means = [one.row()["return_mean"] for one in tested]
    assert [one.tries for one in tested] == [*range(1, len(tested) + 1)]
    assert (report.tries, report.decides, report.generation) == (len(tested), False, tested[-1].generation)
    assert report.selection_mean == means[-1]
    assert report.selection_steps == sum(int(one.episodes.steps_E.sum()) for one in tested)
    assert not set(report.episodes.return_E) & set(tested[-1].episodes.return_E), "other episodes"
    assert len(run.decisions) == len(tested)
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


def test_lucky_evaluations_do_not_end_a_run_and_each_failed_try_is_said(whole, tmp_path, capsys):
    target, notices = float(np.quantile(whole.history["best_fitness"], 0.4)), []
    config = api.load_config(CONFIG, [f"budget.target_certified={target}"])
    outcome = api.run(config, tmp_path / "run", on_notice=notices.append)
    tested = decided(tmp_path / "run")
    assert len(tested) > 1
    assert certified_policies(tmp_path / "run") == []
    assert all(one.row()["return_mean"] < target <= one.stored_fitness for one in tested)
    assert outcome.reason == "the budget of 40 generations is spent"
    assert outcome.run.digest() == whole.digest()
    said = [notice for notice in notices if f"does not reach budget.target_certified = {target:g} in 256" in notice]
    means = [one.row()["return_mean"] for one in tested]
    assert [f": {mean:.6g};" in notice for mean, notice in zip(means, said, strict=True)] == [True] * len(tested)
    told = run_status.read_status(outcome.run)
    given = status_data(told)
    assert (given["target_certified"], list(given["tries"])) == (target, means)
    sentence = f"{len(tested)} tries, none held: {', '.join(f'{mean:.2f}' for mean in means)}"
    print_status(text_console(), outcome.run)
    print_summary(text_console(), outcome.run, "")
    shown = capsys.readouterr().out
    assert shown.count(f" (certified target: {target:g}); selected, not certified\n") == 2
    assert shown.count(f"\ncertified target   {sentence}\n") == 2
    assert dict(what_was_run(read_run(outcome.run.folder)))["certified target"] == f"{target:g}; {sentence}"


def test_tries_that_hold_are_no_failed_ones_and_only_the_newest_are_shown():
    assert failed_sentence([]) == ""
    assert failed_sentence([-1.5]) == "1 try, did not hold: -1.50"
    assert failed_sentence([float(i) for i in range(12)]).startswith("12 tries, none held: 2.00, 3.00, ")
    assert failed_sentence([float(i) for i in range(12)]).endswith(", 11.00 (the newest 10)")


def test_a_run_that_was_interrupted_before_its_certification_begins_with_it(whole, tmp_path, monkeypatch):
    target = float(whole.history["best_fitness"].iloc[0]) - 0.5
    config = api.load_config(CONFIG, [f"budget.target_certified={target}"])
    expected = api.run(config, tmp_path / "expected")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sessions, "certify_best", interrupted)
        with pytest.raises(KeyboardInterrupt):
            api.run(config, tmp_path / "run")
    outcome = api.resume(tmp_path / "run")
    assert (outcome.reason, outcome.run.digest()) == (expected.reason, expected.run.digest())


def test_a_run_that_was_interrupted_after_its_decision_is_over_once_the_value_is_certified(tmp_path, monkeypatch):
    config = api.load_config(CONFIG, ["budget.target_certified=-1000"])
    expected = api.run(config, tmp_path / "expected")
    run_episodes = sessions.new_episodes

    def interrupted(*asked: object) -> object:
        if asked[-1] == Domain.CERTIFICATION_RESET:
            raise KeyboardInterrupt
        return run_episodes(*asked)

    with monkeypatch.context() as patch:
        patch.setattr(sessions, "new_episodes", interrupted)
        with pytest.raises(KeyboardInterrupt):
            api.run(config, tmp_path / "run")
    run = api.open_run(tmp_path / "run")
    assert not run_status.read_status(run).reasons, "a sweep does not leave it alone"
    outcome = api.resume(run.folder)
    assert outcome.reason == expected.reason
    ours, theirs = certified_policies(run.folder), certified_policies(tmp_path / "expected")
    assert [one.episodes.return_E.tolist() for one in ours] == [one.episodes.return_E.tolist() for one in theirs]
    assert run.decisions["tries"].tolist() == [1]


def test_no_resume_is_decided_by_the_episodes_that_are_reported(tmp_path):
    """The two means of the policy that ends this run differ. With a target between them, the decision counts."""
    config = api.load_config(CONFIG, ["budget.target_certified=-1000", "budget.generations=1"])
    folder = api.run(config, tmp_path / "run").run.folder
    [decision], [report] = (
        one["return_mean"].tolist() for one in (api.open_run(folder).decisions, api.open_run(folder).certified)
    )
    between = (decision + report) / 2
    reason = target_reached(folder, between, "sum")
    assert bool(reason) == (decision > report)
    assert target_reached(folder, min(decision, report) - 1.0, "sum")
    assert not target_reached(folder, max(decision, report) + 1.0, "sum")
    if reason:
        assert reason.endswith("further certified ones, below the target")


def test_a_policy_that_passes_a_lower_target_than_it_was_tried_with_is_certified(tmp_path):
    config = api.load_config(CONFIG, ["budget.generations=1"])
    folder = api.run(config, tmp_path / "run").run.folder
    best = float(api.open_run(folder).history["best_fitness"].iloc[-1])
    [decision] = fail_one_try(folder, best)
    outcome = api.resume(folder, {"budget.target_certified": decision.row()["return_mean"] - 1.0})
    assert "(try 1 so far, with any target)" in outcome.reason
    assert len(decided(folder)) == len(certified_policies(folder)) == 1


def fail_one_try(folder, best):
    """The decision of a run whose target is the fitness of its best centre, which it does not reach."""
    outcome = api.resume(folder, {"budget.target_certified": best}, on_notice=lambda notice: None)
    assert outcome.reason == "the budget of 1 generation is spent"
    return decided(folder)


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
    assert run_status.state(run_status.read_status(run)).startswith("finished: the budget of 1 generation")


@pytest.mark.parametrize("episodes", [16, 256])
def test_a_certification_neither_reaches_the_target_nor_stands_for_the_run_s_own(episodes, tmp_path):
    run = api.run(api.load_config(CONFIG, ["budget.generations=1"]), tmp_path / "run").run
    target = float(run.history["best_fitness"].iloc[-1]) - 1.0
    [given] = certify_run(run.folder, top=0, episodes=episodes)
    assert given.row()["return_mean"] >= target
    assert target_reached(run.folder, target, "sum") == ""
    outcome = api.resume(run.folder, {"budget.target_certified": target, "budget.generations": 2})
    assert outcome.reason.startswith(f"the target {target:g} is reached")
    assert [one.episodes.count for one in certified_policies(run.folder)] == [episodes, 256]
    assert [one.number for one in all_certifications(run.folder)] == [0, 1, 2]
    assert [one.decides for one in all_certifications(run.folder)] == [False, True, False]


def test_of_several_decisions_that_reach_a_target_the_newest_counts(tmp_path):
    folder = api.run(api.load_config(CONFIG, ["budget.target_certified=-1000"]), tmp_path / "run").run.folder
    decision, report = all_certifications(folder)
    later = [replace(decision, number=2, tries=2), replace(report, number=3)]
    assert sessions.passed([decision, report, *later], -1000, "sum") is later[0]
    assert sessions.report_of([decision, report, *later], later[0]) is later[1]
    assert sessions.report_of([decision, report, later[0]], later[0]) is None, "that of the one before is older"


def made_up_episodes(kind, rng, mean):
    """Outcomes of EPISODES episodes of a policy with this expected fitness, and its standard deviation."""
    shape = {
        "normal": lambda: rng.normal(mean, 1.0, EPISODES),
        "skewed": lambda: mean + 1.0 - rng.exponential(1.0, EPISODES),
        "yes/no": lambda: (rng.random(EPISODES) < mean).astype(float),
    }[kind]()
    success_E = shape > 0.5 if kind == "yes/no" else None
    nan_E = np.full(EPISODES, np.nan)
    return StoredEpisodes(shape, shape, nan_E, success_E, np.ones(EPISODES, np.int64), np.zeros((EPISODES, 2)))


def test_how_easily_a_run_ends_by_luck_is_said_with_the_number_of_its_tries():
    """256 episodes have a standard error of 1/16: 0.1 standard deviations are 1.6 of it, which 5.48 % exceed."""
    assert false_pass_share(1, 256, 0.1) == pytest.approx(0.0548, abs=1e-4)
    assert false_pass_share(20, 256, 0.1) == pytest.approx(1.0 - (1.0 - 0.0548) ** 20, abs=1e-3)
    assert tries_sentence(20).startswith("try 20 of the tries so far, with any target (at least one of 20 ")
    assert "would pass with 67.6 %" in tries_sentence(20)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "target", "sd"), [("normal", 0.0, 1.0), ("skewed", 0.0, 1.0), ("yes/no", 0.6, 0.49)])
def test_the_interval_of_what_ends_a_run_holds_the_truth_in_95_of_100_made_up_runs(kind, target, sd):
    """The first best centre that is tried is 0.1 standard deviations below the target, and each later one is better by
    0.02. A run ends by the first that passes, most often by luck, so the intervals of the episodes that decide hold the
    truth less often."""
    held, successes_held, decision_held, below = 0, 0, 0, 0
    for run in range(RUNS):
        policies: list[Certified] = []
        for tried in itertools.count():
            truth, fitness = target + sd * (0.02 * tried - 0.1), target + tried

            def episodes_of(policy, number, domain, run=run, truth=truth):
                return made_up_episodes(kind, np.random.default_rng([run, number, domain]), truth)

            assert sessions.due_after(policies, target, "sum")({"best_fitness": fitness})
            best = NamedPolicy("best", policy_with(np.array([tried], np.float32)), tried, fitness)
            policies += sessions.attempt(policies, best, len(policies), target, "sum", {}, episodes_of)
            if not policies[-1].decides:
                break
        *_, decision, report = policies
        assert (report.tries, report.policy) == (tried + 1, best.policy)
        assert not sessions.due_after(policies, target, "sum")({"best_fitness": fitness + 1})
        row, (_, low, high) = report.row(), mean_interval(decision.episodes.return_E)
        held += row["return_low"] <= truth <= row["return_high"]
        decision_held += low <= truth <= high
        successes_held += kind == "yes/no" and row["success_low"] <= truth <= row["success_high"]
        below += row["return_mean"] < target
    assert 0.93 * RUNS <= held <= 0.97 * RUNS
    assert kind != "yes/no" or 0.93 * RUNS <= successes_held <= 0.97 * RUNS
    assert decision_held < 0.9 * RUNS
    assert below > 0.3 * RUNS, "these runs are over, too"


def test_a_sweep_leaves_alone_what_has_reached_its_target(whole, tmp_path):
    target = float(whole.history["best_fitness"].iloc[0]) - 0.5
    [planned] = plan(CONFIG, tmp_path, seeds=[0], overrides=[f"budget.target_certified={target}"])
    reason = api.run(planned.config, planned.folder).reason
    assert reason.startswith("the target")
    [left] = run_planned([planned], tmp_path)
    assert (left.state, left.reason) == ("finished", reason)
    assert not any((tmp_path / INSIDE).glob("*.yaml")), "no process was started"
