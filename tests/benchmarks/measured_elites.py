"""MAP-Elites with each kind of `search.elites`, at equal environment steps: what the maps promise, and what they keep.

    python -m tests.benchmarks.measured_elites --steps 10_000_000 --seeds 0:5 --out runs/measured

After a run, each elite is evaluated in fresh episodes, which do not count as steps of the run, and is put into an empty
map by its means: the corrected columns. The certified best is the policy that selection episodes choose of the best
centre and the ten fittest elites. Results are appended to results.jsonl in the folder; a run that is there is not done
again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from es_service import api
from es_service.runs import evaluation
from es_service.runs.certification import certify_run
from es_service.runs.view import Run
from tests.helpers import workers_in_this_process

CONFIG = Path(__file__).parents[2] / "configs" / "point_maze_map_elites.yaml"
KINDS = ("once", "eme", "archive_sampling", "me_sampling", "deep_grid")
FRESH_EPISODES = 100
SHOWN = {
    "coverage": "coverage",
    "qd_score": "QD-score",
    "map_fitness_max": "best",
    "corrected_coverage": "corrected coverage",
    "corrected_qd_score": "corrected QD-score",
    "corrected_fitness_max": "corrected best",
    "certified": "certified best",
}


def corrected(run: Run, episodes: int) -> dict[str, float]:
    """Coverage, QD-score and best fitness of the elites' means over fresh episodes."""
    chosen = evaluation.candidates(run, best=False, centre=False, cells=[], every=True)
    cells: dict[int, float] = {}
    for result in evaluation.evaluate(run, chosen, episodes):
        if result.cell is not None and np.isfinite(result.mean):
            cells[result.cell] = max(result.mean, cells.get(result.cell, -np.inf))
    offset = run.constants["map.qd_offset"]
    return {
        "corrected_coverage": len(cells) / run.behaviour_map.geometry.size,
        "corrected_qd_score": sum(value - offset for value in cells.values()),
        "corrected_fitness_max": max(cells.values()),
    }


def measured(kind: str, seed: int, steps: int, folder: Path, overrides: list[str]) -> dict[str, Any]:
    """One run, and what it has found."""
    settings = [
        f"search.elites.kind={kind}",
        f"seed={seed}",
        f"budget.env_steps={steps}",
        "budget.generations=null",
        "compute.inline_workers=threads",
        *overrides,
    ]
    shutil.rmtree(folder, ignore_errors=True)  # of a measurement that was interrupted
    begun = time.monotonic()
    run = api.run(api.load_config(CONFIG, settings), folder).run
    seconds = time.monotonic() - begun
    last = run.history.iloc[-1]
    stored = {name: float(last[name]) for name in ("coverage", "qd_score", "map_fitness_max", "best_fitness")}
    corrected_values = corrected(run, FRESH_EPISODES)
    [best] = certify_run(folder)
    return {
        "kind": kind,
        "overrides": overrides,
        "seed": seed,
        "env_steps": int(last["env_steps"]),
        "generations": int(run.history.index[-1]),
        "kept": len(run.at().nodes.get("extra/kept", {}).get("serial_K", run.map)),
        "samples": float(run.map["samples"].mean()) if "samples" in run.map else 1.0,
        **stored,
        **corrected_values,
        "certified": float(best.episodes.values()["return_mean"]),
        "successes": best.episodes.values().get("successes"),
        "seconds": seconds,
    }


def main() -> None:
    """Run what is missing, then print the medians and the range over the seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=lambda text: int(float(text)), default=10_000_000)
    parser.add_argument("--seeds", default="0:5")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", help="further settings of all runs")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    first, end = map(int, asked.seeds.split(":"))
    asked.out.mkdir(parents=True, exist_ok=True)
    results = asked.out / "results.jsonl"
    lines = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    rows = [row for row in lines if row["overrides"] == asked.overrides]
    for seed in range(first, end):
        for kind in asked.kinds:
            if any((row["kind"], row["seed"]) == (kind, seed) for row in rows):
                continue
            name = "_".join([kind, str(seed), *asked.overrides]).replace("/", "_")
            with workers_in_this_process():  # the machine may be too busy to start others
                rows.append(measured(kind, seed, asked.steps, asked.out / name, asked.overrides))
            with results.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    if not rows:
        return
    print(f"| kind | {' | '.join(SHOWN.values())} |\n| --- |{' --- |' * len(SHOWN)}")
    for kind in asked.kinds:
        of_kind = [row for row in rows if row["kind"] == kind and first <= row["seed"] < end]
        if not of_kind:
            continue
        cells = [[row[name] for row in of_kind] for name in SHOWN]
        print(f"| {kind} | " + " | ".join(f"{np.median(c):.4g} ({min(c):.4g} to {max(c):.4g})" for c in cells) + " |")


if __name__ == "__main__":
    main()
