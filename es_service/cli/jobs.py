"""The commands `es-service submit | jobs | logs | stop`: runs as jobs of a Ray cluster."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from es_service import api
from es_service.cli.commands import command
from es_service.cli.data import print_json
from es_service.cli.options import (
    ConfigArgument,
    JsonOption,
    SeedOption,
    SetOption,
    WorkersOption,
    overrides,
    print_note,
)
from es_service.config.keys import parse_overrides
from es_service.config.shipped import read_config
from es_service.errors import ConfigError
from es_service.runs import jobs

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
    out: Annotated[str, typer.Option("--out", help="Absolute path of the run on the cluster's head node.")],
    set_: SetOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = None,
) -> None:
    """Submit a run to a Ray cluster as a job. The same command again resumes the run, whatever interrupted it."""
    wanted = overrides(set_, seed=seed, workers=workers, address="auto")
    _require_absolute_start(config, wanted)
    loaded = api.load_config(config, wanted, new=False)  # the cluster's head node checks its paths
    job = jobs.submit(loaded, address, out)
    print(job)
    print_note(f"submitted; watch it with: {command('logs', job, '--address', address, '--follow')}")


def _require_absolute_start(config: Path, wanted: list[str]) -> None:
    """Raise a ConfigError for a relative `search.init_from`, which would be another folder on the head node."""
    in_file = read_config(config).get("search")
    named = {"search.init_from": in_file.get("init_from")} if isinstance(in_file, dict) else {}
    start = (named | parse_overrides(wanted)[0]).get("search.init_from")
    if isinstance(start, str) and not start.startswith("/"):
        raise ConfigError(f"search.init_from: {start} must be an absolute path on the cluster's head node")


@of_jobs(name="jobs")
def jobs_(address: JobsOption, as_json: JsonOption = False) -> None:
    """List the jobs of a cluster, newest first: id, state, run folder."""
    found = jobs.list_jobs(address)
    if as_json:
        print_json([asdict(job) for job in found])
        return
    for job in found:
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
