"""Where does a generation's time go, and what memory does a run take?

    python -m tests.benchmarks.generation_time [--task point_maze] [--algorithm es] [--engine inline ray]
    python -m tests.benchmarks.generation_time --emitters 1 16      # ME-ES, 64 pairs for each emitter
    python -m tests.benchmarks.generation_time --driver             # the driver's own time, without rollouts
    python -m tests.benchmarks.generation_time --study --task ant_trap        # a study of 6 runs of 12 generations

Two workers; PointMaze with 64, 512 and 4,096 pairs, ants with 64 and 5,000; medians over the generations, but for the
first ten if there are more; the engines take turns. Memory is that of this process and everything it started, shared
pages divided among those who share them. With --emitters each run is followed by a measurement of what rollouts alone
make on the same cores (`es-service bench rollouts`), and its rate is also given as a share of that. With --driver,
episodes have five steps, so that the workers do little; what counts is the processor time of the driver's process.
With --study, two workers compute a study of Optuna's whose trials are tiny: each trial with workers of its own, and
then all of them in one block of `es_service.workers()`. A run before both is not counted, so that compiled code is on
disk for both.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

from es_service import api, workers
from es_service.cli.bench import bench_rollouts

POINT_MAZE_SIZES = ((64, 500), (512, 150), (4096, 40))
ANT_SIZES = ((64, 20), (5000, 1))
"""(pairs, generations)."""
DRIVER = {
    "MAP-Elites, 64": ("map_elites", {"batch": 64}),
    "MAP-Elites, 256": ("map_elites", {"batch": 256}),
    "ME-ES, 64 pairs": ("me_es", {"pairs": 64}),
    "ES, 64 pairs": ("es", {"pairs": 64}),
}
"""Cases of --driver: name -> (algorithm, its settings)."""
FIRST, LAST = 10, 410
"""Generations between which --driver measures."""
PARTS = ("rollout", "gradient", "evaluation", "driver", "store")


def family_mib() -> dict[str, float]:
    """Memory (PSS) by process, this one and its descendants: "name pid" -> MiB."""
    parents = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            parents[int(pid)] = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    family = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= more
    mib = {}
    for pid in family:
        try:
            name = Path(f"/proc/{pid}/comm").read_text().strip()
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        mib[f"{name} {pid}"] = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:"))
    return mib


def rollouts_alone(task: str) -> int:
    """Environment steps per second of `bench rollouts` on all cores, with a policy and 64 episodes side by side."""
    rows = bench_rollouts([task], policies=[True], rollouts=["simd"], batches=[64])
    return max(row["steps_per_second"] for row in rows)


def measure(
    task: str, algorithm: str, engine: str, pairs: int, generations: int, folder: Path, emitters: int = 1
) -> dict[str, object]:
    """One run; milliseconds by part, rates, memory of driver and workers."""
    config = api.load_config(
        {
            "task": {"environment": task},
            "policy": {"hidden": [64, 64] if task == "point_maze" else [256, 256]},
            "search": {"algorithm": algorithm, "pairs": pairs, "emitters": emitters},
            "budget": {"generations": generations},
            "compute": {"workers": 2, "engine": engine},
        }
    )
    started = time.perf_counter()
    first_generation_s, mib = 0.0, {}

    def look(row) -> None:
        nonlocal first_generation_s, mib
        if row["generation"] == 1:
            first_generation_s = time.perf_counter() - started
        if row["generation"] == max(1, generations - 1):
            mib = family_mib()

    history = api.run(config, folder, on_generation=api.Observer(look)).run.history
    history = history.iloc[10:] if generations > 10 else history
    parts = {part: float(history[f"seconds_{part}"].median() * 1000) for part in PARTS}
    whole = sum(parts.values())
    return {
        "task": task,
        "algorithm": algorithm,
        "engine": engine,
        "pairs": pairs,
        "emitters": emitters,
        **{f"{part}_ms": round(value, 2) for part, value in parts.items()},
        "generation_ms": round(whole, 1),
        "outside_rollouts_ms": round(whole - parts["rollout"] - parts["evaluation"], 2),
        "outside_rollouts_percent": round(100 * (whole - parts["rollout"] - parts["evaluation"]) / whole, 1),
        "steps_per_second": round(float(history["steps_per_second"].median())),
        "first_generation_s": round(first_generation_s, 1),
        "processes": len(mib),
        "all_processes_mib": round(sum(mib.values())),
    }


def driver_ms(algorithm: str, settings: dict[str, int], folder: Path) -> float:
    """Processor time of the driver's process for a generation, in milliseconds."""
    config = api.load_config(
        {
            "task": {"environment": "point_maze", "episode_steps": 5},
            "search": {"algorithm": algorithm, **settings},
            "budget": {"generations": LAST},
            "compute": {"workers": 2, "engine": "inline"},
        }
    )
    at: dict[int, float] = {}

    def look(row) -> None:
        if row["generation"] in (FIRST, LAST):
            at[row["generation"]] = time.process_time()

    api.run(config, folder, on_generation=api.Observer(look))  # a few generations late, at both ends
    return round((at[LAST] - at[FIRST]) * 1000 / (LAST - FIRST), 2)


