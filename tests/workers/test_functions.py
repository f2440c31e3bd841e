"""Functions of parameters as tasks: all methods move them, there is no policy, and a call that fails is invalid."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from io import StringIO

import numpy as np
import pytest
import yaml
from rich.console import Console

from es_service import api, load_config
from es_service.cli.status import print_status
from es_service.config.tasks import TASKS, task_of
from es_service.config.workload import chunks_of_phases, policy_spec
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.messages import EvaluationChunk, PolicySpec, TrainingChunk
from es_service.protocol.noise import evaluation_reset_keys
from es_service.report.write import write_report
from es_service.runs.engine import dispatch_limits
from es_service.runs.export import arrays, tables
from tests.helpers import centre, spec, workers_in_this_process
from tests.system.processes import is_running
from tests.workers import functions
from workers.environments import TaskError, describe_environment, make_function_task
from workers.host.functions import Caller, _called
from workers.worker import make_worker

MODULE = "tests.workers.functions"
HILL, NOISY, FRAGILE = (f"function:{MODULE}:{name}" for name in ("hill", "Noisy", "fragile"))
ES = {"algorithm": "es", "pairs": 8, "sigma": 0.1, "step": {"learning_rate": 0.05, "l2": 0.0}}
MAP_ELITES = {"algorithm": "map_elites", "batch": 40, "iso_sigma": 0.2}


def config_of(name, search=ES, generations=3, **compute):
    return {
        "task": {"environment": name},
        "search": search,
        "map": {"cells": [6, 6], "bounds": [[-2, 2], [-2, 2]]} if name != HILL else {"cells": [6, 6]},
        "budget": {"generations": generations},
        "compute": {"engine": "inline", "workers": 1} | compute,
    }


def test_a_function_says_what_it_is():
    task = TASKS[HILL]
    assert (task.kind, task.action_size, task.episode_steps, task.deterministic) == ("function", 3, 1, True)
    assert task.descriptor_names == ("wide", "high")
    assert task.parameters == describe_environment(HILL).parameters
    assert task.parameters.start == (3.0, 0.9, 0.5)
    config = load_config(config_of(HILL))
    assert (config.compute.rollout, config.compute.chunk_pairs, config.search.evaluation_episodes) == ("host", 1, 1)
    assert policy_spec(config, task).parameters == 3
    assert load_config(config_of(NOISY)).search.evaluation_episodes == 30
    assert task_of(load_config(config_of(NOISY))).descriptor_names == ("x0", "x1")


def test_what_a_search_moves_is_half_ranges_and_the_start_is_where_it_begins():
    parameters = TASKS[HILL].parameters
    np.testing.assert_allclose(parameters.values([-1.0, 1.0, 7.0]), [1.0, 1.0, 7.0])
    np.testing.assert_allclose(parameters.values([[0.5, -3.0, -2.0], [0.0, 0.0, 0.0]]), [[4, 0, -2], [3, 0.5, 0]])
    np.testing.assert_allclose(parameters.values(parameters.first(0, 0)), [3.0, 0.9, 0.5], rtol=1e-6)
    first_N_D = np.array([parameters.first(4, number) for number in range(1, 200)])
    assert (np.abs(first_N_D - [0.0, 0.0, 0.5]) <= 1.0).all()
    assert first_N_D.std(axis=0).min() > 0.5


@pytest.mark.slow
def test_an_es_climbs_a_hill_and_every_worker_says_the_same(tmp_path, no_jax):
    with workers_in_this_process():
        run = api.run(config_of(HILL, generations=60), tmp_path / "one").run
    assert run.history.best_fitness.iloc[0] == pytest.approx(10.0 - 100 * 0.7**2 - 0.25)
    assert run.history.best_fitness.iloc[-1] > 9.9
    assert run.history.env_steps.iloc[-1] == 1 + 60 * (16 + 1)
    np.testing.assert_allclose(list(run.parameters("best").values()), [3.0, 0.2, 0.0], atol=0.25)
    assert list(run.parameters("best")) == ["width", "height", "rest"]
    api.run(config_of(HILL, generations=20, workers=3), tmp_path / "three")
    resumed = api.resume(tmp_path / "three", ["budget.generations=60", "compute.workers=2"]).run
    assert resumed.digest() == run.digest()


@pytest.mark.slow
def test_map_elites_fills_a_map_of_descriptors(tmp_path, no_jax):
    config = config_of(HILL, MAP_ELITES, generations=8)
    with workers_in_this_process():
        run = api.run(config, tmp_path / "one").run
    assert len(run.map) > 8
    row = run.map.iloc[0]
    values = run.parameters((int(row.cell_wide), int(row.cell_high)))
    assert (values["width"], values["height"]) == pytest.approx((row.wide, row.high), rel=1e-5)
    assert functions.hill(list(values.values()))[0] == pytest.approx(row.fitness, rel=1e-5)
    assert api.run(config | {"compute": {"workers": 3}}, tmp_path / "three").run.digest() == run.digest()


@pytest.mark.usefixtures("one_process")
def test_status_report_and_exports_have_the_names_of_parameters(tmp_path):
    run = api.run(config_of(HILL, MAP_ELITES, generations=4), tmp_path / "run").run
    best = run.parameters("best")
    console = Console(file=StringIO(), width=200)
    print_status(console, run)
    shown = ", ".join(f"{name} = {value:.6g}" for name, value in best.items())
    assert f"best parameters    {shown}\n" in console.file.getvalue()
    page = write_report(run.folder, tmp_path / "report.html", best=False)[0].read_text()
    assert "Parameters of the best policy" in page
    assert re.search(rf"height</th><td>{best['height']:.9g}</td><td>0 to 1</td><td>0.9</td>", page)
    table = dict(tables(run))["parameters"].set_index("which")
    assert table.loc["best"].to_dict() == best
    assert list(table.columns) == ["width", "height", "rest"]
    cells = [",".join(map(str, one)) for one in run.map[["cell_wide", "cell_high"]].to_numpy().tolist()]
    assert sorted(set(table.index) - {"best", "centre"}) == sorted(cells)
    np.testing.assert_allclose(table.loc[cells, ["width", "height"]], run.map[["wide", "high"]], rtol=1e-5)
    found = arrays(run)
    assert found["parameter_names"].tolist() == list(best)
    np.testing.assert_array_equal(found["values"], table.loc[cells])
    np.testing.assert_array_equal(found["best_values"], list(best.values()))
    policies = api.run(config_of(HILL), tmp_path / "es").run
    assert dict(tables(policies))["parameters"]["which"].tolist()[:2] == ["best", "centre"]


@pytest.mark.parametrize("search", [{"algorithm": "nsr_es", "pairs": 8}, {"algorithm": "ars", "pairs": 8}, MAP_ELITES])
@pytest.mark.usefixtures("one_process")
def test_other_methods_move_a_noisy_function_of_any_number_of_parameters(search, tmp_path):
    config = config_of(NOISY, search | {"evaluation_episodes": 4})
    run = api.run(config, tmp_path / "run").run
    assert np.isfinite(run.history.best_fitness).all()
    assert list(run.parameters("best")) == ["x0", "x1", "x2", "x3"]


@pytest.mark.usefixtures("one_process")
def test_calls_that_fail_are_invalid_and_named_with_their_parameters(tmp_path, capfd, caplog):
    search = MAP_ELITES | {"max_invalid_fraction": 1.0, "evaluation_episodes": 1, "iso_sigma": 1.0}
    notices: list[str] = []
    run = api.run(config_of(FRAGILE, search), tmp_path / "run", on_notice=notices.append).run
    assert (run.map[["x", "y"]] <= 0.0).all(axis=None)
    assert run.history.invalid_members.iloc[1:].min() > 0
    told = capfd.readouterr().err
    for why in ("ValueError: this quarter is forbidden", "the fitness nan is", "returned the fitness 'many'; it must"):
        (line, *_) = [one for one in told.splitlines() if why in one]
        assert line.startswith(f"{FRAGILE} failed with x = "), line
    logged = [one for one in caplog.records if one.levelname == "WARNING" and " failed: " in one.getMessage()]
    logged = [one for one in logged if one.generation > 0]  # the others are episodes of initial centres
    named = [re.match(NAMED, one.getMessage()) for one in logged]
    assert len(named) == run.history.invalid_members.sum()
    for record, found in zip(logged, named, strict=True):
        assert found is not None, record.getMessage()
        x, y, seed = float(found["x"]), float(found["y"]), int(found["seed"])
        policy = int(found["policy"])
        assert seed == int(evaluation_reset_keys(0, record.generation, 0, policy=policy)[0]) >> 1
        try:
            assert not isinstance(functions.fragile((x, y)), float) or x > 0.0
        except ValueError:
            assert x > 0.0 < y
    [notice] = notices
    assert re.match(rf"{FRAGILE} failed, which makes the member invalid: evaluation episode \d+ with x = ", notice)


NAMED = (
    rf"{re.escape(FRAGILE)} failed: episode 0 of policy (?P<policy>\d+) with x = (?P<x>\S+), y = (?P<y>\S+) "
    r"\(seed (?P<seed>\d+)\): (ValueError: this quarter is|the fitness nan is|.* returned the fitness 'many')"
)


@pytest.mark.usefixtures("one_process")
def test_a_function_without_a_return_ends_the_run_with_a_sentence_that_says_so(tmp_path):
    sentence = (
        r"generation 0: each of the 30 episodes of the initial centres failed. The first: evaluation episode 0 with "
        r"x0 = 0.5, .* and 8 more \(seed \d+\): .* returned the fitness None; it must be a number; is a `return` missing"  # noqa: E501
    )
    with pytest.raises(EvaluationError, match=sentence):
        api.run(config_of(f"function:{MODULE}:forgetful"), tmp_path / "run")


TOWER = f"function:{MODULE}:tower"
WIDE = MAP_ELITES | {"batch": 64, "iso_sigma": 3.0, "evaluation_episodes": 1}


@pytest.mark.usefixtures("one_process")
def test_infeasible_points_are_counted_apart_and_enter_nothing_if_they_are_allowed(tmp_path, capfd):
    search = WIDE | {"allow_infeasible": True, "max_invalid_fraction": 0.5}
    run = api.run(config_of(TOWER, search), tmp_path / "run", on_notice=[].append).run
    assert (run.map.a + run.map.b >= 1.2).all()
    assert np.isfinite(run.map.fitness).all()
    assert (run.novelty.a + run.novelty.b >= 1.2).all()
    infeasible, invalid = run.history.infeasible_members, run.history.invalid_members
    assert infeasible.iloc[0] == 0
    assert infeasible.iloc[1:].min() > 32
    assert 0 < invalid.sum() < infeasible.sum()
    told = [line for line in capfd.readouterr().err.splitlines() if " failed with " in line]
    assert told
    assert all("the fitness nan is" in line for line in told)
    goes_on = api.resume(tmp_path / "run", ["budget.generations=5"], on_notice=[].append).run
    whole = api.run(config_of(TOWER, search, generations=5), tmp_path / "whole", on_notice=[].append).run
    assert goes_on.digest() == whole.digest()


@pytest.mark.usefixtures("one_process")
def test_a_run_may_begin_where_all_is_infeasible(tmp_path):
    search = WIDE | {"allow_infeasible": True, "max_invalid_fraction": 0.0}
    run = api.run(config_of(f"function:{MODULE}:nowhere", search), tmp_path / "run").run
    assert len(run.map) == 0
    assert run.history.infeasible_members.tolist()[1:] == [64] * (len(run.history) - 1)


@pytest.mark.usefixtures("one_process")
def test_infeasible_points_that_are_not_allowed_say_what_is_not_finite_and_what_to_set(tmp_path):
    with pytest.raises(EvaluationError) as caught:
        api.run(config_of(TOWER, WIDE), tmp_path / "run", on_notice=[].append)
    sentence = str(caught.value)
    assert re.search(r"generation 1: \d\d of 64 members returned no valid result, more than search.max_inv", sentence)
    assert "the fitness -inf is no finite number that float32 holds; if -inf says that the point is inf" in sentence
    assert "set search.allow_infeasible = true" in sentence
    assert "sigma" not in sentence, "the cause is known"
    assert "descriptor" not in sentence


@pytest.mark.usefixtures("one_process")
def test_too_many_failures_say_why(tmp_path):
    config = config_of(FRAGILE, MAP_ELITES | {"max_invalid_fraction": 0.1, "iso_sigma": 9.0})
    with pytest.raises(EvaluationError, match=r"the first: (member . of pair|episode 0 of policy) .*x = .*: "):
        api.run(config, tmp_path / "run", on_notice=[].append)


def test_a_call_that_ends_its_worker_each_time_is_named_with_its_parameters(tmp_path):
    config = config_of(f"function:{MODULE}:deadly", ES | {"evaluation_episodes": 1}, max_attempts=1)
    with pytest.raises(EvaluationError, match=r"was lost while running it") as caught:
        api.run(config, tmp_path / "run", on_notice=[].append)
    first, second = re.findall(r"left = (\S+), right = (\S+) \(seed \d+\)", str(caught.value))
    assert any(float(left) > 0.0 for left, _ in (first, second))
    np.testing.assert_allclose(np.float64(first), -np.float64(second), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hang", "exit"])
@pytest.mark.usefixtures("one_process")
def test_a_call_that_hangs_or_ends_its_process_is_invalid_and_costs_no_worker(kind, tmp_path, monkeypatch):
    """In a process of its own, which begins anew, if calls have a limit of time."""
    monkeypatch.setenv("HOST_FAULT", str(tmp_path / "fault"))
    (tmp_path / "fault").write_text(kind)
    config = config_of(f"function:{MODULE}:slow", ES | {"evaluation_episodes": 1}, generations=2)
    config["task"]["time_limit_s"] = {"hang": 1.0, "exit": 5.0}[kind]  # another one has another process, too
    notices: list[str] = []
    run = api.run(config, tmp_path / "run", on_notice=notices.append).run
    why = {
        "hang": r"its process gave no answer within 1 s \(task.time_limit_s\)",
        "exit": "its process ended with exit code 3; it has printed: no licence is left",
    }
    assert re.search(rf"member [+-] of pair \d with x0 = .*, x2 = \S+ \(seed \d+\): {why[kind]}", *notices)
    assert run.history[["lost_workers", "retries"]].to_numpy().sum() == 0
    assert run.history.invalid_members.sum() == 1
    calm = api.run(config, tmp_path / "calm").run
    assert calm.history.invalid_members.sum() == 0
    assert calm.history.best_fitness.iloc[0] == run.history.best_fitness.iloc[0]


def test_calls_are_sent_one_by_one_and_the_limit_of_time_is_that_of_calls():
    config = load_config(config_of(HILL, MAP_ELITES))
    assert chunks_of_phases(config) == {"rollout": 40}
    assert dispatch_limits(config).episodes_together == 1
    assert chunks_of_phases(load_config(config_of(NOISY)))["evaluation"] == 30
    limited = load_config(config_of(HILL), ["task.time_limit_s=5"])
    assert dispatch_limits(limited).time_limit_s == 2 * 5.0 + 60.0
    with pytest.raises(ConfigError, match=r"task.time_limit_s: 5 is not allowed for point_maze"):
        load_config({**config_of(HILL), "task": {"environment": "point_maze", "time_limit_s": 5}, "map": {}})


def test_a_seed_belongs_to_the_episode_and_both_of_a_pair_share_it():
    worker_spec = spec(
        environment=NOISY,
        environment_options={"noise": 2.0},
        episode_steps=1,
        policy=PolicySpec((1, 4), output="linear", bias=False),
        action_noise=0.0,
        rollout="host",
        chunk_pairs=2,
    )
    run, subject = make_worker(worker_spec), centre(np.zeros(4), observation_size=1, sigma=1e-12)
    [found] = run([(subject, TrainingChunk(1, 0))])
    np.testing.assert_array_equal(found.fitness[:, 0], found.fitness[:, 1])
    assert found.fitness[0, 0] != found.fitness[1, 0]
    [found] = run([(subject, EvaluationChunk(1, 0, episodes=2))])
    seeds = [int(evaluation_reset_keys(3, 1, episode)[0]) >> 1 for episode in range(2)]
    noise = [np.random.default_rng(seed).normal() for seed in seeds]
    np.testing.assert_allclose(found.fitness, -4.0 + 2.0 * np.array(noise), rtol=1e-6)


def test_noise_of_low_rank_is_refused():
    with pytest.raises(ConfigError, match=r"search.noise.kind: low_rank is not allowed.*no matrices.*must be full"):
        load_config(config_of(HILL), ["search.noise.kind=low_rank"])


def test_a_policy_is_refused_and_a_resolved_config_is_not(tmp_path):
    config = load_config(config_of(HILL))
    assert load_config(yaml.safe_load(config.resolved_yaml())) == config
    for key, value in (("policy.hidden", [4]), ("policy.output", "tanh"), ("task.episode_steps", 5)):
        with pytest.raises(
            ConfigError, match=rf"{key}: .* has no effect with {HILL}, which has no policy; leave it out"
        ):
            load_config(config_of(HILL), {key: value})
    with pytest.raises(
        ConfigError, match=r"xla cannot run .*: it computes tasks in JAX, and not functions of parameters"
    ):
        load_config(config_of(HILL), ["compute.rollout=xla"])


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("parameters", {"width": (5.0, 1.0)}, r"parameters: \(5.0, 1.0\) is not a pair"),
        ("parameters", True, "parameters = True is not a mapping"),
        ("parameters", {}, "parameters = {} is not a mapping from names to bounds"),
        ("start", {"depth": 1.0}, "start has depth, which is none of the parameters"),
        ("start", [1.0, 2.0], "start = .* has not one value for each of the 3 parameters"),
        ("start", {"height": "high"}, "start = .* has values that are no numbers"),
        ("start", {"height": 2.0}, "start of height = 2 is not between its bounds 0 and 1"),
        ("descriptor_bounds", ((0.0, 1.0),), "are not tuples of one length"),
        ("descriptor_names", ("fitness", "high"), "'fitness' would be the column"),
        ("least_fitness", "low", "least_fitness = 'low' is not a finite number"),
    ],
)
def test_a_function_that_contradicts_itself_is_refused(name, value, problem, monkeypatch):
    monkeypatch.setattr(functions.hill, name, value)
    with pytest.raises(TaskError, match=rf"^{HILL}: .*{problem}"):
        describe_environment(HILL)


def test_numbers_of_numpy_are_numbers(monkeypatch):
    monkeypatch.setattr(functions.hill, "parameters", {"width": (np.int64(1), np.float32(5.0)), "h": None, "r": None})
    monkeypatch.setattr(functions.hill, "start", {})
    task = describe_environment(HILL)
    assert task.parameters is not None
    assert task.parameters.bounds[0] == (1, 5.0)
    assert [type(bound) for bound in task.parameters.bounds[0]] == [int, float]
    monkeypatch.setattr(functions.hill, "parameters", np.int64(3))
    assert describe_environment(HILL).action_size == 3


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("math:pi", "is no function"),
        ("math:sin", "has no attribute parameters"),
        ("math:nothing", "has no function nothing"),
        (f"{MODULE}:Uncalled", "is a class without __call__"),
    ],
)
def test_what_is_no_such_function_is_named(name, problem):
    with pytest.raises(TaskError, match=problem):
        describe_environment(f"function:{name}")


@pytest.mark.parametrize(("fitness", "why"), [("10**400", "a number"), ("1e39", "that float32 holds")])
def test_what_is_too_large_is_no_fitness(fitness, why, monkeypatch):
    monkeypatch.setattr(functions, "fragile", eval(f"lambda parameters: {fitness}"))
    functions.fragile.parameters = ("x", "y")
    task = make_function_task(FRAGILE, {})
    *_, told = _called(task, task, np.zeros(2, np.float32), 0)
    assert told.endswith(why)


@pytest.mark.parametrize("how", ["os.kill(os.getpid(), 9)", "caller.close(); time.sleep(60)"])
def test_what_a_call_has_started_ends_with_its_worker(how):
    program = f"""
