"""What do other systems, and our methods, find on our tasks with the same steps or the same CPU time?

    python -m tests.learners.environment && python -m tests.learners.environment qdax       # once
    python -m tests.benchmarks.baselines --tasks ant_trap --systems sac --seeds 0 --cpu-seconds 3600
    python -m tests.benchmarks.baselines --table                                            # only the table

Runs are done one after another, each in a process with one thread, and go on from their checkpoints below
`runs/baselines` if they were stopped or the budget has grown. Each gives a row of results/baselines.csv, with the steps
that it has reached. At the end, the tables of the rows are printed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from es_service.protocol.process_environment import worker_environment
from tests.benchmarks.baselines.programs import SYSTEMS
from tests.benchmarks.baselines.rows import in_words, put, read
from tests.benchmarks.baselines.run import SIZES
from tests.learners.environment import FOLDER, ROOT, problem, python_of

RESULTS = Path(__file__).parents[1] / "results" / "baselines.csv"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=10**9, help="environment steps after which a run ends")
    parser.add_argument("--cpu-seconds", type=float, default=3600.0, help="CPU time after which a run ends")
    parser.add_argument("--environments", type=Path, default=FOLDER, help="folder of the environments of others")
    parser.add_argument("--folder", type=Path, default=ROOT / "runs" / "baselines", help="folder of the checkpoints")
    parser.add_argument("--results", type=Path, default=RESULTS, help="the table that is written")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    systems = [] if given.table else given.systems
    for name in sorted({SYSTEMS[system].environment for system in systems} - {""}):
        if why := problem(name, given.environments):
            way_out = f"python -m tests.learners.environment {name}"
            parser.error(f"{given.environments / name} cannot be used: {why}. To build it: {way_out}")
    failed = []
    for seed in given.seeds:
        for task in given.tasks:
            for system in systems:
                name = f"{task}-{system}-{seed}"
                request = {
                    "task": task,
                    "system": system,
                    "seed": seed,
                    "folder": str((given.folder / name).absolute()),
                    "steps": given.steps,
                    "cpu_seconds": given.cpu_seconds,
                    "parent": os.getpid(),
                }
                where = SYSTEMS[system].environment
                python = python_of(where, given.environments) if where else sys.executable
                command = [python, "-m", "tests.benchmarks.baselines.learn", json.dumps(request)]
                done = subprocess.run(
                    command,
                    cwd=ROOT,
                    env=worker_environment(os.environ),
                    stdout=subprocess.PIPE,
                    text=True,
                    check=False,
                )
                if done.returncode:
                    failed.append(f"{name} (exit code {done.returncode})")
                    continue
                put(given.results, json.loads(done.stdout.splitlines()[-1]))
                print(done.stdout.splitlines()[-1], flush=True)
    print(in_words(read(given.results)))
    if failed:
        sys.exit(f"failed, and said why above if no signal ended it: {', '.join(failed)}")


if __name__ == "__main__":
    main()
