"""`python -m tests.benchmarks.gpu --out FOLDER`: what one GPU does with the rollout xla.

Each case is a process that compiles beside the others and computes alone. A line of JSON is printed when a case has
ended, and all are written to FOLDER/cases.jsonl.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from es_service.protocol.process_environment import worker_environment
from tests.benchmarks.gpu.policies import WAYS

WIDE = [256, 256]
GRAPHS = "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
FLAGS = {
    "workers": "",
    "no_graphs": "--xla_gpu_enable_command_buffer=",
    "any_order": "--xla_gpu_deterministic_ops=false",
    "loops_in_graphs": f"--xla_gpu_enable_command_buffer={GRAPHS} --xla_gpu_graph_min_graph_size=1",
}
"""Further flags of XLA, besides those of workers. A graph is a list of kernels that the GPU starts by itself."""


def cases() -> list[dict[str, Any]]:
    """All cases, those first that take longest to compile or that matter most."""

    def case(task: str, members: int, steps: int, way: str = "workers", **more: Any) -> dict[str, Any]:
        hidden = [64, 64] if task == "point_maze" else WIDE
        return {"task": task, "members": members, "steps": steps, "hidden": hidden, "way": way} | more

    sizes = {
        "ant_maze": (8192, 128, 1024, 32768, 131072),
        "ant_trap": (8192, 128, 1024, 32768, 131072),
        "brax:ant": (8192, 128, 1024, 32768, 131072),
        "point_maze": (128, 1024, 8192, 32768, 131072),
    }
    curve = [
        case(task, members, 200 if task == "point_maze" else 100)
        for task, several in sizes.items()
        for members in several
    ]
    again = [case("ant_trap", 1024, 100)]  # two processes must have the same bits
    kept = {"ant_maze": 250, "ant_trap": 250, "point_maze": 200}
    returns = [case(task, 4096, steps, keep_returns=True) for task, steps in kept.items()]
    low_rank = [case("ant_maze", 8192, 100, noise={"kind": "low_rank", "rank": 1})]
    ways = [case("ant_maze", 8192, 100, way, keep_program=way == "members") for way in WAYS]
    physics = [case("ant_maze", 8192, 100, "members") | {"hidden": []}]
    flags = [case("ant_maze", 8192, 100, flags=name) for name in ("no_graphs", "loops_in_graphs")]
    scatters = [case("ant_trap", 1024, 100, scatters=True, flags=name) for name in ("workers", "any_order")]
    return [*returns, *curve, *again, *low_rank, *ways, *physics, *flags, *scatters]


def run(case: dict[str, Any], out: Path, until: float, platform: str) -> dict[str, Any]:
    """The row of a case, or why it has none."""
    left = until - time.monotonic()
    if left < 10:
        return case | {"error": "no time left"}
    environment = worker_environment(os.environ, 1.0 if platform == "cuda" else 0.0)
    environment |= {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "JAX_PLATFORMS": platform}
    flags = [environment.pop("XLA_FLAGS", ""), FLAGS[case.get("flags", "workers")]]
    environment |= {"XLA_FLAGS": " ".join(filter(None, flags))} if any(flags) else {}
    command = [sys.executable, "-m", "tests.benchmarks.gpu.case", json.dumps(case), str(out), str(out / "lock")]
    try:
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=left, check=False)
        lines = ended.stdout.splitlines()
        return json.loads(lines[-1]) if lines else case | {"error": f"exit {ended.returncode}: {ended.stderr[-400:]}"}
    except (subprocess.TimeoutExpired, json.JSONDecodeError) as error:
        return case | {"error": f"{type(error).__name__}: {str(error)[-200:]}"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--limit", type=float, default=240.0, help="seconds after which no case is waited for")
    parser.add_argument("--together", type=int, default=os.cpu_count(), help="cases that compile side by side")
    parser.add_argument("--platform", default="cuda", help="cpu: to try the script without a GPU")
    parser.add_argument("--only", help="cases whose JSON has a match of this regular expression")
    parser.add_argument(
        "--shrink", type=int, default=1, help="divide the numbers of members by this, to try the script"
    )
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + given.limit
    asked = [case | {"members": max(2, case["members"] // given.shrink)} for case in cases()]
    asked = [case for case in asked if given.only is None or re.search(given.only, json.dumps(case))]
    with ThreadPoolExecutor(given.together) as pool, (given.out / "cases.jsonl").open("w") as file:
        for row in pool.map(lambda case: run(case, given.out, until, given.platform), asked):
            text = json.dumps(row)
            print(text, flush=True)
            file.write(text + "\n")
            file.flush()


if __name__ == "__main__":
    main()
