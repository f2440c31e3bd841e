"""A run that finds the cluster full waits for its first place, and gives back what it asked for if it is stopped."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from es_service.dispatch.waits import NOTICE_S
from es_service.runs.run_status import is_waiting, read_status
from es_service.runs.view import open_run
from es_service.store.digest import digest_parts
from es_service.store.folder import holds_run
from tests.system import cluster
from tests.system.autoscaling import Autoscaled
from tests.system.cluster import Cluster
from tests.system.command_line import es
from tests.system.processes import committed, wait_for
from tests.system.test_cluster import CONFIG, entries, inline_digest

pytestmark = [pytest.mark.long, pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))]
GENERATIONS = 20


def waits(run: Path) -> bool:
    """Whether a run waits, as a reader of its folder sees it."""
    return holds_run(run) and is_waiting(read_status(open_run(run)))


def end(hosts: cluster.Hosts, driver: subprocess.Popen[str], run: Path, number: int) -> str:
    """Send a signal to the driver of a run on the head; what it printed."""
    for pid, line in hosts.processes("head").items():
        if f"{run}" in line and "es-service" in line and "python" in line:
            os.kill(pid, number)
    printed, _ = driver.communicate(timeout=60)
    return printed


def test_a_run_that_finds_the_cluster_full_waits_and_then_ends_with_the_digest_that_it_has_alone(tmp_path):
    """Its wait can be limited or interrupted, and then the cluster knows nothing of it; it is no part of its time."""
    config, first, run = tmp_path / "config.yaml", tmp_path / "first", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG))
    few = ("--or-resume", "--set", f"budget.generations={GENERATIONS}")
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 2)

        def start(folder: Path, *options: object) -> subprocess.Popen[str]:
            words = ("es-service", "run", config, "--out", folder, "--address", hosts.address, *options)
            return hosts.popen("head", *words)

        def nobody_waits() -> bool:
            return "(no resource demands)" in hosts.run("head", "ray", "status")[1]

        holder = start(first)
        wait_for(lambda: (committed(first) or 0) > 3)

        printed, _ = start(run, *few, "--set", "compute.place_timeout_s=3").communicate(timeout=90)
        assert "no worker got a place for 3 s (compute.place_timeout_s)" in printed
        assert "Each worker needs 2 CPU; the cluster has 2 CPU, 0 GPU in total and 0 CPU" in printed
        assert f"es-service resume {run}" in printed
        wait_for(nobody_waits)

        driver = start(run, *few, "--set", "compute.place_timeout_s=null")
        wait_for(lambda: waits(run))
        assert "waiting for a first place in the cluster since 2" in es("status", run)[1]
        wait_for(lambda: "{'CPU': 2.0}: 1+ pending" in hosts.run("head", "ray", "status")[1])
        printed = end(hosts, driver, run, signal.SIGINT)
        assert driver.returncode == 130, printed
        assert "no worker has a place in the cluster; the run waits until there is one. Each worker needs" in printed
        assert not waits(run)
        assert "stopped before its budget was spent" in es("status", run)[1]
        wait_for(nobody_waits)

        began = time.monotonic()
        driver = start(run, *few, "--set", "compute.place_timeout_s=null")
        wait_for(lambda: waits(run))
        waited = time.monotonic()
        time.sleep(3.0)
        assert committed(run) is None
        waited = time.monotonic() - waited + NOTICE_S  # of which no more is known
        end(hosts, holder, first, signal.SIGTERM)
        printed, _ = driver.communicate(timeout=120)
        assert driver.returncode == 0, printed
        took = time.monotonic() - began
    assert "a worker has a place in the cluster; the run begins" in printed
    row = read_status(open_run(run)).row
    assert row is not None
    assert row["wall_clock_s"] < took - waited
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, GENERATIONS)


def test_an_autoscaler_gives_a_run_its_nodes_takes_some_and_all_of_them_and_the_digest_is_the_same(tmp_path):
    """A run that begins without nodes gets all that it may have. One is preempted and replaced. When the run is
    stopped, all are idle and end; it goes on without nodes again, and gets as many as it asks for."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    shape = {"dispatch_log": True, "worker_resources": {"cpu": 2}}
    config.write_text(yaml.safe_dump(CONFIG | {"compute": CONFIG["compute"] | shape}))
    with Autoscaled(tmp_path, cpus=2, most=3) as hosts:
        assert not hosts.workers()
        driver = hosts.popen("head", "es-service", "run", config, "--out", run, "--address", hosts.address)
        wait_for(lambda: len(entries(run, "WorkerUp", 0.0)) == 3 and (committed(run) or 0) > 3, 120)
        nodes, since = hosts.workers(), time.time()
        assert len(nodes) == 3, "it asked for four, and there may be three"

        preempted = min(nodes)
        hosts.preempt(preempted, seconds=30)
        wait_for(lambda: entries(run, "WorkerUp", since), 120)
        wait_for(lambda: preempted not in hosts.workers(), 120)
        assert "drained" in {entry["reason"] for entry in entries(run, "StopWorker", since)}
        assert not entries(run, "WorkerLost", 0.0)
        wait_for(lambda: len(hosts.workers()) == 3, 120)

        printed = end(hosts, driver, run, signal.SIGTERM)
        assert driver.returncode == 143, printed
        wait_for(lambda: not hosts.workers(), 120)

        since, reached = time.time(), (committed(run) or 0) + 20
        words = ("--address", hosts.address, "--workers", 4, "--set", f"budget.generations={reached}")
        code, printed = hosts.run("head", sys.executable, "-m", "es_service", "resume", run, *words, timeout=180)
        assert code == 0, printed
        assert entries(run, "WorkerUp", since)
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, reached)
