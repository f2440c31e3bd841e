"""The commands `es-service submit | jobs | logs | stop`: runs and sweeps as jobs of a Ray cluster."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from es_service import api
from es_service.cli.common import (
    ConfigArgument,
    JsonOption,
    LinesOption,
    SeedOption,
    SetOption,
    WorkersOption,
    command,
    overrides,
    print_json,
    print_json_line,
    print_note,
)
from es_service.cli.sweep import GridOption, ParallelOption, SeedsOption, grid_of, seeds_of
from es_service.config.given import parse_overrides, read_config
from es_service.errors import ConfigError
from es_service.runs import jobs
from es_service.runs.jobs import JobPackage, run_package, sweep_package
from es_service.runs.sweep_plan import plan

job_commands = typer.Typer()
of_jobs = partial(job_commands.command, rich_help_panel="Cluster jobs")
"""Decorator of these commands, which `--help` lists under "Cluster jobs"."""

JobsOption = Annotated[
    str, typer.Option("--address", help="URL of the cluster's dashboard: http://HOST:8265.", show_default=False)
]
JobArgument = Annotated[str, typer.Argument(help="Id of a job, as printed by `submit`.", show_default=False)]


@of_jobs()
def submit(
    config: ConfigArgument,
    address: JobsOption,
    out: Annotated[
        str, typer.Option("--out", help="Absolute path of the run, or of the sweep, on the cluster's head node.")
    ],
    set_: SetOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = None,
    grid: GridOption = None,
    seeds: SeedsOption = None,
    parallel: ParallelOption = None,
    as_json: LinesOption = False,
) -> None:
    """Submit a run to a Ray cluster as a job; with --grid or --seeds, a sweep. The same command again continues it,
    whatever interrupted it.

    Your own modules that the config names are sent with it.
    """
    wanted = overrides(set_, seed=seed, workers=workers, address="auto")
    if grid or seeds is not None:
        package = _sweep_package(config, out, wanted, grid or [], seeds, parallel)
    elif parallel is not None:
        raise ConfigError("--parallel is for a sweep; give --grid or --seeds, too, or leave it out")
    else:
        _require_absolute_start(config, parse_overrides(wanted)[0])
        # The cluster's head node checks its paths.
        package = run_package(api.load_config(config, wanted, new=False), out)
    job = jobs.submit(package, address)
    if as_json:
        print_json_line({"job": job, "folder": out, "sent": list(package.files), "expected": list(package.expected)})
        return
    print(job, flush=True)
    if package.files:
        print_note(f"sent with it: {', '.join(package.files)}")
    if package.expected:
        print_note(f"not sent, so the cluster must have: {', '.join(package.expected)}")
    print_note(f"submitted; watch it with: {command('logs', job, '--address', address, '--follow')}")


def _sweep_package(
    config: Path, out: str, wanted: list[str], grid: list[str], seeds: str | None, parallel: int | None
) -> JobPackage:
    """The job of a sweep, whose configs are all checked here."""
    values = grid_of(grid)
    _require_absolute_start(config, parse_overrides(wanted)[0])
    for start in values.get("search.init_from", ()):
        _require_absolute_start(config, {"search.init_from": start})
    planned = plan(config, Path(out), values, None if seeds is None else seeds_of(seeds), wanted, here=False)
    options = [f"--set={word}" for word in wanted] + [f"--grid={word}" for word in grid]
    options += [] if seeds is None else [f"--seeds={seeds}"]
    options += [] if parallel is None else [f"--parallel={parallel}"]
    return sweep_package(config, planned, options, out)


def _require_absolute_start(config: Path, wanted: Mapping[str, Any]) -> None:
    """Raise a ConfigError for a relative `search.init_from`, which would be another folder on the head node."""
    in_file = read_config(config).get("search")
    named = {"search.init_from": in_file.get("init_from")} if isinstance(in_file, dict) else {}
    start = (named | dict(wanted)).get("search.init_from")
    if isinstance(start, str) and not start.startswith("/"):
        raise ConfigError(f"search.init_from: {start} must be an absolute path on the cluster's head node")


@of_jobs(name="jobs")
def jobs_(address: JobsOption, as_json: JsonOption = False) -> None:
    """List the jobs of a cluster, newest first: id, state, folder."""
    listed = jobs.list_jobs(address)
    if as_json:
        print_json([asdict(job) for job in listed])
        return
    for job in listed:
        print(f"{job.id}  {job.state:<9}  {job.folder}")


@of_jobs()
def logs(
    job: JobArgument,
    address: JobsOption,
    follow: Annotated[bool, typer.Option("--follow", help="Keep printing until the job ends.")] = False,
) -> None:
    """Print the output of a cluster job."""
    for text in jobs.logs(job, address, follow=follow):
        print(text, end="", flush=True)
    if follow:
        state = jobs.state(job, address)
        print_note(f"{job} {state.lower()}")
        raise typer.Exit(0 if state == "SUCCEEDED" else 1)


@of_jobs()
def stop(job: JobArgument, address: JobsOption) -> None:
    """Stop a cluster job. Finished generations are kept, and the same `submit` again resumes the run."""
    print_note(f"{job} {jobs.stop(job, address).lower()}")
