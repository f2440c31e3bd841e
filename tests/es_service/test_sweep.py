"""What a sweep consists of, what is refused before it starts, and how its runs share cores.

Sweeps themselves are in `tests/system/test_sweep.py`.
"""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from typer.testing import CliRunner

from es_service.api import load_config
from es_service.cli.main import app
from es_service.cli.sweep import _check_bounds, _compare, grid_of, live_table, points_of, seeds_of
from es_service.config.text import split_values
from es_service.dispatch.ray_nodes import actor_cores
from es_service.errors import ConfigError
from es_service.report import write
from es_service.runs import sweep as sweep_commands
from es_service.runs import worker_count
from es_service.runs.sweep import INSIDE, Certifying, SweptRun, command_of, sweep
from es_service.runs.sweep_plan import Labelled, left_out_notes, plan, settings_words
from es_service.runs.worker_count import divide, share
from tests.es_service.config_examples import MINIMAL
from tests.run_examples import write_run


def test_every_combination_and_seed_is_a_run_in_a_folder_named_after_it(tmp_path):
    grid = {"search.sigma": [0.05, 0.1], "map.cells": [[20, 20]], "search.step.learning_rate": [1e-3]}
    runs = plan(MINIMAL, tmp_path, grid, range(3), ["search.pairs=64"])
    assert [run.name for run in runs] == [
        f"sigma={sigma}_cells=20,20_learning_rate=0.001_seed={seed}" for sigma in (0.05, 0.1) for seed in range(3)
    ]
    for run in runs:
        assert run.folder == tmp_path / run.name
        assert run.name.startswith(f"sigma={run.config.search.sigma}_")
        assert run.name.endswith(f"_seed={run.config.seed}")
        assert (run.config.search.pairs, run.config.map.cells) == (64, (20, 20))
    assert list(tmp_path.iterdir()) == []


def test_a_grid_and_seeds_of_numpy_are_those_of_python(tmp_path):
    grid = {"search.sigma": [0.05, 0.1], "search.pairs": [64, 128]}
    of_numpy = {key: np.array(values) for key, values in grid.items()}
    assert plan(MINIMAL, tmp_path, of_numpy, np.arange(2)) == plan(MINIMAL, tmp_path, grid, range(2))
    assert load_config(MINIMAL, {"search.pairs": np.int64(16)}) == load_config(MINIMAL, ["search.pairs=16"])


def test_a_larger_sweep_has_the_runs_of_the_smaller_one(tmp_path):
    small = plan(MINIMAL, tmp_path, {"search.sigma": [0.1]}, [1])
    large = plan(MINIMAL, tmp_path, {"search.sigma": [0.05, 0.1]}, range(3))
    assert all(replace(run, group="sigma = 0.1") in large for run in small)  # one value is no name


def test_a_key_that_only_some_methods_of_a_sweep_have_is_left_out_for_the_others(tmp_path):
    grid = {"search.algorithm": ["me_es", "map_elites", "ns_es"]}
    shared = ["search.sigma=0.1", "search.pairs=32", "search.step.learning_rate=0.1", "search.step.l2=0"]
    runs = plan("point_maze_me_es", tmp_path, grid, None, [*shared, "search.evaluation_episodes=30"])
    assert [run.name for run in runs] == ["algorithm=me_es", "algorithm=map_elites", "algorithm=ns_es"]
    assert [run.overrides.get("search.sigma") for run in runs] == [0.1, None, 0.1]
    keys = ", ".join(word.partition("=")[0] for word in shared)
    assert left_out_notes(runs) == [f"left out {keys} with map_elites, since that would have no effect"]
    several = plan(MINIMAL, tmp_path, {"search.algorithm": ["es", "map_elites"], "search.sigma": [0.05, 0.1]}, range(2))
    names = ["algorithm=map_elites_seed=0", "algorithm=map_elites_seed=1"]
    assert [run.name for run in several[4:]] == names
    assert plan(MINIMAL, tmp_path, {"search.algorithm": ["es", "memes"]}, None, ["search.emitters=4"])
    kinds = {"search.step.kind": ["adam", "clipup"]}
    stepping = plan(MINIMAL, tmp_path, kinds, None, ["search.step.max_speed=0.3"])
    assert [run.overrides.get("search.step.max_speed") for run in stepping] == [None, 0.3]
    assert left_out_notes(stepping) == [
        "left out search.step.max_speed with search.step.kind = adam, since that would have no effect"
    ]
    with pytest.raises(ConfigError, match=r"search\.batch: 3 has no effect with es"):
        plan(MINIMAL, tmp_path, {"search.algorithm": ["es", "ns_es"]}, None, ["search.batch=3"])
    with pytest.raises(ConfigError, match=r"search\.typo"):
        plan(MINIMAL, tmp_path, grid, None, ["search.typo=3"])


