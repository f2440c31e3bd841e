"""A night in small: a simulator that leaks, prints and crashes, on two Ray nodes whose workers are killed at random.

    python -m tests.benchmarks.night [MINUTES]      # 20 by default; needs root and iproute2, and matplotlib
    python -m tests.benchmarks.night --draw         # the picture again, of results/night.csv

A run goes on for these minutes. Then the same generations are computed on this machine, where nothing disturbs them,
and the digests are compared. Prints JSON; the greatest values of each minute become results/night.csv and
results/night.png.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service import load_config, open_run, run
from es_service.config.text import dump_yaml
from tests.system.cluster import Cluster

NIGHT = "ES_NIGHT"
"""Variable of the environment with which the simulator leaks, prints and crashes."""
LEAK_BYTES = 2**19
"""What an episode leaks in every second process; in the others twice as much, so that some are replaced after their
episodes and some for their memory."""
STEP_S = 0.001
"""Seconds that a step waits at night, as for a program beside it."""
KILLS_S, LOOKS_S = (5.0, 60.0), 5.0
"""Seconds between two kills, and between two looks."""
SEED = 7
NODES = ("one", "two")
RESULTS = Path(__file__).parent / "results"
LIMIT_MB = 500


class Leaky:
    """A point that drifts. At night, each episode leaks, each step prints and waits, and an episode of a thousand
    crashes."""

    observation_size, action_size, episode_steps = 2, 1, 60
    leaked: list[bytes] = []  # noqa: RUF012

    def reset(self, seed):
        """Begin an episode."""
        self.random, self.place = np.random.default_rng(seed), 0.0
        self.is_night = NIGHT in os.environ
        if self.is_night:
            self.leaked.append(os.urandom(LEAK_BYTES * (1 + os.getpid() % 2)))
            if not int.from_bytes(os.urandom(2)) % 1000:
                os.write(2, b"the solver has diverged\n")
                os.abort()
        return [self.place, self.random.normal()]

    def step(self, action):
        """Drift."""
        self.place += 0.1 * float(action[0]) + 0.1 * self.random.normal()
        if self.is_night:
            os.write(1, b"joint limit reached at %.3f, and much more text\n" % self.place * 10)
            time.sleep(STEP_S)
        return [self.place, self.random.normal()], -abs(self.place - 1.0), False


CONFIG = {
    "task": {"environment": "python:tests.benchmarks.night:Leaky", "recycle_after_episodes": 400},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "es", "pairs": 32, "evaluation_episodes": 4},
    "map": {"enabled": False},
    "budget": {"generations": 10**6},
    "compute": {"worker_memory_mb": LIMIT_MB, "worker_output_bytes": 200_000, "max_attempts": 20},
}


def disturbed(folder: Path, minutes: float) -> tuple[dict[str, int], pd.DataFrame]:
    """A run on two nodes for this time: how many workers were killed and replaced, and a row for each look.

    Raises RuntimeError with what the driver has printed if it ends otherwise than by its budget.
    """
    chance, looks, kills, kill_s = random.Random(SEED), [], 0, 30.0
    out, printed = folder / "night", folder / "printed"
    (folder / "night.yaml").write_text(dump_yaml(CONFIG))
    with Cluster(folder) as hosts:
        for node in NODES:
            hosts.start(node, 1, **{NIGHT: "1"})
        budget = f"budget.wall_clock_s={60 * minutes}"
        command = ["es-service", "run", folder / "night.yaml", "--set", budget, "--address", hosts.address]
        command += ["--log-level", "info"]  # names each replacement
        # To a file, since a pipe that nobody reads would stop the driver.
        driver = hosts.popen("head", "sh", "-c", 'exec "$@" >"$0" 2>&1', printed, *command, "--out", out)
        began = time.monotonic()
        while driver.poll() is None:
            time.sleep(LOOKS_S)
            now_s = time.monotonic() - began
            processes = {node: hosts.processes(node) for node in NODES}
            workers = [pid for node in NODES for pid, command in processes[node].items() if "WorkerActor" in command]
            if now_s > kill_s and workers:
                kill_s = now_s + chance.uniform(*KILLS_S)
                with suppress(ProcessLookupError):  # it has ended by itself
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    kills += 1
            looks.append(
                {
                    "minute": now_s / 60,
                    "worker_mib": max(map(_memory_mib, workers), default=0.0),
                    "node_mib": sum(_memory_mib(pid) for node in NODES for pid in processes[node]) / len(NODES),
                    "driver_mib": _memory_mib(driver.pid),
                    "node_files_mib": max(_ray_files_mib(list(processes[node])) for node in NODES),
                    "head_files_mib": _ray_files_mib([driver.pid]),
                    "run_mib": _size_mib(out),
                    "killed": kills,
                }
            )
    if driver.returncode:
        raise RuntimeError(printed.read_text(errors="replace")[-4000:])
    replacements = r"is replaced by a new process, since .*\.(\w+)\)$"
    said = re.findall(replacements, printed.read_text(errors="replace"), re.MULTILINE)
    replaced = {f"replaced_for_{key}": count for key, count in Counter(said).items()}
    return {"killed": kills} | replaced, pd.DataFrame(looks[:-1])  # the driver has ended before the last look


def _memory_mib(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:  # it has just ended
        return 0.0


def _ray_files_mib(processes: list[int]) -> float:
    """Size of the files of Ray on a node, whose /tmp/ray only its own processes see."""
    return next((size for pid in processes if (size := _size_mib(Path(f"/proc/{pid}/root/tmp/ray")))), 0.0)


def _size_mib(folder: Path) -> float:
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):  # removed meanwhile
                total += os.lstat(os.path.join(parent, name)).st_size
    return total / 2**20


def draw(minutes: pd.DataFrame, path: Path) -> None:
    """Memory above, files below, over the minutes of the night."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (memory, files) = plt.subplots(2, figsize=(7.0, 4.6), sharex=True, layout="constrained")
    names = {
        "worker_mib": "the largest worker",
        "node_mib": "all processes of a node",
        "driver_mib": "the driver",
    }
    for column, name in names.items():
        memory.plot(minutes.minute, minutes[column], label=name)
    memory.axhline(LIMIT_MB, color="black", linewidth=0.8, linestyle=":", label="compute.worker_memory_mb")
    names = {
        "node_files_mib": "files of Ray on a node",
        "head_files_mib": "files of Ray on the head",
        "run_mib": "the run's folder",
    }
    for column, name in names.items():
        files.plot(minutes.minute, minutes[column], label=name)
    for axes, title in ((memory, "memory, MiB"), (files, "files, MiB")):
        axes.set_ylim(0)
        axes.set_ylabel(title)
        axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    files.set_xlabel(f"minutes; {minutes.killed.iloc[-1]:,} workers killed")
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


def main(minutes: float) -> None:
    """Print what a night gives."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        counts, looks = disturbed(folder, minutes)
        of_minutes = looks.groupby(looks.minute.astype(int), as_index=False).max().round(1)
        of_minutes.to_csv(RESULTS / "night.csv", index=False)
        draw(of_minutes, RESULTS / "night.png")
        quarter = np.arange(len(looks)) * 4 // len(looks)
        night = open_run(folder / "night")
        seen: dict[str, Any] = {
            "minutes": round(float(looks.minute.iloc[-1]), 1),
            **{column: looks[column].groupby(quarter).max().round(1).tolist() for column in looks.columns[1:-1]},
            **counts,
            "lost_workers": int(night.history.lost_workers.sum()),
            "generations": night.generation,
        }
        print(json.dumps(seen), file=sys.stderr)
        config = load_config(CONFIG, {"budget.generations": night.generation, "compute.engine": "inline"})
        calm = run(config, folder / "calm").run
        print(json.dumps(seen | {"same_digest": night.digest() == calm.digest()}))


if __name__ == "__main__":
    if sys.argv[1:] == ["--draw"]:
        draw(pd.read_csv(RESULTS / "night.csv"), RESULTS / "night.png")
    else:
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 20.0)
