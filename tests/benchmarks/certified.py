"""What each method finds on the three tasks, in episodes that no choice has seen.

    python -m tests.benchmarks.certified                                   # all that is missing: hours on two cores
    python -m tests.benchmarks.certified --task ant_trap --method nsr_es me_es --seeds 0:2
    python -m tests.benchmarks.certified --physics mujoco                  # AntMaze and AntTrap by MuJoCo's equations
    python -m tests.benchmarks.certified --map grid dominated --task point_maze --seeds 0:3 --marks 1e7
    python -m tests.benchmarks.certified --map grid dominated --task kheperax --seeds 0:3 --marks 2.5e7
    python -m tests.benchmarks.certified --table                           # only print the tables
    python -m tests.benchmarks.certified --config my.yaml --seeds 100:101 --marks 30_000_000 --set search.sigma=0.05

Configs are those of configs/certified, and the shipped ones of MEMES and MAP-Elites. A run stops at each mark, a number
of environment steps, its best centre and ten fittest elites are certified, and it goes on. There are as many runs at a
time as cores, each in one process; each gives a row for each mark in results/certified_methods.csv, and is not computed
again. One that is interrupted goes on from its folder in runs/certified_methods. The last form is a trial, whose rows
are printed and added to results/certified_trials.csv.

With `--physics mujoco`, the ants are trained with `physics: mujoco_euler` and certified in C MuJoCo, too, with Gym's
model and its integrator RK4: the columns `elsewhere_*` of results/certified_mujoco.csv. The method `polish` is there
MEMES for the first 3e7 steps, and from then on polish of its elites beyond the trap, whose marks count both.

With `--map`, the methods that can fill a dominated map fill maps of these kinds, with as many slots as the grid has
cells; results/certified_maps.csv has coverage and QD-score, too, which are counted by the same grid. There is one task
more, the maze of Kheperax: the configs are those of PointMaze, with what Kheperax's own example sets.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from es_service import api
from es_service.cli.sweep import seeds_of
from es_service.config.model import RunConfig
from es_service.protocol.machine import cpu_kind
from es_service.runs.certification import certify_run
from es_service.runs.certified import certified_policies
from es_service.runs.lineage import polish_config
from tests.benchmarks.paper import commit, compute, folder_name
from tests.helpers import workers_in_this_process

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs"
RUNS = ROOT / "runs" / "certified_methods"
RESULTS = Path(__file__).parent / "results" / "certified_methods.csv"
TRIALS, MUJOCO, MAPS = (RESULTS.with_name(f"certified_{name}.csv") for name in ("trials", "mujoco", "maps"))
TASKS = ("point_maze", "ant_maze", "ant_trap")
SHIPPED = ("memes", "map_elites")
METHODS = ("es", "ns_es", "nsr_es", "nsra_es", "me_es", *SHIPPED, "ars")
POLISHED = "polish"
"""The method that goes on from a run of MEMES."""
MARKS = (1_000_000, 10_000_000, 100_000_000)
RUN = ["task", "method", "settings", "seed"]
COUNTED = ["coverage", "qd_score"]
SEEDS = 5
EULER = "task.options.physics=mujoco_euler"
IN_C = {"ant_maze": "gymnasium:es_service/AntMazeMujoco-v0", "ant_trap": "gymnasium:es_service/AntTrapMujoco-v0"}
"""Task -> the same one in C MuJoCo."""
MUJOCO_SEEDS = {"memes": 5, POLISHED: 5, "nsra_es": 5, "me_es": 3, "map_elites": 3, "ars": 3}
"""Method -> number of its seeds in MuJoCo, which begin with 0."""
EXPLORED = 30_000_000
"""Steps of MEMES whose elites are polished."""
POLISH = {
    "ant_trap": (
        "search.candidate_choice=place",
        "search.objective.kind=target",
        "search.objective.descriptor=[30,0]",
        "search.objective.radius=17",
        "search.screened=60",
        "search.candidates=6",
        "search.round_generations=12",
        "search.pairs=40",
        "search.shaping.count=20",
        "search.learning_rate_decay=0.997",
        "search.learning_rate_limit=0.005",
    )
}
"""Task -> settings of the polish, from trials with seeds 100 and 101: candidates are elites beyond the trap."""
SLOTS = {"point_maze": 400, "ant_maze": 400, "ant_trap": 400, "kheperax": 2500}
"""Task -> cells of its grid, and slots of its dominated map."""
KINDS = ("grid", "dominated")
"""Kinds of maps."""
ELSEWHERE = {
    "kheperax": (
        "task.environment=kheperax:standard",
        "task.episode_steps=250",
        "task.options.lasers_return_minus_one_if_out_of_range=true",
        "policy.hidden=[8]",
        "map.cells=[50,50]",
    )
}
"""Task of a suite -> what makes it of a config of PointMaze."""
MAPPED = ("me_es", *SHIPPED)
"""Methods that can fill each."""


class Shown(NamedTuple):
    """Columns of a task in the printed table."""

    task: str
    title: str
    column: str
    marks: tuple[int, ...]


SHOWN = (
    Shown("point_maze", "PointMaze: return", "return_mean", MARKS),
    Shown("ant_maze", "AntMaze: episodes of 256 at the goal", "successes", MARKS[1:]),
    Shown("ant_trap", "AntTrap: return", "return_mean", MARKS[1:]),
)


class Wanted(NamedTuple):
    """A run that is to be certified at each mark."""

    config: Path
    seed: int
    marks: tuple[int, ...]
    settings: tuple[str, ...] = ()
    polished: bool = False
    """Whether the config is that of a search whose elites are polished."""

    @property
    def name(self) -> str:
        """Of its folder."""
        return folder_name(self.config, self.seed, self.settings) + "_polished" * self.polished


def config_at(wanted: Wanted, mark: int) -> RunConfig:
    """The config with which a run goes on to a mark; what it polishes is computed if that is missing."""
    fixed = ("compute.engine=inline", "compute.workers=1", f"seed={wanted.seed}")
    others = ("budget.generations=null", "budget.target_certified=null")
    if not wanted.polished:
        return api.load_config(wanted.config, (*fixed, *others, f"budget.env_steps={mark}", *wanted.settings))
    explored = explored_by(wanted)
    api.run_or_resume(config_at(wanted._replace(polished=False), EXPLORED), explored)
    left = mark - int(api.open_run(explored).history.env_steps.iloc[-1])
    task = api.load_config(wanted.config).task.environment
    return polish_config(explored, (*fixed, f"budget.env_steps={left}", *POLISH[task]))


def explored_by(wanted: Wanted) -> Path:
    """Folder of the run whose elites are polished."""
    return RUNS / wanted.name / "explored"


def run_one(wanted: Wanted) -> pd.DataFrame:
    """One run from its config, or from where it was interrupted: a row for each mark."""
    code, folder = commit(), RUNS / wanted.name / ("polished" if wanted.polished else "")
    in_c = IN_C.get(api.load_config(wanted.config).task.environment) if EULER in wanted.settings else None
    with workers_in_this_process():
        for number, mark in enumerate(wanted.marks):
            api.run_or_resume(config_at(wanted, mark), folder)
            if number > max((policy.number for policy in certified_policies(folder)), default=-1):
                certify_run(folder, workers=1, task=in_c)
    run = api.open_run(folder)
    before = api.open_run(explored_by(wanted)).history.iloc[-1] if wanted.polished else {}
    steps, seconds = (before.get(name, 0) for name in ("env_steps", "wall_clock_s"))
    rows = []
    for policy in certified_policies(folder):
        then = run.history[run.history.env_steps >= wanted.marks[policy.number] - steps].iloc[0]
        of_run = {
            "task": run.config["task"]["environment"],
            "method": run.config["search"]["algorithm"],
            "settings": " ".join([wanted.config.stem, *wanted.settings]),
            "seed": wanted.seed,
            "env_steps": int(then.env_steps + steps),
            "seconds": round(float(then.wall_clock_s + seconds)),
        }
        if {*wanted.settings}.intersection(f"map.kind={kind}" for kind in KINDS):
            of_run |= {name: float(then[name]) for name in COUNTED}
        rows.append(policy.row() | of_run | {"cpu": cpu_kind(), "commit": code})
    return pd.DataFrame(rows)


def read(path: Path) -> pd.DataFrame:
    """A table of results, without rows if there is no file."""
    return pd.read_csv(path) if path.exists() else pd.DataFrame(columns=[*RUN, "env_steps"])


def keep(path: Path, rows: pd.DataFrame) -> bool:
    """Put the rows of a finished run into a table, in the place of older ones of it."""
    table = read(path)
    others = table[~(table[RUN] == rows[RUN].iloc[0]).all(axis="columns")]
    kept = [part for part in (others, rows) if len(part)]
    pd.concat(kept).sort_values([*RUN, "env_steps"]).to_csv(path, index=False, lineterminator="\n")
    print(rows[[*RUN, "env_steps", "seconds", "return_mean", "successes"]].to_string(header=False), flush=True)
    return True


def config_of(task: str, method: str) -> Path:
    """The config of a method in the tables."""
    method = "memes" if method == POLISHED else method
    task = "point_maze" if task in ELSEWHERE else task
    return (CONFIGS if method in SHIPPED else CONFIGS / "certified") / f"{task}_{method}.yaml"


def settings_of(task: str, kind: str) -> tuple[str, ...]:
    """Settings of a task's runs with a map of a kind, or with that of the config if there is no kind."""
    slots = (f"map.slots={SLOTS[task]}",) if kind == "dominated" else ()
    return (*ELSEWHERE.get(task, ()), *((f"map.kind={kind}", *slots) if kind else ()))


