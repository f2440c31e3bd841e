"""When a budget ends a run, above all one of time, and what is said of it."""

from dataclasses import replace

import pytest
import yaml
from typer.testing import CliRunner

from es_service import api
from es_service import sweep as api_sweep
from es_service.cli.main import app
from es_service.dispatch.events import Compiled, Limits, Result, Submit, WorkerLost
from es_service.dispatch.scheduler_state import initial_state
from es_service.dispatch.waits import Computing
from es_service.loop import budget, driver
from es_service.loop.budget import durations, only_started, spent
from es_service.loop.history import LATER
from es_service.loop.state import Generation
from es_service.runs.run_status import more, read_status, state
from es_service.store.writer import RunStore
from tests.run_examples import write_run

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 5},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 2, "evaluation_episodes": 1},
    "budget": {"generations": 50},
    "compute": {"engine": "inline", "workers": 1},
}
pytestmark = pytest.mark.usefixtures("workers_here")


def row(generation=7, seconds=90.0):
    return {"generation": generation, "env_steps": 10, "wall_clock_s": seconds, "best_fitness": 0.0}


@pytest.mark.parametrize(
    ("seconds", "recent", "reason"),
    [
        (90.0, (9.0, 30.0, 9.5), None),  # may end at 99
        (90.0, (11.0, 30.0), "has no time for another generation: 90.0 s are spent, and each of the last 2 generations "
                             "took at least 11 s"),
        (90.0, (11.0,), None),  # in which workers may have compiled
        (90.0, (), None),
        (104.25, (1.0, 1.0), "is spent, exceeded by 4.2 s"),
    ],
)  # fmt: skip
def test_a_budget_of_time_leaves_out_a_generation_that_cannot_end_in_it(seconds, recent, reason):
    expected = {} if reason is None else {"wall_clock_s": f"the budget of 100 s {reason}"}
    assert spent({"generations": 50, "wall_clock_s": 100.0}, row(seconds=seconds), recent) == expected


@pytest.mark.parametrize(
    ("key", "reached", "reason"),
    [
        ("rollout_s", 99.9, None),
        ("rollout_s", 103.21, "the budget of 100 seconds of rollouts is spent, exceeded by 3.2 s"),
        ("cpu_s", 100.0, "the budget of 100 seconds of processors is spent"),
        ("cpu_s", float("nan"), None),  # not measured
        ("env_steps", 1234, "the budget of 100 environment steps is spent, exceeded by 1,134"),
    ],
)
def test_a_budget_ends_a_run_after_the_generation_that_reaches_it(key, reached, reason):
    assert spent({key: 100}, {**row(), key: reached}) == ({} if reason is None else {key: reason})
    assert spent({"rollout_s": 1.0}, row()) == {}, "a run of a version without this column"


def test_seconds_of_rollouts_are_those_in_which_workers_compute():
    """Two workers: the first compiles until 10; then both compute until 15. Later phases need no start."""
    computing, state = Computing(), initial_state(Limits(workers=2))
    state.items = {"a": None, "b": None}
    computing.begin({"TrainingChunk"}, 0.0)
    computing.note(Submit(()), state, 0.0)
    assert computing.seconds(9.0) == 0.0
    computing.note(Compiled(0, "TrainingChunk", 10.0), state, 10.0)
    computing.note(Compiled(1, "TrainingChunk", 12.0), state, 12.0)
    assert computing.seconds(13.0) == 3.0
    state.items = {}
    computing.note(Result(0, "a", 1), state, 15.0)
    assert computing.seconds(100.0) == 5.0  # between generations
    state.items = {"c": None}
    computing.begin({"TrainingChunk"}, 100.0)
    computing.note(Submit(()), state, 100.0)
    assert computing.seconds(101.0) == 6.0
    computing.note(WorkerLost(0, "gone"), state, 102.0)  # none is left, and the next one starts and compiles
    assert computing.seconds(150.0) == 7.0
    computing.note(Compiled(2, "TrainingChunk", 5.0), state, 160.0)
    assert computing.seconds(161.0) == 8.0


def test_runs_are_measured_across_sessions_and_end_by_what_they_have_used(tmp_path):
    settings = {"budget": {"generations": 3}, "task": {**CONFIG["task"], "episode_steps": 50}}
    api.run(api.load_config(CONFIG | settings), tmp_path / "run")
    first = api.open_run(tmp_path / "run").history
    assert (first[["rollout_s", "cpu_s"]].diff().iloc[1:] >= 0).all(axis=None)
    assert 0 < first.rollout_s.iloc[-1] <= first.wall_clock_s.iloc[-1]
    used = float(first.rollout_s.iloc[-1])
    api.resume(tmp_path / "run", {"budget.generations": None, "budget.rollout_s": used + 0.02})
    later = api.open_run(tmp_path / "run").history
    assert later.rollout_s.iloc[-2] < used + 0.02 <= later.rollout_s.iloc[-1]
    assert later.cpu_s.iloc[-1] >= first.cpu_s.iloc[-1]


