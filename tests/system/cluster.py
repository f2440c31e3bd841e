"""A Ray cluster of several hosts on one machine: each node in a network namespace of its own, joined by a bridge.

Needs root and Debian's iproute2. The bridge lives in a namespace too, so nothing of this machine's network is touched.
Each node has its own host name, /tmp/ray and /dev/shm. Processes are found by a variable in their environment, and are
signalled one by one by process id.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

ROOT = Path(__file__).parents[2]
MARK = "ES_TEST_NODE"
PORT = 6379
TOKEN = "0123456789abcdef" * 4
RAY_SETTINGS = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": TOKEN, "RAY_USAGE_STATS_ENABLED": "0"}
COLLECT_ORPHANS = "while true; do sleep infinity & wait; done"


def missing() -> str | None:
    """What this machine lacks for it; None if nothing."""
    if os.geteuid():
        return "needs root"
    if shutil.which("ip") is None:
        return "needs iproute2"
    name = f"es{os.getpid()}try"
    if subprocess.run(["ip", "netns", "add", name], capture_output=True, check=False).returncode:
        return "cannot make network namespaces"
    subprocess.run(["ip", "netns", "delete", name], check=True)
    return None


class Hosts:
    """Hosts by name, each in namespaces of its own. Use as a context manager."""

    namespaces: tuple[str, ...] = ("--mount", "--uts")
    """Those besides the network's that a host has, as options of unshare."""

    def __init__(self, log_folder: Path) -> None:
        self.log_folder = log_folder
        self.nodes: list[str] = []
        self._entries: dict[str, subprocess.Popen[bytes]] = {}
        self._id = f"es{os.getpid()}x{time.monotonic_ns() % 10**6}"
        self._switch = f"{self._id}sw"

    def __enter__(self) -> Self:
        _ip("netns", "add", self._switch)
        _ip("-n", self._switch, "link", "add", "bridge", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "bridge", "up")
        try:
            self.begin()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for node in self.nodes:
            self.end(node)
        for name in (*map(self._namespace, self.nodes), self._switch):
            _ip("netns", "delete", name)

    def begin(self) -> None:
        """Start the hosts that are there from the beginning."""

    def add(self, node: str, *command: object, setup: str = "true", **environment: str) -> None:
        """Make a host that lives as long as a command, which is started there after a line of shell."""
        number = len(self.nodes)
        namespace, ours, theirs = self._namespace(node), f"v{number}", "eth0"
        _ip("netns", "add", namespace)
        self.nodes.append(node)
        _ip("-n", self._switch, "link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", namespace)
        _ip("-n", self._switch, "link", "set", ours, "master", "bridge", "up")
        _ip("-n", namespace, "address", "add", f"{self.ip(number)}/24", "dev", theirs)
        for device in ("lo", theirs):
            _ip("-n", namespace, "link", "set", device, "up")
        shell = (
            f"mkdir -p /tmp/ray && mount -t tmpfs tmpfs /tmp/ray && mount -t tmpfs tmpfs /dev/shm && "
            f'hostname {node} && {setup} && exec "$@"'
        )
        enter = ["ip", "netns", "exec", namespace, "unshare", *self.namespaces, "sh", "-c", shell, "sh"]
        with (self.log_folder / f"{node}.log").open("wb") as log:
            self._entries[node] = subprocess.Popen(
                [*enter, *map(str, command)],
                env=self._environment(node) | environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def popen(self, node: str, *command: object, **environment: str) -> subprocess.Popen[str]:
        """Start a command on a node; what it prints is to be read."""
        return subprocess.Popen(
            [*self.enter(node), *map(str, command)],
            env=self._environment(node) | environment,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def enter(self, node: str) -> list[str]:
        """Command whose arguments are run on a node."""
        return ["nsenter", f"--target={self._entries[node].pid}", "--mount", "--net", "--uts", f"--wd={ROOT}"]

    def run(self, node: str, *command: object, timeout: float = 60.0, **environment: str) -> tuple[int, str]:
        """Run a command on a node to its end: exit code, and all it printed."""
        process = self.popen(node, *command, **environment)
        printed, _ = process.communicate(timeout=timeout)
        return process.returncode, printed

    def processes(self, node: str) -> dict[int, str]:
        """Process id -> command line of what runs on a node."""
        wanted = f"{MARK}={self._id}.{node}".encode()
        found = {}
        for entry in filter(str.isdigit, os.listdir("/proc")):
            try:
                if wanted in Path(f"/proc/{entry}/environ").read_bytes().split(b"\0"):
                    command = Path(f"/proc/{entry}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                    found[int(entry)] = command
            except OSError:  # ended while we looked
                continue
        return found

    def end(self, node: str) -> None:
        """Kill everything on a node, and see it gone."""
        if node not in self._entries:
            return
        while left := self.processes(node):
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.05)
            self._entries[node].poll()  # a child of ours stays in the list until it is asked for
        self._entries[node].wait()

    def ip(self, number: int) -> str:
        """Address of a host by its number."""
        return f"10.77.0.{number + 1}"

    def _namespace(self, node: str) -> str:
        return f"{self._id}{node}"

    def _environment(self, node: str) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "JAX_", "PJRT_"))}
        path = f"{Path(sys.executable).parent}{os.pathsep}{kept.get('PATH', '')}"
        return kept | {MARK: f"{self._id}.{node}", "PATH": path, "PYTHONPATH": str(ROOT)}


