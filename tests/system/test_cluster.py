"""A real cluster of hosts that come, go, hang and die, and a job on one that is lost whole.

`pytest tests/system/test_cluster.py -s` prints for each fault the seconds until it is repaired, the episodes that were
begun again, and how long the longest generation took meanwhile.
"""

import json
import mmap
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from es_service import api
from es_service.dispatch.events import FILE
from es_service.protocol import sources
from es_service.protocol.machine import CODE
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation, read_platforms
from tests.dispatch_checker import check_dispatch, read_dispatch_log
from tests.system import cluster
from tests.system.cluster import ROOT, Cluster
from tests.system.processes import committed, wait_for
from tests.system.session import SMALL
from tests.system.test_code_identity import REWARD, SEARCH, TASK

pytestmark = [
    pytest.mark.long,
    pytest.mark.alone,  # one of its faults is that memory is short
    pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing())),
]

CONFIG = SMALL | {
    "search": SMALL["search"] | {"pairs": 64},
    "budget": {"generations": 1_000_000},
    "compute": {"engine": "ray", "chunk_pairs": 8, "gradient_block_pairs": 16, "chunk_timeout_s": 2.0},
}
"""Eight training chunks, four gradient chunks and one evaluation chunk a generation."""
EPISODES_PER_CHUNK = 16


def entries(folder: Path, name: str, since: float) -> list[dict]:
    """Entries of one kind in the dispatch log since a time; a last line that is being written is left out."""
    if not (folder / FILE).exists():
        return []
    return [entry for entry in read_dispatch_log(folder) if entry["is"] == name and entry["time"] >= since]


def inline_digest(folder: Path, config: dict, generations: int) -> dict[str, str]:
    """Digest of the same run without Ray."""
    compute = config["compute"] | {"engine": "inline", "workers": 1}
    api.run(api.load_config(config | {"budget": {"generations": generations}, "compute": compute}), folder)
    return digest_parts(folder)


def episodes_begun_again(folder: Path, since: float) -> tuple[int, int]:
    """(episodes repeated after a loss, episodes sent a second time because a worker was late). Gradient chunks have no
    episodes."""
    seen: set[tuple] = set()
    repeated = copied = 0
    for entry in entries(folder, "Assign", 0.0):
        item_id = tuple(entry["item_id"])
        if entry["time"] >= since and item_id in seen and item_id[2] != "GradientChunk":
            repeated += (not entry["copy"]) * item_id[-1] * EPISODES_PER_CHUNK
            copied += entry["copy"] * item_id[-1] * EPISODES_PER_CHUNK
        seen.add(item_id)
    return repeated, copied


def longest_generation(folder: Path, since: float) -> float:
    """Seconds of the longest generation that was committed since a time."""
    committed_at = [entry["time"] for entry in entries(folder, "Committed", 0.0)]
    return max((b - a for a, b in pairwise(committed_at) if b >= since), default=0.0)


