"""A stand-in for Slurm: `sbatch`, `srun`, `squeue` and `scontrol requeue`, for one job on hosts of its own.

It does what the script of a job needs: the script runs on the first host, with the options of its #SBATCH lines in its
environment; `srun` runs a command on every host; a signal reaches the script alone, as with `--signal=B:TERM@90`; a job
that is requeued loses all its processes and starts again. Each host has process ids of its own, so that `ray stop`,
which ends every Ray process that it sees, ends those of its host.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.system.cluster import Machines, children_of

SRUN = """#!/bin/bash
while [[ $1 == --* ]]; do shift; done
step=$(mktemp -d "$STAND_IN/step.XXXXXX")
env -0 > "$step/environment"
printf '%s\\0' "$@" > "$step/words"
touch "$step/ready"
until [ -e "$step/ended" ]; do sleep 0.1; done
exit "$(cat "$step/ended")"
"""
SQUEUE = """#!/bin/bash
cat "$STAND_IN/state"
"""
SCONTROL = """#!/bin/bash
[ "$1 $2" = "requeue $SLURM_JOB_ID" ] && echo PENDING > "$STAND_IN/state" && touch "$STAND_IN/requeued"
"""


def write_commands(folder: Path, **commands: str) -> Path:
    """Write programs into `folder`/bin, which is returned."""
    (folder / "bin").mkdir()
    for name, text in commands.items():
        program = folder / "bin" / name.replace("_", "-")
        program.write_text(text)
        program.chmod(0o755)
    return folder / "bin"


def sbatch_options(script: Path) -> dict[str, str]:
    """Option -> value of the #SBATCH lines; "" if it has none."""
    found = re.findall(r"^#SBATCH --([\w-]+)(?:=(\S+))?$", script.read_text(), re.MULTILINE)
    return dict(found)


class Slurm(Machines):
    """One job. Use as a context manager."""

    def __init__(self, folder: Path, hosts: int, cpus: int) -> None:
        super().__init__(folder)
        self._hosts, self._cpus = hosts, cpus
        self._commands = write_commands(folder, srun=SRUN, squeue=SQUEUE, scontrol=SCONTROL)
        self._tasks: dict[Path, list[subprocess.Popen[bytes]]] = {}
        self._started: list[subprocess.Popen[bytes]] = []
        self.restarts = 0

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        for started in self._started:
            started.wait()

    def begin(self) -> None:
        """Make the hosts. Each knows the others' names."""
        names = [f"node{number}" for number in range(self._hosts)]
        hosts = self.log_folder / "hosts"
        lines = [f"{self.ip(number)} {name}" for number, name in enumerate(names)]
        hosts.write_text("\n".join(["127.0.0.1 localhost", *lines, ""]))
        self.boot(*names, setup=f"mount --bind {hosts} /etc/hosts")

    def sbatch(self, script: Path, *arguments: object) -> None:
        """Submit the job, which starts at once."""
        self.options = sbatch_options(script)
        self._job = ["bash", script, *arguments]
        self._start()

    def wait_for(self, what: Callable[[], Any], timeout_s: float = 120.0) -> None:
        """Serve the job until something is true."""
        until = time.monotonic() + timeout_s
        while not what():
            assert time.monotonic() < until, self.output()
            self._serve()
            time.sleep(0.05)

    def ended(self) -> bool:
        """Whether the job has ended for good."""
        return self._script.poll() is not None and not (self.log_folder / "requeued").exists()

    def warn(self) -> None:
        """Send the script, and only it, the signal that it has asked for."""
        assert self.options["signal"].startswith("B:TERM@")
        (pid,) = children_of(self._script.pid)
        os.kill(pid, signal.SIGTERM)

    def output(self) -> str:
        """What the job has printed so far."""
        return (self.log_folder / "slurm.out").read_text()

    @property
    def exit_code(self) -> int | None:
        """Of the script; None while it runs."""
        return self._script.poll()

    def _start(self) -> None:
        (self.log_folder / "state").write_text("RUNNING\n")
        job = {"SLURM_JOB_ID": "7", "SLURM_JOB_NUM_NODES": str(self._hosts), "SLURM_CPUS_PER_TASK": str(self._cpus)}
        job |= {"SLURM_RESTART_COUNT": str(self.restarts), "STAND_IN": str(self.log_folder)}
        self._script = self._popen(self.nodes[0], *self._job, environment=self._environment(self.nodes[0]) | job)

    def _serve(self) -> None:
        """Start and end what the script has asked for."""
        for step in self.log_folder.glob("step.*"):
            if (step / "ready").exists() and step not in self._tasks:
                words = (step / "words").read_text().split("\0")[:-1]
                pairs = [entry.split("=", 1) for entry in (step / "environment").read_text().split("\0")[:-1]]
                self._tasks[step] = [
                    self._popen(node, *words, environment=dict(pairs) | self._mark(node)) for node in self.nodes
                ]
            elif step in self._tasks and all(task.poll() is not None for task in self._tasks[step]):
                codes = [task.returncode for task in self._tasks[step]]
                (step / "ended").write_text(str(max(code if code >= 0 else 128 - code for code in codes)))
        if self._script.poll() is not None:
            self._kill()
            if "requeue" in self.options and (self.log_folder / "requeued").exists():
                (self.log_folder / "requeued").unlink()
                self.restarts += 1
                self._start()

    def _kill(self) -> None:
        """End every process of the job."""
        for node in self.nodes:
            subprocess.run([*self.enter(node), "bash", "-c", "kill -KILL -1"], check=False, capture_output=True)
        for started in self._started:
            started.wait()
        self._started.clear()

    def _popen(self, node: str, *command: object, environment: dict[str, str]) -> subprocess.Popen[bytes]:
        with (self.log_folder / "slurm.out").open("ab") as log:  # --open-mode=append
            words = [*self.enter(node), *map(str, command)]
            started = subprocess.Popen(words, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self._started.append(started)
        return started

    def _mark(self, node: str) -> dict[str, str]:
        """The variables in which the nodes differ."""
        own, first = self._environment(node), self._environment(self.nodes[0])
        return {name: value for name, value in own.items() if first.get(name) != value}

    def _environment(self, node: str) -> dict[str, str]:
        environment = super()._environment(node)
        return environment | {"PATH": f"{self._commands}{os.pathsep}{environment['PATH']}"}
