"""The command line: `es-service run | resume | fork | status | digest | list | evaluate | export | submit | jobs | logs
| stop | bench | doctor`.

Exit codes: 0 done, 1 failed, 2 bad usage or config, 130 or 143 interrupted by SIGINT or SIGTERM.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from es_service import api, digest, jobs
from es_service.cli_bench import bench
from es_service.config.resolution import config_warnings
from es_service.errors import ConfigError, EvaluationError, Interrupted, NotInRunError, ServiceError
from es_service.report.catalogue import print_catalogue
from es_service.report.progress import Row, show_progress
from es_service.report.status import follow_status, print_status, print_summary
from es_service.session import task_of
from es_service.store.folder import DATABASE
from workers.environments import TASKS

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()
errors = Console(stderr=True)

ConfigArgument = Annotated[Path, typer.Argument(help="YAML config; see configs/.", show_default=False)]
RunArgument = Annotated[Path, typer.Argument(help="Folder of a run.", show_default=False)]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one key, e.g. search.sigma=0.05.")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder of the new run; default: a name under runs/.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", help="Worker processes; default: as configured.")]
EngineOption = Annotated[str | None, typer.Option("--engine", help="What runs the workers: inline or ray.")]
AddressOption = Annotated[
    str | None, typer.Option("--address", help="Ray cluster to join: HOST:PORT, or auto. Implies --engine ray.")
]
JobsOption = Annotated[
    str, typer.Option("--address", help="The cluster's dashboard, such as http://127.0.0.1:8265.", show_default=False)
]
JobArgument = Annotated[str, typer.Argument(help="Id of a job, as `submit` printed it.", show_default=False)]


def _print_version(wanted: bool) -> None:
    if wanted:
        print(metadata.version("es-service"))
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
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of all random numbers.")] = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
    or_resume: Annotated[
        bool, typer.Option("--or-resume", help="Go on with the run if --out holds it already.")
    ] = False,
) -> None:
    """Start a run from a config file."""
    overrides = _overrides(set_, seed=seed, **_compute(workers, engine, address))
    if or_resume and out is None:
        raise ConfigError("--or-resume needs --out: without it every run has a folder of its own")
    begun = or_resume and out is not None and (out / DATABASE).exists()
    loaded = api.load_config(config, overrides, new=not begun)
    for warning in config_warnings(loaded, task_of(loaded)):
        _print_note(f"note: {warning}")
    folder = out if out is not None else api.default_folder(loaded)
    _session(folder, partial(api.run_or_resume if or_resume else api.run, loaded, folder))


@app.command()
def resume(
    folder: RunArgument,
    set_: SetOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
) -> None:
    """Go on with a run; only budget, engine, workers and time limits may change."""
    overrides = _overrides(set_, **_compute(workers, engine, address))
    _session(folder, partial(api.resume, folder, overrides))


@app.command()
def fork(
    parent: RunArgument,
    generation: Annotated[
        int | None, typer.Option("--generation", help="One of the last two; default: newest.")
    ] = None,
    set_: SetOption = None,
    out: OutOption = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    address: AddressOption = None,
) -> None:
    """Start a new run from another run's state, with changed settings."""
    overrides = _overrides(set_, **_compute(workers, engine, address))
    folder = out if out is not None else api.default_folder(api.fork_config(parent, overrides))
    _session(folder, partial(api.fork, parent, overrides, generation=generation, out=folder))


@app.command()
def status(
    folder: RunArgument,
    follow: Annotated[bool, typer.Option("--follow", help="Keep watching until the driver ends.")] = False,
) -> None:
    """Show where a run stands, also while it is being written."""
    if follow:
        follow_status(console, api.open_run(folder))
    else:
        print_status(console, api.open_run(folder))


@app.command(name="digest")
def digest_(
    folder: RunArgument,
    parts: Annotated[bool, typer.Option("--parts", help="One line per part of the state.")] = False,
) -> None:
    """Print the SHA-256 over everything deterministic in a run."""
    mixed = "  mixed" if digest.is_mixed(folder) else ""
    if parts:
        for name, value in digest.digest_parts(folder).items():
            print(f"{value}  {name}")
    print(f"{digest.digest(folder)}{mixed}")


@app.command(name="list")
def list_() -> None:
    """Show tasks, algorithms and presets."""
    print_catalogue(console, TASKS)


@app.command()
def evaluate(
    folder: RunArgument,
    best: Annotated[bool, typer.Option("--best", help="The best centre; so too if nothing is named.")] = False,
    centre: Annotated[bool, typer.Option("--centre", help="The newest centre.")] = False,
    cell: Annotated[
        list[str] | None, typer.Option("--cell", metavar="I,J", help="A cell's elite; may be given several times.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Every elite of the map.")] = False,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Fresh episodes of each.")] = 100,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes; default: one per core.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Also write the rows to this CSV file.")] = None,
) -> None:
    """Run fresh episodes of what a run has found, beside what it believed of it."""
    from es_service import evaluation
    from es_service.report.evaluations import csv_file, print_evaluations

    if every and cell:
        raise ConfigError("--all has every cell already; give --all or --cell")
    found = api.open_run(folder)
    chosen = evaluation.candidates(
        found,
        best=best or not (centre or cell or every),
        centre=centre,
        cells=list(dict.fromkeys(_place(text) for text in cell or ())),
        every=every,
    )
    with csv_file(out) as rows:
        print_evaluations(console, found, evaluation.evaluate(found, chosen, episodes, workers), rows, every=every)


