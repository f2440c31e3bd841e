"""Which runs a folder stands for: itself, or the runs of a sweep, or those of any folder that contains runs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

from es_service.store.folder import holds_run, runs_inside

INSIDE = ".sweep"
"""Folder beside the runs of a sweep, with the config that each is given, what it prints, and its group."""
GROUPS = "groups.json"
"""File there: name of a run -> name of its group."""
_MOST_CHARACTERS = 200


def group_of(run: Path) -> str:
    """Name of the group to which its sweep counts a run; empty if there is none."""
    return _groups(run.parent / INSIDE).get(run.name, "")


def write_groups(inside: Path, groups: Mapping[str, str]) -> None:
    """Add the groups of runs to those that a sweep has written before. Raises OSError."""
    if known := {**_groups(inside), **{name: group for name, group in groups.items() if group}}:
        (inside / GROUPS).write_text(json.dumps(known, indent=1))


def _groups(inside: Path) -> dict[str, str]:
    try:
        found = json.loads((inside / GROUPS).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    pairs = found.items() if isinstance(found, dict) else ()
    return {name: group[:_MOST_CHARACTERS] for name, group in pairs if isinstance(group, str)}


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
