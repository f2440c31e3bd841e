"""Runs and sweeps as jobs of a Ray cluster: what a job takes there, and how it is submitted, listed, read and stopped.

A job is `es-service run ... --or-resume` or `es-service sweep ...` on the cluster's head, in a working directory that
holds just the config and the user's modules that it names; es-service itself is installed there. Its folder is on every
node, and Python finds modules there before all others, so the driver and the workers compute with the files that were
sent. They are the files whose hashes are recorded with a run, and no others: packages that are installed here must be
installed there, and data files that a module reads must be there, but for MuJoCo's models. The run's folder is a path
on the head or on a disk that it shares. Ray's list of jobs ends with the cluster, but the run does not: the same
submission to another cluster resumes it."""

from __future__ import annotations

import asyncio
import logging
import posixpath
import shlex
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

from es_service.config.given import config_file
from es_service.config.model import RunConfig
from es_service.errors import ConfigError, EvaluationError, ServiceError, StoreError, WayOut
from es_service.protocol.machine import PACKAGES
from es_service.protocol.sources import modules_of, user_path
from es_service.runs.sweep_plan import PlannedRun

FOLDER = "es_service_run"
"""Key of a job's metadata: the folder of the run or of the sweep."""
ENDED = ("SUCCEEDED", "FAILED", "STOPPED")
STOP_S = 15.0
"""Longest wait for a stopped job to end; Ray kills it after three seconds."""


@dataclass(frozen=True)
class Job:
    """A job on a cluster that runs es-service."""

    id: str
    state: str
    """Ray's status: PENDING, RUNNING, SUCCEEDED, FAILED or STOPPED."""
    folder: str
    started_ms: int


def submit(package: JobPackage, address: str) -> str:
    """Submit a job to the cluster whose dashboard is at `address`, and return its id.

    Raises:
        StoreError: a job of this cluster that has not ended writes to the same folder.
        EvaluationError: the cluster does not answer, or refuses the job.
    """
    client = _client(address)
    for job in _jobs(client, address):
        if job.state not in ENDED and posixpath.normpath(job.folder) == posixpath.normpath(package.out):
            raise StoreError(
                f"the job {job.id}, which is {job.state}, has the folder {package.out}, too; choose another folder, or "
                "stop that job first",
                run=package.out,
            )
    with tempfile.TemporaryDirectory() as folder:
        write_package(package, Path(folder))
        with _explained(address):
            return client.submit_job(
                entrypoint=shlex.join(["es-service", *package.command]),
                submission_id=f"es-{uuid4().hex[:8]}",
                runtime_env={"working_dir": folder},
                metadata={FOLDER: package.out},
            )


def list_jobs(address: str) -> list[Job]:
    """The es-service jobs on a cluster, newest first. Raises EvaluationError as `submit`."""
    return _jobs(_client(address), address)


def _jobs(client: Any, address: str) -> list[Job]:
    with _explained(address):
        all_jobs = client.list_jobs()
    ours = [
        Job(job.submission_id, str(job.status.value), job.metadata[FOLDER], job.start_time or 0)
        for job in all_jobs
        if job.submission_id and FOLDER in (job.metadata or {})
    ]
    return sorted(ours, key=lambda job: job.started_ms, reverse=True)


def state(job: str, address: str) -> str:
    """Ray's status of a job. Raises EvaluationError as `submit`, or if there is no such job."""
    return _state(_client(address), job, address)


def _state(client: Any, job: str, address: str) -> str:
    with _explained(address, job):
        return str(client.get_job_status(job).value)


def logs(job: str, address: str, *, follow: bool = False) -> Iterator[str]:
    """The output of a job, in pieces; with `follow`, until the job ends. Raises EvaluationError as `state`."""
    client = _client(address)
    with _explained(address, job):
        if not follow:
            yield client.get_job_logs(job)
            return
        client.get_job_status(job)  # raises if there is no such job; following would wait for it
        pieces = client.tail_job_logs(job)

        async def next_piece() -> str | None:
            return await anext(pieces, None)

        with asyncio.Runner() as runner:  # Ray follows a log asynchronously only
            while (piece := runner.run(next_piece())) is not None:
                yield piece


def stop(job: str, address: str) -> str:
    """Stop a job, wait for its end and return its status. Raises EvaluationError as `state`, or if it does not end."""
    client = _client(address)
    with _explained(address, job):
        client.stop_job(job)
    until = time.monotonic() + STOP_S
    while (now := _state(client, job, address)) not in ENDED:
        if time.monotonic() > until:
            raise EvaluationError(f"{job} is still {now} {STOP_S:g} s after it was told to stop; see its logs")
        time.sleep(0.2)
    return now


