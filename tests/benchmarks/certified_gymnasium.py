"""How soon does ARS reach the thresholds of Mania et al. 2018 in Gymnasium's MuJoCo tasks, certified in C MuJoCo?

    python -m tests.benchmarks.certified_gymnasium                               # all runs that are missing
    python -m tests.benchmarks.certified_gymnasium --task Hopper-v5 --policy linear --seeds 0:3
    python -m tests.benchmarks.certified_gymnasium --table                       # only print the table
    python -m tests.benchmarks.certified_gymnasium --task Hopper-v5 --seeds 100:103 --set search.sigma=0.05   # a trial

ARS trains with `mujoco:ID`, MuJoCo's equations by simd, without the reward for being alive, and with the settings of
its paper (arXiv:1803.07055, table 9, V2-t), but for Swimmer's, which are those of
configs/gymnasium_Swimmer-v5_ars.yaml. A run stops at each mark, a number of environment steps. If its best policy may
have reached the threshold, and at the last mark, it is certified in `gymnasium:ID`, which is C MuJoCo and gives that
reward. The run goes on until a certified mean reaches the threshold, or until the last mark. There are as many runs at
a time as cores, each in one process. Each certification gives a row in results/certified_gymnasium.csv, and a finished
run is not computed again. One that is interrupted goes on from its folder in runs/certified_gymnasium. The rows of a
trial are printed and not stored.

The thresholds are those of the paper's table 1, for the tasks of version 1: here the tasks are of version 5.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from es_service import api
from es_service.cli.sweep import seeds_of
from es_service.protocol.machine import cpu_kind
from es_service.runs.certification import certify_run
from es_service.runs.certified import certified_policies
from tests.benchmarks.paper import ROOT, commit, compute
from tests.helpers import workers_in_this_process

RUNS = ROOT / "runs" / "certified_gymnasium"
RESULTS = Path(__file__).parent / "results" / "certified_gymnasium.csv"
RUN = ["task", "policy", "settings", "seed"]
"""Columns that name a run."""
SEEDS, EPISODE_STEPS = 5, 1000
NEAR = 0.9
"""A policy is certified if its fitness, with the greatest bonus, is at least this share of the threshold."""
POLICIES: Mapping[str, list[int]] = {"linear": [], "64x64": [64, 64]}


class Published(NamedTuple):
    """Settings of ARS for a task, and the return that counts as solved."""

    threshold: float
    pairs: int
    best: int
    """Best pairs, from which a step is computed."""
    sigma: float
    learning_rate: float
    most_steps: float
    """Last mark."""
    has_bonus: bool = True
    """Whether there is a reward for being alive."""


TASKS: Mapping[str, Published] = {
    "Swimmer-v5": Published(325, 4, 4, 0.1, 0.1, 2e6, has_bonus=False),
    "Hopper-v5": Published(3120, 8, 4, 0.025, 0.01, 5e7),
    "HalfCheetah-v5": Published(3430, 32, 4, 0.03, 0.02, 2e7, has_bonus=False),
    "Walker2d-v5": Published(4390, 40, 30, 0.025, 0.03, 2e8),
    "Ant-v5": Published(3580, 60, 20, 0.025, 0.015, 1e8),
}


class Wanted(NamedTuple):
    """A run that is to be certified at each mark."""

    task: str
    policy: str
    seed: int
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of its folder."""
        return "_".join([self.task, self.policy, str(self.seed), *self.settings]).replace("/", "_")


def marks(most_steps: float) -> list[int]:
    """Numbers of environment steps at which runs are certified: 1, 1.5, 2, 3, 5 and 7 in each power of ten."""
    powers = (10**power for power in range(5, 9))
    found = [int(part * power) for power in powers for part in (1, 1.5, 2, 3, 5, 7) if part * power < most_steps]
    return [*found, int(most_steps)]


def config_of(wanted: Wanted) -> dict[str, Any]:
    """The config of a run, without its budget."""
    published = TASKS[wanted.task]
    return {
        "task": {
            "environment": f"mujoco:{wanted.task}",
            "options": {"healthy_reward": 0.0} if published.has_bonus else {},
        },
        "policy": {"hidden": POLICIES[wanted.policy], "output": "linear", "action_noise": 0},
        "search": {
            "algorithm": "ars",
            "pairs": published.pairs,
            "sigma": published.sigma,
            "shaping": {"count": published.best},
            "step": {"learning_rate": published.learning_rate},
            "evaluation_episodes": 16,
        },
        "map": {"enabled": False},
        "compute": {"engine": "inline", "workers": 1},
        "seed": wanted.seed,
    }


