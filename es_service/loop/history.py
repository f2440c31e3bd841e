"""The columns of a run's history: one row per generation. This table is their documentation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.episodes import METRICS
from es_service.protocol.messages import EpisodesResult, FloatArray, TaskSpec

HistoryRow = dict[str, int | float | None]
"""Values by name of the column, as the loop writes them."""
Row = Mapping[str, Any]
"""The same for readers; a missing value may be NaN."""
Table = Mapping[str, NDArray[Any]]
"""Rows by column: column name -> its values [N]. No value is NaN, or NO_INTEGER in a column of whole numbers."""
NO_INTEGER = -(2**63)
"""Stands for no value in a column of whole numbers."""


@dataclass(frozen=True)
class Column:
    """One column of the history. Only deterministic columns enter the digest."""

    name: str
    type: Literal["INTEGER", "REAL"]
    deterministic: bool
    """Whether every run of the config has the same values; also False for a column that a later version has added, so
    that digests stay comparable between versions."""
    meaning: str = field(compare=False)
    """Explanation for a reader. It is not compared, so that a run with other explanations can be continued."""


_FITNESS = (
    Column("generation", "INTEGER", True, "generations completed; 0 is the evaluation of the initial centres"),
    Column("env_steps", "INTEGER", True, "environment steps so far, evaluations counted, none after done"),
    Column("episodes", "INTEGER", True, "episodes so far, evaluations counted"),
    Column("centre_fitness_mean", "REAL", True, "mean fitness over the new centre's evaluation episodes"),
    Column("centre_fitness_std", "REAL", True, "standard deviation of the same episodes (population formula)"),
    Column("centre_return_mean", "REAL", True, "mean return; equals the fitness with `fitness: sum`"),
    Column("centre_return_std", "REAL", True, "standard deviation of the return over the same episodes"),
    Column("best_fitness", "REAL", True, "highest centre_fitness_mean so far"),
    Column("population_fitness_min", "REAL", True, "lowest fitness of a valid member of this generation"),
    Column("population_fitness_q25", "REAL", True, "first quartile of the valid members' fitness"),
    Column("population_fitness_median", "REAL", True, "median of the valid members' fitness"),
    Column("population_fitness_q75", "REAL", True, "third quartile of the valid members' fitness"),
    Column("population_fitness_max", "REAL", True, "highest fitness of a member: a noisy single value, not the best"),
    Column("population_return_min", "REAL", True, "the same for the valid members' returns"),
    Column("population_return_q25", "REAL", True, "first quartile"),
    Column("population_return_median", "REAL", True, "median"),
    Column("population_return_q75", "REAL", True, "third quartile"),
    Column("population_return_max", "REAL", True, "highest"),
)
_GOAL = (
    Column("goal_distance", "REAL", True, "mean distance to the goal at the end of the evaluation episodes"),
    Column("goal_distance_min", "REAL", True, "least distance to the goal along any evaluation episode"),
)
_GOAL_OF_CENTRE = (
    Column("goal_distance", "REAL", True, "mean distance to the goal at the end"),
    Column("goal_distance_way", "REAL", True, "mean over the episodes of the least distance along each"),
    Column("goal_distance_min", "REAL", True, "least distance along any of the episodes"),
)
_CELL = (
    "cell of the map that the new centre entered; none if it did not. A number: those of a grid run along its last "
    "dimension first, so that of 20 by 20 cells 90 is 4,10; the map's table has both. Of a dominated map, the slot"
)
_MAP = (
    Column("start_cell", "INTEGER", True, "me_es, memes: cell whose elite this generation began with, if it drew one"),
    Column("cell", "INTEGER", True, _CELL),
    Column(
        "map_cells", "INTEGER", True, "filled cells of the map after this generation; of a dominated map, of its grid"
    ),
    Column("coverage", "REAL", True, "filled cells as a fraction of all"),
    Column("coverage_reachable", "REAL", True, "the same of the cells that can be reached, where the task knows them"),
    Column("map_fitness_max", "REAL", True, "highest fitness of an elite, as it entered or as all its samples say"),
    Column("qd_score", "REAL", True, "sum over elites of fitness less map.qd_offset"),
)
_CORRECTED = (
    Column("corrected_coverage", "REAL", True, "coverage of the elites' means over map.correct_episodes new episodes"),
    Column("corrected_qd_score", "REAL", True, "QD-score of the same map; none where a generation does not correct"),
    Column("corrected_fitness_max", "REAL", True, "highest fitness in the same map"),
)
CORRECTED = tuple(column.name for column in _CORRECTED)
"""Names of these columns, which a run has if `map.correct_every` is set."""
METRIC = "metric_"
"""Beginning of the columns of metrics: of the search, of the task, and of the program that runs a session."""
_INFEASIBLE = Column("infeasible_members", "INTEGER", True, "members with a fitness of -inf, which are no invalid ones")
_EPISODES = (
    Column("fitness_first", "REAL", False, "fitness of its first evaluation episode, which a replay shows"),
    Column("reset_seed", "INTEGER", False, "seed in the addresses of the resets of its evaluation episodes"),
    Column("reset_episode", "INTEGER", False, "number of its first episode there; the others follow"),
    Column("reset_ask", "INTEGER", False, "number of its ask there; populations and policies count separately"),
    Column("reset_policy", "INTEGER", False, "number of the policy in its ask; none for a centre"),
)
"""Which episodes an evaluation consisted of."""
_SEARCH_AND_TIMES = (
    Column(
        "centre",
        "INTEGER",
        True,
        "centre that this row is about: the fittest of those that were evaluated; policies count on from the centres",
    ),
    Column("fitness_weight", "REAL", True, "weight of fitness beside novelty in the utilities of that centre"),
    Column("centre_novelty", "REAL", True, "novelty of the mean descriptor in the archive before it entered"),
    Column("archive_size", "INTEGER", True, "entries of the novelty archive after this generation"),
    Column("update_norm", "REAL", True, "Euclidean norm of the step from the old centre to the new one"),
    Column("parameter_norm", "REAL", True, "Euclidean norm of the new centre"),
    Column("invalid_members", "INTEGER", True, "members with a non-finite fitness or descriptor"),
    Column("retries", "INTEGER", False, "chunks handed out again in this generation"),
    Column("lost_workers", "INTEGER", False, "workers that died, hung or were replaced in this generation"),
    Column("workers", "INTEGER", False, "workers the evaluator was asked to keep"),
    Column("wall_clock_s", "REAL", False, "seconds spent in this run so far, all sessions together"),
    Column("steps_per_second", "REAL", False, "environment steps of this generation over its seconds"),
    Column("seconds_rollout", "REAL", False, "waiting for training chunks"),
    Column("seconds_gradient", "REAL", False, "waiting for gradient chunks and adding them up"),
    Column("seconds_evaluation", "REAL", False, "waiting for the new centre's evaluation"),
    Column("seconds_driver", "REAL", False, "everything else on the driver but the store"),
    Column("seconds_store", "REAL", False, "committing the generation before this one"),
)
_COSTS = (
    Column("rollout_s", "REAL", False, "seconds in which workers computed so far, as budget.rollout_s counts them"),
    Column("cpu_s", "REAL", False, "seconds of all processors so far, as budget.cpu_s counts them"),
)
LATER = frozenset(column.name for column in _COSTS)
"""Columns that runs of versions before 0.27 lack, and that are not stored where they are continued."""


def history_columns(
    task: TaskSpec,
    has_map: bool,
    corrects: bool = False,
    allows_infeasible: bool = False,
    metrics: Iterable[str] = (),
) -> tuple[Column, ...]:
    """All columns of a run, with those of its descriptor's dimensions, of its goal and of its map, if it has these.

    Args:
        corrects: whether `map.correct_every` is set.
        allows_infeasible: whether `search.allow_infeasible` is set.
        metrics: names of the metrics of the search.
    """
    descriptor = tuple(
        column
        for name in task.descriptor_names
        for column in (
            Column(f"centre_{name}", "REAL", True, f"mean descriptor of the evaluation episodes: {name}"),
            Column(f"centre_{name}_std", "REAL", True, f"standard deviation of {name} over the same episodes"),
        )
    )
    goal, of_map = _GOAL if task.has_goal else (), _MAP if has_map else ()
    corrected = _CORRECTED if has_map and corrects else ()
    infeasible = (_INFEASIBLE,) if allows_infeasible else ()
    of_search = [Column(f"{METRIC}{name}", "REAL", True, f"metric of the search: {name}") for name in metrics]
    more = *_of_task(task), *of_search
    return (*_FITNESS, *descriptor, *goal, *of_map, *corrected, *infeasible, *_SEARCH_AND_TIMES, *_COSTS, *more)


def _of_task(task: TaskSpec) -> list[Column]:
    """Columns of the task's metrics, which the history and the table of evaluated centres have."""
    meaning = "metric of the task, mean over the evaluation episodes"
    return [Column(f"{METRIC}{name}", "REAL", True, f"{meaning}: {name}") for name in task.metric_names]


