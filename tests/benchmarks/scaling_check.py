"""Does `bench scaling` predict what one and two real workers of Ray do?

    python -m tests.benchmarks.scaling_check

For each config: the prediction, a run with Ray on this machine and the prediction again, since a machine may become
slower meanwhile. A row has milliseconds a generation: `predicted` is the mean of the two predictions, `real` the median
over the generations, but for the first third. Nothing else should compute.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from statistics import mean

from es_service import api
from es_service.config.model import RunConfig
from es_service.runs.scaling import bench_scaling
from tests.benchmarks.ants import USUAL

CONFIGS = {
    "point_maze_me_es.yaml": ([], 300),
    "ant_trap_me_es.yaml": (["search.pairs=256"], 9),
    "ant_maze_me_es.yaml": ([*USUAL, "search.pairs=128"], 6),
}
"""Shipped config -> (changes, generations). The ants have fewer pairs, so that a run takes less than a minute."""
WORKERS = (1, 2)
PARTS = ("rollout", "gradient", "evaluation", "driver", "store")


def predicted(config: RunConfig) -> list[float]:
    """Seconds of a generation for each number of workers, each of which is an actor with one core."""
    return [row["seconds_per_generation"] for row in bench_scaling(config, WORKERS, 1)]


def real(config: RunConfig, folder: Path) -> float:
    """Seconds of a generation."""
    history = api.run(config, folder).run.history
    history = history.iloc[len(history) // 3 :]
    return float(history[[f"seconds_{part}" for part in PARTS]].sum(axis=1).median())


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name, (changes, generations) in CONFIGS.items():
            budget = [f"budget.{key}=null" for key in ("env_steps", "wall_clock_s", "target_fitness")]
            overrides = [*changes, *budget, f"budget.generations={generations}", "compute.engine=ray"]
            configs = [api.load_config(name, [*overrides, f"compute.workers={count}"]) for count in WORKERS]
            before = predicted(configs[0])
            seconds = [
                real(config, Path(folder) / f"{name} {count}") for config, count in zip(configs, WORKERS, strict=True)
            ]
            after = predicted(configs[0])
            for number, count in enumerate(WORKERS):
                expected = mean((before[number], after[number]))
                row = {
                    "config": name,
                    "changes": changes,
                    "workers": count,
                    "predicted_ms": round(1000 * expected, 2),
                    "real_ms": round(1000 * seconds[number], 2),
                    "predicted/real": round(expected / seconds[number], 2),
                }
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
