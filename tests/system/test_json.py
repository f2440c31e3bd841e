"""`--json`: the same as the tables show, as data that a program can read."""

from __future__ import annotations

import json
import math

import pytest
from typer.testing import CliRunner

from es_service import open_run
from es_service.cli import doctor, jobs
from es_service.cli.common import print_json
from es_service.cli.main import app
from es_service.config.given import shipped_configs
from es_service.errors import ConfigError
from es_service.runs.jobs import Job
from es_service.store.digest import checked_parts
from tests.system.command_line import command
from workers.environments import SHIPPED


def said(*words, code=0):
    """What a command prints, read as strict JSON."""
    result = CliRunner().invoke(app, [*map(str, words), "--json"])
    assert result.exit_code == code, result.output

    def refused(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(result.stdout, parse_constant=refused)


def test_status_is_a_list_of_runs_in_the_order_given(finished, tmp_path):
    ours, gone = said("status", finished[0], tmp_path, code=1)
    run = open_run(finished[0])
    assert (ours["run"], ours["run_id"], ours["algorithm"], ours["seed"]) == (
        str(finished[0]),
        run.run_id,
        "nsra_es",
        0,
    )
    assert ours["newest"].keys() == {column.name for column in run.meta.columns}
    assert (ours["newest"]["generation"], ours["limits"], ours["driver"]) == (30, {"generations": 30}, None)
    assert "finished" in ours["state"]
    weight = ours["newest"]["fitness_weight"]
    newest = {"centres": 1, "exploring": int(weight == 0), "exploiting": int(weight == 1), "fitness_weight": weight}
    assert ours["objectives"]["newest"] == newest
    assert ours["objectives"]["recent"]["centres"] == 30
    assert gone["run"] == str(tmp_path)
    assert "is not a run folder" in gone["error"]
    assert said("status", finished[0]) == [ours]


def test_no_run_is_an_empty_list(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said("status") == []


def test_status_does_not_follow_in_json(finished):
    result = CliRunner().invoke(app, ["status", str(finished[0]), "--follow", "--json"])
    assert isinstance(result.exception, ConfigError)


def test_digest_has_its_parts_and_whether_it_is_mixed(finished):
    parts, _ = checked_parts(finished[0])
    assert said("digest", finished[0]) == {"digest": open_run(finished[0]).digest(), "mixed": False, "parts": parts}


def test_list_names_what_the_tables_name():
    found = said("list")
    assert [task["name"] for task in found["tasks"]] == list(SHIPPED)
    assert found["configs"] == list(shipped_configs())
    assert "me_es" in found["algorithms"]
    assert {"key", "literature", "uber"} <= found["presets"][0].keys()


def test_doctor_ends_with_1_if_a_check_fails(monkeypatch):
    for name in ("_rollout", "_vectors", "_ray", "_machine", "_disk", "_software"):
        monkeypatch.setattr(doctor, name, lambda: iter(()))
    (noise,) = said("doctor")
    assert noise["level"] == "ok"
    monkeypatch.setattr(doctor, "_disk", lambda: iter([("FAIL", "no space [left]")]))
    assert said("doctor", code=1) == [{"level": "FAIL", "text": "no space [left]"}, noise]


def test_jobs_are_a_list(monkeypatch):
    monkeypatch.setattr(jobs.jobs, "list_jobs", lambda address: [Job("es-1", "RUNNING", "/runs/a", 5)])
    found = said("jobs", "--address", "http://head:8265")
    assert found == [{"id": "es-1", "state": "RUNNING", "folder": "/runs/a", "started_ms": 5}]


def test_numbers_that_json_does_not_have_are_null(capsys):
    print_json({"a": [math.nan, -math.inf, 1.5], "b": (1, True, None)})
    assert json.loads(capsys.readouterr().out) == {"a": [None, None, 1.5], "b": [1, True, None]}


@pytest.mark.parametrize(
    "name", ["status", "list", "digest", "doctor", "jobs", "verify", "run", "resume", "fork", "sweep", "submit"]
)
def test_each_command_that_prints_a_table_has_the_option(name):
    assert "--json" in CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "200"}).output


def test_a_run_and_a_sweep_print_a_line_for_each_row(tmp_path, one_process):
    small = ["point_maze_es", "--engine", "inline", "--set", "search.pairs=2", "--set", "search.evaluation_episodes=1"]
    small += ["--set", "task.episode_steps=5", "--set", "budget.generations=2", "--set", "policy.hidden=[4]"]

    def lines(*words):
        result = CliRunner().invoke(app, [*words, "--json"], catch_exceptions=False)
        assert result.exit_code == 0
        return [json.loads(line) for line in result.stdout.splitlines()]

    *rows, end = lines("run", *small, "--out", str(tmp_path / "run"))
    assert [row["generation"] for row in rows] == [0, 1, 2]
    assert end == {"run": str(tmp_path / "run"), "is_finished": True, "reason": end["reason"]}
    *rows, end = lines("resume", str(tmp_path / "run"), "--set", "budget.generations=3")
    assert [row["generation"] for row in rows] == [3]


@pytest.mark.slow
def test_a_sweep_prints_a_line_for_each_run_that_has_changed_and_the_comparison(tmp_path):
    words = ["sweep", "point_maze_es", "--engine", "inline", "--set", "search.pairs=2", "--set", "task.episode_steps=5"]
    words += ["--set", "budget.generations=1", "--seeds", "0:2", "--out", str(tmp_path / "swept"), "--json"]
    result = command(*words)
    assert result.returncode == 0, result.stderr
    told = [json.loads(line) for line in result.stdout.splitlines()]
    states = {(line["run"], line["state"]) for line in told if "run" in line}
    assert {("seed=0", "running"), ("seed=0", "finished"), ("seed=1", "finished")} <= states
    assert told[-1] == {"report": str(tmp_path / "swept" / "report.html")}
    assert {line["newest"]["generation"] for line in told if line.get("state") == "finished"} == {1}
