"""`status`, `digest`, `report` and `evaluate` of sweeps and of several runs: one that is damaged hides no other."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from es_service import api, open_run
from es_service.cli.evaluate import csv_file
from es_service.cli.main import app
from es_service.errors import ConfigError, Interrupted, NotInRunError, StoreError
from es_service.runs import evaluation
from es_service.runs.run_status import newest_runs, runs_of
from es_service.runs.sweep import INSIDE
from es_service.store.lock import acquire_lock
from tests.database import execute
from tests.run_examples import write_run

pytestmark = pytest.mark.usefixtures("workers_here")

SEEDS = (0, 2, 10)


def es(*words):
    """Run a command of which it is known that it raises no error: (exit code, stdout, stderr)."""
    result = CliRunner().invoke(app, [*map(str, words)], env={"COLUMNS": "300"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def sweep(tmp_path):
    """A sweep with three runs, and one that waits."""
    folder = tmp_path / "sweep"
    for seed in SEEDS:
        write_run(folder / f"seed={seed}", {"seed": seed, "map.cells": [4, 4]})
    (folder / INSIDE).mkdir()
    for seed in (*SEEDS, 11):
        (folder / INSIDE / f"seed={seed}.yaml").touch()
    acquire_lock(folder / INSIDE).release()
    return folder


def damage(run: Path) -> None:
    (run / "run.db").write_bytes(b"no database")


def test_a_folder_stands_for_its_runs_in_the_order_of_their_numbers(tmp_path):
    names = ["sigma=0.05_seed=2", "sigma=0.05_seed=10", "sigma=0.1_seed=1"]
    for name in reversed(names):
        write_run(tmp_path / name)
    (tmp_path / "notes").mkdir()
    assert runs_of(tmp_path) == [tmp_path / name for name in names], "without the folder .sweep, too"
    assert runs_of(tmp_path / names[0]) == [tmp_path / names[0]]


def test_what_an_interrupted_creation_left_is_no_run(tmp_path):
    """`run` creates a run beside its place, under a hidden name, and then renames it."""
    run = write_run(tmp_path / "seed=0")
    shutil.copytree(run, tmp_path / ".seed=1.creating")
    assert runs_of(tmp_path) == newest_runs(tmp_path) == [run]
    shutil.rmtree(run)
    assert runs_of(tmp_path) == [tmp_path]
    assert newest_runs(tmp_path) == []
    with pytest.raises(StoreError, match="and no run folders, as a sweep does"):
        es("status", tmp_path)


def test_status_of_a_sweep_is_a_line_for_each_run(sweep):
    code, printed, _ = es("status", sweep)
    lines = [line.split() for line in printed.splitlines()[1:]]
    assert (code, [Path(line[0]).name for line in lines]) == (0, [f"seed={seed}" for seed in (*SEEDS, 11)])
    assert [line[3] for line in lines] == ["0", "2", "10", "-"]
    assert printed.splitlines()[4].endswith("not started")
    (sweep / INSIDE / "seed=11.log").write_text("error: no space\n")
    assert (
        es("status", sweep)[1].splitlines()[4].endswith(f"not started; its output is in {sweep}/{INSIDE}/seed=11.log")
    )
    damage(sweep / "seed=2")
    code, printed, _ = es("status", sweep, sweep / "seed=10")
    states = [line.partition("error:")[1] for line in printed.splitlines()[1:]]
    assert (code, states) == (1, ["", "error:", "", "", ""])
    code, printed, _ = es("status", sweep, "--json")
    assert code == 1
    first, damaged, _, waits = json.loads(printed)
    assert (first["seed"], first["newest"]["generation"]) == (0, 20)
    assert damaged.keys() == {"run", "error"}
    assert waits == {"run": str(sweep / "seed=11"), "state": "not started", "newest": None}


def test_one_run_of_several_is_followed(sweep):
    with pytest.raises(ConfigError, match=r"--follow: needs one run; .*sweep has several: seed=0, seed=2, seed=10"):
        es("status", sweep, "--follow")


def test_digests_are_a_line_for_each_run(sweep):
    runs = [sweep / f"seed={seed}" for seed in SEEDS]
    digests = [open_run(run).digest() for run in runs]
    lines = [f"{digest}  {run}" for digest, run in zip(digests, runs, strict=True)]
    code, printed, notes = es("digest", sweep)
    assert (code, printed.splitlines()) == (0, lines)
    assert notes == f"note: {sweep}/seed=11 has not started\n"
    assert es("digest", runs[2], runs[0])[1].splitlines() == [lines[2], lines[0]]
    assert es("digest", runs[0])[1] == f"{digests[0]}\n", "of one run, the digest alone"
    damage(runs[1])
    code, printed, notes = es("digest", sweep)
    assert (code, printed.splitlines()) == (1, [lines[0], lines[2]])
    assert f"error: {runs[1]} is not a run folder: file is not a database" in notes
    code, printed, _ = es("digest", sweep, "--json")
    *sound, damaged = json.loads(printed)
    assert [(one["run"], one["digest"]) for one in sound] == [(str(runs[0]), digests[0]), (str(runs[2]), digests[2])]
    assert (code, damaged["run"], damaged.keys()) == (1, str(runs[1]), {"run", "error"})
    assert json.loads(es("digest", runs[0], "--json")[1]).keys() == {"digest", "mixed", "parts"}


def test_the_report_of_a_sweep_compares_its_runs_in_its_folder(sweep, tmp_path):
    code, printed, notes = es("report", sweep)
    assert (code, printed) == (0, f"{sweep}/report.html\n")
    assert notes == f"note: {sweep}/seed=11 has not started\n"
    page = (sweep / "report.html").read_text()
    assert all(f"seed={seed}" in page for seed in SEEDS)

    damage(sweep / "seed=2")
    begun = write_run(tmp_path / "begun")
    execute(begun, "DELETE FROM history")
    code, printed, notes = es("report", sweep, begun, "--out", tmp_path / "page.html")
    assert (code, printed) == (1, f"{tmp_path}/page.html\n")
    assert f"error: {sweep}/seed=2 " in notes
    assert f"note: {begun} is left out, since it has no finished generation yet" in notes
    page = (tmp_path / "page.html").read_text()
    assert "seed=0" in page
    assert "seed=2" not in page
    for words, error, message in (
        ((sweep, "--replay", "best"), ConfigError, "--replay: shows policies of one run"),
        ((sweep, begun), ConfigError, "add --out FILE"),
        ((begun, begun, "--out", tmp_path / "b.html"), NotInRunError, "no run with a finished generation"),
    ):
        with pytest.raises(error, match=message):
            es("report", *words)


def test_evaluate_prints_one_table_of_all_runs(sweep, tmp_path):
    damage(sweep / "seed=2")
    runs = [f"{sweep}/seed={seed}" for seed in (0, 10)]
    options = ("--episodes", 2, "--workers", 1)
    code, printed, notes = es("evaluate", sweep, *options, "--json", "--out", tmp_path / "rows.csv")
    *found, damaged = json.loads(printed)
    assert [(one["run"], one["policy"]) for one in found] == [(run, "best") for run in runs]
    assert (code, damaged["run"], damaged.keys()) == (1, f"{sweep}/seed=2", {"run", "error"})
    assert f"error: {sweep}/seed=2 " in notes
    rows = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    assert rows == [{key: str(value) for key, value in one.items()} for one in found]

    alone = json.loads(es("evaluate", runs[0], *options, "--json")[1])
    assert alone == [{key: value for key, value in found[0].items() if key != "run"}]
    code, printed, _ = es("evaluate", sweep / "seed=2", runs[0], *options)
    head, line = printed.splitlines()
    assert (code, head.split()[:2], line.split()[:2]) == (1, ["run", "policy"], [runs[0], "best"])
    assert head.index(" policy ") == line.index(" best "), "the columns are aligned"


def test_each_row_of_several_runs_is_written_as_soon_as_it_is_printed(sweep, tmp_path, monkeypatch):
    """A run may have thousands of elites, and an evaluation may be interrupted."""
    evaluated = evaluation.evaluate

    def interrupted(run, chosen, *others, **named):
        """Stop after two policies of the second run."""
        for number, fresh in enumerate(evaluated(run, chosen, *others, **named)):
            if run.folder.name == "seed=2" and number == 2:
                raise Interrupted(2)
            yield fresh

    monkeypatch.setattr(evaluation, "evaluate", interrupted)
    command = ("evaluate", sweep, "--all", "--episodes", "1", "--workers", "1", "--out", str(tmp_path / "rows.csv"))
    stopped = CliRunner().invoke(app, [*map(str, command)], env={"COLUMNS": "300"})
    assert stopped.exit_code == 130
    written = list(csv.DictReader((tmp_path / "rows.csv.new").read_text().splitlines()))
    printed = [line.split()[:2] for line in stopped.stdout.splitlines() if line.startswith(str(sweep))]
    assert [[row["run"], row["policy"]] for row in written] == printed
    assert [row["run"] for row in written].count(f"{sweep}/seed=2") == 2


def test_too_many_workers_end_an_evaluation_before_its_first_run(sweep, tmp_path):
    """It is the option that is wrong, so the exit code is 2; it is not a problem of each run."""
    damage(sweep / "seed=0")
    with pytest.raises(ConfigError, match=r"compute\.workers: 100000 workers are too many") as refused:
        es("evaluate", sweep, "--workers", 100_000)
    assert refused.value.field == "compute.workers"


def test_rows_of_other_descriptors_are_not_put_into_one_file(tmp_path):
    message = r"rows\.csv: its columns are run, x, and this run has run, y; evaluate runs with other descriptors sep"
    with csv_file(tmp_path / "rows.csv", lambda note: None) as write:
        write({"run": "a", "x": 1})
        with pytest.raises(ConfigError, match=message):
            write({"run": "b", "y": 1})


def test_a_folder_that_is_neither_is_said_to_be_neither(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for name, what in (
        ("empty", "contains no run.db, and no run folders, as a sweep does"),
        ("file", "is a file"),
        ("gone", "does not exist"),
    ):
        for command in ("status", "digest", "report", "evaluate"):
            with pytest.raises(StoreError, match=f"{name} is not a run folder: it {what}"):
                es(command, tmp_path / name)
    write_run(tmp_path / "sweep" / "seed=0")
    with pytest.raises(StoreError, match=r"sweep is not a run folder, but contains the run folder .*seed=0"):
        es("verify", tmp_path / "sweep")


def test_the_report_of_a_sweep_over_an_option_of_the_task_groups_by_it(tmp_path):
    """Runs of other tasks are not compared otherwise."""
    given = {
        "task": {"environment": "point_maze", "episode_steps": 10},
        "policy": {"hidden": [4]},
        "search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 1},
        "map": {"enabled": False},
        "budget": {"generations": 1},
        "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
    }
    for start in ("default", "corner"):
        api.run(api.load_config(given, {"task.options.start": start}), tmp_path / "sweep" / f"start={start}")
    code, printed, _ = es("report", tmp_path / "sweep")
    assert code == 0, printed
    page = (tmp_path / "sweep" / "report.html").read_text()
    assert "start = default" in page
    assert "start = corner" in page