def study(task: str, engine: str, trials: int, folder: Path, *, stay: bool) -> tuple[float, list[str]]:
    """Seconds of a study of Optuna's, and the digests of its runs."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    digests = []

    def value(trial: optuna.Trial) -> float:
        config = {
            "task": {"environment": task, "episode_steps": 10},
            "search": {"algorithm": "es", "pairs": 4, "sigma": trial.suggest_float("sigma", 0.01, 0.5, log=True)},
            "budget": {"generations": 12},
            "compute": {"workers": 2, "engine": engine},
        }
        run = api.run(config, folder / str(trial.number)).run
        digests.append(run.digest())
        return float(run.history["centre_fitness_mean"].iloc[-1])

    started = time.perf_counter()
    with workers() if stay else nullcontext():
        optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0)).optimize(value, n_trials=trials)
    return time.perf_counter() - started, digests


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="point_maze")
    parser.add_argument("--algorithm", default="es")
    parser.add_argument("--engine", nargs="+", default=["inline", "ray"])
    parser.add_argument("--emitters", nargs="*", type=int, default=[])
    parser.add_argument("--driver", action="store_true")
    parser.add_argument("--study", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, case in DRIVER.items() if arguments.driver else ():
            print(json.dumps({"case": name, "driver_ms": driver_ms(*case, Path(folder) / name)}), flush=True)
        if arguments.driver:
            return
        for engine in arguments.engine if arguments.study else ():
            here = Path(folder) / engine
            study(arguments.task, engine, 1, here / "before", stay=False)
            alone_s, digests = study(arguments.task, engine, 6, here / "alone", stay=False)
            stay_s, same = study(arguments.task, engine, 6, here / "stay", stay=True)
            row = {"alone_s": round(alone_s, 1), "stay_s": round(stay_s, 1), "ratio": round(stay_s / alone_s, 3)}
            print(json.dumps({"study": arguments.task, "engine": engine, **row, "same": digests == same}), flush=True)
        if arguments.study:
            return
        sizes = POINT_MAZE_SIZES if arguments.task == "point_maze" else ANT_SIZES
        for emitters, engine in itertools.product(arguments.emitters, arguments.engine):
            generations = 300 // emitters + 20 if arguments.task == "point_maze" else 3
            run = Path(folder) / f"{engine}_emitters{emitters}"
            row = measure(arguments.task, "me_es", engine, 64, generations, run, emitters)
            alone = rollouts_alone(arguments.task)
            share = round(100 * int(str(row["steps_per_second"])) / alone)
            print(json.dumps(row | {"rollouts_alone": alone, "percent_of_rollouts_alone": share}), flush=True)
        if arguments.emitters:
            return
        for (pairs, generations), engine in itertools.product(sizes, arguments.engine):
            run = Path(folder) / f"{engine}{pairs}"
            row = measure(arguments.task, arguments.algorithm, engine, pairs, generations, run)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
