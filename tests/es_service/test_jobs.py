"""What a job is sent, and what is refused before. Jobs need a cluster: `tests/system/test_cluster.py`."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from es_service.api import load_config
from es_service.cli import jobs as cli_jobs
from es_service.cli import sweep
from es_service.cli.common import error_message
from es_service.cli.main import app
from es_service.config.given import parse_overrides
from es_service.config.text import dump_yaml
from es_service.errors import ConfigError, EvaluationError, StoreError
from es_service.protocol.sources import driver_sources, worker_sources
from es_service.runs import jobs
from es_service.runs.jobs import CONFIG as SENT_CONFIG
from es_service.runs.jobs import JobPackage, run_package, write_package

ROOT = Path(__file__).parents[2]
CONFIG = load_config(
    {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
)


def test_without_the_extra_the_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    with pytest.raises(EvaluationError, match="extra `cluster`") as error:
        jobs.submit(run_package(CONFIG, "/runs/x"), "http://127.0.0.1:8265")
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
        run_package(CONFIG, "runs/x")


SEARCH = """
import sortedcontainers
from es_service.search.algorithms.es import es
from . import steps
import sent_numbers

def search(config):
    return es(config)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The working folder of a user with a search in a package, a module that it imports, and other files."""
    here = tmp_path / "here"
    (here / "sent_searches").mkdir(parents=True)
    for name, text in {
        "sent_searches/__init__.py": "",
        "sent_searches/first.py": SEARCH,
        "sent_searches/steps.py": "import json\n",
        "sent_searches/data.npz": "data",
        "sent_numbers.py": "import numpy\n",
        "my_notes.py": "",
        "config.yaml": dump_yaml(
            {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
        ),
    }.items():
        (here / name).write_text(text)
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield here
    for name in [name for name in sys.modules if name.partition(".")[0] in ("sent_searches", "sent_numbers")]:
        del sys.modules[name]


@pytest.fixture
def submitted(monkeypatch):
    """A function that submits with the command line, and returns (package, printed text), and sends nothing."""
    sent: list[JobPackage] = []
    monkeypatch.setattr(jobs, "submit", lambda package, address: sent.append(package) or "es-1")

    def submit(*words):
        command = ["submit", "config.yaml", "--address", "http://h:8265", "--out", "/runs/x", *words]
        result = CliRunner().invoke(app, command)
        if result.exception is not None:
            raise result.exception
        return sent.pop(), result.output

    return submit


OWN = "search.algorithm=sent_searches.first:search"


def test_the_files_that_count_as_code_are_sent_and_have_the_same_hashes_there(own, submitted, tmp_path, monkeypatch):
    """So a worker there is not refused, and the run records the code that was sent."""
    package, printed = submitted("--set", OWN)
    files = ["sent_numbers.py", "sent_searches/__init__.py", "sent_searches/first.py", "sent_searches/steps.py"]
    assert list(package.files) == files
    assert f"sent with it: {', '.join(files)}\n" in printed
    assert "so the cluster must have: sortedcontainers\n" in printed, "not numpy, which es-service itself needs"
    assert printed.startswith("es-1\n")
    there = tmp_path / "there"
    there.mkdir()
    write_package(package, there)
    assert sorted(str(file.relative_to(there)) for file in there.rglob("*.*")) == [SENT_CONFIG, *files]
    config = load_config(there / SENT_CONFIG)
    assert (config.search.algorithm, config.compute.address) == ("sent_searches.first:search", "auto")
    here = driver_sources(config.search.algorithm)
    monkeypatch.chdir(there)
    print_code = "import json\nfrom es_service.protocol.sources import *\n"
    print_code += f"print(json.dumps([driver_sources({config.search.algorithm!r}), worker_sources('point_maze')]))"
    environment = {"PYTHONPATH": f"{there}:{ROOT}"}
    process = subprocess.run([sys.executable, "-c", print_code], env=environment, capture_output=True, check=True)
    assert json.loads(process.stdout) == [here, worker_sources("point_maze")]


def test_the_module_of_a_descriptor_is_sent(own, submitted):
    (own / "sent_numbers.py").write_text("def place(episode):\n    return [0.0]\n")
    task = ("task.environment=python:tests.workers.host_tasks:CornerMaze", "task.descriptor=sent_numbers:place")
    package, _ = submitted(*(word for key in task for word in ("--set", key)), "--set", "map.bounds=[[0,1]]")
    assert "sent_numbers.py" in package.files


def test_an_installed_package_is_not_sent_but_named(own, submitted, monkeypatch):
    place = own / "site-packages"
    (own / "sent_searches").rename(place.with_name("moved"))
    place.mkdir()
    (own / "moved").rename(place / "sent_searches")
    monkeypatch.syspath_prepend(place)
    package, printed = submitted("--set", OWN)
    assert package.files == {}
    assert "sent with it" not in printed
    assert "not sent, so the cluster must have: sent_searches\n" in printed


def test_a_module_that_is_not_found_here_is_refused_before_anything_is_sent(own, submitted):
    for key, module in (("search.algorithm", "my_serches"), ("task.environment", "my_taks")):
        with pytest.raises(ConfigError, match=rf"{key}: .*cannot import {module} .*; start in the folder that"):
            submitted("--set", f"{key}={module}:Name")


def test_a_job_is_told_as_a_line_of_json(own, submitted):
    _, printed = submitted("--set", OWN, "--json")
    told = json.loads(printed.splitlines()[-1])
    assert (told["job"], told["folder"], told["expected"]) == ("es-1", "/runs/x", ["sortedcontainers"])
    assert "sent_searches/first.py" in told["sent"]


def test_shipped_tasks_and_searches_send_nothing(own, submitted):
    package, printed = submitted()
    assert (package.files, package.expected) == ({}, ())
    assert package.command == ("run", SENT_CONFIG, "--or-resume", "--out", "/runs/x")
    assert "sent" not in printed.replace("submitted", "")


def test_a_sweep_is_sent_with_its_options_and_the_modules_of_all_its_runs(own, submitted, tmp_path):
    """The config is sent as it is, since presets and derived values depend on the settings of each run."""
    grid = ("--grid", f"{OWN},es", "--grid", "policy.hidden=[8],[16, 16]")
    (tmp_path / "runs").mkdir()
    package, _ = submitted(*grid, "--seeds", "0:2", "--parallel", "2", "--workers", "3", "--set", "search.pairs=32")
    assert package.config == (own / "config.yaml").read_text()
    assert "sent_searches/first.py" in package.files
    out: list[Any] = []

    def took(configs, out_, wanted, values, seeds, parallel, options, certifying, bounds, as_json):
        out.append((str(configs[0].source), str(out_), wanted, values, seeds, parallel))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "run_sweep", took)
        assert CliRunner().invoke(app, list(package.command)).exit_code == 0
    [(config, folder, wanted, values, seeds, parallel)] = out
    assert (config, folder, seeds, parallel) == (SENT_CONFIG, "/runs/x", "0:2", 2)
    assert values == {"search.algorithm": ["sent_searches.first:search", "es"], "policy.hidden": [[8], [16, 16]]}
    settings = parse_overrides(wanted)[0]
    assert (settings["search.pairs"], settings["compute.workers"]) == (32, 3)
    assert (settings["compute.engine"], settings["compute.address"]) == ("ray", "auto")


def test_what_a_sweep_refuses_is_refused_before_it_is_sent(own, submitted):
    for words, message in (
        (("--grid", "search.sigma=0.1,big"), "search.sigma: big is not allowed"),
        (("--grid", "search.init_from=/runs/a,runs/b"), "search.init_from: runs/b must be an absolute path"),
        (("--grid", "search.sigma=0.1", "--seeds", "x"), "--seeds x: x is no seed"),
        (("--seeds", "0:2", "--seed", "1"), "seed: it has values in the sweep, and 1 for all runs"),
        (("--parallel", "2"), "--parallel is for a sweep"),
    ):
        with pytest.raises(ConfigError) as error:
            submitted(*words)
        assert message in str(error.value)


def test_where_nothing_answers_the_error_says_what_to_check():
    with pytest.raises(EvaluationError, match=r"the Ray job request to http://127\.0\.0\.1:1 failed: .*RAY_AUTH_TOKEN"):
        jobs.list_jobs("http://127.0.0.1:1")


class Cluster:
    """Ray's client, for a job that ends after a while, and a clock that only sleeping moves."""

    def __init__(self, monkeypatch, ends_s: float) -> None:
        self.now_s, self.ends_s, self.clients, self.sent = 0.0, ends_s, 0, []
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

    def list_jobs(self) -> list[SimpleNamespace]:
        state, metadata = self.get_job_status("es-1"), {jobs.FOLDER: "/runs/x"}
        return [SimpleNamespace(submission_id="es-1", status=state, metadata=metadata, start_time=1)]

    def submit_job(self, submission_id: str, **job: Any) -> str:
        self.sent.append(job)
        return submission_id

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


def test_a_folder_that_a_running_job_writes_to_is_refused_before_anything_is_sent(monkeypatch):
    cluster, package = Cluster(monkeypatch, ends_s=3.0), run_package(CONFIG, "/runs/x/")
    with pytest.raises(StoreError, match="the job es-1, which is RUNNING, has the folder /runs/x/, too; choose"):
        jobs.submit(package, "http://head:8265")
    assert not cluster.sent
    cluster.now_s = 4.0
    assert jobs.submit(package, "http://head:8265").startswith("es-")
    assert len(cluster.sent) == 1


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