def memory_in_use() -> tuple[int, int]:
    """Bytes of this machine in use, and in all."""
    fields = dict(re.findall(r"^(\w+):\s+(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE))
    total = int(fields["MemTotal"]) * 1024
    return total - int(fields["MemAvailable"]) * 1024, total


def stop_a_little_later(hosts, driver, run):
    """Stop a run's driver on the head by SIGTERM, after some more generations; returns what it printed."""
    reached = read_generation(run)
    wait_for(lambda: read_generation(run) > reached + 3)
    for pid, line in hosts.processes("head").items():
        if "es-service run" in line:
            os.kill(pid, signal.SIGTERM)
    printed, _ = driver.communicate(timeout=30)
    assert driver.returncode == 143, printed
    return printed


@pytest.mark.parametrize("cores", [1, 2])
def test_hosts_come_go_hang_and_die_and_the_digest_is_that_of_one_process(tmp_path, cores):
    """Each host has one actor, which owns all of its cores."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG | {"compute": CONFIG["compute"] | {"dispatch_log": True}}))
    report = []

    def strike(what, fault, healed, timeout_s=90.0):
        """Do it, wait until the workers wanted are all up again, and note what it cost."""
        since, lost = time.time(), len(entries(run, "WorkerLost", 0.0)) + len(entries(run, "StopWorker", 0.0))
        reason = fault()
        seconds = wait_for(lambda: healed(since), timeout_s) - since
        lost = len(entries(run, "WorkerLost", 0.0)) + len(entries(run, "StopWorker", 0.0)) - lost
        repeated, copied = episodes_begun_again(run, since)
        longest = longest_generation(run, since)
        report.append(
            {
                "fault": what,
                "cores": cores,
                "seconds": round(seconds, 1),
                "lost": lost,
                "repeated": repeated,
                "copied": copied,
                "longest_generation": round(longest, 2),
            }
        )
        print(json.dumps(report[-1]), flush=True)
        return reason

    def replaced(since):
        """When the first worker came up after one had been lost."""
        gone = entries(run, "WorkerLost", since) + entries(run, "StopWorker", since)
        up = entries(run, "WorkerUp", min((entry["time"] for entry in gone), default=float("inf")))
        return up[0]["time"] if up else 0.0

    def working_again(since):
        """When the first generation was committed after a loss was noticed."""
        gone = entries(run, "WorkerLost", since) + entries(run, "StopWorker", since)
        done = entries(run, "Committed", min((entry["time"] for entry in gone), default=float("inf")))
        return done[0]["time"] if done else 0.0

    def joined(since):
        up = entries(run, "WorkerUp", since)
        return up[0]["time"] if up else 0.0

    with Cluster(tmp_path) as hosts:
        hosts.start("one", cores)
        hosts.start("two", cores)
        driver = hosts.popen("head", "es-service", "run", config, "--out", run, "--address", hosts.address)
        wait_for(lambda: len(entries(run, "Committed", 0.0)) > 3)

        strike("worker killed", lambda: os.kill(hosts.worker("one"), signal.SIGKILL), replaced)
        strike("worker stopped", lambda: os.kill(hosts.worker("two"), signal.SIGSTOP), replaced)
        used, total = memory_in_use()
        tight = {"RAY_memory_usage_threshold": f"{(used + 3 * 2**30) / total:.3f}"}
        hosts.start("late", cores, **tight)
        strike("node joins", lambda: None, joined)
        assert entries(run, "SetWorkers", 0.0)[-1]["workers"] == 3

        since = time.time()
        used, _ = memory_in_use()
        ballast = mmap.mmap(-1, int(float(tight["RAY_memory_usage_threshold"]) * total) - used + 2**29)
        for at in range(0, len(ballast), mmap.PAGESIZE):
            ballast[at] = 1
        gone = wait_for(lambda: entries(run, "WorkerLost", since))
        ballast.close()
        strike("out of memory", lambda: None, lambda _: replaced(since))
        assert "its node ran out of memory" in gone[0]["reason"]

        def kill_raylet():
            raylet = next(pid for pid, line in hosts.processes("one").items() if "/raylet/raylet " in line)
            os.kill(raylet, signal.SIGKILL)

        strike("raylet killed", kill_raylet, working_again)
        wait_for(lambda: entries(run, "SetWorkers", 0.0)[-1]["workers"] == 2)
        strike("node dies whole", lambda: hosts.end("two"), working_again)

        printed = stop_a_little_later(hosts, driver, run)

    counts = check_dispatch(run)
    reached = read_generation(run)
    assert counts["generations"] == reached + 1
    assert set(api.open_run(run).history["workers"]) <= {cores * actors for actors in (1, 2, 3)}
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, reached)
    assert "lost a worker" in printed


def test_a_job_is_submitted_followed_stopped_and_goes_on_in_another_cluster(tmp_path):
    """The second cluster knows nothing of the first; only the run folder is left of it."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG))
    url = "http://127.0.0.1:8265"

    def es(hosts, *arguments, **environment):
        return hosts.run("head", "es-service", *arguments, "--address", url, **environment)

    def submit(hosts, *more):
        code, printed = es(hosts, "submit", config, "--out", run, *more)
        assert code == 0, printed
        return printed.split()[0]

    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)
        wait_for(lambda: es(hosts, "jobs")[0] == 0)  # the dashboard takes its time
        job = submit(hosts)
        wait_for(lambda: (committed(run) or 0) > 3)
        code, printed = es(hosts, "jobs")
        assert (code, printed.split()) == (0, [job, "RUNNING", str(run)])
        assert es(hosts, "stop", job) == (0, f"{job} stopped\n")
        code, printed = es(hosts, "logs", job)
        assert code == 0
        assert "generation 0 " in printed
        assert f"es-service resume {run}" in printed
        for arguments, message in (
            (("logs", "es-nothing"), "there is no job es-nothing on"),
            (("logs", "es-nothing", "--follow"), "there is no job es-nothing on"),
            (("stop", "es-nothing"), "there is no job es-nothing on"),
            (("submit", config, "--out", "runs/x"), "the run folder runs/x must be an absolute path"),
        ):
            code, printed = es(hosts, *arguments)
            assert code in (1, 2)
            assert message in printed
        code, printed = es(hosts, "jobs", RAY_AUTH_TOKEN="f" * 64)
        assert code == 1
        assert "RAY_AUTH_TOKEN is the token of the cluster" in printed

        refused = submit(hosts, "--seed", "1")
        code, printed = es(hosts, "logs", refused, "--follow")
        assert code == 1
        assert "seed: 0 -> 1" in printed

        stopped_at = read_generation(run)
        by_ray = ("ray", "job", "submit", "--address", url, "--no-wait", "--working-dir", tmp_path / "sent", "--")
        (tmp_path / "sent").mkdir()
        (tmp_path / "sent" / config.name).write_text(config.read_text())
        entry = ("es-service", "run", config.name, "--or-resume", "--out", run, "--address", "auto")
        code, printed = hosts.run("head", *by_ray, *entry)
        assert code == 0, printed
        wait_for(lambda: read_generation(run) > stopped_at + 3)
        lost_at = time.time()
        for node in reversed(hosts.nodes):  # the head with the driver last
            hosts.end(node)
    reached = read_generation(run)
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)
        wait_for(lambda: es(hosts, "jobs")[0] == 0)
        job = submit(hosts, "--set", f"budget.generations={reached + 20}")
        code, printed = es(hosts, "logs", job, "--follow")
        assert code == 0, printed
        assert printed.count("Running entrypoint") == 1, "nothing is sent twice"
        assert f"es-service digest {run}" in printed, "the end of the log is there too"
        assert "WebSocket" not in printed
        assert printed.endswith(f"{job} succeeded\n")
        print(f"head lost: {time.time() - lost_at:.1f} s to the end of the run in a new cluster")
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, reached + 20)


