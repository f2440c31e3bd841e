"""The command line as a user meets it: summaries, options, messages, exit codes."""

from __future__ import annotations

import itertools
import json
import os
import shutil

import pytest
import yaml

from es_service import open_run
from es_service.protocol.machine import cores
from tests.system.command_line import PROGRAM, digest, es
from tests.system.session import ROOT, SMALL


def test_run_ends_in_a_summary_with_the_next_commands(finished):
    folder, printed = finished
    assert "Done: the budget of 30 generations is spent." in printed
    for command in ("status", "report", "evaluate", "digest", "resume", "fork"):
        assert f"{PROGRAM} {command} {folder}" in printed
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "run.db", "run.lock"}


def test_resolved_config_is_complete_and_runs_to_the_same_digest(finished, tmp_path):
    folder, _ = finished
    recorded = yaml.safe_load((folder / "config.yaml").read_text())
    assert recorded["search"]["sigma"] == 0.02
    assert recorded["compute"]["gradient_block_pairs"] == 8
    assert es("run", folder / "config.yaml", "--out", tmp_path / "again")[0] == 0
    assert digest(tmp_path / "again") == digest(folder)


@pytest.fixture
def one_core():
    """Of those that this process has; commands that are given a variable of the environment have no other."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.long
def test_bench_rollouts_prints_a_row_per_policy_batch_and_rollout(one_core):
    words = ("bench", "rollouts", "--task", "point_maze", "--batch", 8, "--seconds", 0, "--json")
    code, printed = es(*words, COLUMNS="80")
    assert code == 0, printed
    rows = [json.loads(line) for line in printed.splitlines()]
    assert {row["policy"] for row in rows} == {"on", "off"}
    assert {(row["policy"], row["rollout"]) for row in rows} == set(itertools.product(("on", "off"), ("xla", "simd")))
    assert {(row["task"], row["batch"], row["cores"]) for row in rows} == {("point_maze", 8, 1)}
    assert all(row["steps_per_second"] > 0 and row["compile_seconds"] >= 0 for row in rows)
    for wrong, message in (
        (("--batch", 7), "must be even"),
        (("--policy", "maybe"), "--policy maybe: must be on or off"),
        (("--task", "ant_maz"), "did you mean ant_maze?"),
        (("--rollout", "gpu"), "--rollout gpu: must be host, xla or simd, or several"),
        (("--task", "brax:ant", "--set", "task.options.backend=mjx2"), "must be "),
        (("--task", "brax:ant", "--set", "task.options.backnd=mjx"), "did you mean backend?"),
        (("--task", "brax:ant", "--set", "search.sigma=1"), "only task.options.NAME can be set here"),
    ):
        code, printed = es("bench", "rollouts", *wrong)
        assert code == 2
        assert message in printed


@pytest.mark.alone
@pytest.mark.long
def test_bench_scaling_predicts_a_row_per_number_of_workers():
    config = ("point_maze_es", "--set", "search.pairs=512")
    code, printed = es("bench", "scaling", *config, "--workers", "1,4,128", "--cores-per-node", 32, "--json")
    assert code == 0, printed
    rows = [json.loads(line) for line in printed.splitlines()]
    assert [row["workers"] for row in rows] == [1, 4, 128]
    assert all(
        set(row) == {"workers", "seconds_per_generation", "steps_per_second", "efficiency", "limit"} for row in rows
    )
    one, four, many = rows
    assert 0.5 < one["efficiency"] <= 1.0
    assert one["seconds_per_generation"] > four["seconds_per_generation"]
    assert four["steps_per_second"] > 1.5 * one["steps_per_second"] > 0
    assert many["efficiency"] < 0.3, "there are eight chunks of rollouts"
    assert many["limit"] in ("too few items", "the driver", "evaluation")
    code, printed = es("bench", "scaling", "point_maze_es", "--workers", "1,none")
    assert (code, "--workers 1,none: must be whole numbers" in printed) == (2, True)
    eight = ("--set", "compute.worker_resources.cpu=8", "--set", "compute.engine=ray")
    code, printed = es("bench", "scaling", "point_maze_es", *eight, "--workers", "16,12")
    assert (code, "8 cores each do not divide 12 workers" in printed) == (2, True)
    assert "efficiency" not in printed, "an error has no heading of a table"


@pytest.mark.long
@pytest.mark.alone
def test_bench_scaling_predicts_a_method_that_asks_for_policies():
    """The last chunk of which is not full."""
    config = ("point_maze_map_elites", "--set", "search.batch=72", "--set", "search.evaluation_episodes=3")
    code, printed = es("bench", "scaling", *config, "--workers", "1,64", "--json")
    assert code == 0, printed
    one, many = map(json.loads, printed.splitlines())
    assert 0.0 < one["efficiency"] <= 1.0, "messages cost much beside chunks that take a millisecond"
    assert many["efficiency"] < 0.3, "there are fourteen chunks"
    assert min(one["steps_per_second"], many["steps_per_second"]) > 0


@pytest.mark.slow
def test_what_simd_cannot_compile_is_said_in_one_line_and_runs_on_xla():
    task = "tests.examples.fourier:Fourier"
    code, printed = es("bench", "rollouts", "--task", task, "--policy", "off", "--batch", 8, "--seconds", 0)
    assert code == 0, printed
    lines = [line for line in printed.splitlines() if line.startswith(task)]
    assert [line.split()[2] for line in lines[:-1]] == ["xla"] * len({1, cores()})
    assert "simd cannot run it: the primitive fft (at " in lines[-1]
    assert "fourier.py:" in lines[-1]
    code, printed = es("bench", "rollouts", "--task", task, "--policy", "on", "--rollout", "simd", "--seconds", 0)
    assert code == 1
    assert "simd cannot run it: the primitive fft" in printed


def test_options_stand_for_keys(config, tmp_path):
    folder = tmp_path / "run"
    code, _ = es(
        "run", config, "--out", folder, "--seed", 5, "--workers", 2, "--engine", "inline",
        "--set", "search.sigma=0.05", "--set", "budget.generations=2",
    )  # fmt: skip
    assert code == 0
    run = open_run(folder)
    assert (run.config["seed"], run.config["search"]["sigma"], run.config["compute"]["workers"]) == (5, 0.05, 2)
    assert run.generation == 2


def test_all_problems_of_a_config_are_one_message_and_exit_code_two(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(SMALL | {"search": SMALL["search"] | {"pairs": 20, "sgima": 0.1}, "budget": None}))
    code, printed = es("run", path, "--out", tmp_path / "run")
    assert code == 2
    for problem in ("3 problems", "did you mean search.sigma?", "try pairs = 24", "budget: null"):
        assert problem in " ".join(printed.split())
    assert not (tmp_path / "run").exists()


def test_bad_paths(config, finished, tmp_path):
    copy = shutil.copytree(finished[0], tmp_path / "copy")
    malformed = tmp_path / "malformed.yaml"
    malformed.write_text("task: {environment: point_maze\nsearch: [\n")
    cases = [
        (("run", tmp_path / "none.yaml"), 2, "no such file"),
        (("run", malformed), 2, "line"),
        (("run", config, "--out", finished[0]), 1, f"es-service resume {finished[0]}"),
        (("run", config, "--out", "/proc/nowhere/run"), 1, "/proc/nowhere"),
        (("run", config, "--set", "search.sigma"), 2, "search.sigma"),
        (("run", config, "--wrokers", "2"), 2, "--workers"),
        (("rnu", config), 2, "run"),
        (("resume", tmp_path), 1, "not a run folder"),
        (("status", tmp_path / "nothing"), 1, "does not exist"),
        (("digest", config), 1, "not a run folder"),
        (("resume", copy, "--set", "search.sigma=0.5", "--set", "seed=3"), 2, "search.sigma: 0.02 -> 0.5"),
        (("resume", copy, "--set", "search.sigma=a", "--set", "budget.generatons=3"), 2, "did you mean budget."),
        (("resume", copy, "--set", "compute.rollout_block_pairs=auto"), 0, "Done: no generation was run, since"),
    ]
    for arguments, expected, message in cases:
        code, printed = es(*arguments)
        assert (code, message in " ".join(printed.split())) == (expected, True), (arguments, code, printed)


def test_a_folder_where_no_runs_folder_can_be_made(config, tmp_path):
    (tmp_path / "runs").write_text("in the way")
    code, printed = es("run", config, cwd=tmp_path)
    assert code == 1
    assert "choose another folder" in printed


def test_unwritable_home_does_not_matter(config, tmp_path):
    code, printed = es("run", config, "--out", tmp_path / "run", HOME="/proc/nowhere", XDG_CACHE_HOME="/proc/nowhere")
    assert code == 0, printed


def test_list_and_doctor(tmp_path):
    code, printed = es("list", COLUMNS="80")
    assert code == 0
    words = " ".join(printed.replace("│", " ").split())
    for wanted in (
        "point_maze a point must reach a goal in a square; two walls block the direct path "
        "observation 2, action 2, steps 200 descriptor: x in [-1, 1], y in [-1, 1] "
        "success: the point is in the goal square of side 0.1 option start: default | corner",
        "brax:NAME any environment",
        "module:Class a task of your own",
        "module:function A search of your own",
        "search.pairs",
    ):
        assert wanted in words
    code, printed = es("doctor", cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert code == 0, printed
    assert "noise equals its" in printed
    assert "FAIL" not in printed