def evaluated_columns(task: TaskSpec, has_map: bool) -> tuple[Column, ...]:
    """Columns of the evaluated centres, of which a generation may have several; `generation` comes before them."""
    return (
        Column("centre", "INTEGER", True, "index of the centre; policies count on from the centres"),
        Column("fitness_weight", "REAL", True, "weight of fitness in its utilities: 0 explores, 1 exploits, else both"),
        *(
            (
                Column("start_cell", "INTEGER", True, "cell whose elite it started from in this generation"),
                Column("cell", "INTEGER", True, "cell of which it is the elite after this generation"),
            )
            if has_map
            else ()
        ),
        Column("fitness_mean", "REAL", True, "mean fitness over its evaluation episodes"),
        Column("fitness_std", "REAL", True, "standard deviation of the same episodes (population formula)"),
        Column("fitness_max", "REAL", True, "highest fitness of one of the same episodes"),
        Column("return_mean", "REAL", True, "mean return over the same episodes"),
        *(Column(name, "REAL", True, "mean descriptor over the same episodes") for name in task.descriptor_names),
        *(_GOAL_OF_CENTRE if task.has_goal else ()),
        *_of_task(task),
        Column("novelty", "REAL", True, "novelty of its mean descriptor in the archive before the generation"),
        Column("update_norm", "REAL", True, "Euclidean norm of its step in this generation"),
        Column("env_steps", "INTEGER", True, "environment steps of its population and of its evaluation"),
        *_EPISODES,
    )