def missing(wanted: list[Wanted], table: pd.DataFrame) -> list[Wanted]:
    """Those that have no row at their last mark."""
    known = {(row.settings, row.seed, row.method == POLISHED): row.env_steps for row in table.itertuples()}
    return [
        run
        for run in wanted
        if known.get((" ".join([run.config.stem, *run.settings]), run.seed, run.polished), 0) < run.marks[-1]
    ]


def in_words(table: pd.DataFrame, columns: str = "") -> str:
    """The results in Markdown: the median over the seeds at each mark, with the range.

    Args:
        columns: what the names of the columns begin with.
    """
    head = ["method", *(f"{shown.title}, {mark:.0e}".replace("e+0", "e") for shown in SHOWN for mark in shown.marks)]
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    for method in (*METHODS, POLISHED):
        cells = [
            _cell(table[(table.task == shown.task) & (table.method == method)], columns + shown.column, mark)
            for shown in SHOWN
            for mark in shown.marks
        ]
        if any(cells):
            lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def maps_in_words(table: pd.DataFrame) -> str:
    """The maps in Markdown: medians over the seeds, with the range."""
    head = ["task", "method", "map", "steps", "seeds", "certified return", "coverage, %", "QD-score, thousands"]
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    factors = {"return_mean": 1.0, "coverage": 100.0, "qd_score": 1e-3}
    for (task, method, settings), of_settings in table.groupby(["task", "method", "settings"], sort=True):
        kind = next(kind for kind in KINDS if f"map.kind={kind}" in settings.split())
        for _, rows in of_settings.groupby("certification"):
            values = [_range(rows[column] * factor) for column, factor in factors.items()]
            steps = f"{rows.env_steps.min():.1e}".replace("e+0", "e")
            lines.append(f"| {' | '.join([task, method, kind, steps, str(len(rows)), *values])} |")
    return "\n".join(lines)


