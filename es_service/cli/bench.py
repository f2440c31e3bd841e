"""The commands `es-service bench ...`: measurements of this machine's speed."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from es_service.cli.options import ConfigArgument, SetOption, overrides
from es_service.config.tasks import CALLER
from es_service.config.text import one_of
from es_service.errors import ConfigError

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
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of rows as JSON.")] = False,
) -> None:
    """Measure environment steps per second: with and without a policy, on one core and on all."""
    from es_service.cli import bench_rollouts as measured

    policies = {None: (False, True), "on": (True,), "off": (False,)}.get(policy)
    rollouts = rollout.split(",") if rollout else []
    if policies is None:
        raise ConfigError(f"--policy {policy}: must be on or off")
    # Rollouts of a caller's tasks compute nothing.
    able = [name for name, candidate in measured.ROLLOUTS.items() if candidate.task_kinds != (CALLER,)]
    if not set(rollouts) <= set(able):
        raise ConfigError(f"--rollout {rollout}: must be {one_of(able)}, or several separated by commas")
    if odd := [number for number in batch or () if number % 2]:
        raise ConfigError(f"--batch {odd[0]}: must be even, so that it consists of whole pairs")
    rows = measured.bench_rollouts(
        task or (), policies=policies, rollouts=rollouts, batches=batch or (), seconds=seconds, overrides=set_ or ()
    )
    if as_json:
        print(json.dumps(list(rows), indent=1))
        return
    print(measured.HEADER)
    for row in rows:
        print(measured.line(row), flush=True)


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
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of rows as JSON.")] = False,
) -> None:
    """Predict how fast a config runs on a cluster, from measurements on this machine. It takes half a minute."""
    from es_service.runs.checked_config import load_config
    from es_service.runs.scaling import bench_scaling

    counts = workers.split(",")
    if not all(count.strip().isdigit() and int(count) for count in counts):
        raise ConfigError(f"--workers {workers}: must be whole numbers, each at least 1, such as {SCALING_WORKERS}")
    rows = bench_scaling(load_config(config, overrides(set_)), [int(count) for count in counts], cores_per_node)
    if as_json:
        print(json.dumps(list(rows), indent=1))
        return
    print(SCALING_HEADER)
    for row in rows:
        print(
            f"{row['workers']:>8}{row['seconds_per_generation']:>14.4g}{row['steps_per_second']:>16,}"
            f"{row['efficiency']:>12.0%}  {row['limit']}",
            flush=True,
        )
