"""Does another version of the code compute the same runs, bit for bit?

    PYTHONPATH=OTHER_CHECKOUT python tests/benchmarks/reference_runs.py make before
    python tests/benchmarks/reference_runs.py make after
    python tests/benchmarks/reference_runs.py compare before after

`make` computes ten runs with whatever `es_service` Python finds, by its command line alone, so that it serves every
version: each algorithm, the three tasks, both engines, both rollouts, two runs that are killed (`kill -9`) and resumed,
one fork. Their configs are frozen in `reference_configs`, and written with the older names of two keys for a version
before 0.13. `compare` shows for each run how many arrays (centres, optimisers, statistics, novelty archive, map,
elites) and how many history values are equal, and exits with 1 if anything is not. Two workers; about two minutes on a
Zen 5.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

CONFIGS = Path(__file__).parent / "reference_configs"
RENAMED = {"search.step.learning_rate": "search.learning_rate"}
"""Key of a setting below -> its name before version 0.13."""
NOT_REPEATED = ("retries", "lost_workers", "workers", "wall_clock_s", "steps_per_second", "rollout_s", "cpu_s")
"""History columns that two equal runs may differ in; so may those that begin with "seconds_"."""
ONE_EMITTER = ("search.emitters=1", "search.pairs=64")
"""What the config of ME-ES on PointMaze had before version 0.7."""
SMALL_ANT = ("search.pairs=16", "search.evaluation_episodes=8", "budget.generations=6")


class Reference(NamedTuple):
    """One run: a frozen config, what is changed of it, and what happens to it."""

    config: str
    engine: str
    settings: tuple[str, ...]
    killed_at: int | None = None
    """Generation after which the driver is killed; the run is then resumed."""
    resumed_with: str = "inline"
    parent: str | None = None
    """The run this one is a fork of."""


REFERENCES = {
    "es": Reference("point_maze_es", "inline", ("budget.generations=60",)),
    "ns_es": Reference("point_maze_ns_es", "ray", ("budget.generations=60",)),
    "nsr_es_xla": Reference("point_maze_nsr_es", "inline", ("budget.generations=20", "compute.rollout=xla")),
    "nsra_es_resumed": Reference("point_maze_nsra_es", "inline", ("budget.generations=200",), killed_at=40),
    "me_es": Reference("point_maze_me_es", "ray", (*ONE_EMITTER, "budget.generations=200")),
    "me_es_resumed": Reference(
        "point_maze_me_es",
        "inline",
        (*ONE_EMITTER, "budget.generations=300", "seed=7"),
        killed_at=33,
        resumed_with="ray",
    ),
    "me_es_fork": Reference(
        "point_maze_me_es", "inline", ("budget.generations=260", "search.step.learning_rate=0.02"), parent="me_es"
    ),
    "ant_maze_me_es": Reference("ant_maze_me_es", "inline", (*SMALL_ANT, "search.block_generations=2")),
    "ant_maze_nsra_es": Reference("ant_maze_nsra_es", "ray", SMALL_ANT),
    "ant_trap_nsr_es": Reference("ant_trap_nsr_es", "inline", (*SMALL_ANT, "compute.inline_workers=threads")),
}


def command(*words: object) -> list[str]:
    """A command of the version at hand."""
    return [sys.executable, "-m", "es_service", *map(str, words)]


def finish(words: list[str]) -> None:
    """Run a command to its end."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{words} ended with {done.returncode}:\n{done.stderr}")


def kill_after(words: list[str], folder: Path, generation: int) -> None:
    """Run a command until a generation is committed, then kill its process; workers end by themselves."""
    from es_service import open_run

    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None:
        time.sleep(0.05)
        if (folder / "run.db").exists() and reached(open_run, folder) >= generation:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            return
    sys.exit(f"{words} ended before generation {generation} could be seen")


def reached(open_run, folder: Path) -> int:
    """Newest committed generation, -1 before the first."""
    try:
        return len(open_run(folder).history) - 1
    except Exception:  # the folder is being made
        return -1


def make(folder: Path) -> None:
    """Compute all runs into a folder, each beside the arrays that `compare` reads."""
    from es_service.protocol.machine import VERSION

    folder.mkdir(parents=True)
    is_older = tuple(map(int, VERSION.split(".")[:2])) < (0, 13)
    for name, reference in REFERENCES.items():
        run, started = folder / name, time.perf_counter()
        settings = []
        for setting in reference.settings:
            key, _, value = setting.partition("=")
            settings += ["--set", f"{RENAMED.get(key, key) if is_older else key}={value}"]
        sizes = ["--workers", "2", "--engine", reference.engine]
        if reference.parent:
            finish(command("fork", folder / reference.parent, "--out", run, *sizes, *settings))
        else:
            text = (CONFIGS / f"{reference.config}.yaml").read_text()
            if is_older:
                text = re.sub(r"  step:\n    (.*)\n    (.*)\n", r"  \1\n  \2\n", text)
            config = folder / f"{name}.yaml"
            config.write_text(text)
            words = command("run", config, "--out", run, *sizes, *settings)
            if reference.killed_at is None:
                finish(words)
            else:
                kill_after(words, run, reference.killed_at)
                finish(command("resume", run, "--workers", "2", "--engine", reference.resumed_with))
        np.savez(folder / f"{name}.npz", **contents(run))
        digest = subprocess.run(command("digest", run), capture_output=True, text=True, check=True).stdout.strip()
        print(f"{name:<18}{time.perf_counter() - started:6.1f} s  {digest}", flush=True)


def contents(run: Path) -> dict[str, np.ndarray]:
    """Every array of the newest state, and every numeric history column."""
    from es_service import open_run

    opened_run = open_run(run)
    arrays = {
        f"state/{part}/{name}": values
        for part, values_of in opened_run.at().nodes.items()
        for name, values in values_of.items()
    }
    for column, values in opened_run.history.items():
        if column not in NOT_REPEATED and not str(column).startswith("seconds_"):
            arrays[f"history/{column}"] = values.to_numpy(np.float64, na_value=np.nan)
    return arrays


def compare(before: Path, after: Path) -> bool:
    """Whether all is equal; prints a line per run, and what differs."""
    equal = True
    for name in REFERENCES:
        old, new = (renamed(np.load(folder / f"{name}.npz")) for folder in (before, after))
        names = sorted({*old, *new})
        other = [key for key in names if key not in old or key not in new or not same(old[key], new[key])]
        values = sum(new[key].size for key in new)
        generations = len(new["history/env_steps"]) - 1
        verdict = f"differ in {', '.join(other)}" if other else "equal"
        print(f"{name:<18}{generations:>5} generations {len(names):>6} arrays {values:>12,} values  {verdict}")
        equal &= not other
    return equal


def renamed(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays by the names that they have since version 0.6: what was a member is a centre."""
    invalid = "history/invalid_members"
    return {name if name == invalid else name.replace("member", "centre"): arrays[name] for name in arrays}


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two arrays have the same type, shape and bits."""
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


def main() -> None:
    """The command line of this script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["make", "compare"])
    parser.add_argument("folders", type=Path, nargs="+")
    given = parser.parse_args()
    if given.what == "make":
        make(*given.folders)
    elif not compare(*given.folders):
        sys.exit(1)


if __name__ == "__main__":
    main()
