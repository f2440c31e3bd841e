"""A run of a method of ours, in the same budgets as the others."""

from __future__ import annotations

from pathlib import Path

import es_service
from es_service.runs.certification import certify_run
from es_service.runs.checked_config import load_config
from es_service.store.folder import holds_run
from tests.benchmarks.baselines.run import COMPUTE, Facts, Found, Run
from tests.benchmarks.certified import CONFIGS, config_of


def our_config(task: str, system: str) -> Path:
    """The config whose settings were chosen for about this budget: on PointMaze, a million steps as in the paper."""
    return CONFIGS / "paper" / f"{task}_{system}.yaml" if task == "point_maze" else config_of(task, system)


class OurRun(Run):
    """A run folder, which is its own checkpoint. What it has found is what `es-service evaluate --certify` chooses."""

    chunk = 10_000_000  # a session begins in a second

    def __init__(self, task: str, system: str, seed: int, folder: Path) -> None:
        self._folder = folder / "run"
        compute = {f"compute.{name}": value for name, value in COMPUTE.items()}
        endless = {"budget.env_steps": None, "budget.generations": 2**40}
        config = our_config(task, system)
        self._config = load_config(config, {"seed": seed} | compute | endless)
        name = f"configs/{config.relative_to(CONFIGS)}"
        self.facts = Facts(0.0, tuple(self._config.policy.hidden), name, ("es-service",))
        super().__init__(task, system, seed, folder)

    @property
    def steps(self) -> int:
        """Environment steps of all sessions."""
        return int(es_service.open_run(self._folder).history.env_steps.iloc[-1]) if holds_run(self._folder) else 0

    def advance(self, steps: int) -> None:
        """Search until the generation with the last of so many environment steps."""
        wanted = self.steps + steps

        def ended(row: dict) -> es_service.Stop | None:
            return es_service.Stop("its steps are spent") if row["env_steps"] >= wanted else None

        es_service.run_or_resume(self._config, self._folder, on_generation=ended, progress=False)

    def write(self, folder: Path) -> None:
        """Nothing: the run has stored each generation."""

    def read(self, folder: Path) -> None:
        """Nothing."""

    def certified(self, episodes: int) -> Found:
        """The best of the best centre, or of the ten elites with the highest fitness."""
        [policy] = certify_run(self._folder, episodes=episodes, workers=1)
        return Found(policy.episodes, policy.candidates)
