"""`es-service doctor --cluster` on clusters of several hosts, and a run in a cluster with TLS."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time

import pytest
import yaml

from es_service.store.digest import digest_parts
from tests.system import cluster
from tests.system.cluster import Cluster
from tests.system.processes import ROOT, wait_for
from tests.system.test_cluster import CONFIG, inline_digest

pytestmark = [pytest.mark.slow, pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))]
PUBLIC = "11.0.0.77"
"""An address that is public, but for the namespace that has it here."""


def doctor(hosts: Cluster, *options: object, code: int, **environment: str) -> str:
    """What the command prints on the head, where its exit code must be this one."""
    found, printed = hosts.run("head", "es-service", "doctor", "--cluster", *options, timeout=120.0, **environment)
    assert found == code, printed
    assert "Traceback" not in printed
    return printed


def test_everything_that_is_wrong_with_a_cluster_is_found(tmp_path):
    """One host is as the driver's. Of another, a file of our code was edited, the shared folder is its own, and one of
    its addresses is public. Nobody needs a token."""
    shared, edited = tmp_path / "shared", tmp_path / "policy.py"
    shared.mkdir()
    policy = ROOT / "workers/policy.py"
    edited.write_text(f"{policy.read_text()}# edited\n")
    other = f"mount --bind {edited} {policy} && mount -t tmpfs tmpfs {shared} && ip address add {PUBLIC}/8 dev eth0"
    hosts = Cluster(tmp_path)
    hosts.settings = {**hosts.settings, "RAY_AUTH_MODE": "disabled"}
    with hosts:
        hosts.start("alike", 1)
        hosts.start("other", 1, setup=other)

        def findings():
            printed = doctor(hosts, hosts.address, "--shared", shared, "--json", code=1)
            found = {one["what"]: one for one in json.loads(printed) if one["level"] == "FAIL"}
            return found if "dashboard" in found["Ray answers without a token"]["where"] else None

        found = wait_for(findings)  # the dashboard takes its time
        assert found.keys() == {
            "Ray answers without a token",
            "Ray listens on a public address",
            "other code than here in workers/policy.py",
            f"{shared} is not shared (No such file or directory)",
        }
        where = found["Ray answers without a token"]["where"]
        for name, place in (("head", "head 6379, raylet"), ("head", "dashboard 8265"), ("alike", ""), ("other", "")):
            assert re.search(rf"{name} 10\.77\.0\.\d \([^)]*{place or 'raylet'}", where), where
        assert PUBLIC in found.pop("Ray listens on a public address")["where"]
        found.pop("Ray answers without a token")
        assert {one["where"] for one in found.values()} == {f"other {hosts.ip(2)}"}
        assert list(shared.iterdir()) == []

        printed = doctor(hosts, "auto", code=1)
        assert printed.startswith(f"  ok  3 of 3 nodes answered: head {hosts.ip(0)}, ")
        assert f"FAIL  other {hosts.ip(2)}: other code than here in workers/policy.py; " in printed
        assert "is not shared" not in printed

        for pid, line in hosts.processes("head").items():
            if "gcs_server" in line:
                os.kill(pid, signal.SIGSTOP)
        began = time.monotonic()
        printed = doctor(hosts, hosts.address, code=1)
        assert f"no Ray cluster answers at {hosts.address} within" in printed
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
    """And a cluster with a token and TLS has no finding."""
    config, run = tmp_path / "config.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(CONFIG | {"budget": {"generations": 5}}))
    hosts = Cluster(tmp_path)
    hosts.settings = {**hosts.settings, **certificates(tmp_path, [hosts.ip(0), hosts.ip(1)])}
    assert hosts.settings["RAY_USE_TLS"] == "1"
    with hosts:
        hosts.start("one", 1)
        printed = doctor(hosts, hosts.address, code=0)
        assert printed.startswith(f"  ok  2 of 2 nodes answered: head {hosts.ip(0)}, one {hosts.ip(1)}; ")
        assert len(printed.splitlines()) == 1, printed
        printed = doctor(hosts, hosts.address, code=1, RAY_USE_TLS="0")
        assert f"no Ray cluster answers at {hosts.address} within" in printed
        command = ("es-service", "run", config, "--out", run, "--address", hosts.address)
        code, printed = hosts.run("head", *command, timeout=120.0)
        assert code == 0, printed
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, 5)
