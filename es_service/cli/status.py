"""The command `status`, and what commands print of runs: their states and progress, certified policies in words, and
the next commands for them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from es_service import api
from es_service.cli.common import (
    JsonOption,
    command,
    console,
    is_single,
    of_each,
    print_json,
    print_line,
    print_note,
    problem_data,
    settings,
    way_command,
)
from es_service.errors import ConfigError, ServiceError, StoreError, counted, decimals
from es_service.loop.history import evaluated_nouns
from es_service.protocol.machine import given_path
from es_service.report.progress import plain_line, short
from es_service.report.summary import number, qd_score
from es_service.runs.certified import (
    Certified,
    certified_elsewhere,
    failed_sentence,
    newest_certified,
    pairs_sentence,
    tries_sentence,
)
from es_service.runs.run_status import (
    FAULTS_OF,
    Recent,
    RunStatus,
    doing,
    how_to_continue,
    is_waiting,
    more,
    newest_runs,
    output_of,
    population_size,
    read_recent,
    read_status,
    runs_of,
    state,
)
from es_service.runs.view import Run

FOLLOW_INTERVAL_S = 1.0
WEIGHED = {"fitness", "novelty", "mixture"}
"""Kinds of objectives that the weight of fitness beside novelty describes."""
SHOWN_PARAMETERS = 12
"""Most parameters of a function that `status` shows; an export has all of them."""


def print_status(console: Console, run: Run) -> None:
    """Print the settings of a run, its state (waiting, running, stopped or finished) and its progress."""
    status = read_status(run)
    constants, parent = run.constants, run.meta.parent
    method = (constants["search.algorithm"], population_size(constants))
    fields = {
        "run": str(run.folder),
        "task": f"{constants['task.environment']}, {counted(constants['task.episode_steps'], 'step')} an episode",
        "search": ", ".join(filter(None, [*method, f"seed {constants['seed']}"])),
    }
    if where := run.task.does_not_repeat:
        fields["not repeatable"] = f"the task returns other numbers for the same seed {where}"
    if parent:
        fields["started from"] = f"{parent['folder']}, generation {parent['generation']}"
    fields["state"] = (
        state(status) if status.driver else f"{state(status)}; continue with: {way_command(how_to_continue(status))}"
    )
    _print_fields(console, fields | _progress(status) | _parameters(status) | _certified(run))
    if status.output:
        print_line(console, "newest lines that its workers have printed:")
        for line in status.output:
            print_line(console, f"  {line}")


def follow_status(console: Console, run: Run) -> None:
    """Print a line for the newest generation, at most one a second, until no driver is running; and one for a wait."""
    next_generation, told = 0, ""
    while True:
        status = read_status(run)
        waits_for = "a place" if is_waiting(status) else doing(status)
        if waits_for and waits_for != told:
            print_line(console, state(status))
        told = waits_for
        if status.row and status.row["generation"] >= next_generation:
            next_generation = status.row["generation"] + 1
            print_line(console, plain_line(status.row))
        if not status.driver:
            way = way_command(how_to_continue(status))
            print_line(console, f"no driver is running: {state(status)}; continue with: {way}")
            return
        time.sleep(FOLLOW_INTERVAL_S)


def print_summary(console: Console, run: Run, reason: str) -> None:
    """Print the summary of a session at its end: the result, the folder and the next commands."""
    status, folder = read_status(run), run.folder
    sigma = next((key for key in ("search.sigma", "search.iso_sigma") if key in run.constants), None)
    doubled = {sigma: float(f"{run.constants[sigma] * 2:g}")} if sigma else {}
    print_line(console, f"\n{'Not done' if status.only_started else 'Done'}: {reason}.")
    _print_fields(console, _progress(status) | _parameters(status) | _certified(run))
    print_line(console, f"\nThe run is in {folder}. Next:")
    for words in (
        ("status", folder),
        ("report", folder),
        ("evaluate", folder, "--certify"),
        ("digest", folder),
        ("resume", folder, *settings(more(status))),
        ("fork", folder, *settings(doubled | more(status))),
    ):
        print_line(console, f"  {command(*words)}")


def _progress(status: RunStatus) -> dict[str, str]:
    last, limits = status.row, status.limits
    if last is None:
        return {"generation": "no generation is finished yet"}
    goal = {}
    if "goal_distance" in last:
        goal["goal distance"] = f"{last['goal_distance']:.3f} at the end, minimum {last['goal_distance_min']:.3f}"
    filled = {}
    if "map_cells" in last:
        score = qd_score(last["qd_score"])
        filled["map"] = f"{counted(last['map_cells'], 'cell')}, {100 * last['coverage']:.1f} %; QD-score {score}"
        offset = status.run.constants["map.qd_offset"]
        if last["qd_score"] < 0.0 or last["centre_fitness_mean"] < offset:
            filled["map"] += f", which elites below map.qd_offset = {offset:g} lower"
    nouns, episodes = evaluated_nouns(last), status.run.constants["search.evaluation_episodes"]
    spread = f" ± {decimals(last['centre_fitness_std'])}" if episodes > 1 else ""  # that of one episode is not known
    rate = last["env_steps"] / last["wall_clock_s"] if last["wall_clock_s"] else 0.0
    recent = read_recent(status.run, last["generation"])
    of = {key: f" of {limit:,}" for key, limit in limits.items()}
    steps = f"{last['env_steps']:,}{of.get('env_steps', '')}"
    target = f" (target: {limits['target_fitness']:g})" if "target_fitness" in limits else ""
    if status.target_certified is not None:
        target += f" (certified target: {status.target_certified:g})"
    return {
        "generation": f"{last['generation']:,}{of.get('generations', '')}",
        "best fitness": f"{decimals(last['best_fitness'])}{target}; selected, not certified",
        **({"certified target": failed_sentence(status.tries)} if status.tries else {}),
        f"{nouns[0]} fitness": f"{decimals(last['centre_fitness_mean'])}{spread}",
        **goal,
        **filled,
        "novelty archive": counted(last["archive_size"], *nouns),
        **_objectives(status.run, recent),
        "environment steps": f"{steps} in {counted(last['episodes'], 'episode')}",
        "time": f"{last['wall_clock_s']:.1f}{of.get('wall_clock_s', '')} s, {rate:,.0f} steps/s overall",
        **_faults(recent, last["generation"]),
    }


def _parameters(status: RunStatus) -> dict[str, str]:
    """The parameters of the best centre by name, if the task is a function."""
    run = status.run
    if status.row is None or run.task.parameters is None:
        return {}
    try:
        named = run.parameters("best")
    except StoreError as error:
        return {"best parameters": f"not known: {error.sentence}"}
    shown = ", ".join(f"{name} = {value:.6g}" for name, value in list(named.items())[:SHOWN_PARAMETERS])
    more = f" and {len(named) - SHOWN_PARAMETERS} more" if len(named) > SHOWN_PARAMETERS else ""
    return {"best parameters": f"{shown}{more}"}


def _objectives(run: Run, recent: Recent) -> dict[str, str]:
    """What the centres of the newest generation climb; nothing if it moved none, or if that is not known."""
    newest, all_, search = recent.newest, recent.objectives, run.meta.config["search"]
    chosen = [
        objective["kind"] for objective in (search.get("objective"), *(search.get("objectives") or ())) if objective
    ]
    if not {*chosen} <= WEIGHED or "target_weight" in search:  # a place or a distance beside fitness
        return {"objectives": ", ".join(dict.fromkeys(chosen)) or "nearness to targets, and fitness"}
    if newest is None or all_ is None:
        return {}
    if all_.are_separate:
        share = 100 * all_.exploring / all_.centres
        text = f"{newest.exploring:,} exploring, {newest.exploiting:,} exploiting"
        return {"centres": f"{text}; of the last {all_.centres:,}, {share:.1f} % explored"}
    if not newest.centres:
        return {}
    weight = newest.fitness_weight
    return {"weight of fitness": f"{weight:g} (novelty: {1.0 - weight:g})"}


def _certified(run: Run) -> dict[str, str]:
    """The policy of the newest certification, and those of the newest ones in other tasks, if there are any."""
    try:
        newest, elsewhere = newest_certified(run.folder), certified_elsewhere(run.folder)
    except StoreError as error:
        return {"certified": f"not known: {error.sentence}"}
    fields = {} if newest is None else {"certified": f"{newest.title}: {certified_line(newest.row())}"}
    return fields | {f"in {task}": f"{one.title}: {elsewhere_line(one.row())}" for task, one in elsewhere.items()}


def _faults(recent: Recent, generation: int) -> dict[str, str]:
    """The invalid members and the faults of recent generations, if there are any; or why they and the objectives are
    not known."""
    if recent.problem:
        return {"not known": f"objectives and faults of the recent generations: {recent.problem}"}
    invalid = {"invalid members": recent.invalid_members} if recent.invalid_members else {}
    if not recent.lost_workers and not recent.retries:
        return invalid
    where = f" in the last {FAULTS_OF:,} generations" if generation >= FAULTS_OF else ""
    faults = f"{counted(recent.lost_workers, 'worker')} replaced, {counted(recent.retries, 'chunk')} sent again"
    return invalid | {"faults handled": f"{faults}{where}"}


def _print_fields(console: Console, fields: dict[str, str]) -> None:
    for name, value in fields.items():
        print_line(console, f"{name:<18} {value}")


def print_certified(console: Console, certified: list[Certified]) -> None:
    """Print a line for each policy of a certification, and one more for its episodes in another task."""
    for policy in certified:
        print_line(console, f"  {policy.title}: {certified_line(policy.row())}")
        if policy.elsewhere is not None:
            print_line(console, f"  {policy.title} in {policy.elsewhere.title}: {elsewhere_line(policy.row())}")


def certified_line(row: Mapping[str, Any]) -> str:
    chosen = (
        f"first of {row['candidates']:,}" if row["rank"] == 0 else f"number {row['rank'] + 1} of {row['candidates']:,}"
    )
    tries = f"; {tries_sentence(row['tries'])}" if row["tries"] else ""
    episodes = counted(row["episodes"], "episode")
    return f"{', '.join(_values(row))}; {episodes}, {chosen} by {row['selected_by']}{tries}"


def elsewhere_line(row: Mapping[str, Any]) -> str:
    """The values of a certified policy in another task in words, each with its gap."""
    episodes = counted(row["elsewhere_episodes"], "episode")
    return f"{', '.join(_values(row, 'elsewhere_'))}; {episodes}, {pairs_sentence(paired=row['elsewhere_paired'])}"


def _values(row: Mapping[str, Any], prefix: str = "") -> list[str]:
    """What the columns of a row say that begin with a prefix."""
    means = {"return": "return", "last_reward": "last reward", "goal_distance": "least goal distance"}
    parts = [
        f"{what} {_interval(row, f'{prefix}{name}')}{_gap(row, name, prefix)}"
        for name, what in means.items()
        if row[f"{prefix}{name}_mean"] is not None
    ]
    if row[f"{prefix}successes"] is not None:
        low, high = (100 * row[f"{prefix}success_{end}"] for end in ("low", "high"))
        count = f"{row[f'{prefix}successes']} of {row[f'{prefix}episodes']}"
        parts.append(f"success {count} ({low:.1f} to {high:.1f} %){_gap(row, 'success', prefix, 100.0, ' %')}")
    return parts


def _gap(row: Mapping[str, Any], name: str, prefix: str, scale: float = 1.0, unit: str = "") -> str:
    if not prefix or row[f"gap_{name}_mean"] is None:
        return ""
    mean, low, high = (_signed(scale * row[f"gap_{name}_{end}"]) for end in ("mean", "low", "high"))
    return f" (gap {mean} [{low}, {high}]{unit})"


def _signed(value: float) -> str:
    return f"{'+' if value >= 0.0 else ''}{number(value)}"


def _interval(row: Mapping[str, Any], name: str) -> str:
    mean, low, high = (row[f"{name}_{end}"] for end in ("mean", "low", "high"))
    mean, low, high = (decimals(value, "z,.2f") for value in (mean, low, high))
    return f"{mean} [{low}, {high}]"


# The command, and the line of each of several runs.

NEWEST = 10
"""Most runs that `status` shows without a folder."""


def status(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            parser=given_path,
            metavar="[RUN]...",
            help="Folders of runs or of sweeps; default: the newest runs under runs/.",
            show_default=False,
        ),
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Watch one run until its driver ends.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the state of a run, also while it is running; for a sweep or several runs, print one line each."""
    if follow and len(folders or ()) != 1:
        raise ConfigError(f"--follow: needs exactly one folder, got {len(folders or ())}; give one, or omit --follow")
    if follow and as_json:
        raise ConfigError("--follow and --json cannot be combined; omit one of them")
    if not folders:
        found = newest_runs(api.RUNS_FOLDER)
        folders = found[:NEWEST]
        if not folders and not as_json:
            print_note(f"there is no run under {api.RUNS_FOLDER}/ in this folder; give the folder of a run")
            return
        if len(found) > NEWEST and not as_json:
            everything = command("status", f"{api.RUNS_FOLDER}/")
            print_note(f"the {NEWEST} newest of {len(found)} runs under {api.RUNS_FOLDER}/; all: {everything}")
    elif is_single(folders) and not as_json:
        run = api.open_run(folders[0])
        (follow_status if follow else print_status)(console, run)
        return
    if follow:
        names = ", ".join(run.name for run in runs_of(folders[0]))
        raise ConfigError(f"--follow: needs one run; {folders[0]} has several: {names}")
    shown = _print_statuses(folders) if as_json else print_overview(console, folders)
    raise typer.Exit(0 if shown else 1)


