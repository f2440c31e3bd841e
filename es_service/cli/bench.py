"""The command line's `es-service bench`: how fast is this machine?"""

from __future__ import annotations

import json
from typing import Annotated

import typer

from es_service.config.problems import one_of
from es_service.errors import ConfigError

bench = typer.Typer(help="Measure this machine.", no_args_is_help=True)


@bench.callback()
def _bench() -> None:
    """Keeps `rollouts` a command of its own while it is the only one."""


@bench.command()
def rollouts(
    task: Annotated[list[str] | None, typer.Option("--task", help="Task to measure; default: all of ours.")] = None,
    policy: Annotated[str | None, typer.Option("--policy", help="on or off; default: both.")] = None,
    rollout: Annotated[str, typer.Option("--rollout", help="xla, simd (our own compiler), or both.")] = "xla,simd",
    batch: Annotated[
        list[int] | None, typer.Option("--batch", min=2, help="Episodes that step together, an even number.")
    ] = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.0, help="To measure for, each.")] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of rows as JSON.")] = False,
) -> None:
    """Environment steps a second: physics alone and with policies, on one core and on all, beside the paper's."""
    from es_service.cli import bench_rollouts as measured

    policies = {None: (False, True), "on": (True,), "off": (False,)}.get(policy)
    rollouts = rollout.split(",")
    if policies is None:
        raise ConfigError(f"--policy {policy}: must be on or off")
    if not set(rollouts) <= set(measured.ROLLOUTS):
        raise ConfigError(
            f"--rollout {rollout}: must be {one_of(measured.ROLLOUTS)}, or both with a comma between them"
        )
    if any(number % 2 for number in batch or ()):
        raise ConfigError("--batch: must be even, for whole pairs")
    rows = measured.bench_rollouts(
        task or (), policies=policies, rollouts=rollouts, batches=batch or (), seconds=seconds
    )
    if as_json:
        print(json.dumps(list(rows), indent=1))
        return
    print(measured.HEADER)
    for row in rows:
        print(measured.line(row), flush=True)