import os, time
import numpy as np
from workers.host.functions import Caller
caller = Caller("function:{MODULE}:starting", {{}}, 20.0)
print(int(caller(np.zeros(1, np.float32), 0)[0]), flush=True)
{how}
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        started = int(parent.stdout.readline())
        until = time.monotonic() + 60
        while is_running(started):
            assert time.monotonic() < until
            time.sleep(0.05)
        parent.kill()


def test_a_call_in_a_process_of_its_own_imports_what_its_worker_can(tmp_path, monkeypatch):
    """Ray adds the driver's folders to the path of an actor, not to its environment variables."""
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "far_away.py").write_text("def f(x):\n    return sum(x)\n\n\nf.parameters = ('a', 'b')\n")
    monkeypatch.syspath_prepend(tmp_path / "far")
    monkeypatch.chdir(tmp_path)
    caller = Caller("function:far_away:f", {}, 20.0)
    assert caller(np.float32([1.0, 2.0]), 0)[0] == 3.0
    caller.close()


def test_a_process_that_cannot_be_started_once_is_started_by_the_next_call(monkeypatch):
    caller = Caller(HILL, {}, 20.0)
    with monkeypatch.context() as patch:
        patch.setattr("es_service.protocol.child.start_child", lambda start: (_ for _ in ()).throw(BlockingIOError()))
        with pytest.raises(BlockingIOError):
            caller(np.zeros(3, np.float32), 0)
    assert np.isfinite(caller(np.zeros(3, np.float32), 0)[0])
    caller.close()
