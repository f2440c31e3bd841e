"""Writing of reports: which file, from which data."""

from __future__ import annotations

import os
from pathlib import Path

from es_service.errors import StoreError
from es_service.report.data import read_run
from es_service.report.page import Evaluate, run_page

REPORT = "report.html"
"""Name of a run's report in its folder."""


def python_call(folder: Path) -> Evaluate:
    """The Python call that gives a policy of a run."""

    def call(name: str) -> str:
        place = repr(name) if name in ("best", "centre") else f"({name})" if "," in name else name
        return f"open_run({str(folder)!r}).policy({place})"

    return call


def write_report(folder: Path, out: Path | None = None, evaluate: Evaluate | None = None) -> Path:
    """Write the report of one run and return its file.

    Args:
        out: file to write; None: `report.html` in the run's folder.
        evaluate: what evaluates a policy, as text; None: the Python call.

    Raises:
        StoreError: the run cannot be read, or the file cannot be written.
    """
    data = read_run(folder)
    return write_page(run_page(data, evaluate or python_call(folder)), out or folder / REPORT)


def write_page(page: str, file: Path) -> Path:
    """Write a page so that a reader never sees half of it."""
    half = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        half.write_text(page)
        half.replace(file)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise StoreError(f"cannot write {file}: {error.strerror or error}; choose another file") from error
    return file
