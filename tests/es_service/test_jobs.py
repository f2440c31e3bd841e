"""What is refused before a job is sent. Jobs need a cluster: `tests/system/test_cluster.py`."""

from __future__ import annotations

import re
import sys

import pytest
from typer.testing import CliRunner

from es_service import cli_jobs, jobs
from es_service.api import load_config
from es_service.cli import app
from es_service.config.yaml_text import dump_yaml
from es_service.errors import ConfigError, EvaluationError

CONFIG = load_config(
    {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
)


def test_without_the_extra_the_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    with pytest.raises(
        EvaluationError, match=r"extra `cluster`.*in a clone .*pip install .*'\.\[cluster\]'\. `es-service"
    ):
        jobs.submit(CONFIG, "http://127.0.0.1:8265", "/runs/x")


@pytest.mark.parametrize(
    ("address", "host"),
    [
        ("node:6379", "node"),
        ("10.0.0.1", "10.0.0.1"),
        ("ray://10.0.0.1:10001", "10.0.0.1"),
        ("[::1]:8265", "[::1]"),
        ("ray://[::1]:10001", "[::1]"),
        ("[::1", "127.0.0.1"),
        ("auto", "127.0.0.1"),
        ("", "127.0.0.1"),
    ],
)
def test_the_address_is_that_of_the_dashboard(address, host):
    suggestion = f"--address {address}: must be the URL of the cluster's dashboard, such as http://{host}:8265"
    with pytest.raises(ConfigError, match=f"^{re.escape(suggestion)}$"):
        jobs.list_jobs(address)


def test_a_relative_folder_is_refused():
    with pytest.raises(ConfigError, match=r"--out runs/x: must be absolute"):
        jobs.submit(CONFIG, "http://127.0.0.1:8265", "runs/x")


def test_where_nothing_answers_the_error_says_what_to_check():
    with pytest.raises(EvaluationError, match=r"the cluster at http://127\.0\.0\.1:1 did not do it: .*RAY_AUTH_TOKEN"):
        jobs.list_jobs("http://127.0.0.1:1")


@pytest.mark.parametrize("start", ["runs/a", "~/runs/a"])
@pytest.mark.parametrize("in_file", [True, False])
def test_a_start_that_is_another_folder_on_the_head_is_refused(tmp_path, start, in_file):
    file = tmp_path / "config.yaml"
    search = {"algorithm": "es"} | ({"init_from": start} if in_file else {})
    file.write_text(dump_yaml({"task": {"environment": "point_maze"}, "search": search, "budget": {"generations": 1}}))
    set_ = [] if in_file else [f"search.init_from={start}"]
    with pytest.raises(ConfigError, match=rf"search\.init_from: {start} must be absolute"):
        cli_jobs.submit(file, "http://127.0.0.1:1", "/runs/x", set_=set_)
    with pytest.raises(EvaluationError, match="did not do it"):  # past this check: nothing answers there
        cli_jobs.submit(file, "http://127.0.0.1:1", "/runs/x", set_=["search.init_from=/runs/a"])


def test_help_tells_commands_of_a_cluster_from_those_of_this_machine():
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "100"}).stdout
    here, there = shown.split("Cluster jobs")
    for command in ("submit", "jobs", "logs", "stop"):
        assert f" {command} " in there
        assert f"│ {command} " not in here
    assert "│ run " in here