def run_one(wanted: Wanted) -> pd.DataFrame:
    """One run from its config, or from where it was interrupted: a row for each mark."""
    published, code, folder = TASKS[wanted.task], commit(), RUNS / wanted.name
    certified = folder / "certified.csv"
    for mark in marks(published.most_steps):
        rows = pd.read_csv(certified) if certified.exists() else pd.DataFrame()
        if len(rows) and rows.elsewhere_return_mean.iloc[-1] >= published.threshold:
            break
        with workers_in_this_process():
            budget = [f"budget.env_steps={mark}", "budget.generations=null"]
            run = api.run_or_resume(api.load_config(config_of(wanted), (*budget, *wanted.settings)), folder).run
            last, passed = run.history.iloc[-1], run.history.env_steps.iloc[:-1].max() >= mark
            if passed or (len(rows) and rows.env_steps.iloc[-1] >= last.env_steps):  # before an interruption
                continue
            most = float(run.history.best_fitness.max()) + published.has_bonus * EPISODE_STEPS
            if most < NEAR * published.threshold and mark < published.most_steps:
                continue
            certify_run(folder, workers=1, task=f"gymnasium:{wanted.task}")
        best = max(certified_policies(folder), key=lambda policy: policy.number).row()
        row = (
            dict(zip(RUN, [wanted.task, wanted.policy, " ".join(wanted.settings), wanted.seed], strict=True))
            | {"env_steps": int(last.env_steps), "cpu_s": round(float(last.cpu_s), 1)}
            | {name: value for name, value in best.items() if "return" in name}
            | {"threshold": published.threshold, "cpu": cpu_kind(), "commit": code}
        )
        pd.concat([rows, pd.DataFrame([row])]).to_csv(certified, index=False)
    return read(certified)


def read(path: Path) -> pd.DataFrame:
    """A table of results, without rows if there is no file."""
    if not path.exists():
        return pd.DataFrame(columns=RUN)
    return pd.read_csv(path, dtype={"settings": object}).fillna({"settings": ""})


def keep(rows: pd.DataFrame) -> bool:
    """Print the rows of a finished run; unless it was a trial, put them into the table in the place of older ones."""
    print(
        rows[[*RUN, "env_steps", "cpu_s", "return_mean", "elsewhere_return_mean"]].to_string(header=False), flush=True
    )
    if not rows.settings.iloc[0]:
        table = read(RESULTS)
        is_old = (table[RUN] == rows[RUN].iloc[0]).all(axis="columns")
        kept = [part for part in (table.loc[~is_old], rows) if len(part)]
        pd.concat(kept).sort_values(by=[*RUN, "env_steps"]).to_csv(RESULTS, index=False, lineterminator="\n")
    return True


def in_words(table: pd.DataFrame) -> str:
    """The results in Markdown: of each task and policy, the seeds that reached the threshold, and after how long."""
    head = ["task", "policy", "threshold", "seeds that reached it", "million steps", "seconds of a core", "last return"]
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    for _, rows in table.groupby(["task", "policy"], sort=False):
        last = rows.sort_values("env_steps").groupby("seed").last()
        reached = last[last.elsewhere_return_mean >= last.threshold]
        cells = [
            str(last.task.iloc[0]),
            str(last.policy.iloc[0]),
            f"{last.threshold.iloc[0]:,.0f}",
            f"{len(reached)} of {len(last)}",
        ]
        cells += [_range(reached.env_steps / 1e6), _range(reached.cpu_s), _range(last.elsewhere_return_mean)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _range(values: pd.Series) -> str:
    if values.empty:
        return ""
    low, median, high = (
        f"{value:,.3g}" if abs(value) < 100 else f"{value:,.0f}" for value in values.quantile([0, 0.5, 1])
    )
    return f"**{median}** ({low} to {high})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--policy", nargs="+", default=list(POLICIES), choices=POLICIES)
    parser.add_argument("--seeds", metavar="A:B", default=f"0:{SEEDS}")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="settings of a trial")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    known = {tuple(row) for row in read(RESULTS)[RUN].itertuples(index=False)}
    wanted = [
        Wanted(task, policy, seed, tuple(given.set))
        for task in given.task
        for policy in given.policy
        for seed in seeds_of(given.seeds)
        if (task, policy, " ".join(given.set), seed) not in known
    ]
    if not given.table:
        compute(wanted, run_one, keep, RUNS)
    print(in_words(read(RESULTS)))


if __name__ == "__main__":
    main()
