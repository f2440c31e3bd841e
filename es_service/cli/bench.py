"""The commands `es-service bench ...`: measurements of this machine's speed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Annotated, Any

import typer

from es_service.cli.common import ConfigArgument, LinesOption, SetOption, overrides, print_json_line
from es_service.config.given import Overrides, parse_overrides
from es_service.config.parts import TASK_OPTIONS
from es_service.config.resolution import options_of
from es_service.config.tasks import CALLER, OTHER_TASKS, ROLLOUTS, TASKS, read_options
from es_service.config.text import did_you_mean_task, one_of, problem_of
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.child import Child, NoAnswerError
from es_service.protocol.machine import cores
from es_service.protocol.process_environment import child_environment
from es_service.protocol.user_code import RaisedError

BATCHES = {"point_maze": (64,)}
ANT_BATCHES = (8, 16, 64)
PAPER = {"point_maze": 1_520_000, "ant_maze": 4_480, "ant_trap": 7_470}
"""Steps a second on one CPU, without a policy (Chalumeau et al. 2022): other physics, another machine."""
HIDDEN = {"point_maze": [64, 64]}
ANT_HIDDEN = [256, 256]


def bench_rollouts(
    tasks: Sequence[str] = (),
    *,
    policies: Sequence[bool] = (False, True),
    rollouts: Sequence[str] = (),
    batches: Sequence[int] = (),
    seconds: float = 3.0,
    overrides: Overrides = (),
) -> Iterator[dict[str, Any]]:
    """Yield one row per task, policy (on, off), rollout, batch and number of cores (one, all), as each is measured.

    The hidden layers are the paper's: 64x64 for PointMaze, else 256x256. Each core has a process like a worker's; the
    rates of several, measured at the same time, are added. If a rollout cannot run a task, its rows are replaced by
    one row {"task", "rollout", "note"}.

    Args:
        overrides: values of `task.options`, which all of the tasks must have.

    Raises:
        ConfigError: a task is unknown, or lacks an option.
        EvaluationError: a task cannot be measured, or a rollout cannot run it and no other was requested.
    """
    for task in tasks:
        if task not in TASKS:
            raise ConfigError(
                f"--task {task}: unknown task; must be {one_of(TASKS)}, or {OTHER_TASKS}"
                f"{did_you_mean_task(task, TASKS)}"
            )
    options = {task: _options(task, overrides) for task in tasks or TASKS}
    every = sorted({1, cores()})
    for task in tasks or TASKS:
        cannot: set[str] = set()
        asked = rollouts or [name for name, candidate in ROLLOUTS.items() if TASKS[task].kind in candidate.task_kinds]
        for policy, rollout in itertools.product(policies, asked):
            if rollout in cannot:
                continue
            for batch, count in itertools.product(batches or BATCHES.get(task, ANT_BATCHES), every):
                arguments = {
                    "task": task,
                    "options": options[task],
                    "hidden": HIDDEN.get(task, ANT_HIDDEN),
                    "policy": policy,
                    "batch": batch,
                    "seconds": seconds,
                    "rollout": rollout,
                }
                row = _row(arguments, count)
                if "note" in row and set(asked) == {rollout}:
                    raise EvaluationError(f"{task}: {row['note']}")
                yield row
                if "note" in row:
                    cannot.add(rollout)
                    break


def _options(task: str, overrides: Overrides) -> dict[str, Any]:
    values, problems = parse_overrides(overrides)
    problems += [problem_of(key, value, f"only {TASK_OPTIONS}NAME can be set here")
                 for key, value in values.items() if not key.startswith(TASK_OPTIONS)]  # fmt: skip
    read, unknown = read_options(values, TASKS[task])
    if problems or unknown:
        raise ConfigError.listing(f"--task {task}", [*problems, *unknown])
    return options_of({key: read[key] for key in values})


def _row(arguments: Mapping[str, Any], count: int) -> dict[str, Any]:
    with ExitStack() as ends:  # in case one fails or a signal arrives
        started = [ends.enter_context(Child("workers.measure:measurer", child_environment())) for _ in range(count)]
        for process in started:
            process.ask(arguments["task"], {name: value for name, value in arguments.items() if name != "task"})
            process.ask()
        try:
            measurements = [(process.answer(), process.answer())[1] for process in started]
        except (NoAnswerError, RaisedError) as error:
            why = f"its process {error}" if isinstance(error, NoAnswerError) else error
            raise EvaluationError(f"{arguments['task']} cannot be measured: {why}") from None
    named = {"task": arguments["task"], "rollout": arguments["rollout"]}
    if "problem" in measurements[0]:
        return named | {"note": f"{arguments['rollout']} cannot run it: {measurements[0]['problem']}"}
    return named | {
        "policy": "on" if arguments["policy"] else "off",
        "batch": arguments["batch"],
        "cores": count,
        "steps_per_second": sum(measurement["steps_per_second"] for measurement in measurements),
        "compile_seconds": max(measurement["compile_seconds"] for measurement in measurements),
        "peak_mib": max(measurement["peak_mib"] for measurement in measurements),
    }


COLUMNS = {"task": -36, "policy": -8, "rollout": -9, "batch": 5, "cores": 7, "steps/s": 13, "compile s": 11,
           "peak MiB": 10, "paper": 12}  # fmt: skip
"""Title -> width; negative ones are flush left."""
HEADER = "".join(f"{title:{'<' if width < 0 else '>'}{abs(width)}}" for title, width in COLUMNS.items())


def line(row: Mapping[str, Any]) -> str:
    """A row under HEADER, with the paper's rate where that is comparable."""
    if "note" in row:
        return f"{row['task']:<36}{row['note']}"
    comparable = row["policy"] == "off" and row["cores"] == 1 and row["task"] in PAPER
    paper = f"{PAPER[row['task']]:,}" if comparable else ""
    shown = (row["task"], row["policy"], row["rollout"], row["batch"], row["cores"], f"{row['steps_per_second']:,}",
             row["compile_seconds"], row["peak_mib"], paper)  # fmt: skip
    widths = COLUMNS.values()
    return "".join(
        f"{value!s:{'<' if width < 0 else '>'}{abs(width)}}" for value, width in zip(shown, widths, strict=True)
    )


