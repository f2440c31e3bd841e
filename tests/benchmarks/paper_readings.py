"""How the paper's measures are read from a run: defined here, once.

Chalumeau et al. 2022 give, for PointMaze and AntTrap, the best fitness, and for AntMaze the minimum distance to the
goal, as a negative number, each after a number of environment steps. They do not say over what the best and the minimum
are taken. So there are two readings, both over all centres that were evaluated by then:

* `centre`: the mean over the evaluation episodes of one centre; for AntMaze of the least distance along each episode;
* `single`: one evaluation episode.

A method without centres, MAP-Elites, evaluates policies instead. Episodes of training do not count.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

READINGS = ("centre", "single")
AT = (1_000_000, 10_000_000, 100_000_000, 1_000_000_000)
"""Environment steps after which a run is read."""
CURVE_AT = tuple(round(10 ** (eighth / 8)) for eighth in range(5 * 8, 9 * 8 + 1))
"""Environment steps of the points of a curve: eight in each decade, from 1e5 to 1e9."""
DISTANCE_TASKS = frozenset({"ant_maze"})
"""Tasks whose measure is the minimum distance to the goal."""
GOAL_M = 1.0
"""AntMaze: an episode reaches the goal if it comes so near, in metres."""


def power(steps: int) -> str:
    """1000000 -> 1e6."""
    return f"{steps:.0e}".replace("e+0", "e")


def column(reading: str, at: int) -> str:
    """Name of the column of a reading, such as centre_1e6."""
    return f"{reading}_{power(at)}"


def measured(task: str, evaluations: pd.DataFrame, history: pd.DataFrame) -> pd.DataFrame:
    """Both readings after each generation.

    Args:
        evaluations: `Run.evaluations`.
        history: `Run.history`.

    Returns:
        env_steps, centre and single [G], by generation: the highest value so far. A value that is not a number, of a
        centre whose episodes failed, counts as none.
    """
    names = ("goal_distance_way", "goal_distance_min") if task in DISTANCE_TASKS else ("fitness_mean", "fitness_max")
    sign = -1.0 if task in DISTANCE_TASKS else 1.0
    values = sign * evaluations[list(names)].replace([np.inf, -np.inf], np.nan)
    best = values.groupby(evaluations["generation"]).max().cummax().ffill()
    best.columns = pd.Index(READINGS)
    return pd.DataFrame({"env_steps": history["env_steps"], **best})


def readings(task: str, evaluations: pd.DataFrame, history: pd.DataFrame) -> dict[str, Any]:
    """The columns of the table of runs: `centre_1e6`, `single_1e6` and so on, and for AntMaze the steps to the goal.

    A reading is that of the last generation that ended by then; none if the run has fewer steps than 98 percent of
    them, since a run ends within a generation of its limit.
    """
    measurements = measured(task, evaluations, history)
    steps, rows = measurements["env_steps"], read_at(measurements, AT)
    columns: dict[str, Any] = {
        column(name, at): None if np.isnan(rows.at[at, name]) else rows.at[at, name] for at in AT for name in READINGS
    }
    if task in DISTANCE_TASKS:
        for name in READINGS:
            there = steps[measurements[name] >= -GOAL_M]
            columns[f"steps_to_goal_{name}"] = int(there.iloc[0]) if len(there) else None
    return columns


def curve(task: str, evaluations: pd.DataFrame, history: pd.DataFrame) -> pd.DataFrame:
    """env_steps, centre and single of a run at the points of `CURVE_AT` that it has reached."""
    rows = read_at(measured(task, evaluations, history), CURVE_AT)
    return rows.dropna(subset=list(READINGS)).rename_axis("env_steps").reset_index()


def read_at(found: pd.DataFrame, points: tuple[int, ...]) -> pd.DataFrame:
    """What was `measured`, read after so many steps as each point has; NaN where the run is too short."""
    steps = found["env_steps"].to_numpy()
    last = np.searchsorted(steps, points, side="right") - 1
    is_there = (last >= 0) & (steps[-1] >= 0.98 * np.array(points))
    rows = found[list(READINGS)].iloc[np.maximum(last, 0)].astype(float).round(2)
    return rows.set_axis(pd.Index(points)).where(pd.Series(is_there, index=points), axis=0)
