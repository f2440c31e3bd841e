"""A night in small: a simulator that leaks, prints and crashes, on two Ray nodes whose workers are killed at random.

    python -m tests.benchmarks.night [MINUTES]      # 20 by default; needs root and iproute2

Prints JSON: the greatest memory of all workers, and size of Ray's files, in MiB, in each quarter of the time; how often
workers were lost and killed; whether the digest is that of a run on this machine that nothing has disturbed.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from es_service import load_config, open_run, run
from es_service.config.text import dump_yaml
from tests.system.cluster import Cluster

NIGHT = "ES_NIGHT"
"""Variable of the environment with which the simulator leaks, prints and crashes."""
LEAK_BYTES = 2**18
KILLS_S, LOOKS_S = (5.0, 30.0), 5.0
"""Seconds between two kills, and between two looks."""
SEED = 7


class Leaky:
    """A point that drifts. At night, each episode leaks, each step prints, and an episode of some thousands crashes."""

    observation_size, action_size, episode_steps = 2, 1, 60
    leaked: list[bytes] = []  # noqa: RUF012

    def reset(self, seed):
        """Begin an episode."""
        self.random, self.place = np.random.default_rng(seed), 0.0
        self.is_night = NIGHT in os.environ
        if self.is_night:
            self.leaked.append(os.urandom(LEAK_BYTES))
            if not int.from_bytes(os.urandom(2)) % 5000:
                os.write(2, b"the solver has diverged\n")
                os.abort()
        return [self.place, self.random.normal()]

    def step(self, action):
        """Drift."""
        self.place += 0.1 * float(action[0]) + 0.1 * self.random.normal()
        if self.is_night:
            os.write(1, b"joint limit reached at %.3f, and much more text\n" % self.place)
        return [self.place, self.random.normal()], -abs(self.place - 1.0), False


CONFIG = {
    "task": {"environment": "python:tests.benchmarks.night:Leaky", "recycle_after_episodes": 2000},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "es", "pairs": 32, "evaluation_episodes": 4},
    "map": {"enabled": False},
    "budget": {"generations": 10**6},
    "compute": {"worker_memory_mb": 500, "worker_output_bytes": 200_000, "max_attempts": 20},
}


def disturbed(folder: Path, minutes: float) -> dict[str, object]:
    """A run on two nodes for this time; what was seen meanwhile."""
    chance, seen, kills = random.Random(SEED), [], 0
    (folder / "night.yaml").write_text(dump_yaml(CONFIG))
    with Cluster(folder) as hosts:
        for node in ("one", "two"):
            hosts.start(node, 1, **{NIGHT: "1"})
        options = [
            "--set",
            f"budget.wall_clock_s={60 * minutes}",
            "--address",
            hosts.address,
            "--out",
            folder / "night",
        ]
        driver = hosts.popen("head", "es-service", "run", folder / "night.yaml", *options)
        began, kill_s = time.monotonic(), 30.0
        while driver.poll() is None:
            time.sleep(LOOKS_S)
            now_s = time.monotonic() - began
            workers = [
                pid for node in ("one", "two") for pid, said in hosts.processes(node).items() if "WorkerActor" in said
            ]
            if now_s > kill_s and workers:
                kill_s, kills = now_s + chance.uniform(*KILLS_S), kills + 1
                os.kill(chance.choice(workers), signal.SIGKILL)
            seen.append(
                (now_s, sum(map(_memory_mib, workers)), sum(_files_mib(hosts, node) for node in ("one", "two")))
            )
        print(driver.communicate()[0][-2000:], file=sys.stderr)
    length = seen[-1][0]
    quarters = [[look for look in seen if 4 * look[0] // length == quarter] for quarter in range(4)]
    return {
        "minutes": round(length / 60, 1),
        "workers_mib": [round(max(memory for _, memory, _ in looks)) for looks in quarters],
        "files_mib": [round(max(files for *_, files in looks), 1) for looks in quarters],
        "killed": kills,
    }


def _memory_mib(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:  # it has just ended
        return 0.0


def _files_mib(hosts: Cluster, node: str) -> float:
    """Size of the files of Ray on a node, whose /tmp/ray only its own processes see."""
    total = 0
    for pid in list(hosts.processes(node))[:1]:
        for folder, _, names in os.walk(f"/proc/{pid}/root/tmp/ray"):
            for name in names:
                with suppress(OSError):  # removed meanwhile
                    total += os.lstat(os.path.join(folder, name)).st_size
    return total / 2**20


def main(minutes: float) -> None:
    """Print what a night gives."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        told = disturbed(folder, minutes)
        night = open_run(folder / "night")
        config = load_config(CONFIG, {"budget.generations": night.generation, "compute.engine": "inline"})
        calm = run(config, folder / "calm").run
        lost = int(night.history.lost_workers.sum())
        told |= {"generations": night.generation, "lost_workers": lost, "same_digest": night.digest() == calm.digest()}
        told["run_mib"] = round(sum(file.stat().st_size for file in night.folder.iterdir()) / 2**20, 1)
        print(json.dumps(told))


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 20.0)
