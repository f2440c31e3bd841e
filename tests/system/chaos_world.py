"""A Ray cluster on four hosts, and a run on it, that are kept going while faults strike them.

Hosts outlive what runs on them. What ends is started again, as a supervisor does: a node whose processes ended joins
again, a head that ended is replaced by a new cluster, and a run whose driver ended is submitted again with the same
folder. A driver that ends without being allowed to is an error.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import struct
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import yaml

from es_service.dispatch.events import FILE
from tests.system.chaos_tally import Tally
from tests.system.cluster import PORT, RAY_SETTINGS, Machines, children_of, join, ray_start

HEAD, NODES = "head", ("one", "two", "three")
CLOCK = Path(__file__).with_name("wall_clock.c")
NODE_DISK, RUN_DISK = "size=128m", "size=256m"
MEMORY = 8 * 2**30
"""Bytes of memory that a host seems to have."""
HEALTH = {
    "RAY_health_check_initial_delay_ms": "5000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "2000",
    "RAY_health_check_failure_threshold": "4",
}
"""A node without an answer for some ten seconds counts as dead; with Ray's own settings it is a minute."""
AGAIN_S = 2.0
"""Least time between two starts of the same thing."""
KILLED = (-signal.SIGKILL, 128 + signal.SIGKILL)
"""Exit codes of a driver that was killed, by versions of nsenter."""


@dataclass(frozen=True)
class End:
    """How a driver ended."""

    code: int
    printed: str