def test_a_job_takes_the_user_s_modules_to_every_node_and_may_be_a_sweep(tmp_path, monkeypatch):
    """The driver is on the head and the worker on another node; neither runs in the folder that has the modules."""
    here, out, url = tmp_path / "here", tmp_path / "sweep", "http://127.0.0.1:8265"
    here.mkdir()
    for name, text in {"my_task.py": TASK, "my_reward.py": REWARD, "my_search.py": SEARCH}.items():
        (here / name).write_text(text)
    task, search = {"environment": "my_task:Point"}, {"algorithm": "my_search:search", "pairs": 16}
    config = SMALL | {"task": task, "search": search, "budget": {"generations": 2}}
    (here / "config.yaml").write_text(yaml.safe_dump(config))

    def es(*arguments):
        words = map(str, ("es-service", *arguments, "--address", url))
        return hosts.run("head", "sh", "-c", f"cd {here} && {shlex.join(words)}", timeout=120.0)

    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)
        wait_for(lambda: es("jobs")[0] == 0)
        code, printed = es("submit", "config.yaml", "--grid", "search.sigma=0.1", "--seeds", "0:1", "--out", out)
        assert code == 0, printed
        assert "sent with it: my_reward.py, my_search.py, my_task.py\n" in printed
        code, log = es("logs", printed.split()[0], "--follow")
        assert code == 0, log
    run = out / "sigma=0.1_seed=0"
    assert read_generation(run) == 2
    assert (out / "report.html").exists()
    monkeypatch.chdir(here)
    [(_, platform)] = read_platforms(run)
    assert platform[CODE] == sources.worker_sources("my_task:Point") | sources.driver_sources("my_search:search")
    assert {"my_reward.py", "my_search.py", "my_task.py"} <= platform[CODE].keys()


