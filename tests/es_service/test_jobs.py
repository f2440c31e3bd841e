"""What is refused before a job is sent. Jobs need a cluster: `tests/system/test_cluster.py`."""

from __future__ import annotations

import re
import sys
from collections.abc import AsyncIterator
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from es_service.api import load_config
from es_service.cli import jobs as cli_jobs
from es_service.cli.commands import error_message
from es_service.cli.main import app
from es_service.config.yaml_text import dump_yaml
from es_service.errors import ConfigError, EvaluationError
from es_service.runs import jobs

CONFIG = load_config(
    {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
)


def test_without_the_extra_the_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    with pytest.raises(EvaluationError, match="extra `cluster`") as error:
        jobs.submit(CONFIG, "http://127.0.0.1:8265", "/runs/x")
    install, without = error.value.ways_out
    assert (install.action, install.extra, without.action) == ("install", "cluster", "run")
    assert re.search(r"in a clone .*pip install .*'\.\[cluster\]'", error_message(error.value))


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
    url = f"http://{host}:8265"
    wanted = f"the address {address} must be the URL of the cluster's dashboard, such as {url}"
    with pytest.raises(ConfigError, match=f"^{re.escape(wanted)}$") as error:
        jobs.list_jobs(address)
    assert (error.value.field, error.value.value, error.value.suggestion) == ("address", address, url)


def test_a_relative_folder_is_refused():
    with pytest.raises(ConfigError, match=r"the run folder runs/x must be an absolute path"):
        jobs.submit(CONFIG, "http://127.0.0.1:8265", "runs/x")


def test_where_nothing_answers_the_error_says_what_to_check():
    with pytest.raises(EvaluationError, match=r"the Ray job request to http://127\.0\.0\.1:1 failed: .*RAY_AUTH_TOKEN"):
        jobs.list_jobs("http://127.0.0.1:1")


class Cluster:
    """Ray's client, for a job that ends after a while, and a clock that only sleeping moves."""

    def __init__(self, monkeypatch, ends_s: float) -> None:
        self.now_s, self.ends_s, self.clients = 0.0, ends_s, 0
        clock = SimpleNamespace(monotonic=lambda: self.now_s, sleep=self.sleep)
        monkeypatch.setattr(jobs, "time", clock)
        monkeypatch.setattr(jobs, "_client", self.client)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def client(self, address: str) -> Cluster:
        self.clients += 1
        return self

    def get_job_status(self, job: str) -> SimpleNamespace:
        return SimpleNamespace(value="RUNNING" if self.now_s < self.ends_s else "STOPPED")

    def stop_job(self, job: str) -> None:
        pass

    async def tail_job_logs(self, job: str) -> AsyncIterator[str]:
        for piece in ("one\n", "two\n"):
            yield piece
        raise RuntimeError("the connection closed")


def test_a_log_is_followed_piece_by_piece_and_a_lost_connection_is_told(monkeypatch):
    Cluster(monkeypatch, ends_s=10.0)
    pieces = jobs.logs("job", "http://head:8265", follow=True)
    assert [next(pieces), next(pieces)] == ["one\n", "two\n"]
    with pytest.raises(EvaluationError, match="request to http://head:8265 failed: the connection closed"):
        next(pieces)


def test_a_job_is_stopped_and_waited_for_over_one_connection(monkeypatch):
    cluster = Cluster(monkeypatch, ends_s=3.0)
    assert jobs.stop("job", "http://head:8265") == "STOPPED"
    assert cluster.clients == 1
    cluster.ends_s = 100.0
    with pytest.raises(EvaluationError, match="job is still RUNNING 15 s after"):
        jobs.stop("job", "http://head:8265")


@pytest.mark.parametrize("start", ["runs/a", "~/runs/a"])
@pytest.mark.parametrize("in_file", [True, False])
def test_a_start_that_is_another_folder_on_the_head_is_refused(tmp_path, start, in_file):
    file = tmp_path / "config.yaml"
    search = {"algorithm": "es"} | ({"init_from": start} if in_file else {})
    file.write_text(dump_yaml({"task": {"environment": "point_maze"}, "search": search, "budget": {"generations": 1}}))
    set_ = [] if in_file else [f"search.init_from={start}"]
    with pytest.raises(ConfigError, match=rf"search\.init_from: {start} must be an absolute path"):
        cli_jobs.submit(file, "http://127.0.0.1:1", "/runs/x", set_=set_)
    with pytest.raises(EvaluationError, match="the Ray job request to"):  # past this check: nothing answers there
        cli_jobs.submit(file, "http://127.0.0.1:1", "/runs/x", set_=["search.init_from=/runs/a"])


def test_help_tells_commands_of_a_cluster_from_those_of_this_machine():
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "100"}).stdout
    here, there = shown.split("Cluster jobs")
    for command in ("submit", "jobs", "logs", "stop"):
        assert f" {command} " in there
        assert f"│ {command} " not in here
    assert "│ run " in here
