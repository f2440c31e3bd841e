"""Runs whose files are damaged at random: every reader and `resume` end in a right answer or in a clear error."""

from __future__ import annotations

import hashlib
import json
import math
import random
import shutil
import time
import traceback
from ast import literal_eval
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from es_service import api
from es_service.cli.main import app
from es_service.errors import ServiceError, StoreError
from es_service.report.data import RunData, read_run
from es_service.report.page import run_page
from es_service.runs.evaluation import candidates
from es_service.runs.export import SUMS, arrays, export, tables
from es_service.store import upkeep
from es_service.store.digest import checked_parts
from es_service.store.folder import COPY
from es_service.store.reader import read_platforms
from tests.es_service.mutations import damage_bytes, damage_rows, edit_text

NEWEST, COPIED = 6, 3
"""Generations of the run and of its copy."""
LONGEST_S = 10.0
"""Seconds of the processor, since others may be busy on it; a read that waits ends at the time limit of tests."""
RIGHT, PARTLY, OTHER = "right", "partly right", "another answer"
OLDER = "right but for the recent generations"
RECENT = ("weight of fitness", "centres ", "faults handled", "not known")
"""Lines of `status` about the recent generations, whose damage hides nothing else of a run."""
CERTIFIED = "certified"
"""The line about certified policies, of which the run has none."""
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 10},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 2},
    "map": {"cells": [4, 4]},
    "compute": {"engine": "inline", "workers": 1},
}


def command(*words: object) -> str:
    """What a command prints; raises ServiceError if it says that it cannot."""
    done = CliRunner().invoke(app, [*map(str, words)], env={"COLUMNS": "200"})
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    if done.exit_code:
        raise StoreError(done.output)
    return done.stdout


def exported(folder: Path) -> list[Any]:
    run = api.open_run(folder)
    return [[(name, table.to_dict("list")) for name, table in tables(run)], arrays(run)]


OF_CONFIG: dict[str, Callable[[Path], Any]] = {
    "status": lambda folder: command("status", folder),
    "status --json": lambda folder: command("status", folder, "--json"),
    "status of two": lambda folder: command("status", folder, folder),
}
"""Reads that also show what a user has written into config.yaml."""
COMMANDS = OF_CONFIG | {
    "digest": lambda folder: command("digest", folder),
    "digest --json": lambda folder: command("digest", folder, "--json"),
    "export": lambda folder: command("export", folder, "--to", "csv", "--out", folder / "csv"),
}
READS: dict[str, Callable[[Path], Any]] = {
    "digest from Python": checked_parts,
    "policies": lambda folder: candidates(api.open_run(folder), best=True, centre=True, cells=[], every=True),
    "export from Python": exported,
    "platforms": read_platforms,
    "generation": lambda folder: api.open_run(folder).generation,
}


class Example:
    """A run with an export, what its readers say about it, and what reports show after each of its generations."""

    def __init__(self, place: Path) -> None:
        self.folder, self.original = place / "run", place / "original"
        reports = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(upkeep, "LOCAL_COPY_INTERVAL_S", 0.0)
            patch.setattr(upkeep, "COPY_TIME_FRACTION", math.inf)
            for generation in range(1, NEWEST + 1):
                if generation == COPIED + 1:
                    patch.undo()
                api.run_or_resume(CONFIG | {"budget": {"generations": generation}}, self.original)
                reports.append(read_run(self.original))
        for to in ("csv", "npz", "parquet"):
            export(api.open_run(self.original), to, self.original / "export")
        self.restore()
        self.answers = {name: canonical(read(self.folder)) for name, read in (READS | COMMANDS).items()}
        self.report = read_run(self.folder)
        self.digests = {generation: report.digest for generation, report in enumerate(reports, 1)}
        self.shown = set().union(*map(shown, reports))

    def restore(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.original, self.folder)


@pytest.fixture(scope="module")
def example(tmp_path_factory, workers_here):
    return Example(tmp_path_factory.mktemp("fuzz"))