def _print_statuses(folders: list[Path]) -> bool:
    """Print a list with an object for each run; return whether all runs could be read."""
    statuses: list[dict[str, Any]] = []
    for folder, data in of_each(folders, lambda run: status_data(read_status(api.open_run(run)))):
        if isinstance(data, ServiceError):
            statuses.append(problem_data(folder, data))
        else:
            statuses.append(data or {"run": str(folder), "state": NOT_STARTED, "newest": None})
    print_json(statuses)
    return not any("error" in run_status for run_status in statuses)


def status_data(status: RunStatus) -> dict[str, Any]:
    """What `status` shows of a run: `newest` is the newest row of its history, `objectives` says what the centres of
    that generation climb, and those of recent ones, or in `problem` why that is not known; `tries` has the mean fitness
    of each policy that did not reach `target_certified` in new episodes."""
    run, row = status.run, status.row
    recent = read_recent(run, row["generation"]) if row else Recent()
    return {
        "run": str(run.folder),
        "run_id": run.run_id,
        "task": run.constants["task.environment"],
        "algorithm": run.constants["search.algorithm"],
        "seed": run.constants["seed"],
        "state": state(status),
        "driver": status.driver,
        "last_end": status.end,
        "output": status.output,
        "limits": status.limits,
        "target_certified": status.target_certified,
        "tries": status.tries,
        "newest": row,
        "objectives": {
            "newest": recent.newest and recent.newest._asdict(),
            "recent": recent.objectives and recent.objectives._asdict(),
            "problem": recent.problem,
        },
    }


