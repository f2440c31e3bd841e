"""A session of a run on the command line, and the commands that are about computing one: `polish` and `verify`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from es_service import api
from es_service.cli.common import (
    AddressOption,
    EngineOption,
    JsonOption,
    LogLevelOption,
    LogOption,
    OutOption,
    RunArgument,
    SeedOption,
    SetOption,
    ShowOutputOption,
    WorkersOption,
    command,
    console,
    errors,
    output_shown,
    overrides,
    print_error,
    print_json,
    print_json_line,
    print_line,
    print_note,
)
from es_service.cli.status import print_certified, print_summary
from es_service.cli.sweep import ParallelOption, SeedsOption, polish_goals
from es_service.config.changes import again_with
from es_service.config.given import parse_overrides
from es_service.errors import ConfigError, Interrupted, RunLockedError, ServiceError, WayOut
from es_service.loop.history import Row
from es_service.loop.state import Observer
from es_service.protocol.user_code import users_error
from es_service.report.progress import ShowNotice, ShowRow, print_notice, show_progress
from es_service.runs.checked_config import changed_config
from es_service.runs.tracking import check_trackers, tracked
from es_service.runs.verification import (
    Recomputed,
    RecomputedCertification,
    recomputed_certifications,
    why_not_repeatable,
)
from es_service.runs.verification import verify as recompute
from es_service.store.create import refuse_taken
from es_service.store.folder import holds_run


def told_to_user(error: Exception, ways_out: Sequence[WayOut] = ()) -> ServiceError | None:
    """An error for the user: one of this package, or what the user's code raised; None if it is a bug of ours."""
    if isinstance(error, ServiceError):
        return error
    text = users_error(error)
    return ServiceError(text, ways_out=ways_out) if text else None


@contextlib.contextmanager
def naming(call: WayOut) -> Iterator[None]:
    """Make the ways out of an error that start a run repeat this command: the code that raises it has only a config."""
    try:
        yield
    except ServiceError as error:
        error.ways_out = tuple(
            again_with(replace(call, out=way.out), way.purpose, way.settings) if way.action == "run" else way
            for way in error.ways_out
        )
        raise


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
                on_generation=Observer(partial(tell_generation, show)),
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
    goals: Annotated[
        str | None,
        typer.Option(
            "--goals",
            metavar="all | A,B",
            help="A run for each of these goals of the task, which share the budget and the cores.",
        ),
    ] = None,
    seeds: SeedsOption = None,
    parallel: ParallelOption = None,
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
    from es_service.runs.lineage import certified_for, polish_config

    chosen = [] if candidates is None else [f"search.candidates={candidates}"]
    wanted = overrides([*chosen, *(set_ or ())], seed=seed, workers=workers, engine=engine, address=address)
    if goals is not None:
        if out is None or show_output:
            what = "needs --out FOLDER, in which each goal has a run" if out is None else "does not show output"
            raise ConfigError(f"--goals {goals} {what}", field="goals", value=goals)
        polish_goals(parent, goals, out, wanted, seeds, parallel, log, log_level)
        return
    for option, value in {"--seeds": seeds, "--parallel": parallel}.items():
        if value is not None:
            raise ConfigError(f"{option} {value} needs --goals; add it, or leave {option} out", field=option)
    config = polish_config(parent, wanted)
    folder = out if out is not None else api.default_folder(config)
    told = partial(print_notice, errors), output_shown(show_output)
    check_trackers(log or ())
    refuse_taken(folder)
    before = certified_for(api.open_run(parent), config, *told, workers=workers)  # first: a driver may hold the parent
    with naming(WayOut("polish", "", str(parent), parse_overrides(wanted)[0])):
        session(folder, partial(api.run, config, folder), log, show_output=show_output)
    after = certified_for(api.open_run(folder), config, *told, workers=workers, centre=True)
    for what, certified in (("before", before), ("after", after)):
        print_line(console, f"certified {what} polishing:")
        print_certified(console, certified)


# The command `verify`: compute generations of a run again, and tell whether the bits are equal.


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
