"""What autoscalers and preemption rely on: a real drain of a node, and Ray's report of the workers that are missing."""

import os
import signal
import time

import pytest
import yaml

from tests.system import cluster
from tests.system.cluster import Cluster
from tests.system.processes import wait_for
from tests.system.test_cluster import CONFIG, entries, episodes_begun_again, stop_a_little_later

pytestmark = [pytest.mark.long, pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))]


def test_a_node_that_is_told_to_stop_hands_its_work_over(tmp_path):
    """As a pod, a container or a machine that is evicted: SIGTERM to `ray start --block`."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG | {"compute": CONFIG["compute"] | {"dispatch_log": True}}))
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)
        hosts.start("two", 1)
        driver = hosts.popen("head", "es-service", "run", config, "--out", run, "--address", hosts.address)
        wait_for(lambda: len(entries(run, "WorkerUp", 0.0)) == 2 and len(entries(run, "Committed", 0.0)) > 3)
        since = time.time()
        (ray,) = [pid for pid, line in hosts.processes("two").items() if "ray start" in line]
        os.kill(ray, signal.SIGTERM)
        wait_for(lambda: not hosts.processes("two"))
        seconds = time.time() - since
        print(f"a node that was told to stop ended after {seconds:.1f} s")
        stop_a_little_later(hosts, driver, run)
    assert {entry["reason"] for entry in entries(run, "StopWorker", since)} == {"drained"}
    assert not entries(run, "WorkerLost", since)
    assert episodes_begun_again(run, since)[0] == 0
    assert seconds < 25.0, "it was idle and ended by itself; Ray's limit is 30 s"


def test_a_run_asks_an_autoscaler_for_all_of_its_workers_and_begins_with_the_first_node(tmp_path):
    """Without a number of workers it asks for all that have work, if it knows how large they are; else for one."""
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(CONFIG | {"compute": CONFIG["compute"] | {"dispatch_log": True}}))
    size = ("--set", "compute.worker_resources.cpu=2")
    every = (*size, "--workers", "4")
    with Cluster(tmp_path) as hosts:
        for options, demand in (
            ((), "{'CPU': 1.0}: 1+ pending"),
            (size, "{'CPU': 2.0}: 4+ pending"),
            (every, "{'CPU': 2.0}: 2+ pending"),
        ):
            run = tmp_path / f"run{len(options)}"
            driver = hosts.popen(
                "head", "es-service", "run", config, "--out", run, "--address", hosts.address, *options
            )
            wait_for(lambda demand=demand: demand in hosts.run("head", "ray", "status")[1])
            if options == every:
                hosts.start("one", 2)
                wait_for(lambda run=run: len(entries(run, "Committed", 0.0)) > 3)
                assert len(entries(run, "WorkerUp", 0.0)) == 1
                hosts.start("two", 2)
                wait_for(lambda run=run: len(entries(run, "WorkerUp", 0.0)) == 2)
                assert not entries(run, "WorkerLost", 0.0)
            driver.terminate()
            driver.communicate(timeout=30)