@app.command()
def export(
    folder: RunArgument,
    to: Annotated[str, typer.Option("--to", help="csv, parquet, npz or ribs.", show_default=False)],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write into; default: RUN/export.")] = None,
) -> None:
    """Write history, novelty archive and map as tables, or policies as arrays."""
    from es_service.export import export as write

    for file in write(api.open_run(folder), to, out if out is not None else folder / "export"):
        print(file)


@app.command()
def submit(
    config: ConfigArgument,
    address: JobsOption,
    out: Annotated[str, typer.Option("--out", help="Folder of the run on the cluster's head, or a disk it shares.")],
    set_: SetOption = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of all random numbers.")] = None,
    workers: WorkersOption = None,
) -> None:
    """Send a run to a Ray cluster as a job. The same command again goes on with it, after whatever happened."""
    overrides = _overrides(set_, seed=seed, **_compute(workers, None, "auto"))
    loaded = api.load_config(config, overrides, new=False)  # paths are those of the cluster's head, which checks them
    job = jobs.submit(loaded, address, out)
    print(job)
    _print_note(f"submitted; watch it with: es-service logs {job} --address {address} --follow")


@app.command(name="jobs")
def jobs_(address: JobsOption) -> None:
    """List the cluster's jobs, newest first: id, state, run folder."""
    for job in jobs.list_jobs(address):
        print(f"{job.id}  {job.state:<9}  {job.folder}")


@app.command()
def logs(
    job: JobArgument,
    address: JobsOption,
    follow: Annotated[bool, typer.Option("--follow", help="Keep printing until the job ends.")] = False,
) -> None:
    """Print what a job has printed."""
    for text in jobs.logs(job, address, follow=follow):
        print(text, end="", flush=True)
    if follow:
        state = jobs.state(job, address)
        _print_note(f"{job} {state.lower()}")
        raise typer.Exit(0 if state == "SUCCEEDED" else 1)


@app.command()
def stop(job: JobArgument, address: JobsOption) -> None:
    """Stop a job; what is committed stays, and submitting it again goes on from there."""
    _print_note(f"{job} {jobs.stop(job, address).lower()}")


app.add_typer(bench, name="bench")


@app.command()
def doctor() -> None:
    """Check that this machine can run, and show what results depend on."""
    from es_service.doctor import examine

    raise typer.Exit(0 if examine(console) else 1)


def main() -> None:
    """Run the command; turn errors into one readable message and an exit code. `__main__` is the way in."""
    try:
        app()
    except Interrupted:
        raise
    except (ConfigError, NotInRunError) as error:
        _print_error(str(error))
        sys.exit(2)
    except ServiceError as error:
        _print_error(str(error))
        sys.exit(1)
    except MemoryError as error:
        _print_error(f"not enough memory: {error}. A smaller policy.hidden or search.pairs needs less.")
        sys.exit(1)


def _session(folder: Path, work: Callable[..., api.Outcome]) -> None:
    """Show a run while it works, and at its end what came of it."""
    began = False

    def show_and_note(show: Callable[[Row], None], row: Row) -> None:
        nonlocal began
        began = True  # whatever has become of the folder's name since
        show(row)

    try:
        with show_progress(console, errors, str(folder)) as (show, note):
            outcome = work(on_generation=partial(show_and_note, show), on_notice=note)
    except Interrupted:
        if began or (folder / DATABASE).exists():
            _print_note(f"interrupted; every finished generation is saved. Go on with: es-service resume {folder}")
        else:
            _print_note("interrupted before the run began; nothing was written")
        raise
    except EvaluationError:
        _print_note(f"every finished generation is saved. Once the cause is gone: es-service resume {folder}")
        raise
    print_summary(console, outcome.run, outcome.reason)


def _compute(workers: int | None, engine: str | None, address: str | None) -> dict[str, object]:
    """The options that say where a run runs, by config key. A cluster to join is a Ray cluster."""
    if address is not None and engine is None:
        engine = "ray"
    chosen: dict[str, object] = {"compute.workers": workers, "compute.engine": engine, "compute.address": address}
    if engine == "inline" and address is None:  # what the file, or the run's record, says of a cluster is moot then
        chosen |= {"compute.address": "null", "compute.worker_resources.cpu": 1, "compute.worker_resources.gpu": 0}
    return chosen


def _place(text: str) -> tuple[int, ...]:
    """A cell as it is typed: 3,17."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--cell {text}: must be whole numbers with commas between them, such as 3,17") from None


def _overrides(set_: list[str] | None, **options: object) -> list[str]:
    """`--set` values, then options that stand for a key; the later ones win."""
    return [*(set_ or []), *(f"{key}={value}" for key, value in options.items() if value is not None)]


def _print_note(message: str) -> None:
    errors.print(message, highlight=False, markup=False, soft_wrap=True)


def _print_error(message: str) -> None:
    errors.print(f"error: {message}", style="red", highlight=False, markup=False, soft_wrap=True)
