"""The README's commands and code, run in order as a reader would, and its tables held against the code."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from es_service.config.presets import preset_table
from es_service.config.yaml_text import show

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
MEASUREMENTS = (ROOT / "tests" / "benchmarks" / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README + MEASUREMENTS, re.MULTILINE | re.DOTALL)


def between(name: str) -> str:
    return README.split(f"<!-- {name} -->")[1].split(f"<!-- /{name} -->")[0].strip()


COMMANDS = [line for block in blocks("bash") for line in block.splitlines()]
SCRIPTS = blocks("python")
ALL_OF_THEM = pytest.mark.timeout(3600)  # the first test that needs the reader waits for every command


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """The folder in which everything was run in order, and what each command and script that failed has printed."""
    folder, failed = tmp_path_factory.mktemp("reader"), {}
    (folder / "configs").symlink_to(ROOT / "configs")
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    shell, python = ["sh", "-c"], [sys.executable, "-c"]
    for text, program in [*((line, shell) for line in COMMANDS), *((code, python) for code in SCRIPTS)]:
        limited = ["timeout", "--kill-after=10", "300", *program, text]  # ends what a command has started, too
        result = subprocess.run(limited, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if result.returncode:
            failed[text] = f"exit code {result.returncode}:\n{result.stdout}{result.stderr}"
    return folder, failed


@ALL_OF_THEM
@pytest.mark.parametrize("text", COMMANDS + SCRIPTS, ids=lambda text: text.splitlines()[0])
def test_every_command_and_every_script_works(reader, text):
    _, failed = reader
    assert text not in failed, failed[text]


def test_every_important_command_is_shown():
    assert {line.split()[1] for line in COMMANDS} >= {"run", "resume", "fork", "status", "digest", "list", "doctor"}


@ALL_OF_THEM
def test_exported_policies_replayed_by_the_readme_s_lines_return_what_the_run_says(reader, monkeypatch):
    """From the corner, so that there is no luck in an episode: but for last bits, which 200 steps add up."""
    folder, failed = reader
    (code,) = [script for script in SCRIPTS if "policies.npz" in script]
    assert code not in failed, failed[code]
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(code, names)
    assert len(names["returns"]) >= 8
    np.testing.assert_allclose(names["returns"], names["file"]["fitness"], rtol=1e-5, atol=1e-3)
    names["file"].close()


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"^make (\w+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_preset_table_is_the_code_s():
    rows = [f"| `{row.key}` | {show(row.literature)} | {show(row.uber)} |" for row in preset_table()]
    assert between("presets").splitlines()[2:] == rows


def test_files_it_names_exist():
    for text, place in ((README, ROOT), (MEASUREMENTS, ROOT / "tests" / "benchmarks")):
        for path in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
            assert (place / path).exists(), path
