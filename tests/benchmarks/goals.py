"""A policy for each goal of the mazes of JaxGCRL: how many goals does an archive of policies reach?

    python -m tests.benchmarks.goals                                     # all that is missing: hours on two cores
    python -m tests.benchmarks.goals --tasks ant_u_maze --seeds 0:1
    python -m tests.benchmarks.goals --tasks ant_u_maze --seeds 100:101 --set search.screened=64     # a trial
    python -m tests.benchmarks.goals --one --seeds 0:5                   # one policy for all goals of a maze
    python -m tests.benchmarks.goals --table                             # only print the table
    python -m tests.benchmarks.goals --draw ant_u_maze                   # the picture, of the run folder of seed 0

`es-service run ant_big_maze_memes` explores the maze, and `es-service polish --goals all` makes a policy for each goal,
with which a new episode starts when that goal is drawn. Each goal and seed is a row of results/goal_archives.csv: the
share of 256 certified episodes in which the ant comes within 0.5 m of the goal. A finished seed is not computed again;
one that is interrupted goes on from runs/goals. Settings of a trial are told in the row.

With `--one`, ARS trains one policy, which sees the goal that is drawn in each episode. Its row has the goal `drawn`.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from es_service import api, open_run
from es_service.cli.sweep import GOALS, HELD, seeds_of
from es_service.protocol.machine import VERSION, cores, cpu_kind
from es_service.runs.certification import certify_run
from es_service.runs.goals import goals_reached
from workers.environments.ant_tasks import DRAWN, MAZES, cells_of, goals_of, place, walls_of

RUNS = Path(__file__).parents[2] / "runs" / "goals"
RESULTS = Path(__file__).parent / "results" / "goal_archives.csv"
EXPLORE_STEPS = {"ant_u_maze": 50_000_000, "ant_big_maze": 200_000_000, "ant_hardest_maze": 400_000_000}
GOAL_STEPS = 50_000_000
"""Environment steps of the polish of each goal."""
OBSERVATION = "task.options.observation=without_goal"
"""A policy of the archive is for one goal, and does not see that of the episode."""
POLISH = (
    "search.pairs=32",
    "search.shaping.count=16",
    "search.screened=100",
    "search.candidates=6",
    "search.round_generations=12",
    "search.objective.radius=100",
    "search.objective.ties=distance",
    "search.learning_rate_decay=0.994",
    "search.learning_rate_limit=0.004",
)
"""Settings of the polish, from trials with seed 100 of ant_big_maze. The radius holds the whole maze, so steps at the
goal count first, and nearness among the policies that have equally many."""


ONE_STEPS = 200_000_000
ONE: Mapping[str, Any] = {
    "policy": {"hidden": [64], "action_noise": 0},
    "search": {
        "algorithm": "ars",
        "pairs": 64,
        "sigma": 0.025,
        "shaping": {"count": 32},
        "step": {"learning_rate": 0.015},
        "learning_rate_decay": 0.9995,
        "learning_rate_limit": 0.003,
        "evaluation_episodes": 64,
    },
    "map": {"enabled": False},
    "budget": {"env_steps": ONE_STEPS},
}
"""Config of one policy for all goals, without its task."""


def command(*words: object, settings: Sequence[str]) -> None:
    """Run a command of es-service with settings to its end."""
    given = [*map(str, words), *(f"--set={setting}" for setting in settings)]
    subprocess.run([sys.executable, "-m", "es_service", *given], check=True)


def archive(task: str, seed: int, settings: Sequence[str]) -> pd.DataFrame:
    """Rows of a seed: one for each goal."""
    folder, started = RUNS / f"{task}_{seed}", time.time()
    own = [setting for setting in settings if setting.startswith("task.")]
    explore = [f"task.environment={task}", OBSERVATION, f"budget.env_steps={EXPLORE_STEPS[task]}", f"seed={seed}", *own]
    command("run", "ant_big_maze_memes", "--or-resume", "--out", folder / "explore", settings=explore)
    polish = [*POLISH, f"budget.env_steps={GOAL_STEPS}", *settings]
    command("polish", folder / "explore", "--goals", "all", "--out", folder / "polish", settings=polish)
    return told(pd.read_csv(folder / "polish" / GOALS), task, EXPLORE_STEPS[task], settings, started)


def one_policy(task: str, seed: int, settings: Sequence[str]) -> pd.DataFrame:
    """Row of a seed: the policy that all goals share."""
    folder, started = RUNS / f"{task}_{seed}_one", time.time()
    of_task = {"environment": task, "options": {"reward": "dense"}, "episodes_per_member": 4}
    run = api.run_or_resume(api.load_config({**ONE, "task": of_task, "seed": seed}, settings), folder).run
    certify_run(run.folder)
    return told(goals_reached([run.folder]), task, 0, settings, started)


def told(rows: pd.DataFrame, task: str, explore_steps: int, settings: Sequence[str], started: float) -> pd.DataFrame:
    """Rows with what else the table says of a run."""
    return rows.drop(columns="run").assign(
        task=task, explore_steps=explore_steps, settings=" ".join(settings), cores=cores(),
        hours=round((time.time() - started) / 3600, 3), cpu=cpu_kind(), version=VERSION,
    )  # fmt: skip


def table(rows: pd.DataFrame) -> str:
    """A line for each task and seed: how many goals are reached in at least half of the episodes, and how often the
    archive reaches a goal that is drawn."""
    lines = ["| task | seed | goals reached | share of episodes | steps |", "| --- | --- | --- | --- | --- |"]
    for (task, seed, settings, one), of in rows.groupby(["task", "seed", "settings", rows.goal == DRAWN], sort=False):
        steps = of.env_steps.sum() + of.explore_steps.iloc[0]
        title = f"{task}{', one policy' * one}{f' ({settings})' if settings else ''}"
        reached = "" if one else f"{int((of.success >= HELD).sum())} of {len(of)}"
        lines.append(f"| {title} | {seed} | {reached} | {of.success.mean():.0%} | {steps:.2g} |")
    return "\n".join(lines)


def draw(task: str, seed: int) -> None:
    """The maze with its goals, and the way of each certified policy of a seed in its episode of median return."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Circle

    from es_service.runs.replay import record

    figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
    for (x0, y0), (x1, y1) in walls_of(task):
        axes.plot((x0, x1), (y0, y1), color="black", linewidth=6, solid_capstyle="round")
    [start] = cells_of(task, "S")
    axes.plot(*place(start), "s", color="0.4", markersize=9)
    for number, (goal, at) in enumerate(goals_of(task).items()):
        colour = plt.get_cmap("turbo")((number + 0.5) / len(goals_of(task)))
        [replay], _ = record(
            open_run(RUNS / f"{task}_{seed}" / "polish" / f"{goal}_run"), best=False, cells=(), certified=True
        )
        way_T_2 = np.asarray(replay.recording.descriptor_T_B)
        axes.plot(*way_T_2.T, color=colour, linewidth=1.2)
        axes.add_patch(Circle(at, 0.5, facecolor="none", edgecolor=colour, linewidth=2.5))
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{task}, seed {seed}: the way of each policy")
    figure.savefig(RESULTS.with_name(f"goals_{task}.png"), dpi=90)


def read() -> pd.DataFrame:
    """The rows that there are."""
    if not RESULTS.exists():
        return pd.DataFrame(columns=["task", "seed", "settings", "goal"])
    return pd.read_csv(RESULTS, keep_default_na=False)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(MAZES), choices=list(MAZES))
    parser.add_argument("--seeds", default="0:5")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--one", action="store_true", help="one policy for all goals")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--draw", choices=list(MAZES))
    given = parser.parse_args()
    if given.draw:
        draw(given.draw, seeds_of(given.seeds)[0])
        return
    settings = " ".join(given.settings)
    for task in () if given.table else given.tasks:
        for seed in seeds_of(given.seeds):
            rows = read()
            same = (rows.task == task) & (rows.seed == seed) & (rows.settings == settings)
            if (same & ((rows.goal == DRAWN) == given.one)).any():
                continue
            computed = (one_policy if given.one else archive)(task, seed, given.settings)
            pd.concat([read(), computed], ignore_index=True).to_csv(RESULTS, index=False)  # others may add rows, too
            if seed or given.one:
                shutil.rmtree(RUNS / f"{task}_{seed}{'_one' * given.one}")
    print(table(read()))


if __name__ == "__main__":
    main()