def test_every_config_of_several_is_a_group_with_settings_of_its_own(tmp_path):
    configs = [Labelled("evolution strategy", MINIMAL), Labelled("MAP-Elites", "point_maze_map_elites")]
    runs = plan(configs, tmp_path, {"policy.hidden": [[8], [16]]}, range(2), ["budget.generations=4"])
    assert len(runs) == 8
    assert [run.name for run in runs[::4]] == ["evolution-strategy_hidden=8_seed=0", "MAP-Elites_hidden=8_seed=0"]
    assert [run.group for run in runs[::2]] == [
        f"{label}, hidden = [{size}]" for label in ("evolution strategy", "MAP-Elites") for size in (8, 16)
    ]
    assert {run.config.search.algorithm for run in runs[4:]} == {"map_elites"}
    assert {run.config.budget.generations for run in runs} == {4}
    # A key of one of the methods is left out for the other, and one that none of them has is refused.
    left = plan(configs, tmp_path, {"search.sigma": [0.1, 0.2]})
    assert [run.group for run in left] == [
        *(f"evolution strategy, sigma = {sigma}" for sigma in (0.1, 0.2)),
        "MAP-Elites",
    ]
    with pytest.raises(ConfigError, match=r"search\.emitters: 3 has no effect"):
        plan(configs, tmp_path, {}, None, ["search.emitters=3"])
    same = [Labelled("A", "point_maze_es"), Labelled("A", "ant_maze_me_es")]
    assert [run.name for run in plan(same, tmp_path)] == ["A_point_maze_es_run", "A_ant_maze_me_es_run"]
    with pytest.raises(ConfigError, match="folders with the same name"):
        plan([configs[0], configs[0]], tmp_path)


def test_settings_are_named_in_words():
    settings = {"search.algorithm": "me_es", "novelty.newest": None, "search.sigma": 0.1, "map.correct_every": None}
    assert settings_words(settings) == "me_es, newest = no limit, sigma = 0.1, correct_every = never"
    assert settings_words({"search.a": 1, "map.a": None}) == "search.a = 1, map.a = none"
    assert settings_words({"search.step.max_speed": None}) == "max_speed = learning_rate / 0.75"


def test_all_problems_of_all_runs_are_one_message(tmp_path):
    grid = {"search.sigma": [0.05, "big", -1.0], "search.pairs": [100]}
    with pytest.raises(ConfigError) as error:
        plan(MINIMAL, tmp_path, grid, range(5), ["compute.chunk_pairs=16"])
    assert sorted(str(problem.field) for problem in error.value.problems) == ["search.pairs"] + ["search.sigma"] * 2
    assert "search.sigma: big is not allowed; must be a number above 0" in str(error.value)
    assert "search.pairs: 100 is not a multiple of compute.chunk_pairs (16)" in str(error.value)
    for wrong, message in (
        ({"search.sgima": [1.0]}, "did you mean search.sigma?"),
        ({"seed": [0, 1]}, "give the seeds separately"),
        ({"search.sigma": []}, "search.sigma: there is no value"),
        ({"search.sigma": [0.1, 0.10]}, "search.sigma: 0.1 is there twice"),
        ({"compute.chunk_pairs": [16]}, "compute.chunk_pairs: it has values in the sweep, and 16 for all runs"),
    ):
        with pytest.raises(ConfigError) as error:
            plan(MINIMAL, tmp_path, wrong, [0], ["compute.chunk_pairs=16"])
        assert message in str(error.value)
    with pytest.raises(ConfigError, match="seed: it has values in the sweep, and 3 for all runs"):
        plan(MINIMAL, tmp_path, {}, range(3), ["seed=3"])
    with pytest.raises(ConfigError, match="seed: 1 is there twice"):
        plan(MINIMAL, tmp_path, {}, [1, 2, 1])
    with pytest.raises(ConfigError, match="folders with the same name"):
        plan(MINIMAL, tmp_path, {"search.algorithm": ["a:b", "a-b"]})


