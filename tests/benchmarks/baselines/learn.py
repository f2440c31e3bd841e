"""One run of a system, in the environment of its library; `python -m tests.benchmarks.baselines` starts it.

    python -m tests.benchmarks.baselines.learn '{"task": "ant_trap", "system": "sac", "seed": 0, "folder": ..., ...}'

It ends with the process that started it. It goes on from the folder's checkpoint if there is one, certifies what it has
found by the end, and prints its row as one line of JSON.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

from es_service.protocol.child import end_with
from tests.benchmarks.baselines.programs import SYSTEMS
from tests.benchmarks.baselines.run import Run


def begun(task: str, system: str, seed: int, folder: Path) -> Run:
    """A run, new or from its checkpoint."""
    module, _, name = SYSTEMS[system].run.partition(":")
    run_class: type[Run] = getattr(importlib.import_module(f"tests.benchmarks.baselines.{module}"), name)
    return run_class(task, system, seed, folder)


def main() -> None:
    asked = json.loads(sys.argv[1])
    end_with(asked.pop("parent"))
    steps, seconds = asked.pop("steps"), asked.pop("cpu_seconds")
    run = begun(**asked | {"folder": Path(asked["folder"])})
    before = run.steps
    run.work(steps, seconds)
    if run.steps != before:
        run.keep()
    print(json.dumps(run.row(is_finished=run.steps >= steps or run.cpu_seconds >= seconds)))


if __name__ == "__main__":
    main()
