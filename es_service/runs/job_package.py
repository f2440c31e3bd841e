"""What a job takes to a cluster: its command, its config, and the user's modules that the config names.

A job's folder is on every node, and Python finds modules there before all others, so the driver and the workers compute
with the files that were sent. They are the files whose hashes are recorded with a run, and no others: packages that are
installed here must be installed there, and data files that a module reads must be there, but for MuJoCo's models.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from es_service.config.given import config_file
from es_service.config.model import RunConfig
from es_service.errors import ConfigError
from es_service.protocol.machine import PACKAGES
from es_service.protocol.sources import modules_of, user_path
from es_service.runs.sweep_plan import PlannedRun

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
    """Text of the config file."""
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