def _range(values: pd.Series) -> str:
    return f"**{_number(values.median())}** ({_number(values.min())} to {_number(values.max())})"


def _cell(of_method: pd.DataFrame, column: str, mark: int) -> str:
    """Median and range over the seeds, of the first row of each from the mark to twice as many steps; and how many
    seeds, if not five."""
    values = (
        of_method[of_method.env_steps.between(mark, 2 * mark)].sort_values("env_steps").groupby("seed")[column].first()
    )
    if not len(values):
        return ""
    median = f"**{_number(values.median())}**"
    if len(values) == 1:
        return f"{median} (1 seed)"
    seeds = "" if len(values) == SEEDS else f", {len(values)} seeds"
    return f"{median} ({_number(values.min())} to {_number(values.max())}{seeds})"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 or value == int(value) else f"{value:#.3g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=list(TASKS), choices=(*TASKS, *ELSEWHERE))
    parser.add_argument("--method", nargs="+", default=[*METHODS, POLISHED], choices=[*METHODS, POLISHED])
    parser.add_argument("--seeds", metavar="A:B", help="default: 0:5, or those that the table in MuJoCo has")
    parser.add_argument("--physics", choices=("spring", "mujoco"), default="spring")
    parser.add_argument("--map", nargs="+", choices=KINDS, default=[], help="kinds of maps to compare")
    parser.add_argument("--marks", nargs="+", type=lambda text: int(float(text.replace("_", ""))), default=MARKS)
    parser.add_argument("--table", action="store_true", help="run nothing")
    parser.add_argument("--config", type=Path, help="a trial: a config of your own")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="settings of a trial")
    given = parser.parse_args()
    in_mujoco, trial = given.physics == "mujoco", given.config is not None
    path = TRIALS if trial else MUJOCO if in_mujoco else MAPS if given.map else RESULTS
    if given.set and not trial:
        parser.error("--set needs --config")
    if given.map and (trial or in_mujoco):
        parser.error("--map does not go with --config and --physics mujoco")
    settings = (*([EULER] if in_mujoco else []), *given.set)
    tasks = [task for task in given.task if task in (IN_C if in_mujoco else SLOTS if given.map else TASKS)]
    able = MUJOCO_SEEDS if in_mujoco else MAPPED if given.map else METHODS
    methods = [method for method in given.method if method in able]
    count = dict.fromkeys(METHODS, SEEDS) | (MUJOCO_SEEDS if in_mujoco else {})
    pairs = [(task, method) for task in tasks for method in methods if method != POLISHED or task in POLISH]
    chosen = (
        [("", given.config, SEEDS, False)]
        if trial
        else [(task, config_of(task, method), count[method], method == POLISHED) for task, method in pairs]
    )
    marks = tuple(given.marks), tuple(mark for mark in given.marks if mark > EXPLORED)
    wanted = [
        Wanted(config, seed, marks[polished], (*settings, *settings_of(task, kind)), polished)
        for seed in seeds_of(given.seeds or f"0:{SEEDS}")
        for kind in given.map or [""]
        for task, config, most, polished in chosen
        if marks[polished] and (given.seeds or seed < most)
    ]
    if not wanted:
        of_maps = f"{', '.join(ELSEWHERE)} needs --map"
        parser.error(f"in MuJoCo there are {', '.join(MUJOCO_SEEDS)} on {' and '.join(IN_C)}; {of_maps}")
    if not given.table:
        compute(missing(wanted, read(path)), run_one, lambda rows: keep(path, rows), RUNS)
    print(maps_in_words(read(path)) if given.map else in_words(read(path), "elsewhere_" if in_mujoco else ""))


if __name__ == "__main__":
    main()