def canonical(value: Any) -> Any:
    """A value that equals another one if all numbers in both have the same bits and types."""
    if is_dataclass(value):
        return [canonical(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, dict):
        return {key: canonical(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [canonical(one) for one in value]
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    return repr(value)


def damaged(folder: Path, rng: random.Random) -> str:
    """Damage the run; returns the kind of damage, which begins with "config" if config.yaml was changed."""
    database, copy, config = (folder / name for name in ("run.db", COPY, "config.yaml"))
    kinds = {"database": 6, "rows": 5, "without a copy": 4, "both": 2, "copy": 1, "config": 5}
    (kind,) = rng.choices(tuple(kinds), tuple(kinds.values()))
    match kind:
        case "database":
            what = damage_bytes(database, rng)
        case "rows":
            what = damage_rows(database, rng)
        case "without a copy":
            copy.unlink()
            what = rng.choice((damage_bytes, damage_rows))(database, rng)
        case "both":
            what = f"{damage_bytes(database, rng)}, {damage_bytes(copy, rng)}"
        case "copy":
            what = damage_bytes(copy, rng)
        case _:
            what = rng.choice((edit_text, edit_text, damage_bytes))(config, rng)
    return f"{kind}: {what}"


def examined(example: Example, number: int) -> Iterator[str]:
    """What happened with each reader and with `resume`; begins with WRONG if it must not happen."""
    rng = random.Random(number)
    example.restore()
    what, folder = damaged(example.folder, rng), example.folder
    edited = what.startswith("config")
    name = rng.choice(tuple(COMMANDS))
    checks: dict[str, Callable[[], str]] = {
        name: lambda name=name, read=read: judged(name, canonical(read(folder)), example.answers[name])
        for name, read in {**READS, name: COMMANDS[name]}.items()
    }
    digest = rng.choice((True, False))
    checks[f"report, {digest=}"] = lambda: compared(example, folder, digest)
    checks["exports"] = lambda: exports(folder, rng)
    checks["resume"] = lambda: resumed(example, edited)
    for name, check in checks.items():
        begun = time.process_time()
        try:
            answer = check()
        except ServiceError as error:
            answer = f"refused: {type(error).__name__}"
        except Exception:
            answer = f"WRONG: {traceback.format_exc()}"
        if answer == OTHER and not (edited and name in OF_CONFIG):
            answer = "WRONG: another answer without a word"
        if (seconds := time.process_time() - begun) > LONGEST_S:
            answer = f"WRONG: it took {seconds:.0f} s"
        yield f"{answer} ({name} after mutation {number}, {what})" if answer.startswith("WRONG") else answer


def judged(name: str, answer: Any, right: Any) -> str:
    """Whether a reader's answer is that of the undamaged run; `status` may say that recent generations, or certified
    policies, are not known."""
    if answer == right:
        return RIGHT
    known = {"status": status_without_recent, "status --json": json_without_recent}.get(name)
    return OLDER if known and known(literal_eval(answer)) == (known(literal_eval(right))[0], True) else OTHER


def status_without_recent(answer: str) -> tuple[object, bool]:
    """What `status` says of all but the recent generations, and whether it says that these, or certified policies, are
    not known."""
    lines = answer.splitlines()
    unknown = any(line.startswith("not known") or line.split()[:3] == [CERTIFIED, "not", "known:"] for line in lines)
    return [line for line in lines if not line.startswith((*RECENT, CERTIFIED))], unknown


def json_without_recent(answer: str) -> tuple[object, bool]:
    """The same of `status --json`."""
    [data] = json.loads(answer)
    objectives = data.pop("objectives")
    return data, objectives["problem"] is not None and objectives["newest"] is objectives["recent"] is None


def compared(example: Example, folder: Path, digest: bool) -> str:
    """Whether a report shows what it should; of a damaged run, whether all that it shows was so at some generation."""
    found = read_run(folder, digest=digest)
    if digest and (found.problems or found.status.problem):
        run_page(found, lambda name: name)
    if found.problems:
        return PARTLY if shown(found) <= example.shown else OTHER
    same = repr(found.status.row) == repr(example.report.status.row) and shown(found) == shown(example.report)
    return RIGHT if same and found.digest in ("", example.report.digest) else OTHER


def shown(report: RunData) -> set[Any]:
    """What a report shows, except the digest and what the config says."""
    map_ = {} if report.map is None else {field.name: getattr(report.map, field.name) for field in fields(report.map)}
    map_ = {name: values for name, values in map_.items() if values is not None}
    geometry = map_.pop("geometry", None)
    single = {"best": report.best, "geometry": geometry, "description": report.meta}
    found = {(name, repr(value)) for name, value in single.items() if value is not None}
    if report.status.row:
        found.add(("history", tuple(np.float64(value).tobytes() for value in report.status.row.values())))
    found |= {("map", row) for row in rows(map_)}
    found |= {("history", row) for row in rows(report.history)} | {("centre", row) for row in rows(report.centres)}
    found |= {("path", cell, path.tobytes()) for cell, path in report.paths.items()}
    return found | {("platform", repr(platform)) for platform in report.platforms}


def rows(columns: Any) -> set[tuple[bytes, ...]]:
    return set(zip(*([value.tobytes() for value in column] for column in columns.values()), strict=True))


def exports(folder: Path, rng: random.Random) -> str:
    """Whether SHA256SUMS tells which exported file is damaged, and is right again after another export."""
    place = folder / "export"
    file = place / rng.choice(sorted(path.name for path in place.iterdir()))
    before = file.read_bytes()
    damage_bytes(file, rng)
    if file.name != SUMS:
        return RIGHT if changed(place) == ({file.name} if file.read_bytes() != before else set()) else OTHER
    export(api.open_run(folder), "csv", place)
    return RIGHT if not any(name.endswith("csv") for name in changed(place)) else OTHER


def changed(place: Path) -> set[str]:
    """Names of exported files that do not have their SHA-256."""
    sums = (line.split("  ") for line in (place / SUMS).read_text(errors="replace").splitlines())
    return {name for sha256, name in sums if hashlib.sha256((place / name).read_bytes()).hexdigest() != sha256}


def resumed(example: Example, edited: bool) -> str:
    """Whether a run ends as it would have without damage; with an edited config, it may end earlier or later."""
    notices: list[str] = []
    run = api.resume(example.folder, {"budget.generations": NEWEST}, on_notice=notices.append).run
    if (run.generation != NEWEST and not edited) or run.digest() != example.digests.get(run.generation):
        return OTHER
    return "continued with a notice" if notices else "continued"


def wrong(example: Example, numbers: range) -> tuple[list[str], Counter[str]]:
    answers = [answer for number in numbers for answer in examined(example, number)]
    return [answer for answer in answers if answer.startswith("WRONG")], Counter(answers)


@pytest.mark.slow
def test_damage_of_any_kind_gives_right_answers_or_errors(example):
    found, counts = wrong(example, range(50))
    assert not found, "\n".join(found)
    assert counts.keys() >= {"right", "partly right", "continued", "continued with a notice", "refused: StoreError"}


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("first", range(50, 10_050, 500))
def test_more_damage_gives_right_answers_or_errors(example, first):
    found, _ = wrong(example, range(first, first + 500))
    assert not found, "\n".join(found)
