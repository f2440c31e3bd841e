"""The command `verify`: compute generations of a run again, and tell whether the bits are equal."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from es_service import api
from es_service.cli.options import JsonOption, LogLevelOption, RunArgument, ShowOutputOption
from es_service.cli.printing import console, output_shown, print_error, print_json, print_line, print_note
from es_service.errors import RunLockedError
from es_service.runs.checked_config import changed_config
from es_service.runs.verification import (
    Recomputed,
    RecomputedCertification,
    recomputed_certifications,
    why_not_repeatable,
)
from es_service.runs.verification import verify as recompute


def verify(
    folder: RunArgument,
    generations: Annotated[
        int, typer.Option("--generations", min=1, help="Generations to compute from each state that is kept.")
    ] = 1,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes; default: one per core.")] = None,
    show_output: ShowOutputOption = False,
    as_json: JsonOption = False,
    log_level: LogLevelOption = None,
) -> None:
    """Compute generations of a run again on this machine and compare every bit; exit code 1 if one differs, 3 if
    this cannot be judged: the run is running, or a task cannot be run here or does not repeat itself."""
    run, on_output = api.open_run(folder), output_shown(show_output)
    try:
        recomputed = recompute(run, generations, workers, on_output)
    except RunLockedError as error:
        print_error(error)
        raise typer.Exit(3) from None
    digest = run.digest()  # raises if stored data are damaged
    groups: list[Recomputed] = []
    for group in recomputed:
        groups.append(group)
        if not as_json:
            print_line(console, _line(group))
    certified: list[RecomputedCertification] = []
    for one in recomputed_certifications(run, workers, on_output):
        certified.append(one)
        if not as_json:
            print_line(console, _certified_line(one))
    differs = any(group.differences for group in groups) or any(one.differences for one in certified)
    why = ""
    if differs:
        why = why_not_repeatable(run, changed_config(run.present_config, name=str(run.config_file)))
    is_judged = not why and not any(one.not_judged for one in certified)
    if as_json:
        print_json(
            {
                "digest": digest,
                "equal": not differs,
                "does_not_repeat": why,
                "recomputed": [asdict(group) for group in groups],
                "certified": [
                    {
                        "certification": one.policy.number,
                        "policy": one.policy.name,
                        "differences": one.differences,
                        "not_judged": one.not_judged,
                    }
                    for one in certified
                ],
            }
        )
    else:
        again = sum(group.last - group.first + 1 for group in groups)
        print(f"{digest}  {'different' if differs else 'equal'}")
        print_note(f"{again:,} of {(run.generation or 0) + 1:,} generations were computed again")
        if why:
            print_note(
                f"{run.constants['task.environment']} does not repeat itself: with the same seed and actions it "
                f"returns other numbers {why}. So the differences do not say that the run is wrong, and it cannot be "
                "verified"
            )
    raise typer.Exit(1 if differs and not why else 0 if is_judged else 3)


def _certified_line(one: RecomputedCertification) -> str:
    kind = "decision" if one.policy.decides else "certification"
    where = "" if one.policy.elsewhere is None else f", also in {one.policy.elsewhere.title}"
    what = f"differs: {', '.join(one.differences)}" if one.differences else "equal"
    since = f"; since it was made: {', '.join(one.changes)}" if one.changes else ""
    unknown = f", but {one.not_judged}" if one.not_judged else ""
    return f"{kind} {one.policy.number}, {one.policy.name}{where}: {what}{unknown}{since}"


def _line(group: Recomputed) -> str:
    which = f"generation {group.first}" if group.first == group.last else f"generations {group.first} to {group.last}"
    if not group.differences:
        line = f"{which}: equal"
    elif group.first == group.last:
        line = f"{which} differs: {', '.join(group.differences)}"
    else:
        line = f"{which}: generation {group.last} differs: {', '.join(group.differences)}"
    return line + (f"; since the run computed it: {', '.join(group.changes)}" if group.changes else "")
