"""Trackers on the command line: a run that is resumed, and a tracker that fails."""

from es_service import open_run
from es_service.runs.tracking import TensorBoard
from tests.es_service.test_trackers import events
from tests.system.command_line import es


def test_a_run_survives_a_tracker_that_fails_and_fills_it_when_resumed(tmp_path):
    folder = tmp_path / "run"
    small = ("--set", "search.pairs=4", "--set", "task.episode_steps=20")
    code, printed = es("run", "point_maze_me_es", *small, "--set", "budget.generations=2", "--out", folder)
    assert code == 0, printed

    (folder / "tensorboard").write_text("no folder")
    code, printed = es("resume", folder, "--set", "budget.generations=4", "--log", "tensorboard")
    assert code == 0, printed
    assert printed.count("the tracker tensorboard failed") == 1
    assert open_run(folder).generation == 4

    (folder / "tensorboard").unlink()
    code, printed = es("resume", folder, "--set", "budget.generations=5", "--log", "tensorboard")
    assert (code, "failed" in printed) == (0, False), printed
    assert [event.step for event in events(TensorBoard(open_run(folder)).files())] == list(range(6))
    assert es("export", folder, "--to", "tensorboard")[0] == 0


def test_a_sweep_says_which_of_its_runs_a_tracker_lacks(tmp_path):
    command = ("sweep", "point_maze_me_es", "--seeds", "0:2", "--out", tmp_path / "sweep", "--workers", 1)
    small = ("--set", "search.pairs=4", "--set", "task.episode_steps=20", "--set", "compute.engine=inline")
    code, printed = es(*command, *small, "--set", "budget.generations=1")
    assert code == 0, printed
    (tmp_path / "sweep/seed=1/tensorboard").write_text("no folder")
    code, printed = es(*command, *small, "--set", "budget.generations=2", "--log", "tensorboard")
    assert code == 0, printed
    assert printed.count("the tracker tensorboard failed") == 1
    assert "note: seed=1: the tracker tensorboard failed" in printed


def test_a_missing_tracker_ends_a_run_before_it_begins(tmp_path):
    code, printed = es("run", "point_maze_me_es", "--log", "tensorbord", "--out", tmp_path / "run")
    assert code == 2
    assert "the tracker tensorbord is unknown; must be tensorboard, wandb or mlflow; did you mean" in printed
    assert not (tmp_path / "run").exists()
