"""The command `verify`: compute generations of a run again, and tell whether the bits are equal."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from es_service import api
from es_service.cli.console import console, print_line
from es_service.cli.data import print_json
from es_service.cli.options import JsonOption, LogLevelOption, RunArgument, print_error, print_note
from es_service.errors import RunLockedError
from es_service.runs.certification import recomputed as recomputed_certifications
from es_service.runs.checked_config import changed_config
from es_service.runs.repeating import why_not_repeatable
from es_service.runs.verification import Recomputed
from es_service.runs.verification import verify as recompute


def verify(
    folder: RunArgument,
    generations: Annotated[
        int, typer.Option("--generations", min=1, help="Generations to compute from each state that is kept.")
    ] = 1,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes; default: one per core.")] = None,
    as_json: JsonOption = False,
    log_level: LogLevelOption = None,
) -> None:
    """Compute generations of a run again on this machine and compare every bit; exit code 1 if one differs, 3 if
    this cannot be judged: the run is running, or its task does not repeat itself."""
    run = api.open_run(folder)
    try:
        recomputed = recompute(run, generations, workers)
    except RunLockedError as error:
        print_error(error)
        raise typer.Exit(3) from None
    digest = run.digest()  # raises if stored data are damaged
    found: list[Recomputed] = []
    for one in recomputed:
        found.append(one)
        if not as_json:
            print_line(console, _line(one))
    certified = []
    for one, differences, changes in recomputed_certifications(run, workers):
        certified.append((one, differences))
        if not as_json:
            what = f"differs: {', '.join(differences)}" if differences else "equal"
            since = f"; since it was made: {', '.join(changes)}" if changes else ""
            print_line(console, f"certification {one.number}, {one.name}: {what}{since}")
    why = ""
    if any(one.differences for one in found) or any(differences for _, differences in certified):
        why = why_not_repeatable(run, changed_config(run.present_config, {}))
    equal = not any(one.differences for one in found) and not any(differences for _, differences in certified)
    if as_json:
        print_json(
            {
                "digest": digest,
                "equal": equal,
                "does_not_repeat": why,
                "recomputed": [asdict(one) for one in found],
                "certified": [
                    {"certification": one.number, "policy": one.name, "differences": differences}
                    for one, differences in certified
                ],
            }
        )
    else:
        again = sum(one.last - one.first + 1 for one in found)
        print(f"{digest}  {'equal' if equal else 'different'}")
        print_note(f"{again:,} of {(run.generation or 0) + 1:,} generations were computed again")
        if why:
            print_note(
                f"{run.constants['task.environment']} does not repeat itself: with the same seed and actions it "
                f"returns other numbers {why}. So the differences do not say that the run is wrong, and it cannot be "
                "verified"
            )
    raise typer.Exit(0 if equal else 3 if why else 1)


def _line(one: Recomputed) -> str:
    which = f"generation {one.first}" if one.first == one.last else f"generations {one.first} to {one.last}"
    if not one.differences:
        line = f"{which}: equal"
    elif one.first == one.last:
        line = f"{which} differs: {', '.join(one.differences)}"
    else:
        line = f"{which}: generation {one.last} differs: {', '.join(one.differences)}"
    return line + (f"; since the run computed it: {', '.join(one.changes)}" if one.changes else "")