class World(Machines):
    """The hosts, the cluster and the run. Use as a context manager."""

    def __init__(self, folder: Path, config: dict[str, Any], *, clock: bool) -> None:
        """Make them ready to begin.

        Args:
            folder: a new folder for all files; the run is in `run` of a small disk there.
            clock: whether the hosts have wall clocks that can be moved, which needs `cc`.
        """
        super().__init__(folder)
        self.disk = folder / "disk"
        self.run_folder = self.disk / "run"
        self.tally = Tally()
        self.may_end = False
        """Whether the driver may end now by an error of its own."""
        self.ends: list[End] = []
        """Of each driver but the last."""
        self._config, self._clock = config, clock
        self._started: dict[str, subprocess.Popen[bytes]] = {}
        """Host -> its Ray, and "driver" -> the driver."""
        self._tried_s: dict[str, float] = {}
        self._number = 0

    def __enter__(self) -> Self:
        self.disk.mkdir()
        (self.log_folder / "config.yaml").write_text(yaml.safe_dump(self._config))
        if self._clock:
            build_clock(self.log_folder)
        self._on_sigterm = signal.signal(signal.SIGTERM, signal.default_int_handler)  # else nothing would be undone
        try:
            subprocess.run(["mount", "-t", "tmpfs", "-o", RUN_DISK, "tmpfs", self.disk], check=True)
            return super().__enter__()
        except BaseException:
            self._unmount()
            raise

    def __exit__(self, *_: object) -> None:
        try:
            super().__exit__()
            for started in self._started.values():
                started.wait()
            if self.run_folder.exists():
                self.run_folder = shutil.copytree(self.run_folder, self.log_folder / "run")
        finally:
            self._unmount()

    def begin(self) -> None:
        """Make the hosts, start the cluster and submit the run."""
        for host in (HEAD, *NODES):
            set_clock(self.log_folder / f"clock.{host}", 0)
            self.fill_memory(host, 0.0)
            memory = self.log_folder / f"memory.{host}"
            self.boot(host, setup=f"mount -o remount,{NODE_DISK} /tmp/ray && mount --bind {memory} /sys/fs/cgroup")
        self.wait(lambda: self.tally.commits > 2)

    def tend(self) -> None:
        """Start what has ended."""
        self.tally.read(self.run_folder / FILE, 2 * self._config["compute"]["chunk_pairs"])
        if "driver" in self._started and self._has_ended("driver"):
            self._note_end()
        if self._has_ended(HEAD):
            for host in (HEAD, *NODES):
                self.clear(host, but="es-service run")  # which has to notice by itself
            self._start_ray(HEAD, 0, "--head", f"--port={PORT}", "--include-dashboard=false")
        elif self._runs(HEAD) and self._joined(HEAD):
            for host in NODES:
                if self._has_ended(host):
                    self.clear(host)
                    self._start_ray(host, 1, *join(f"{self.ip(0)}:{PORT}"))
            if "driver" not in self._started:
                words = ("es-service", "run", self.log_folder / "config.yaml", "--or-resume", "--out", self.run_folder)
                clock = with_clock(self.log_folder, f"clock.{HEAD}") if self._clock else {}
                self._start("driver", HEAD, *words, "--address", f"{self.ip(0)}:{PORT}", **clock)

    def wait(self, what: Callable[[], Any], timeout_s: float = 400.0) -> None:
        """Tend until something is true."""
        until = time.monotonic() + timeout_s
        while not what():
            assert time.monotonic() < until, self.state()
            self.tend()
            time.sleep(0.05)

    def rest(self, seconds: float) -> None:
        """Tend for some time."""
        until = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() >= until)

    def stop(self) -> int:
        """Tell the driver to stop; its exit code."""
        os.kill(self.driver(), signal.SIGTERM)
        return self._started["driver"].wait(timeout=120)

    def driver(self) -> int:
        """Process id of the driver."""
        return next(pid for pid, line in self._programs(HEAD).items() if "es-service run" in line)

    def pids(self, host: str, name: str) -> list[int]:
        """Process ids of the programs on a host whose command line has a name in it."""
        return [pid for pid, line in self._programs(host).items() if name in line]

    def clear(self, host: str, but: str = "nothing") -> None:
        """Kill every program on a host, but those with a text in their command line, and see them gone."""
        while left := [pid for pid, line in self._programs(host).items() if but not in line]:
            self.signal(left, signal.SIGKILL)
            time.sleep(0.02)

    def signal(self, pids: Any, number: int) -> None:
        """Send a signal to processes, some of which may have ended."""
        for pid in pids:
            try:
                os.kill(pid, number)
            except ProcessLookupError:
                continue

    def root(self, host: str) -> Path:
        """The files of a host."""
        return Path(f"/proc/{children_of(self._entries[host].pid)[0]}/root")

    def proceed(self, host: str) -> None:
        """Let stopped programs of a host go on."""
        self.signal(self.processes(host), signal.SIGCONT)

    def move_clock(self, host: str, seconds: int) -> None:
        """Set by how much a wall clock is wrong: that of a node's host, or on the head that of the driver alone."""
        set_clock(self.log_folder / f"clock.{host}", seconds)

    def fill_memory(self, host: str, share: float) -> None:
        """Set how much memory of a host seems to be in use, from 0 to 1: what Ray's memory monitor reads there."""
        folder = self.log_folder / f"memory.{host}"
        folder.mkdir(exist_ok=True)
        used = int(share * MEMORY)
        stat = f"anon {used}\nfile 0\nshmem 0\ninactive_file 0\nactive_file 0"
        for name, text in {"memory.max": MEMORY, "memory.current": used, "memory.stat": stat}.items():
            (folder / f"{name}.new").write_text(f"{text}\n")
            (folder / f"{name}.new").replace(folder / name)

    def link(self, host: str, *words: str) -> None:
        """Change the switch's end of a host's link."""
        number = self.nodes.index(host)
        subprocess.run(["ip", "-n", self._switch, "link", "set", f"v{number}", *words], check=True)

    def shape(self, host: str, *limit: str) -> None:
        """Limit what may pass a host's link, in both directions; without words, no longer."""
        for space, device in ((self._switch, f"v{self.nodes.index(host)}"), (self._namespace(host), "eth0")):
            command = ["add", "dev", device, "root", *limit] if limit else ["del", "dev", device, "root"]
            subprocess.run(["tc", "-n", space, "qdisc", *command], check=True)

    def state(self) -> str:
        """What runs, and the ends of the logs, for a message."""
        lines = [f"{self.tally}"]
        for name, started in self._started.items():
            log = sorted(self.log_folder.glob(f"{name}.*.log"))[-1].read_text(errors="replace")[-1500:]
            lines.append(f"{name}: exit code {started.poll()}, after {self._tried_s[name]:.0f}:\n{log}")
        return "\n".join(lines)

    def _unmount(self) -> None:
        """Undo the rest of what `__enter__` did; once is enough."""
        if self.disk.is_mount():
            subprocess.run(["umount", "--lazy", self.disk], check=True)
        signal.signal(signal.SIGTERM, self._on_sigterm)

    def _programs(self, host: str) -> dict[int, str]:
        """Those of `processes` that are not the host itself."""
        entry = self._entries[host].pid
        own = {entry, *children_of(entry)}
        return {
            pid: line
            for pid, line in self.processes(host).items()
            if pid not in own and not line.startswith(("sleep infinity", "nsenter"))
        }

    def _joined(self, host: str) -> bool:
        log = sorted(self.log_folder.glob(f"{host}.*.log"))[-1]
        return "Ray runtime started" in log.read_text(errors="replace")

    def _has_ended(self, name: str) -> bool:
        """Whether something does not run, and has not just been started."""
        return not self._runs(name) and time.monotonic() > self._tried_s.get(name, -AGAIN_S) + AGAIN_S

    def _runs(self, name: str) -> bool:
        started = self._started.get(name)
        return started is not None and started.poll() is None

    def _start_ray(self, host: str, cpus: int, *role: str) -> None:
        clean = ("sh", "-c", 'rm -rf /tmp/ray/session*; exec "$@"', "sh")
        self._start(host, host, *clean, *ray_start(self.ip(self.nodes.index(host)), cpus, *role))

    def _start(self, name: str, host: str, *command: object, **environment: str) -> None:
        self._number += 1
        self._tried_s[name] = time.monotonic()
        with (self.log_folder / f"{name}.{self._number:04}.log").open("wb") as log:
            words, environment = [*self.enter(host), *map(str, command)], self._environment(host) | environment
            self._started[name] = subprocess.Popen(
                words, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )

    def _note_end(self) -> None:
        """Note how the driver ended, so that another one is started."""
        ended = self._started.pop("driver")
        printed = sorted(self.log_folder.glob("driver.*.log"))[-1].read_text(errors="replace")
        self.ends.append(End(ended.returncode, printed))
        # Ray itself ends a driver that asks a head node for something in the instant in which that is lost.
        by_ray = "WrongClusterID" in printed
        ours = "Traceback" if "(raylet)" in printed else "Traceback|StackTrace"  # Ray's own may print the latter
        says_why = re.search("^error: ", printed, re.MULTILINE) and not re.search(ours, printed)
        by_itself = ended.returncode == 1 and says_why
        assert self.may_end, self.ends[-1]
        assert by_itself or by_ray or ended.returncode in KILLED, self.ends[-1]

    def _environment(self, node: str) -> dict[str, str]:
        environment = super()._environment(node) | RAY_SETTINGS | HEALTH
        if node == HEAD:
            return environment
        clock = with_clock(self.log_folder, f"clock.{node}") if self._clock else {}
        return environment | clock | {"XDG_CACHE_HOME": "/tmp/ray/cache"}


def build_clock(folder: Path) -> None:
    """Compile the library that moves wall clocks into a folder."""
    library = folder / "wall_clock.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-Wall", "-Werror", "-o", library, CLOCK, "-ldl"], check=True)


def with_clock(folder: Path, name: str) -> dict[str, str]:
    """Environment of processes whose wall clock is wrong by what a file in the folder says."""
    return {"LD_PRELOAD": str(folder / "wall_clock.so"), "ES_TEST_CLOCK": str(folder / name)}


def set_clock(path: Path, seconds: int) -> None:
    """Write such a file, in place, since the processes have mapped it."""
    file = os.open(path, os.O_WRONLY | os.O_CREAT)
    os.pwrite(file, struct.pack("q", seconds), 0)
    os.close(file)