bench = typer.Typer(help="Measure the speed of this machine.", no_args_is_help=True)


@bench.command()
def rollouts(
    task: Annotated[
        list[str] | None, typer.Option("--task", help="Task to measure; default: all shipped tasks.")
    ] = None,
    policy: Annotated[
        str | None, typer.Option("--policy", help="With a policy (on), without (off); default: both.")
    ] = None,
    rollout: Annotated[
        str | None, typer.Option("--rollout", help="xla, simd (this project's compiler) or xla,simd; default: all.")
    ] = None,
    batch: Annotated[
        list[int] | None, typer.Option("--batch", min=2, help="Number of episodes that step together; must be even.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.0, help="Duration of each measurement in seconds.")
    ] = 3.0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="task.options.KEY=VALUE", help="Change an option of the tasks.")
    ] = None,
    as_json: LinesOption = False,
) -> None:
    """Measure environment steps per second: with and without a policy, on one core and on all."""
    policies = {None: (False, True), "on": (True,), "off": (False,)}.get(policy)
    rollouts = rollout.split(",") if rollout else []
    if policies is None:
        raise ConfigError(f"--policy {policy}: must be on or off")
    # Rollouts of a caller's tasks compute nothing.
    able = [name for name, candidate in ROLLOUTS.items() if candidate.task_kinds != (CALLER,)]
    if not set(rollouts) <= set(able):
        raise ConfigError(f"--rollout {rollout}: must be {one_of(able)}, or several separated by commas")
    if odd := [number for number in batch or () if number % 2]:
        raise ConfigError(f"--batch {odd[0]}: must be even, so that it consists of whole pairs")
    rows = bench_rollouts(
        task or (), policies=policies, rollouts=rollouts, batches=batch or (), seconds=seconds, overrides=set_ or ()
    )
    if as_json:
        for row in rows:
            print_json_line(row)
        return
    print(HEADER)
    for row in rows:
        print(line(row), flush=True)


SCALING_WORKERS = "1,2,8,64,512,4096"
SCALING_HEADER = f"{'workers':>8}{'s/generation':>14}{'steps/s':>16}{'efficiency':>12}  limited by"


@bench.command()
def scaling(
    config: ConfigArgument,
    workers: Annotated[
        str, typer.Option("--workers", help="Numbers of workers (cores), separated by commas.")
    ] = SCALING_WORKERS,
    cores_per_node: Annotated[int, typer.Option("--cores-per-node", min=1, help="Cores of each node.")] = 64,
    set_: SetOption = None,
    as_json: LinesOption = False,
) -> None:
    """Predict how fast a config runs on a cluster, from measurements on this machine. It takes half a minute."""
    from es_service.runs.checked_config import load_config
    from es_service.runs.scaling import bench_scaling

    counts = workers.split(",")
    if not all(count.strip().isdecimal() and int(count) for count in counts):
        raise ConfigError(f"--workers {workers}: must be whole numbers, each at least 1, such as {SCALING_WORKERS}")
    rows = bench_scaling(load_config(config, overrides(set_)), [int(count) for count in counts], cores_per_node)
    if as_json:
        for row in rows:
            print_json_line(row)
        return
    for number, row in enumerate(rows):
        if not number:
            print(SCALING_HEADER)
        print(
            f"{row['workers']:>8}{row['seconds_per_generation']:>14.4g}{row['steps_per_second']:>16,}"
            f"{row['efficiency']:>12.0%}  {row['limit']}",
            flush=True,
        )
