"""A session of a run on the command line: its progress, its end, and its errors; and the command `polish`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from es_service import api
from es_service.cli.options import (
    AddressOption,
    EngineOption,
    LogLevelOption,
    LogOption,
    OutOption,
    RunArgument,
    SeedOption,
    SetOption,
    ShowOutputOption,
    WorkersOption,
    overrides,
)
from es_service.cli.printing import command, console, errors, output_shown, print_json_line, print_line, print_note
from es_service.cli.status import print_certified, print_summary
from es_service.errors import Interrupted, ServiceError, WayOut
from es_service.loop.history import Row
from es_service.protocol.raised import users_error
from es_service.report.progress import ShowNotice, ShowRow, print_notice, show_progress
from es_service.runs.tracking import tracked
from es_service.store.folder import holds_run


def told_to_user(error: Exception, ways_out: Sequence[WayOut] = ()) -> ServiceError | None:
    """An error for the user: one of this package, or what the user's code raised; None if it is a bug of ours."""
    if isinstance(error, ServiceError):
        return error
    text = users_error(error)
    return ServiceError(text, ways_out=ways_out) if text else None


def session(
    folder: Path,
    work: Callable[..., api.Outcome],
    log: Sequence[str] | None,
    *,
    show_output: bool = False,
    as_json: bool = False,
) -> None:
    """Show the progress of a run, send it to trackers, and show a summary at its end. The run continues if the output
    is closed.

    Args:
        show_output: whether to print what workers print, too.
        as_json: whether to print each row of the history as a line of JSON, and at the end a line that says why.
    """
    began = False

    def tell(show: Callable[[Any], None], what: Row | str) -> None:
        try:
            show(what)
        except SystemExit:  # raised by rich for a broken pipe; from then on rich prints nothing
            print_note(f"the output was closed; the run continues. Watch: {command('status', folder, '--follow')}")

    def tell_generation(show: Callable[[Row], None], row: Row) -> None:
        nonlocal began
        began = True  # remembered, since the folder may be renamed later
        tell(show, row)
        send(row)

    try:
        with (
            _json_lines() if as_json else show_progress(console, errors, str(folder)) as (show, note),
            tracked(folder, log or (), partial(tell, note)) as send,
        ):
            outcome = work(
                on_generation=partial(tell_generation, show),
                on_notice=partial(tell, note),
                on_compile=partial(tell, note),
                on_output=output_shown(show_output),
            )
    except Interrupted:
        if began or holds_run(folder):
            print_note(f"interrupted; every finished generation is saved. Continue with: {command('resume', folder)}")
        else:
            print_note("interrupted before the run began; nothing was written")
        raise
    except Exception as error:
        goes_on = WayOut("resume", "continue from the last finished generation after the cause is fixed", str(folder))
        if (told := told_to_user(error, [goes_on] if holds_run(folder) else ())) in (None, error):
            raise
        raise told from error
    with contextlib.suppress(SystemExit):
        reason = outcome.reason if began else f"no generation was run, since {outcome.reason}"
        if as_json:
            print_json_line({"run": str(outcome.run.folder), "is_finished": outcome.is_finished, "reason": reason})
        else:
            print_summary(console, outcome.run, reason)


@contextlib.contextmanager
def _json_lines() -> Iterator[tuple[ShowRow, ShowNotice]]:
    """As `show_progress`, for rows as lines of JSON."""
    yield print_json_line, partial(print_notice, errors)


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
    show_output: ShowOutputOption = False,
) -> None:
    """Start a new run that improves policies of another one, and certify both; search.objective says what improves."""
    from es_service.runs.polishing import certified_for, polish_config

    chosen = [] if candidates is None else [f"search.candidates={candidates}"]
    wanted = overrides([*chosen, *(set_ or ())], seed=seed, workers=workers, engine=engine, address=address)
    config = polish_config(parent, wanted)
    folder = out if out is not None else api.default_folder(config)
    told = partial(print_notice, errors), output_shown(show_output)
    before = certified_for(api.open_run(parent), config, *told, workers=workers)  # first: a driver may hold the parent
    session(folder, partial(api.run, config, folder), log, show_output=show_output)
    after = certified_for(api.open_run(folder), config, *told, workers=workers, centre=True)
    for what, certified in (("before", before), ("after", after)):
        print_line(console, f"certified {what} polishing:")
        print_certified(console, certified)