def test_a_folder_that_holds_a_run_with_other_settings_is_refused(tmp_path):
    settings = {"search.sigma": 0.05, "seed": 1}
    write_run(tmp_path / "sigma=0.05_seed=1", settings)
    source = {"task": {"environment": "point_maze"}, "search": {"algorithm": "me_es"}, "budget": {"generations": 9}}
    assert len(plan(source, tmp_path, {"search.sigma": [0.05]}, range(2))) == 2
    with pytest.raises(ConfigError) as error:
        plan(source, tmp_path, {"search.sigma": [0.05]}, range(2), {"policy.hidden": [16]})
    assert "sigma=0.05_seed=1 holds a run with other settings" in str(error.value)
    assert "policy.hidden: [64, 64] -> [16]" in str(error.value)
    with pytest.raises(ConfigError, match="is the folder of a run"):
        plan(source, tmp_path / "sigma=0.05_seed=1", {}, range(2))


@pytest.mark.parametrize(
    ("text", "seeds"), [("0:5", [0, 1, 2, 3, 4]), ("7", [7]), ("0,7", [0, 7]), ("0:2, 10:12", [0, 1, 10, 11])]
)
def test_seeds_are_ranges_without_their_end_and_single_ones(text, seeds):
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "0-5", "-1", "0:5:2", "1,,2", ":5", "5:5", "5:0"])
def test_other_seeds_are_refused(text):
    with pytest.raises(ConfigError, match="--seeds") as error:
        seeds_of(text)
    assert (error.value.field, error.value.value) == ("seeds", text)
    assert error.value.suggestion == {"5:0": "0:6", "5:5": "5:6"}.get(text)


def test_points_of_cost_are_environment_steps_or_seconds():
    assert points_of(["1e7, 100000000", "cpu_s=60,120", "cpu_s=7.5"]) == {
        "env_steps": [1e7, 1e8],
        "cpu_s": [60.0, 120.0, 7.5],
    }
    for text in ("x", "0", "nan", "inf", "1e7,-1", "rollout_s=", ""):
        with pytest.raises(ConfigError, match="is no cost; write numbers above 0"):
            points_of([text])
    with pytest.raises(ConfigError, match=r"the cost cpu is unknown; must be .*did you mean cpu_s"):
        points_of(["cpu=60"])
    with pytest.raises(ConfigError, match="the cost seconds is unknown"):
        sweep(MINIMAL, "nowhere", seeds=[0], certify_at={"seconds": [1.0]})


def test_values_of_the_grid_are_those_of_set(tmp_path):
    words = ["policy.hidden=[64, 64],[16]", "task.options.start=corner,off", "search.sigma = 1e-2, 0.1"]
    grid = {"policy.hidden": [[64, 64], [16]], "task.options.start": ["corner", "off"], "search.sigma": [0.01, 0.1]}
    assert grid_of(words) == grid
    for word, message in (
        ("search.sigma", "write KEY=A,B"),
        ("search.sigma=", "write KEY=A,B"),
        ("search.sigma=0.1,,0.2", "is no list of values between commas"),
    ):
        with pytest.raises(ConfigError) as error:
            grid_of([word])
        assert (message in str(error.value), len(error.value.problems)) == (True, 1)
    for key, message in (("search.sgima", "did you mean search.sigma?"), ("search", "this is a section")):
        with pytest.raises(ConfigError) as error:
            plan(MINIMAL, tmp_path, {key: [0.1, 0.2]}, None)
        assert (message in str(error.value), len(error.value.problems)) == (True, 1)
    with pytest.raises(ConfigError, match="has values already"):
        grid_of(["search.sigma=0.1", "search.sigma=0.2"])


