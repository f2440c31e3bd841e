"""The image builds, and two containers of it, each with a network of its own, make a cluster that runs a job.

    pytest -m image -s

Outside CI: ten minutes, root, debootstrap, podman, buildah and iproute2, and a package index. No Docker engine is
needed: podman builds the real Dockerfile in a chroot, on a base made by debootstrap, and buildah runs the commands of
compose.yaml in the result. ES_IMAGE_BUILD_OPTIONS: more words for `podman build`, such as -v mounts of certificates.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
import yaml

from tests.system.processes import ROOT, wait_for

TOOLS = ("debootstrap", "podman", "buildah", "ip")
missing = [tool for tool in TOOLS if shutil.which(tool) is None] + ["root"] * (os.geteuid() != 0)
pytestmark = [pytest.mark.image, pytest.mark.skipif(bool(missing), reason=f"needs {', '.join(missing)}")]
BASE, IMAGE = "localhost/es-test-base", "localhost/es-test"
ADDRESSES = {"head": "10.78.0.1", "worker": "10.78.0.2"}
HEAD = f"{ADDRESSES['head']}:6379"
"""Named, since a chroot shows these containers the Rays of the machine's other processes, too."""
URL = "http://127.0.0.1:8265"
TOKEN = "0123456789abcdef" * 4


def sh(*command: object, **options) -> str:
    """Run to the end; what it printed."""
    result = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, cwd=ROOT, timeout=1500, **options
    )
    assert result.returncode == 0, (command, result.stdout[-4000:], result.stderr[-4000:])
    return result.stdout


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    if not sh("podman", "--storage-driver=vfs", "images", "--quiet", BASE).strip():
        tree = tmp_path_factory.mktemp("base")
        sh("debootstrap", "--variant=minbase", "--include=python3,python3-venv,ca-certificates", "bookworm", tree)
        tree.chmod(0o755)  # it becomes the root folder, which pytest made for its own user alone
        sh("tar", "-C", tree, "-cf", f"{tree}.tar", ".")
        sh("podman", "--storage-driver=vfs", "import", f"{tree}.tar", BASE)
    build = ["podman", "--storage-driver=vfs", "build", "--isolation=chroot", "--network=host"]
    build += shlex.split(os.environ.get("ES_IMAGE_BUILD_OPTIONS", ""))
    started = time.monotonic()
    sh(*build, "--build-arg", f"BASE_IMAGE={BASE}", "-f", "docker/Dockerfile", "-t", IMAGE, ".")
    print(f"built in {time.monotonic() - started:.0f} s")
    return IMAGE


class Containers:
    """A container per service of compose.yaml, each in a network namespace, joined by a veth pair."""

    def __init__(self, log_folder: Path) -> None:
        self.log_folder = log_folder
        self._started: list[subprocess.Popen[bytes]] = []
        text = (ROOT / "docker" / "compose.yaml").read_text()
        defaults = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)  # ${WORKERS:-2} -> 2
        self.services = yaml.safe_load(defaults)["services"]

    def __enter__(self) -> Containers:
        for service in ADDRESSES:
            sh("ip", "netns", "add", self._name(service))
            sh("buildah", "--storage-driver=vfs", "from", "--name", self._name(service), IMAGE)
        one, other = map(self._name, ADDRESSES)
        sh("ip", "-n", one, "link", "add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", other)
        for service, address in ADDRESSES.items():
            sh("ip", "-n", self._name(service), "address", "add", f"{address}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                sh("ip", "-n", self._name(service), "link", "set", device, "up")
        for service in ADDRESSES:  # Ray takes the address that leads to the world for its own
            sh("ip", "-n", self._name(service), "route", "add", "default", "dev", "eth0")
        return self

    def __exit__(self, *_: object) -> None:
        for service in ADDRESSES:
            for pid in sh("ip", "netns", "pids", self._name(service)).split():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            sh("ip", "netns", "delete", self._name(service))
        for started in self._started:
            started.wait()
        for service in ADDRESSES:
            sh("buildah", "--storage-driver=vfs", "rm", self._name(service))

    def command(self, service: str, *command: str) -> list[str]:
        enter = ["ip", "netns", "exec", self._name(service), "buildah", "--storage-driver=vfs", "run"]
        return [*enter, "--isolation=chroot", f"--env=RAY_AUTH_TOKEN={TOKEN}", self._name(service), "--", *command]

    def start(self, service: str) -> None:
        """Start what compose.yaml says this service runs."""
        with (self.log_folder / service).open("wb") as log:
            words = self.services[service]["command"].replace("head:", f"{ADDRESSES['head']}:")  # no name server here
            command = self.command(service, *shlex.split(words))
            started = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self._started.append(started)

    def healthy(self, service: str) -> bool:
        """Whether compose.yaml's check of a service passes."""
        check = self.services[service]["healthcheck"]["test"][1:]
        return subprocess.run(self.command(service, *check), capture_output=True, check=False).returncode == 0

    def run(self, service: str, *command: str) -> str:
        return sh(*self.command(service, *command))

    def _name(self, service: str) -> str:
        return f"es-test-{service}"


def test_two_containers_run_a_job(image, tmp_path):
    config = "/opt/es-service/configs/point_maze_nsra_es.yaml"
    with Containers(tmp_path) as containers:
        assert containers.run("head", "id", "--user").strip() == "1000"
        containers.start("head")
        wait_for(lambda: containers.healthy("head"), timeout_s=120)
        containers.start("worker")
        wait_for(lambda: containers.healthy("worker"), timeout_s=120)
        wait_for(
            lambda: containers.run("head", "ray", "status", f"--address={HEAD}").count("node_") == 2, timeout_s=120
        )
        submit = ("es-service", "submit", config, "--out", "/runs/first", "--set", "budget.generations=200")
        wait_for(lambda: "es-" in containers.run("head", *submit, "--address", URL), timeout_s=120)
        (job,) = [
            line.split()[0] for line in containers.run("head", "es-service", "jobs", "--address", URL).splitlines()
        ]
        print(containers.run("head", "es-service", "logs", job, "--follow", "--address", URL))
        alone = ("es-service", "run", config, "--engine", "inline", "--out", "/runs/alone")
        containers.run("head", *alone, "--set", "budget.generations=200")
        digests = [containers.run("head", "es-service", "digest", f"/runs/{name}") for name in ("first", "alone")]
        assert digests[0] == digests[1]
        print(f"digest in two containers and in one process: {digests[0]}")
