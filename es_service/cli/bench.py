"""The commands `es-service bench ...`: measurements of this machine's speed."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from es_service.config.problems import one_of
from es_service.errors import ConfigError

bench = typer.Typer(help="Measure the speed of this machine.", no_args_is_help=True)


@bench.callback()
def _bench() -> None:
    """Do nothing; this callback keeps `rollouts` a subcommand although it is the only one."""


@bench.command()
def rollouts(
    task: Annotated[
        list[str] | None, typer.Option("--task", help="Task to measure; default: all shipped tasks.")
    ] = None,
    policy: Annotated[
        str | None, typer.Option("--policy", help="With a policy (on), without (off); default: both.")
    ] = None,
    rollout: Annotated[
        str, typer.Option("--rollout", help="xla, simd (this project's compiler) or xla,simd.")
    ] = "xla,simd",
    batch: Annotated[
        list[int] | None, typer.Option("--batch", min=2, help="Number of episodes that step together; must be even.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.0, help="Duration of each measurement in seconds.")
    ] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of rows as JSON.")] = False,
) -> None:
    """Measure environment steps per second: with and without a policy, on one core and on all."""
    from es_service.cli import bench_rollouts as measured

    policies = {None: (False, True), "on": (True,), "off": (False,)}.get(policy)
    rollouts = rollout.split(",")
    if policies is None:
        raise ConfigError(f"--policy {policy}: must be on or off")
    if not set(rollouts) <= set(measured.ROLLOUTS):
        raise ConfigError(f"--rollout {rollout}: must be {one_of(measured.ROLLOUTS)}, or both separated by a comma")
    if odd := [number for number in batch or () if number % 2]:
        raise ConfigError(f"--batch {odd[0]}: must be even, so that it consists of whole pairs")
    rows = measured.bench_rollouts(
        task or (), policies=policies, rollouts=rollouts, batches=batch or (), seconds=seconds
    )
    if as_json:
        print(json.dumps(list(rows), indent=1))
        return
    print(measured.HEADER)
    for row in rows:
        print(measured.line(row), flush=True)
