"""The command `polish`: policies of a run, improved until they hold in new episodes."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from es_service import api
from es_service.cli.console import console, errors, print_line
from es_service.cli.options import (
    AddressOption,
    EngineOption,
    LogLevelOption,
    LogOption,
    OutOption,
    RunArgument,
    SeedOption,
    SetOption,
    WorkersOption,
    overrides,
)
from es_service.cli.session import session
from es_service.cli.tables.certified import print_certified
from es_service.report.progress import print_notice


def polish(
    parent: RunArgument,
    candidates: Annotated[
        int | None, typer.Option("--candidates", min=1, help="Policies that are left after the first evaluation.")
    ] = None,
    set_: SetOption = None,
    out: OutOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
    log: LogOption = None,
    log_level: LogLevelOption = None,
) -> None:
    """Start a new run that improves policies of another one, and certify both; search.objective says what improves."""
    from es_service.runs.polishing import certified_for, polish_config

    chosen = [] if candidates is None else [f"search.candidates={candidates}"]
    wanted = overrides([*chosen, *(set_ or ())], seed=seed, workers=workers, engine=engine, address=address)
    config = polish_config(parent, wanted)
    folder = out if out is not None else api.default_folder(config)
    tell = partial(print_notice, errors)
    before = certified_for(api.open_run(parent), config, tell, workers=workers)  # first: a driver may hold the parent
    session(folder, partial(api.run, config, folder), log)
    after = certified_for(api.open_run(folder), config, tell, workers=workers, centre=True)
    for what, certified in (("before", before), ("after", after)):
        print_line(console, f"certified {what} polishing:")
        print_certified(console, certified)