def evaluated_word(row: Row) -> str:
    """What the columns centre_* of a row are about: "centre", or "policy" where a generation has moved no centre and
    evaluated policies as they are, of which it is the fittest."""
    update_norm = row["update_norm"]
    moved = update_norm is not None and math.isfinite(update_norm)
    return "centre" if moved or row["generation"] == 0 else "policy"


def evaluated_nouns(row: Row) -> tuple[str, str]:
    """`evaluated_word`, in the singular and in the plural."""
    word = evaluated_word(row)
    return word, "policies" if word == "policy" else f"{word}s"


@dataclass(frozen=True)
class Resets:
    """Address of the resets of an evaluation's episodes; see `protocol.noise.evaluation_reset_keys`."""

    seed: int
    episode: int = 0
    """Number of the first episode; the others follow."""
    ask: int = 0
    policy: int | None = None


RESETS = tuple(f"reset_{part.name}" for part in fields(Resets))
"""Columns with this address."""
NO_POLICY = -1
"""Stands for the number of the policy there if a centre was evaluated."""


def with_gaps(values_N: NDArray[np.int64]) -> NDArray[np.int64]:
    """A column of whole numbers, in which a negative number is no value."""
    return np.where(values_N < 0, NO_INTEGER, values_N)


@np.errstate(invalid="ignore", over="ignore")
def population_columns(populations: Sequence[EpisodesResult], infeasible: int = 0) -> HistoryRow:
    """Number of invalid members, and quartiles of the valid members' fitness and return, of all populations together.

    Args:
        populations: fitness is NaN for invalid and infeasible members, which only these have; empty for generation 0.
        infeasible: number of infeasible members.
    """
    fitness_N = np.concatenate([np.zeros(0, np.float32), *(population.fitness.ravel() for population in populations)])
    returns_N = np.concatenate([np.zeros(0, np.float32), *(population.returns.ravel() for population in populations)])
    columns: HistoryRow = {"invalid_members": int(np.isnan(fitness_N).sum()) - infeasible}
    for quantity, values in (("fitness", fitness_N), ("return", returns_N)):
        names = [f"population_{quantity}_{name}" for name in ("min", "q25", "median", "q75", "max")]
        if not populations:
            columns |= dict.fromkeys(names)
            continue
        values = values[np.isfinite(fitness_N) & np.isfinite(values)].astype(np.float64)
        columns |= dict(zip(names, quartiles(values), strict=True))
    return columns