@given(st.lists(st.sampled_from(["1", "[1, 2]", "{a: [1]}", "'x, y'", "brax:ant", "null", "-1e-3"]), min_size=1))
def test_values_are_split_at_the_commas_between_them_alone(values):
    assert split_values(",".join(values)) == values


def test_options_that_contradict_each_other_are_refused(tmp_path):
    for words, message in (
        (("sweep", "point_maze_es", "--out", tmp_path / "a"), "a sweep needs --grid KEY=A,B or --seeds A:B"),
        (("sweep", "a", "b", "--out", tmp_path / "a", "--label", "c"), "--label: there are 1 for 2 configs"),
        (("run", "point_maze_es", "--seeds", "0:2", "--seed", 1), "--seed and --seeds cannot be combined"),
        (("run", "point_maze_es", "--seeds", "0:2", "--show-output"), "--show-output and --seeds cannot be combined"),
        (("run", "point_maze_es", "--seeds", "0:2", "--set", "search.sigma=x", "--out", tmp_path), "sigma: x is not"),
    ):
        result = CliRunner().invoke(app, [str(word) for word in words])
        assert isinstance(result.exception, ConfigError)
        assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_a_stop_that_a_run_does_not_reach_leaves_its_budget_at_the_end(tmp_path, monkeypatch):
    planned = plan(MINIMAL, tmp_path, {}, [0], ["budget.generations=1"])[0]
    (tmp_path / INSIDE).mkdir()
    command = command_of(planned, 2, tmp_path / INSIDE, [], Certifying({"env_steps": [1e9]}))
    stopped = command.next_words()
    assert stopped[-1] == "--set=budget.env_steps=1000000000"
    write_run(planned.folder, {"budget.env_steps": 10**9}, generations=1)
    assert command.next_words() == command.certify
    monkeypatch.setattr(sweep_commands, "certified_over_time", lambda folder: [sweep_commands.newest(folder)])
    assert command.next_words() == command.run
    shutil.rmtree(planned.folder)
    write_run(planned.folder, generations=1)
    assert command.next_words() == []


def test_a_run_is_certified_at_points_of_cost_and_at_its_end(tmp_path, monkeypatch):
    """A generation of these runs has 1,000 environment steps and takes 10 s, and the budget is 20,000 steps."""
    planned = plan(MINIMAL, tmp_path, {}, [0], ["budget.env_steps=20000", "budget.generations=1000"])[0]
    steps, done = [0], []
    monkeypatch.setattr(sweep_commands, "certified_over_time", lambda _: [{"env_steps": value} for value in done])
    monkeypatch.setattr(sweep_commands, "holds_run", lambda _: steps[0] > 0)
    monkeypatch.setattr(sweep_commands, "recent_durations", lambda *_: ())
    monkeypatch.setattr(
        sweep_commands,
        "read_newest",
        lambda _: {"generation": 0, "env_steps": steps[0], "cpu_s": steps[0] / 100, "best_fitness": 0.0},
    )
    steps_G = np.arange(0, 21000, 1000)
    history = {"env_steps": steps_G, "rollout_s": steps_G * np.nan, "cpu_s": steps_G / 100}
    monkeypatch.setattr(sweep_commands, "read_history_columns", lambda _: history)
    (tmp_path / INSIDE).mkdir()

    def words(**at):
        command = command_of(planned, 2, tmp_path / INSIDE, ["--log=wandb"], Certifying(at))
        return command.next_words()

    run, certify = (
        [planned.folder.name, "--log=wandb"],
        ["evaluate", str(planned.folder), "--certify", "--workers", "2"],
    )
    for now, known, expected in (
        (0, [], "budget.env_steps=7001"),
        (7000, [], "budget.env_steps=7001"),
        (8000, [], "certify"),
        (8000, [8000], "budget.env_steps=12000"),
        (12000, [8000, 12000], ""),
        (20000, [8000, 12000], "certify"),
        (20000, [8000, 12000, 20000], None),
        (20000, [20000], None),
    ):
        steps[0], done[:] = now, known
        found = words(env_steps=[12000, 7000.5, 30000])
        if expected is None:
            assert found == []
        elif expected == "certify":
            assert found[-5:] == certify
        else:
            assert found[-1] == (f"--set={expected}" if expected else run[-1])
            assert "run" in found
    assert Certifying().next_limits(planned, None, ended=False) == {}
    for now, known, expected in (
        (0, [], ["--set=budget.env_steps=9000", "--set=budget.cpu_s=55.5"]),
        (6000, [], certify[-2:]),
        (6000, [6000], ["--set=budget.env_steps=9000", "--set=budget.cpu_s=120"]),
        (9000, [6000, 9000], ["--log=wandb", "--set=budget.cpu_s=120"]),
        (12000, [6000, 12000], run[1:]),
    ):
        steps[0], done[:] = now, known
        assert words(env_steps=[9000], cpu_s=[120, 55.5])[-len(expected) :] == expected


