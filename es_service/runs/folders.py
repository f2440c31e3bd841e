"""Which runs a folder stands for: itself, or the runs of a sweep, or those of any folder that contains runs."""

from __future__ import annotations

import re
from pathlib import Path

from es_service.runs.sweep import INSIDE
from es_service.store.folder import holds_run, runs_inside


def runs_of(folder: Path) -> list[Path]:
    """The folder itself, or the folders of the runs that it holds, also of those that a sweep has not started yet.

    They are in the order of their names, with numbers in the order of their values. Raises StoreError as `holds_run`.
    """
    if holds_run(folder):
        return [folder]
    return sorted(_inside(folder), key=lambda run: _in_order(run.name)) or [folder]


def output_of(run: Path) -> Path | None:
    """The file with what the process of a sweep's run has printed; None if there is none."""
    log = run.parent / INSIDE / f"{run.name}.log"
    return log if log.is_file() else None


def _inside(folder: Path) -> set[Path]:
    """Folders of the runs directly inside a folder, and those for which a sweep has a config."""
    return runs_inside(folder) | {folder / file.stem for file in (folder / INSIDE).glob("*.yaml")}


def _in_order(name: str) -> list[str | float]:
    """Key by which seed=2 comes before seed=10, and sigma=0.05 before sigma=0.1: texts and numbers by turns."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", name)
    return [float(part) if number % 2 else part for number, part in enumerate(parts)]
