"""`python -m tests.benchmarks.gpu.service --out FOLDER`: runs of the service on one GPU, killed and resumed there.

A run that is not disturbed, one that is killed and resumed, and one by Ray must have the same digest.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

GPU = {"worker_resources": {"gpu": 1}}
CONFIG: dict[str, Any] = {
    "seed": 0,
    "task": {"environment": "point_maze"},
    "search": {"algorithm": "nsr_es", "pairs": 2048, "evaluation_episodes": 16},
    "policy": {"hidden": [64, 64]},
    "budget": {"generations": 12},
    "compute": GPU,
}
PROGRAM = [sys.executable, "-m", "es_service"]


def started(config: Path, folder: Path, *more: str) -> subprocess.Popen[str]:
    """A new run."""
    command = [*PROGRAM, "run", str(config), "--out", str(folder), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def answer(*words: str, limit_s: float) -> str:
    """What a command prints at its end."""
    ended = subprocess.run([*PROGRAM, *words], capture_output=True, text=True, timeout=limit_s, check=False)
    return (ended.stdout + ended.stderr).strip()[-1500:]


def lines_until(process: subprocess.Popen[str], word: str) -> str:
    """Output of a process up to the first line with this word, or all."""
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if word in line:
            break
    return "".join(said)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--platform", default="cuda", help="cpu: to try the script without a GPU")
    parser.add_argument("--ray", action="store_true", help="one more run, by Ray")
    given = parser.parse_args()
    runs = given.out / "runs"
    shutil.rmtree(runs, ignore_errors=True)
    runs.mkdir(parents=True)
    config = CONFIG if given.platform == "cuda" else CONFIG | {"compute": {"rollout": "xla"}}
    file = runs / "config.json.yaml"
    file.write_text(json.dumps(config))
    began = time.monotonic()

    def tell(name: str, **values: Any) -> None:
        print(json.dumps({"part": name, "at_s": round(time.monotonic() - began, 1), **values}), flush=True)

    whole = started(file, runs / "whole")
    tell("whole", said=lines_until(whole, "no line has this")[-900:], code=whole.wait())
    killed = started(file, runs / "killed")
    lines_until(killed, "generation 6 ")
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    tell("resumed", said=answer("resume", str(runs / "killed"), limit_s=120)[-600:])
    if given.ray:
        by_ray = started(file, runs / "by_ray", "--set", "compute.engine=ray")
        tell("by Ray", said=lines_until(by_ray, "no line has this")[-900:], code=by_ray.wait())
    for folder in sorted(runs.iterdir()):
        if folder.is_dir():
            tell("digest", run=folder.name, digest=answer("digest", str(folder), limit_s=60))
    tell("status", said=answer("status", str(runs / "killed"), limit_s=60))
    tell("evaluate", said=answer("evaluate", str(runs / "whole"), "--episodes", "64", limit_s=120))
    tell("verify", said=answer("verify", str(runs / "whole"), limit_s=200))


if __name__ == "__main__":
    main()