def test_the_page_of_a_sweep_over_several_tasks_needs_bounds_and_says_where_to_give_them(tmp_path, monkeypatch, capsys):
    def wrote(folders, file, *, bounds):
        if not bounds:
            raise ConfigError("task.environment differs", field="task.environment")
        return [(folders, file, bounds)]

    monkeypatch.setattr(write, "write_comparison", wrote)
    run, shown = SweptRun("a", tmp_path / "a", {}, "finished", {"generation": 1}), []
    _compare([run], tmp_path, {}, shown.append)
    assert "task.environment differs (--bounds of sweep and report)" in " ".join(capsys.readouterr().err.split())
    _compare([run], tmp_path, {"a": (0.0, 1.0)}, shown.append)
    assert shown == [([run.folder], tmp_path / "report.html", {"a": (0.0, 1.0)})]


def test_bounds_of_tasks_are_checked_before_a_run_starts():
    tasks = {"ant_maze", "point_maze"}
    _check_bounds({}, tasks)
    _check_bounds({"ant_maze": (0.0, 1.0), "point_maze": (-130.0, -25.0)}, tasks)
    with pytest.raises(
        ConfigError, match="the task point_maz is unknown; must be ant_maze or point_maze; did you mean"
    ):
        _check_bounds({"ant_maze": (0.0, 1.0), "point_maz": (-130.0, -25.0)}, tasks)
    with pytest.raises(ConfigError, match="bounds: point_maze has none; name the fitness"):
        _check_bounds({"ant_maze": (0.0, 1.0)}, tasks)


def test_a_run_that_cannot_be_started_has_failed_and_the_others_are_tried(tmp_path):
    names = ["seed=0", "seed=1"]
    for name in names:
        (tmp_path / INSIDE / f"{name}.log").mkdir(parents=True)
    runs = sweep(MINIMAL, tmp_path, seeds=range(2))
    assert [(run.name, run.state) for run in runs] == [(name, "failed") for name in names]
    assert all("its process cannot be started" in run.reason for run in runs)


def config(**compute):
    return load_config(MINIMAL | {"search": {"algorithm": "es", "pairs": 512}, "compute": compute})


