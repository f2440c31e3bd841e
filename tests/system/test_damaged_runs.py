"""Commands for runs that are damaged at random; `es_service/test_store_fuzz.py` does the same with Python's readers."""

from __future__ import annotations

import random
import shutil

import pytest

from es_service import api
from tests.database import execute
from tests.es_service.mutations import damage_bytes, damage_rows
from tests.es_service.test_store_fuzz import json_without_recent, status_without_recent
from tests.system.command_line import command, digest
from tests.system.session import SMALL

READS = (
    ("status",),
    ("status", "--json"),
    ("digest",),
    ("evaluate", "--episodes", "1", "--workers", "1"),
    ("export", "--to", "npz"),
    ("report", "--replay", "none"),
)
WITHOUT_RECENT = {("status",): status_without_recent, ("status", "--json"): json_without_recent}
"""What a command says of all but recent generations and certified policies, and whether it says that these are not
known."""


def printed(folder, words):
    """What a command prints; None if it says that it cannot."""
    result = command(words[0], folder, *words[1:])
    said = result.stdout + result.stderr
    assert "Traceback" not in said, said
    if result.returncode == 0:
        return result.stdout
    assert result.returncode in (1, 2)
    assert "cannot" in said or "damaged" in said or '"problem"' in said, said
    return None


@pytest.fixture(scope="module")
def example(mapped, tmp_path_factory):
    """A run and its copy, the folder in which copies of both are damaged, and what commands print of it before."""
    place = tmp_path_factory.mktemp("damaged")
    original, folder = place / "original", place / "run"
    for copy in (original, folder):
        shutil.copytree(mapped.folder, copy)
        shutil.copyfile(copy / "run.db", copy / "run.db.copy")
    return original, folder, {words: printed(folder, words) for words in READS}


def examine(example, number):
    rng, (original, folder, expected) = random.Random(number), example
    shutil.rmtree(folder)
    shutil.copytree(original, folder)
    print(number, rng.choice((damage_bytes, damage_rows))(folder / "run.db", rng))
    for words in READS:
        found = printed(folder, words)
        if found not in (None, expected[words]):
            of = WITHOUT_RECENT[words]
            assert of(found) == (of(expected[words])[0], True), words
    if printed(folder, ("resume",)) is not None:
        assert digest(folder) == expected["digest",].strip()


@pytest.mark.slow
def test_no_command_shows_a_traceback_or_another_run(example):
    examine(example, 0)


@pytest.mark.long
@pytest.mark.parametrize("number", range(1, 40))
def test_no_command_shows_a_traceback_or_another_run_for_long(example, number):
    examine(example, number)


def test_resume_falls_back_to_a_kept_state_and_says_so(tmp_path):
    folder = tmp_path / "run"
    api.run(SMALL | {"budget": {"generations": 9}, "store": {"keep_every": 3}}, folder)
    uninterrupted = digest(folder)
    execute(folder, "UPDATE state SET payload = x'00' WHERE generation >= 8")
    result = command("resume", folder)
    assert result.returncode == 0, result.stderr
    assert "fell back to generation 6" in result.stderr
    assert digest(folder) == uninterrupted
