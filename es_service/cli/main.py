"""The command line: `es-service run | resume | fork | polish | sweep | status | watch | digest | config | list |
evaluate | export | report | verify | submit | jobs | logs | stop | bench | doctor | help`.

Exit codes: 0 done, 1 failed, 2 bad usage or config, 3 cannot be checked now (`verify` of a running run), 130 or 143
interrupted by SIGINT or SIGTERM.
"""

from __future__ import annotations

import contextlib
import io
import signal
import sys
from functools import partial
from itertools import chain
from typing import Annotated

import typer

from es_service import api
from es_service.cli.bench import bench
from es_service.cli.common import (
    AddressOption,
    ConfigArgument,
    EngineOption,
    JsonOption,
    LinesOption,
    LogLevelOption,
    LogOption,
    OrResumeOption,
    OutOption,
    RunArgument,
    SeedOption,
    SetOption,
    ShowOutputOption,
    StrictOption,
    WorkersOption,
    console,
    overrides,
    print_config_notes,
    print_error,
    print_line,
)
from es_service.cli.evaluate import evaluate
from es_service.cli.jobs import job_commands
from es_service.cli.report import export, report, watch
from es_service.cli.session import naming, polish, session, told_to_user, verify
from es_service.cli.show import config_, digest_, help_, list_
from es_service.cli.status import status
from es_service.cli.sweep import SeedsOption, run_seeds, sweep
from es_service.config.given import parse_overrides
from es_service.config.workload import parallel_sentence
from es_service.errors import ConfigError, Interrupted, NotInRunError, WayOut
from es_service.logs import logger
from es_service.protocol.machine import VERSION
from es_service.runs.signals import EARLY
from es_service.store.folder import holds_run

_LOG = logger(__name__)
app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(VERSION)
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Evolution strategies for neuro-evolution on hard-exploration control tasks."""


@app.command()
def run(
    config: ConfigArgument,
    set_: SetOption = None,
    out: OutOption = None,
    seed: SeedOption = None,
    seeds: SeedsOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
    log: LogOption = None,
    log_level: LogLevelOption = None,
    or_resume: OrResumeOption = False,
    show_output: ShowOutputOption = False,
    as_json: LinesOption = False,
) -> None:
    """Start a run from a config file; with --seeds, a run for each seed."""
    wanted = overrides(set_, seed=seed, workers=workers, engine=engine, address=address)
    if or_resume and out is None:
        raise ConfigError("--or-resume needs --out: add --out FOLDER to name the folder of the run to start or resume")
    if seeds is not None:
        if show_output:
            raise ConfigError("--show-output and --seeds cannot be combined; `status` shows the newest lines of a run")
        run_seeds(config, seeds, out, wanted, seed, log, log_level, as_json=as_json)
        return
    begun = or_resume and out is not None and holds_run(out)
    loaded = api.load_config(config, wanted, new=not begun)
    print_config_notes(config, [loaded])
    if loaded.compute.engine == "ray" and not as_json:  # on the cores of one machine it says nothing that helps
        with contextlib.suppress(SystemExit):  # rich's answer to a closed output
            print_line(console, parallel_sentence(loaded))
    folder = out if out is not None else api.default_folder(loaded)
    shown = {"show_output": show_output, "as_json": as_json}
    with naming(WayOut("run", "", settings=parse_overrides(wanted)[0], config=str(config))):
        session(folder, partial(api.run_or_resume if or_resume else api.run, loaded, folder), log, **shown)


@app.command()
def resume(
    folder: RunArgument,
    set_: SetOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
    strict: StrictOption = False,
    log: LogOption = None,
    log_level: LogLevelOption = None,
    show_output: ShowOutputOption = False,
    as_json: LinesOption = False,
) -> None:
    """Continue a run; only budget, engine, workers and time limits may change."""
    wanted = overrides(set_, workers=workers, engine=engine, address=address)
    session(folder, partial(api.resume, folder, wanted, strict=strict), log, show_output=show_output, as_json=as_json)


@app.command()
def fork(
    parent: RunArgument,
    generation: Annotated[
        int | None,
        typer.Option("--generation", help="A generation whose state is kept; default: the newest."),
    ] = None,
    set_: SetOption = None,
    out: OutOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
    log: LogOption = None,
    log_level: LogLevelOption = None,
    show_output: ShowOutputOption = False,
    as_json: LinesOption = False,
) -> None:
    """Start a new run from another run's state, with changed settings."""
    wanted = overrides(set_, workers=workers, engine=engine, address=address)
    folder = out if out is not None else api.default_folder(api.fork_config(parent, wanted))
    fork = partial(api.fork, parent, wanted, generation=generation, out=folder)
    session(folder, fork, log, show_output=show_output, as_json=as_json)


app.command()(status)
app.command(name="digest")(digest_)
app.command(name="config")(config_)
app.command(name="list")(list_)
app.command(name="help")(help_)


app.command()(evaluate)
app.command()(polish)
app.command()(sweep)
app.command()(export)
app.command()(report)
app.command()(watch)
app.command()(verify)
app.add_typer(job_commands)
app.add_typer(bench, name="bench")


@app.command()
def doctor(
    tasks: Annotated[
        list[str] | None,
        typer.Argument(metavar="[TASK]...", help="Check these tasks instead: do they repeat, how fast are they?"),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option("--cluster", metavar="ADDRESS", help="Check this Ray cluster instead: HOST:PORT, or auto."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check that this machine, a cluster or a task can run searches, and show what their results depend on."""
    from es_service.cli.doctor import findings, print_findings, task_findings
    from es_service.dispatch.cluster_findings import cluster_findings

    if not tasks:
        found = findings() if cluster is None else cluster_findings(cluster)
    elif cluster is None:
        found = chain.from_iterable(map(task_findings, tasks))
    else:
        raise ConfigError("--cluster is no check of a task; leave it or the task out")
    raise typer.Exit(0 if print_findings(found, as_json=as_json) else 1)


def main() -> None:
    """Run the command; turn errors into one readable message and an exit code. Called by `es_service.__main__`."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # print ? for a ± where only ASCII can be printed
    try:
        app()
    except SystemExit as ended:
        if ended.code == 128 + signal.SIGINT and (stop := _interruption(ended)) is not None:
            raise stop from None
        raise
    except MemoryError as error:
        print_error(f"not enough memory{f': {error}' if str(error) else ''}. Reduce policy.hidden or search.pairs.")
        sys.exit(1)
    except Exception as error:
        if (told := told_to_user(error)) is None:
            raise  # a bug, of which the traceback is all that is known
        print_error(told)
        _LOG.debug("the traceback of this error", exc_info=error)
        sys.exit(2 if isinstance(told, ConfigError | NotInRunError) else 1)


def _interruption(ended: SystemExit) -> Interrupted | None:
    """What has interrupted a command. Typer ends it with the exit code of SIGINT after any KeyboardInterrupt, and Ray
    raises one of its own in place of that of a signal handler."""
    error: BaseException | None = ended
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return error if isinstance(error, Interrupted) else Interrupted(EARLY.number or signal.SIGINT)
        error = error.__cause__ or error.__context__
    return None
