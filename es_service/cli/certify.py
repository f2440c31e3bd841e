"""The option `--certify` of `evaluate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from es_service.cli.console import console, errors, print_line
from es_service.cli.several import is_single, of_each, readable
from es_service.cli.tables.certified import print_certified
from es_service.report.progress import print_notice
from es_service.runs.certification import certify_run


def certified_rows(
    folders: list[Path], problems: list[dict[str, str]], *, as_json: bool, **asked: Any
) -> list[dict[str, Any]]:
    """Certify the policies of each run, print them unless they are wanted as JSON, and return their rows.

    Args:
        problems: list to which runs that cannot be certified are added, if there are several.
        asked: arguments of `certify_run`.
    """
    tell = partial(print_notice, errors)

    def rows_of(folder: Path) -> list[dict[str, Any]]:
        certified = certify_run(folder, on_notice=tell, **asked)
        if not as_json:
            print_line(console, f"{folder}: certification {certified[0].number}")
            print_certified(console, certified)
        return [policy.row() for policy in certified]

    if is_single(folders):
        return rows_of(folders[0])
    each = readable(of_each(folders, rows_of), problems)
    return [{"run": str(folder), **row} for folder, rows in each for row in rows]
