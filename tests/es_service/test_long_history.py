"""The memory that the history of a long run takes: eight bytes a value, and less than a gigabyte in all."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from es_service import open_run
from es_service.loop.blocks import names_of, state_of, stored
from es_service.report.data import read_run
from es_service.runs.export import tables
from es_service.search.novelty import archive_of
from es_service.store import reader
from es_service.store.create import Beginning
from es_service.store.writer import RunStore
from tests.run_examples import write_run
from tests.system.processes import ROOT

MILLION = 1_000_000
MOST_BYTES = 10**9


def long_run(folder: Path, generations: int) -> Path:
    """A run with the rows of a short one again and again, and with its last state."""
    short = write_run(folder / "short", generations=20)
    rows, centres = reader.read_history(short), reader.read_evaluations(short)
    newest, parts, _ = reader.read_parts(short)
    state = state_of(parts, newest, 0.0)
    named = names_of(parts)
    contents = reader.read_parts(short, named=lambda at, parts: named)[2]
    count = np.arange(generations)
    archive = archive_of(np.random.default_rng(0).uniform(-1, 1, (generations, 2)), count, 0 * count)
    state = replace(state, search=replace(state.search, archive=archive))

    def history() -> Iterator[dict[str, Any]]:
        for generation in range(generations):
            yield rows[generation % newest] | {"generation": generation}

    beginning = Beginning(
        history=history(),
        parts=stored(state),
        contents=contents,
        newest=generations - 1,
        evaluations=(centres[generation % newest] for generation in range(generations)),
    )
    config = (short / "config.yaml").read_text()
    RunStore.create(folder / "long", config, reader.read_meta(short), beginning).close()
    return folder / "long"


FEW, SMALL, LARGE = 10, 500, 2500


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Number of generations -> a run."""
    return {count: long_run(tmp_path_factory.mktemp("runs"), count) for count in (FEW, SMALL, LARGE)}


@pytest.mark.slow
@pytest.mark.parametrize("read", ["history", "evaluations", "export", "report"])
def test_a_generation_takes_about_eight_bytes_a_value(runs, read):
    def peak(generations: int) -> int:
        folder = runs[generations]
        tracemalloc.start()
        match read:
            case "report":
                read_run(folder, paths=False)
            case "export":
                for _ in tables(open_run(folder)):
                    pass
            case _:
                getattr(open_run(folder), read)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    peak(FEW)  # imports
    meta = reader.read_meta(runs[FEW])
    values = len(meta.columns) * (read != "evaluations") + len(meta.evaluation_columns) * (read != "history")
    assert peak(LARGE) - peak(SMALL) < 2 * 8 * values * (LARGE - SMALL)


@pytest.fixture(scope="module")
def of_a_million(tmp_path_factory):
    return long_run(tmp_path_factory.mktemp("long"), MILLION)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "work",
    [
        "assert len(run.history) == len(run.evaluations)",
        "export(run, 'csv', out)",
        "export(run, 'parquet', out)",
        "export(run, 'npz', out)",
        "write_report(run.folder, out / 'report.html', best=False)",
        "run.digest()",
    ],
)
def test_a_million_generations_stay_below_a_gigabyte(tmp_path, of_a_million, work):
    program = f"""
from pathlib import Path
from es_service import open_run, write_report
from es_service.runs.export import export
run, out = open_run({str(of_a_million)!r}), Path({str(tmp_path)!r})
{work}
print(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    kibibytes = int(done.stdout.split()[-1])
    print(f"\n{work}: {kibibytes * 1024 / 1e6:.0f} MB at most")
    assert kibibytes * 1024 < MOST_BYTES
