"""`es-service doctor --cluster` on clusters of several hosts, healthy and with each fault; and a run with TLS."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import ray
import yaml

from es_service.protocol import machine
from es_service.store.digest import digest_parts
from tests.system import cluster
from tests.system.cluster import TOKEN, Cluster
from tests.system.processes import ROOT, wait_for
from tests.system.test_cluster import CONFIG, inline_digest

pytestmark = [pytest.mark.long, pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))]
NOT_ENCRYPTED = "messages between nodes are not encrypted"
LISTEN = f"""
import pathlib, socket, sys
packets = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.ntohs(3))
packets.settimeout(0.1)
seen = with_token = 0
while not pathlib.Path(sys.argv[1]).exists():
    try:
        packet, (device, *_) = packets.recvfrom(1 << 16)
    except TimeoutError:
        continue
    if device == "eth0":
        seen += 1
        with_token += {TOKEN.encode()!r} in packet
print(seen, with_token)
"""
"""Counts what passes between hosts until a file exists: all packets, and those in which the token can be read."""


def doctor(hosts: Cluster, *options: object, code: int, **environment: str) -> str:
    """What the command prints on the head, where its exit code must be this one."""
    found, printed = hosts.run("head", "es-service", "doctor", "--cluster", *options, timeout=300.0, **environment)
    assert found == code, printed
    assert "Traceback" not in printed
    return printed


def findings(hosts: Cluster, code: int) -> list[str]:
    """What is found, but for what is in order, without what it means and what to do."""
    printed = json.loads(doctor(hosts, hosts.address, "--json", code=code))
    return [one["text"].partition(";")[0] for one in printed if one["level"] != "ok"]


def has_dashboard(hosts: Cluster) -> bool:
    """Whether the dashboard, which takes its time to start, is listening."""
    return ":8265" in hosts.run("head", "ss", "-Hltn")[1]


@contextlib.contextmanager
def counted(hosts: Cluster, folder: Path):
    """What LISTEN counts on the head until the end of the block, as a list that is filled then."""
    stop, counts = folder / "stop", []
    process = hosts.popen("head", sys.executable, "-c", LISTEN, stop)
    try:
        yield counts
    finally:
        stop.touch()
        printed, _ = process.communicate(timeout=60)
    counts += map(int, printed.split())


def test_a_cluster_with_a_token_has_no_finding_until_one_of_its_hosts_has_faults(tmp_path):
    """Then each fault is found. The token can be read in the traffic, as the guide says."""
    site = tmp_path / "site"
    site.mkdir()
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1, PYTHONPATH=f"{ROOT}{os.pathsep}{site}")
        wait_for(lambda: has_dashboard(hosts), 120.0)
        with counted(hosts, tmp_path) as counts:
            printed = doctor(hosts, "auto", code=0)
        seen, with_token = counts
        assert 0 < with_token < seen
        *sound, note = printed.splitlines()
        assert [line[:6] for line in sound] == ["  ok  "] * 3
        assert sound[0] == f"  ok  2 of 2 nodes answer: head {hosts.ip(0)}, one {hosts.ip(1)}"
        assert sound[2].endswith(f": head {hosts.ip(0)}:6379, dashboard 127.0.0.1:8265")
        assert note.startswith(f"note  {NOT_ENCRYPTED}")

        edited = {
            Path(machine.__file__): (f'VERSION = "{machine.VERSION}"', 'VERSION = "0.1.0"'),
            ROOT / "workers/measure.py": ("", "# edited\n"),
            Path(ray.__file__).with_name("_version.py"): (ray.__version__, "2.0.0"),
        }
        mounts = []
        for file, (old, new) in edited.items():
            (tmp_path / file.name).write_text(file.read_text().replace(old, new, 1))
            mounts.append(f"mount --bind {tmp_path / file.name} {file}")
        (site / "sitecustomize.py").write_text("import platform\nplatform.python_version = lambda: '3.11.99'\n")
        assert hosts.run("one", "sh", "-ec", "\n".join(mounts)) == (0, "")
        here = {"es-service": machine.VERSION, "python": sys.version.split()[0], "ray": ray.__version__}
        versions = f"es-service 0.1.0 (here {here['es-service']}), python 3.11.99 (here {here['python']}), "
        versions = f"other versions: {versions}ray 2.0.0 (here {here['ray']})"

        def with_new_process():
            found = findings(hosts, code=1)
            is_new = f"one {hosts.ip(1)}: {versions}" in found
            return found if is_new else None  # a process that Ray started before has the old versions

        assert wait_for(with_new_process, 240.0) == [
            f"one {hosts.ip(1)}: {versions}",
            f"one {hosts.ip(1)}: other code than here in es_service/protocol/machine.py, workers/measure.py",
            NOT_ENCRYPTED,
        ]


def test_a_cluster_without_a_token_is_found(tmp_path):
    hosts = Cluster(tmp_path)
    hosts.settings = {**hosts.settings, "RAY_AUTH_MODE": "disabled"}
    with hosts:
        hosts.start("one", 1)
        wait_for(lambda: has_dashboard(hosts), 120.0)
        servers = f"head {hosts.ip(0)}:6379, dashboard 127.0.0.1:8265"
        assert findings(hosts, code=1) == [f"{servers}: Ray answers without a token", NOT_ENCRYPTED]


def test_what_does_not_answer_is_found_within_its_time(tmp_path):
    """A node that is stopped, a host with another Ray, a host that is no node, a head that is stopped."""
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)

        def stop(node: str, program: str) -> None:
            (pid,) = [pid for pid, line in hosts.processes(node).items() if line.split()[0].endswith(program)]
            os.kill(pid, signal.SIGSTOP)

        file = Path(ray.__file__).with_name("_version.py")
        (tmp_path / "version.py").write_text(file.read_text().replace(ray.__version__, "2.0.0"))
        other = f"mount --bind {tmp_path / 'version.py'} {file} && es-service doctor --cluster {hosts.address}"
        code, printed = hosts.run("one", "unshare", "--mount", "sh", "-c", other, timeout=300.0)
        assert (code, len(printed.splitlines())) == (1, 1), printed
        assert f"Version mismatch: The cluster was started with: Ray: {ray.__version__} " in printed

        alone = f"mount -t proc proc /proc && es-service doctor --cluster {hosts.address}"
        inside = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", alone)
        code, printed = hosts.run("one", *inside, timeout=300.0)
        assert (code, len(printed.splitlines())) == (1, 1), printed
        assert "no node of Ray runs on this host" in printed

        stop("one", "raylet")
        impatient = "from es_service.dispatch import cluster_findings; cluster_findings.NODE_S = 10.0; "
        impatient += "from es_service.cli.main import main; main()"
        code, printed = hosts.run(
            "head", sys.executable, "-c", impatient, "doctor", "--cluster", hosts.address, timeout=300.0
        )
        assert code == 1, printed
        assert f"FAIL  one {hosts.ip(1)}: the node does not answer a task (nothing within 10 s); " in printed
        assert f"  ok  1 of 2 nodes answer: head {hosts.ip(0)}\n" in printed

        stop("head", "gcs_server")
        began = time.monotonic()
        printed = doctor(hosts, hosts.address, code=1)
        assert f"at {hosts.address}: its port is open, but gives no answer within 4 s" in printed
        assert time.monotonic() - began < 60


def certificates(folder, addresses):
    """Make certificates for these addresses by the lines of the guide; returns the variables that they set."""
    guide = (ROOT / "docker/README.md").read_text()
    (lines,) = [block for block in re.findall(r"^```console\n(.*?)^```", guide, re.M | re.S) if "RAY_USE_TLS" in block]
    theirs = "IP:10.0.0.1,IP:10.0.0.2"
    assert theirs in lines
    lines = lines.replace(theirs, ",".join(f"IP:{address}" for address in addresses))
    made = subprocess.run(["bash", "-c", f"set -e\n{lines}\nenv -0"], cwd=folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    return dict(entry.split("=", 1) for entry in made.stdout.split("\0") if entry.startswith(("RAY_USE_", "RAY_TLS_")))


def test_a_run_in_a_cluster_with_tls_has_the_digest_that_it_has_alone(tmp_path):
    """Nobody can read the token in the traffic, nobody joins without a certificate, and nothing at all is found."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG | {"budget": {"generations": 5}}))
    hosts = Cluster(tmp_path)
    hosts.settings = {**hosts.settings, **certificates(tmp_path, [hosts.ip(0), hosts.ip(1)])}
    assert hosts.settings["RAY_USE_TLS"] == "1"
    with hosts:
        with counted(hosts, tmp_path) as counts:
            hosts.start("one", 1)
            wait_for(lambda: has_dashboard(hosts), 120.0)
            printed = doctor(hosts, hosts.address, code=0)
            command = ("es-service", "run", config, "--out", run, "--address", hosts.address)
            code, said = hosts.run("head", *command, timeout=300.0)
            assert code == 0, said
        assert [line[:6] for line in printed.splitlines()] == ["  ok  "] * 4, printed
        seen, with_token = counts
        assert seen > 100
        assert with_token == 0
        printed = doctor(hosts, hosts.address, code=1, RAY_USE_TLS="0")
        assert "if the cluster uses TLS, this host must, too" in printed
        strangers = tmp_path / "stranger"
        strangers.mkdir()
        printed = doctor(hosts, hosts.address, code=1, **certificates(strangers, [hosts.ip(0)]))
        assert f"could not connect to a Ray cluster at {hosts.address}: " in printed
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, 5)
