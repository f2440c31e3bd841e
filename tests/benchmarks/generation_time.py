"""Where does a generation's time go, and what memory does a run take?

    python -m tests.benchmarks.generation_time

Plain ES on PointMaze with two workers at 512 and 4,096 pairs, medians over the generations after the first ten.
"""

from __future__ import annotations

import json
import resource
import tempfile
import time
from pathlib import Path

from es_service import api
from tests.benchmarks.rollouts_per_second import resident_mib
from tests.system.test_workers import children

PARTS = ("rollout", "gradient", "evaluation", "driver", "store")


def measure(pairs: int, generations: int, folder: Path) -> dict[str, object]:
    """One run; milliseconds by part, rates, memory of driver and workers."""
    config = api.load_config(
        {
            "task": {"environment": "point_maze"},
            "search": {"algorithm": "es", "pairs": pairs},
            "budget": {"generations": generations},
            "compute": {"workers": 2},
        }
    )
    started = time.perf_counter()
    first_generation_s, worker_mib = 0.0, 0.0

    def look(row) -> None:
        nonlocal first_generation_s, worker_mib
        if row["generation"] == 1:
            first_generation_s = time.perf_counter() - started
        if row["generation"] == generations - 1:
            worker_mib = max(resident_mib(pid) for pid in children())

    history = api.run(config, folder, on_generation=look).run.history.iloc[10:]
    parts = {part: float(history[f"seconds_{part}"].median() * 1000) for part in PARTS}
    whole = sum(parts.values())
    return {
        "pairs": pairs,
        **{f"{part}_ms": round(value, 2) for part, value in parts.items()},
        "generation_ms": round(whole, 1),
        "outside_rollouts_ms": round(whole - parts["rollout"] - parts["evaluation"], 2),
        "outside_rollouts_percent": round(100 * (whole - parts["rollout"] - parts["evaluation"]) / whole, 1),
        "steps_per_second": round(float(history["steps_per_second"].median())),
        "first_generation_s": round(first_generation_s, 1),
        "worker_peak_mib": round(worker_mib),
        "driver_peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rows = [measure(512, 150, Path(folder) / "512"), measure(4096, 40, Path(folder) / "4096")]
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