class Machines(Hosts):
    """Hosts with process ids of their own, so that what ends every process that it sees ends those of one host."""

    namespaces = ("--mount", "--uts", "--pid", "--fork", "--kill-child", "--mount-proc")

    def boot(self, *nodes: str, setup: str = "true") -> None:
        """Make hosts, each with a first process that collects orphans, and wait for them."""
        for node in nodes:
            self.add(node, "bash", "-c", COLLECT_ORPHANS, setup=setup)
        for node in nodes:
            until = time.monotonic() + 60
            while not self._is_up(node):
                assert time.monotonic() < until, (self.log_folder / f"{node}.log").read_text()
                time.sleep(0.1)

    def enter(self, node: str) -> list[str]:
        """Command whose arguments are run on a node."""
        (first,) = children_of(self._entries[node].pid)  # `unshare --fork` itself is outside
        return ["nsenter", f"--target={first}", "--mount", "--net", "--uts", "--pid", f"--wd={ROOT}"]

    def _is_up(self, node: str) -> bool:
        first = children_of(self._entries[node].pid)
        return bool(first) and Path(f"/proc/{first[0]}/cmdline").read_bytes().startswith(b"bash")


class Cluster(Hosts):
    """Nodes by name; the first is the head, with the dashboard and no CPU for workers. Use as a context manager."""

    settings: Mapping[str, str] = RAY_SETTINGS
    """Environment variables of every process."""
    patience_s = 180.0
    """Longest time in which a node starts."""

    @property
    def address(self) -> str:
        """Where a driver joins."""
        return f"{self.ip(0)}:{PORT}"

    def begin(self) -> None:
        """Start the head."""
        self.start("head", 0)

    def start(self, node: str, cpus: int, setup: str = "true", **environment: str) -> None:
        """Start a node after a line of shell, and wait for it."""
        number = len(self.nodes)
        role = ["--head", f"--port={PORT}", "--dashboard-host=127.0.0.1"] if number == 0 else join(self.address)
        self.add(node, *ray_start(self.ip(number), cpus, *role), setup=setup, **environment)
        self._wait_until_joined(node)

    def worker(self, node: str) -> int:
        """Process id of a worker on a node."""
        return next(pid for pid, command in self.processes(node).items() if "WorkerActor" in command)

    def _wait_until_joined(self, node: str) -> None:
        until = time.monotonic() + self.patience_s
        while "Ray runtime started" not in (self.log_folder / f"{node}.log").read_text():
            assert time.monotonic() < until, (self.log_folder / f"{node}.log").read_text()
            time.sleep(0.1)

    def _environment(self, node: str) -> dict[str, str]:
        return {**super()._environment(node), **self.settings}


def ray_start(ip: str, cpus: int, *role: str) -> list[str]:
    """Command that is a node for as long as it runs, with an object store that is large enough for any test."""
    here = [f"--node-ip-address={ip}", f"--num-cpus={cpus}", "--object-store-memory=100000000"]
    return [str(Path(sys.executable).parent / "ray"), "start", "--block", "--disable-usage-stats", *here, *role]


def join(address: str) -> list[str]:
    """Options of a node that joins the head at an address."""
    return [f"--address={address}"]


def children_of(pid: int) -> list[int]:
    """Process ids of a process's children."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)
