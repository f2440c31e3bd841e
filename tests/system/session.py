"""One session of a run in a process of its own, which can be told to die: `python -m tests.system.session JSON`.

JSON: {"folder", "config": mapping or null to resume, "kill": {"at": hook name, "nth": 1, "after_us": null}}. The kill
is SIGKILL to itself at the nth time the store reaches the named point; with `after_us`, that many microseconds later,
from a thread, while the main thread goes on.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import AbstractContextManager
from pathlib import Path

from tests.system import warm
from tests.system.processes import ROOT, running

Started = AbstractContextManager[subprocess.Popen[str]]
SMALL = {
    "task": {"environment": "point_maze", "episode_steps": 30},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "nsra_es", "pairs": 16, "evaluation_episodes": 4, "fitness_weight_patience": 2},
    "budget": {"generations": 30},
    "compute": {"engine": "inline", "workers": 1, "chunk_pairs": 8, "gradient_block_pairs": 8},
}
"""A run of some milliseconds a generation: five centres, archive, adaptive weight."""


def start(folder: Path, *, config: dict | None = None, kill: dict | None = None) -> Started:
    """Start a session; it resumes unless a config is given."""
    arguments = json.dumps({"folder": str(folder), "config": config, "kill": kill})
    return running(sys.executable, "-m", "tests.system.session", arguments, cwd=ROOT)


def finish(folder: Path, *, config: dict | None = None, kill: dict | None = None) -> int:
    """Run a session to its end; the exit code. A session that fails by itself shows its error."""
    process = warm.call(_main, str(folder), config, kill)
    assert process.returncode in (0, -signal.SIGKILL), process.stderr
    return process.returncode


def _main(folder: str, config: dict | None, kill: dict | None) -> None:
    from es_service import api

    seen = 0
    killers: list[threading.Thread] = []

    def die() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def hook(name: str) -> None:
        nonlocal seen
        if kill is None or name != kill["at"]:
            return
        seen += 1
        if seen != kill.get("nth", 1):
            return
        delay_us = kill.get("after_us")
        if delay_us is None:
            die()
        armed = threading.Event()

        def later() -> None:
            end = time.perf_counter_ns() + 1000 * delay_us
            armed.set()
            while time.perf_counter_ns() < end:
                time.sleep(0)
            die()

        killers.append(threading.Thread(target=later, daemon=True))
        killers[0].start()
        armed.wait()

    if config is None:
        api.resume(folder, hook=hook)
    else:
        api.run(api.load_config(config), folder, hook=hook)
    for killer in killers:
        killer.join()  # it may have had no core until the session was over


if __name__ == "__main__":
    _main(**json.loads(sys.argv[1]))
