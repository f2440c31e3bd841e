"""What does a recurrent policy find in Craftax-Classic by MEMES, beside a policy that acts at random?

    python -m tests.benchmarks.craftax --seeds 0:3                  # all rows that are missing, and the table
    python -m tests.benchmarks.craftax --seeds 100:101 --env-steps 1e6 --set search.sigma=0.05    # a trial

The policy sees the symbols (1,345 numbers), has a layer and a memory of 32 units each, and takes the greatest of 17
outputs. The descriptor is which of six achievements were unlocked in the episode, so the map has 64 cells. Episodes
end by death, or after Craftax's 10,000 steps. The best policy is certified in 256 episodes that no choice has seen.
The rows are in results/craftax.csv; those of trials are only printed. One process of one core for all; needs the
extra `craftax`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service import api
from es_service.cli.sweep import seeds_of
from es_service.protocol.machine import VERSION, cpu_kind
from es_service.protocol.noise import Domain, stream_keys
from es_service.runs.certification import certify_run
from tests.benchmarks.paper import ROOT
from tests.helpers import workers_in_this_process
from workers.environments import make_environment

RUNS = ROOT / "runs" / "craftax"
RESULTS = Path(__file__).parent / "results" / "craftax.csv"
ENV_STEPS, EPISODES, ACTIONS = 3_000_000, 256, 17
"""Steps that fit: one core of a Zen 4 does about 5,000 a second. Settings are the better of two trials of 4e5 steps."""
ACHIEVEMENTS = ["collect_wood", "place_table", "collect_sapling", "collect_drink", "eat_cow", "wake_up"]
CONFIG = {
    "task": {"environment": "craftax:Craftax-Classic-Symbolic-v1", "options": {"descriptor": ACHIEVEMENTS}},
    "policy": {"hidden": [32], "memory": 32, "output": "argmax"},
    "search": {
        "algorithm": "memes",
        "emitters": 4,
        "stagnation_generations": 32,
        "pairs": 16,
        "shaping": {"kind": "top_pairs", "count": 8},
        "sigma": 0.1,
        "step": {"kind": "plain", "learning_rate": 0.1, "l2": 0},
        "evaluation_episodes": 8,
    },
    "map": {"cells": [2] * len(ACHIEVEMENTS)},
    "compute": {"engine": "inline", "workers": 1},
}


def of_seed(seed: int, env_steps: int, settings: Sequence[str]) -> dict[str, Any]:
    """A run from its config, or from where it was interrupted, and its certified best policy."""
    folder = RUNS / "_".join([str(seed), *settings])
    budget = (f"seed={seed}", f"budget.env_steps={env_steps}", "budget.generations=null")
    run = api.run_or_resume(api.load_config(CONFIG, (*budget, *settings)), folder).run
    best, last = certify_run(folder, workers=1, episodes=EPISODES)[0].row(), run.history.iloc[-1]
    row = {"env_steps": int(last.env_steps), "cpu_s": round(float(last.cpu_s)), "coverage": float(last.coverage)}
    return row | {name: best[name] for name in ("return_mean", "return_low", "return_high")}


def at_random() -> dict[str, Any]:
    """Episodes in which each action is drawn evenly: the greatest of numbers that are alike."""
    import jax
    import jax.numpy as jnp

    task = make_environment(CONFIG["task"]["environment"], {})

    def episode(key: Any) -> Any:
        def go_on(carry: Any) -> Any:
            step, state, total, _ = carry
            numbers = jax.random.normal(jax.random.fold_in(key[:2], step), (ACTIONS,))
            state, reward, done = task.step(state, numbers)
            return step + 1, state, total + reward, done

        start = 0, task.reset(key), 0.0, False
        steps, _, total, _ = jax.lax.while_loop(lambda carry: ~carry[-1], go_on, start)
        return steps, total

    keys = stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(EPISODES))
    steps, returns = (np.asarray(of, float) for of in jax.jit(jax.vmap(episode))(jnp.asarray(keys)))
    mean, error = returns.mean(), 1.96 * returns.std(ddof=1) / np.sqrt(EPISODES)
    return {"env_steps": int(steps.sum()), "return_mean": mean, "return_low": mean - error, "return_high": mean + error}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", metavar="A:B", default="0:3")
    parser.add_argument("--env-steps", type=lambda text: int(float(text)), default=ENV_STEPS)
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    given = parser.parse_args()
    is_trial = bool(given.settings) or given.env_steps != ENV_STEPS
    table = pd.read_csv(RESULTS) if RESULTS.exists() else pd.DataFrame(columns=["policy", "seed"])
    with workers_in_this_process():
        for policy, seed in [("at random", 0), *(("memes", seed) for seed in seeds_of(given.seeds))]:
            if not is_trial and ((table.policy == policy) & (table.seed == seed)).any():
                continue
            found = of_seed(seed, given.env_steps, given.settings) if policy == "memes" else at_random()
            row = {"policy": policy, "seed": seed, **found, "cpu": cpu_kind(), "es-service": VERSION}
            print(row, flush=True)
            table = pd.concat([table, pd.DataFrame([row])]) if len(table) else pd.DataFrame([row])
            if not is_trial:
                table.to_csv(RESULTS, index=False, lineterminator="\n")
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