def test_runs_share_the_cores_of_a_machine():
    def divided(parallel, *runs, cores=12):
        found = divide(runs, parallel, [cores], drivers=cores)
        return found.at_once, found.workers

    auto, three = config(), config(workers=3)
    assert divided(4, *[auto] * 5) == (4, (3,) * 5)
    assert divided(None, auto, auto) == (2, (6, 6))
    assert divided(None, *[auto] * 20) == (12, (1,) * 20)
    assert divided(5, *[auto] * 20) == (5, (2,) * 20)
    assert divided(40, *[auto] * 20) == (20, (1,) * 20)
    assert divided(1, auto, auto) == (1, ("auto", "auto"))
    assert divided(None, auto) == (1, ("auto",))
    assert divided(None, *[three] * 20) == (4, (3,) * 20)
    assert divided(6, *[three] * 20) == (6, (3,) * 20)
    assert divided(2, auto, auto, cores=64) == (2, (8, 8)), "a generation has eight chunks of work"
    gpu = config(engine="ray", worker_resources={"gpu": 1})
    assert divided(None, gpu, gpu) == (1, ("auto", "auto"))
    two = config(engine="ray", worker_resources={"cpu": 2})
    assert divided(4, *[two] * 4) == (4, (2,) * 4), "workers are a multiple of the cores of an actor"


def test_a_cluster_is_asked_for_its_nodes_only_if_runs_share_it(monkeypatch):
    nodes, asked = [], []
    monkeypatch.setattr(worker_count, "nodes_of_cluster", lambda address: asked.append(address) or nodes)
    auto, two = config(engine="ray", address="head:6379"), config(engine="ray", address="head:6379", workers=2)
    assert worker_count.shared([auto, auto], 1).workers == ("auto", "auto")
    assert worker_count.shared([auto], 4).workers == ("auto",)
    assert worker_count.shared([two, two], 2).workers == (2, 2)
    assert asked == []
    with pytest.raises(ConfigError, match="the cluster at head:6379 has no cores yet that runs could share"):
        worker_count.shared([auto, auto], 2)
    nodes += [4, 4, 4, 4]
    assert worker_count.shared([auto] * 3, 3).workers == (4, 4, 4)
    assert asked == ["head:6379"] * 2
    nodes[:] = [8, 8, 8, 8]
    small = config(engine="ray", address="head:6379", chunk_pairs=16)
    few = small.model_copy(update={"search": small.search.model_copy(update={"pairs": 9 * 16})})
    assert worker_count.shared([few] * 2, 2).workers == (16, 16), "two actors of a node, not nine of one core"
    with pytest.raises(ConfigError, match="parallel: 0 is not allowed"):
        worker_count.shared([auto], 0)
    with pytest.raises(ConfigError, match="50000 workers are too many for this machine"):
        worker_count.shared([config(), config(workers=50_000)])


@given(st.integers(1, 9), st.integers(1, 64), st.integers(1, 40))
def test_every_run_has_room_on_equal_nodes(nodes, cores, at_once):
    """With actors of the size that a run then chooses, on which it waits for a node with so many free cores."""
    each = share([cores] * nodes, at_once)
    assert 1 <= each <= max(1, nodes * cores // at_once)
    if at_once > nodes * cores:
        return
    size = actor_cores([cores] * nodes, each, None)
    assert nodes * (cores // size) >= at_once * (each // size)


def test_unequal_nodes_have_actors_of_one_core():
    assert share([4, 16], 3) == 6
    assert actor_cores([4, 16], 6, None) == 1


ROW = {"generation": 12_345, "best_fitness": -1234.5, "env_steps": 10**10, "steps_per_second": 1e6, "map_cells": 400}


@pytest.mark.parametrize(("width", "height"), [(40, 24), (80, 24), (80, 10), (120, 40)])
def test_the_table_fits_the_screen_and_keeps_the_runs_that_run(tmp_path, width, height):
    states = ["finished"] * 30 + ["failed"] + ["running"] * 3 + ["waiting"] * 30
    runs = [
        SweptRun(f"sigma=0.05_[x]_seed={number}", tmp_path, {"generations": 20_000}, state, ROW)
        for number, state in enumerate(states)
    ]
    console = Console(width=width, height=height, force_terminal=False)
    with console.capture() as capture:
        console.print(live_table("[sweep]", runs, width, height))
    lines = capture.get().splitlines()
    assert len(lines) <= height
    assert all(len(line) <= width for line in lines)
    assert sum("running" in line for line in lines if "│" in line) == (3 if height >= 24 else 1)
    assert "3 running, 1 failed, 30 waiting, 30 finished" in " ".join(" ".join(lines).split())