def _client(address: str) -> Any:
    if not address.startswith(("http://", "https://")):
        url = f"http://{_host(address)}:8265"
        raise ConfigError(
            f"the address {address} must be the URL of the cluster's dashboard, such as {url}",
            field="address",
            value=address,
            allowed="a URL",
            suggestion=url,
        )
    try:
        import aiohttp  # noqa: F401  needed by Ray's client, installed by the extra
        from ray.job_submission import JobSubmissionClient
    except ImportError as error:
        raise EvaluationError(
            f"jobs need the extra `cluster` ({error})",
            ways_out=[
                WayOut("install", "install it", extra="cluster"),
                WayOut("run", "run on the cluster without a job", settings={"compute.address": "HOST:PORT"}),
            ],
        ) from error
    for name in ("job.sdk", "dashboard_sdk"):
        logging.getLogger(f"ray.dashboard.modules.{name}").setLevel(logging.WARNING)  # else they log every request
    logging.getLogger("ray._private.runtime_env.packaging").setLevel(logging.WARNING)
    with _explained(address):
        return JobSubmissionClient(address)


def _host(address: str) -> str:
    """The host of a wrong address, in the form that a URL needs; 127.0.0.1 if it names none."""
    try:
        host = urlsplit(address if "://" in address else f"//{address}").hostname
    except ValueError:  # an unclosed bracket
        host = None
    if host is None or host == "auto":
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


@contextmanager
def _explained(address: str, job: str | None = None) -> Iterator[None]:
    """Turn whatever Ray's client raises into one readable EvaluationError."""
    try:
        yield
    except ServiceError:
        raise
    except Exception as error:  # RuntimeError and ConnectionError, mostly
        text = str(error).strip()
        if job is not None and "does not exist" in text:
            raise EvaluationError(f"there is no job {job} on {address}", field="job", value=job) from error
        first = text.partition("\n")[0]
        raise EvaluationError(
            f"the Ray job request to {address} failed: {first}. Check the address, that its dashboard runs there, and "
            "that RAY_AUTH_TOKEN is the token of the cluster (with RAY_AUTH_MODE=token)"
        ) from error


CONFIG = "config.yaml"
"""Name of the config in a job's folder."""


@dataclass(frozen=True)
class JobPackage:
    """A job before it is sent."""

    command: tuple[str, ...]
    """Words after `es-service`."""
    out: str
    """Folder of the run or of the sweep, as the cluster's head sees it."""
    config: str
    files: Mapping[str, Path]
    """Place in the job's folder -> source file of a user's module, in alphabetical order."""
    expected: tuple[str, ...]
    """Packages that these files or the config name, and that the cluster must have, since they are not sent."""


def run_package(config: RunConfig, out: str) -> JobPackage:
    """A job that starts a run, or resumes it if its folder holds it already.

    Args:
        config: must have engine ray and the address "auto", the cluster in which the job runs.
        out: if this folder holds another run, the job fails and says what differs.

    Raises:
        ConfigError: `out` is relative.
    """
    return _package(["run", CONFIG, "--or-resume"], out, config.resolved_yaml(), [config])


def sweep_package(source: Path, planned: Sequence[PlannedRun], options: Sequence[str], out: str) -> JobPackage:
    """A job that starts a sweep, or continues it.

    Args:
        source: the config file, or the name of a shipped config.
        planned: the runs of the sweep.
        options: those of `es-service sweep` from which the runs were planned.

    Raises:
        ConfigError: `out` is relative.
    """
    text = config_file(source).read_text(encoding="utf-8")
    return _package(["sweep", CONFIG, *options], out, text, [run.config for run in planned])


def write_package(package: JobPackage, folder: Path) -> None:
    """Write the config and the modules into an empty folder, where the modules can be imported."""
    (folder / CONFIG).write_text(package.config, encoding="utf-8")
    for name, file in package.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folder / name)


def _package(command: Sequence[str], out: str, text: str, configs: Sequence[RunConfig]) -> JobPackage:
    if not out.startswith("/"):
        raise ConfigError(
            f"the run folder {out} must be an absolute path, such as /runs/{out}: Ray deletes a job's own directory",
            field="out",
            value=out,
            allowed="an absolute path",
            suggestion=f"/runs/{out}",
        )
    files: dict[str, Path] = {}
    expected: set[str] = set()
    named = {path for config in configs for path in (*config.task.code, config.search.algorithm)}
    for path in filter(None, map(user_path, named)):
        modules = modules_of(path)
        if modules.is_installed:
            expected.add(path.partition(":")[0].partition(".")[0])
        else:
            files |= {module.source: module.file for module in modules.user.values()} | dict(modules.models)
            expected |= modules.others
    return JobPackage(
        (*command, "--out", out), out, text, dict(sorted(files.items())), tuple(sorted(expected - set(PACKAGES)))
    )