def quartiles(values_N: NDArray[np.float64]) -> list[float]:
    """Minimum, quartiles and maximum of finite values; NaN without any.

    These are the numbers of `np.quantile` (its default, Hyndman and Fan's type 7), bit for bit, of which the general
    case is ten times as slow: half of a small generation's row would be this.
    """
    if not values_N.size:
        return [math.nan] * 5
    last = values_N.size - 1
    below = [numerator * last // 4 for numerator in range(5)]
    low, high = np.sort(values_N)[[below, [min(at + 1, last) for at in below]]].tolist()
    values = []
    for numerator, at, first, second in zip(range(5), below, low, high, strict=True):
        share = numerator / 4 * last - at
        # Interpolated from the nearer of the two, as NumPy does.
        values.append(first + (second - first) * share if share < 0.5 else second - (second - first) * (1.0 - share))
    return values


@np.errstate(invalid="ignore", over="ignore")  # the deviation of infinite values is NaN
def evaluation_columns(table: Table, episodes: EpisodesResult, row: int, task: TaskSpec) -> HistoryRow:
    """Columns about the episodes of the centre that the history's row is about: fitness, return, descriptor, distance
    to the goal, and metrics of the task.

    Args:
        table: columns of all evaluated centres.
        episodes: their episodes [N, E].
        row: index of the centre.
    """
    same = {"fitness_mean", "fitness_std", "return_mean", *task.descriptor_names}
    goal = {"goal_distance", "goal_distance_min"} if task.has_goal else set()
    std_B = episodes.descriptor[row].astype(np.float64).std(axis=0).tolist()
    return {
        **{f"centre_{name}": float(table[name][row]) for name in same},
        "centre_return_std": float(episodes.returns[row].astype(np.float64).std()),
        **{f"centre_{name}_std": value for name, value in zip(task.descriptor_names, std_B, strict=True)},
        **{name: float(table[name][row]) for name in (*goal, *(column.name for column in _of_task(task)))},
    }


def doubles(values_N_E: FloatArray) -> NDArray[np.float64]:
    """Values of episodes, [N, E] or [N, E, B], in float64 and with the episodes of a centre side by side in memory.

    NumPy adds along an axis in an order that depends on the strides. With this layout, a mean over the episodes has the
    bits that the mean of the centre's episodes alone has, whatever the layout in which chunks were put together.
    """
    return values_N_E.astype(np.float64, order="C")


@np.errstate(invalid="ignore", over="ignore")  # the deviation of infinite values is NaN
def episodes_table(episodes: EpisodesResult, task: TaskSpec) -> dict[str, NDArray[np.float64]]:
    """Columns of the evaluated centres about their episodes, [N, E]: fitness, return, descriptor, distance to the goal,
    metrics of the task."""
    fitness_N_E, returns_N_E = doubles(episodes.fitness), doubles(episodes.returns)
    mean_N_B = doubles(episodes.descriptor).mean(axis=1)
    columns = {
        "fitness_mean": fitness_N_E.mean(axis=1),
        "fitness_std": fitness_N_E.std(axis=1),
        "fitness_max": fitness_N_E.max(axis=1),
        "return_mean": returns_N_E.mean(axis=1),
        **dict(zip(task.descriptor_names, mean_N_B.T, strict=True)),
    }
    if task.has_goal:
        end_N_E, least_N_E = np.moveaxis(doubles(episodes.goal_distance), -1, 0)
        columns["goal_distance"] = end_N_E.mean(axis=1)
        columns["goal_distance_way"] = least_N_E.mean(axis=1)
        columns["goal_distance_min"] = least_N_E.min(axis=1)
    if task.metric_names:
        mean_N_M = doubles(episodes.outputs[METRICS]).mean(axis=1)
        columns |= {f"{METRIC}{name}": mean_N for name, mean_N in zip(task.metric_names, mean_N_M.T, strict=True)}
    return columns


def or_none(value: float) -> float | None:
    """A number, or None for NaN."""
    return None if math.isnan(value) else float(value)
