"""What the commands of the command line share: options, what they stand for in a config, how notes are printed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

console = Console()
errors = Console(stderr=True)

ConfigArgument = Annotated[Path, typer.Argument(help="YAML config; see configs/.", show_default=False)]
RunArgument = Annotated[Path, typer.Argument(help="Folder of a run.", show_default=False)]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one key, e.g. search.sigma=0.05.")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder of the new run; default: a name under runs/.")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Seed of all random numbers.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", help="Worker processes; default: as configured.")]
EngineOption = Annotated[str | None, typer.Option("--engine", help="What runs the workers: inline or ray.")]
AddressOption = Annotated[
    str | None, typer.Option("--address", help="Ray cluster to join: HOST:PORT, or auto. Implies --engine ray.")
]


def compute(workers: int | None, engine: str | None, address: str | None) -> dict[str, object]:
    """The options that say where a run runs, by config key. A cluster to join is a Ray cluster."""
    if address is not None and engine is None:
        engine = "ray"
    chosen: dict[str, object] = {"compute.workers": workers, "compute.engine": engine, "compute.address": address}
    if engine == "inline" and address is None:  # what the file, or the run's record, says of a cluster is moot then
        chosen |= {"compute.address": "null", "compute.worker_resources.cpu": 1, "compute.worker_resources.gpu": 0}
    return chosen


def overrides(set_: list[str] | None, **options: object) -> list[str]:
    """`--set` values, then options that stand for a key; the later ones win."""
    return [*(set_ or []), *(f"{key}={value}" for key, value in options.items() if value is not None)]


def print_note(message: str) -> None:
    """A line for the user that is no result."""
    errors.print(message, highlight=False, markup=False, soft_wrap=True)


def print_error(message: str) -> None:
    """What has gone wrong, and what to do."""
    errors.print(f"error: {message}", style="red", highlight=False, markup=False, soft_wrap=True)