_COLUMNS = ("run", "algorithm", "task", "seed", "generation", "env steps", "best", "cells", "state")
NOT_STARTED = "not started"
"""State of a sweep's run that has no folder yet."""


def print_overview(console: Console, folders: Sequence[Path]) -> bool:
    """Print a line for each run, with the error if it cannot be read; return whether all could be read.

    Args:
        folders: those of runs or of sweeps.
    """
    rows, problems = [], 0
    for folder, result in of_each(folders, lambda run: _row(read_status(api.open_run(run)))):
        if isinstance(result, ServiceError):
            rows.append(_without_row(folder, f"error: {' '.join(result.sentence.split())}"))
            problems += 1
        elif result is None:
            output = output_of(folder)
            rows.append(_without_row(folder, NOT_STARTED + (f"; its output is in {output}" if output else "")))
        else:
            rows.append(result)
    widths = [max(map(len, column)) for column in zip(_COLUMNS, *rows, strict=True)]
    for row in (_COLUMNS, *rows):
        line = "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        print_line(console, line)
    return not problems


def _without_row(folder: Path, state: str) -> tuple[str, ...]:
    return (str(folder), *["-"] * (len(_COLUMNS) - 2), state)


def _row(status: RunStatus) -> tuple[str, ...]:
    constants, limits, row = status.run.constants, status.limits, status.row
    who = (str(status.run.folder), constants["search.algorithm"], constants["task.environment"], str(constants["seed"]))
    if row is None:
        return (*who, *["-"] * (len(_COLUMNS) - len(who) - 1), state(status))
    generations, steps = limits.get("generations"), limits.get("env_steps")
    return (
        *who,
        f"{row['generation']:,}" + (f" of {generations:,}" if generations else ""),
        short(row["env_steps"]) + (f" of {short(steps)}" if steps else ""),
        decimals(row["best_fitness"]),
        f"{row['map_cells']:,}" if "map_cells" in row else "-",
        state(status),
    )
