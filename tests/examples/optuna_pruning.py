"""Settings of an evolution strategy by Optuna: its TPE sampler proposes them, its pruner ends runs that fall behind.

python tests/examples/optuna_pruning.py
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import optuna

from es_service import Stop, load_config, run, workers

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 50},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 8},
    "compute": {"engine": "inline", "workers": 1},
}


def search(trials: int, generations: int, folder: Path, seed: int = 0) -> optuna.Study:
    """A study of sigma and learning rate, whose runs are in folders named after their trials."""

    def mean_fitness(trial: optuna.Trial) -> float:
        settings = {
            "search.sigma": trial.suggest_float("sigma", 0.005, 0.5, log=True),
            "search.step.learning_rate": trial.suggest_float("learning_rate", 0.001, 0.3, log=True),
            "budget.generations": generations,
            "seed": seed,
        }

        def on_generation(row):
            trial.report(row["centre_fitness_mean"], row["generation"])
            return Stop("pruned") if trial.should_prune() else None

        outcome = run(load_config(CONFIG, settings), folder / str(trial.number), on_generation=on_generation)
        if outcome.reason == "pruned":
            raise optuna.TrialPruned
        return float(outcome.run.history["centre_fitness_mean"].iloc[-1])

    study = optuna.create_study(
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=3),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=2, n_warmup_steps=3),
    )
    with workers():  # which stay from one trial to the next
        study.optimize(mean_fitness, n_trials=trials)
    return study


if __name__ == "__main__":
    with TemporaryDirectory() as parent:
        found = search(30, 60, Path(parent))
    pruned = len(found.get_trials(states=[optuna.trial.TrialState.PRUNED]))
    print(f"{found.best_params} of {len(found.trials)} trials, {pruned} of them pruned: fitness {found.best_value:.1f}")