def test_a_run_without_the_columns_of_later_versions_goes_on_without_them(tmp_path):
    folder = write_run(tmp_path / "run", generations=2)
    meta = api.open_run(folder).meta
    assert {"rollout_s", "cpu_s"} <= {column.name for column in meta.columns}
    older = replace(meta, columns=tuple(column for column in meta.columns if column.name not in LATER))
    RunStore.create(tmp_path / "older", "", older).close()
    with RunStore.open(tmp_path / "older") as store:
        names = {column.name for column in meta.columns}
        store.commit([Generation(0, {}, dict.fromkeys(names - {"generation"}))])
        assert "rollout_s" not in store.last_history()


def test_a_run_with_time_for_nothing_but_its_start_has_only_started():
    late, limits = row(generation=0, seconds=40.7), {"wall_clock_s": 5.0}
    assert spent(limits, late) == {
        "wall_clock_s": "only starting took place: the budget of 5 s was spent before the first generation, exceeded "
        "by 35.7 s, by starting workers, compiling and evaluating the initial centres"
    }
    assert only_started(limits, late)
    both, late_by_both = {"cpu_s": 9.0, **limits}, {**late, "cpu_s": 60.0}
    assert only_started(both, late_by_both)
    assert only_started({"cpu_s": 9.0}, late_by_both)
    assert "budget of 9 seconds of processors was spent before the first" in spent(both, late_by_both)["cpu_s"]
    assert spent({"cpu_s": 9.0, "wall_clock_s": 500.0}, late_by_both).keys() == {"cpu_s"}
    assert not only_started(limits, row(generation=1, seconds=40.7))
    assert not only_started({"generations": 0, **limits}, late)
    assert not only_started({"wall_clock_s": 50.0}, late)


def test_durations_are_those_of_generations_that_train_as_far_as_they_are_known():
    rows = [{"generation": g, **dict.fromkeys(budget.PHASES, 0.5 * g)} for g in range(3)]
    rows += [{"generation": 3, **dict.fromkeys(budget.PHASES, float("nan"))}]
    assert durations(rows) == (2.5, 5.0)


@pytest.fixture
def slow(monkeypatch):
    """A clock by which each generation takes 10 s."""
    now = [0.0]

    class Slow(budget.Clock):
        def lap(self, name):
            now[0] += 5.0 if name == "seconds_evaluation" else 0.0  # twice in a generation
            super().lap(name)

    monkeypatch.setattr(budget.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(driver, "Clock", Slow)


@pytest.mark.usefixtures("slow")
def test_a_run_stops_before_its_time_is_over_and_stays_over(tmp_path):
    outcome = api.run(CONFIG | {"budget": {"wall_clock_s": 95.0}}, tmp_path / "run")
    history = outcome.run.history
    took = history.wall_clock_s.diff().iloc[-1]
    assert history.wall_clock_s.iloc[-1] <= 95.0 < history.wall_clock_s.iloc[-1] + took
    assert "has no time for another generation" in outcome.reason
    assert outcome.is_finished
    assert state(read_status(outcome.run)) == f"finished: {outcome.reason}"
    again = api.resume(outcome.run.folder)
    assert (again.reason, again.is_finished, again.run.generation) == (outcome.reason, True, outcome.run.generation)
    assert more(read_status(outcome.run)) == {"budget.wall_clock_s": 190}
    longer = api.resume(outcome.run.folder, {"budget.wall_clock_s": None, "budget.generations": 30}).run
    whole = api.run(CONFIG | {"budget": {"generations": 30}}, tmp_path / "whole").run
    assert longer.digest() == whole.digest()


def test_a_run_that_only_started_is_not_finished(tmp_path):
    outcome = api.run(CONFIG | {"budget": {"wall_clock_s": 1e-6}}, tmp_path / "run")
    assert not outcome.is_finished
    assert outcome.reason.startswith("only starting took place")
    assert state(read_status(outcome.run)) == f"stopped before its first generation: {outcome.reason}"
    assert not api.resume(outcome.run.folder).is_finished
    assert api.resume(outcome.run.folder, {"budget.wall_clock_s": None, "budget.generations": 1}).is_finished


def test_a_run_that_its_caller_stops_is_not_finished(tmp_path):
    outcome = api.run(CONFIG, tmp_path / "run", on_generation=lambda row: api.Stop("enough"))
    assert (outcome.reason, outcome.is_finished) == ("enough", False)


@pytest.mark.slow
def test_a_sweep_names_runs_that_only_started_and_leaves_them_alone(tmp_path):
    file, out = tmp_path / "config.yaml", tmp_path / "sweep"
    file.write_text(yaml.safe_dump(CONFIG | {"budget": {"wall_clock_s": 1e-6}}))
    [swept] = api_sweep(str(file), out, seeds=range(1))
    assert (swept.state, swept.row["generation"]) == ("stopped", 0)
    assert swept.reason.startswith("only starting took place")
    before = (swept.folder / "run.lock").read_bytes()
    shown = CliRunner().invoke(app, ["sweep", str(file), "--seeds", "0:1", "--out", str(out)])
    assert shown.exit_code == 0
    assert f"{swept.name} is not finished: {swept.reason}. Raise budget.wall_clock_s" in shown.output
    assert (swept.folder / "run.lock").read_bytes() == before