def test_what_cannot_be_joined_is_named(tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(CONFIG))
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)

        def run(*more, **environment):
            command = ("es-service", "run", config, "--out", tmp_path / "run", "--address", hosts.address, *more)
            code, printed = hosts.run("head", *command, timeout=90.0, **environment)
            assert code == 1
            assert "Traceback" not in printed
            return printed

        assert "the token in RAY_AUTH_TOKEN is not the cluster's" in run(RAY_AUTH_TOKEN="f" * 64)

        started = time.monotonic()
        shape = ("--set", "compute.worker_resources.cpu=64", "--set", "compute.place_timeout_s=10")
        printed = run("--or-resume", *shape)
        assert "no worker got a place for 10 s (compute.place_timeout_s)" in printed
        assert "Each worker needs 64 CPU; the cluster has 1 CPU" in printed
        assert "No node has 64 CPU; add one that does" in printed
        assert time.monotonic() - started < 60

        # A cluster of other versions is one that says it has them.
        pretend = (
            "import json, ray; from ray.experimental import internal_kv as kv; ray.init(address='auto'); "
            "versions = json.loads(kv._internal_kv_get('CLUSTER_METADATA', namespace='cluster')); "
            "versions |= {'ray_version': '2.1.0', 'python_version': '3.9.1'}; "
            "kv._internal_kv_put('CLUSTER_METADATA', json.dumps(versions), overwrite=True, namespace='cluster')"
        )
        code, printed = hosts.run("head", "python", "-c", pretend)
        assert code == 0, printed
        printed = run("--or-resume")
        for version in ("2.1.0", "3.9.1", "2.60"):
            assert version in printed


def test_a_node_with_other_code_is_told_of_once_and_left_out(tmp_path):
    """It gets no worker after the first ones; a run for which there is no other node ends at once."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    compute = CONFIG["compute"] | {"dispatch_log": True, "worker_resources": {"cpu": 1}, "workers": 4}
    config.write_text(yaml.safe_dump(CONFIG | {"compute": compute}))
    ours, other = ROOT / "workers" / "measure.py", tmp_path / "measure.py"
    other.write_text(f"{ours.read_text()}# a comment\n")
    with Cluster(tmp_path) as hosts:
        hosts.start("stale", 2, setup=f"mount --bind {other} {ours}", PYTHONDONTWRITEBYTECODE="1")
        started = time.monotonic()
        command = ("es-service", "run", config, "--address", hosts.address, "--out")
        code, printed = hosts.run("head", *command, tmp_path / "alone", timeout=90.0)
        assert code == 1
        assert "stale has other code" in printed
        assert "workers/measure.py" in printed
        assert "Traceback" not in printed
        print(f"every node refuses: the run ends after {time.monotonic() - started:.1f} s")
        hosts.start("good", 2)
        driver = hosts.popen("head", *command, run)
        wait_for(lambda: len(entries(run, "Committed", 0.0)) > 3)
        since = time.time()
        wait_for(lambda: len(entries(run, "Committed", since)) > 50)
        wait_for(lambda: len(entries(run, "WorkerUp", 0.0)) == 2)  # a fast machine has many generations before
        assert not entries(run, "WorkerLost", since)
        printed = stop_a_little_later(hosts, driver, run)
    assert printed.count("stale has other code") == 1, printed
    assert "lost" not in printed, printed
    refused = entries(run, "WorkerLost", 0.0)
    assert 1 <= len(refused) <= 4
    assert all(entry["refused"] for entry in refused)
    assert {entry["worker"] for entry in refused}.isdisjoint(e["worker"] for e in entries(run, "WorkerUp", 0.0))
    assert len(entries(run, "WorkerUp", 0.0)) == 2
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, read_generation(run))


def test_a_driver_whose_head_dies_says_so_and_goes_on_alone(tmp_path):
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG))
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)
        driver = hosts.popen("one", "es-service", "run", config, "--out", run, "--address", hosts.address)
        wait_for(lambda: (committed(run) or 0) > 3)
        died = time.monotonic()
        hosts.end("head")
        try:
            printed, _ = driver.communicate(timeout=90)
        except subprocess.TimeoutExpired:
            pytest.fail("the driver waits for ever")
        print(f"head dies under a driver elsewhere: it ends after {time.monotonic() - died:.1f} s")
    assert driver.returncode == 1, printed
    assert "its head node has ended or cannot be reached" in printed
    reached = read_generation(run) + 3
    alone = [Path(sys.executable).with_name("es-service"), "resume", run, "--engine", "inline", "--workers", "1"]
    subprocess.run([*alone, "--set", f"budget.generations={reached}"], check=True, capture_output=True)
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, reached)
