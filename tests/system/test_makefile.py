"""The Makefile where something is missing or interrupted, with pip and with uv, and the hooks that do what one of its
targets does."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.system.processes import running, wait_until

MAKEFILE = Path(__file__).parents[2] / "Makefile"
DEBIANS_PYTHON = f"""#!/bin/sh
if [ "$1 $2" != "-m venv" ]; then exec {sys.executable} "$@"; fi
mkdir -p .venv/bin
ln -s {sys.executable} .venv/bin/python
echo "The virtual environment was not created successfully because ensurepip is not available."
exit 1
"""
"""As it is without the package python3-venv."""
BACKEND = """
import pathlib, time, zipfile

def build_editable(folder, settings=None, metadata=None):
    while pathlib.Path("wait").exists():
        time.sleep(0.05)
    files = {
        "METADATA": "Metadata-Version: 2.1\\nName: es-service\\nVersion: 1.0\\nProvides-Extra: dev\\n",
        "WHEEL": "Wheel-Version: 1.0\\nGenerator: test\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n",
        "entry_points.txt": "[console_scripts]\\nes-service = small:main\\n",
    }
    with zipfile.ZipFile(pathlib.Path(folder, "es_service-1.0-py3-none-any.whl"), "w") as wheel:
        wheel.writestr("small.py", "import sys\\ndef main():\\n    print('it runs', *sys.argv[1:])\\n")
        for name, text in files.items():
            wheel.writestr(f"es_service-1.0.dist-info/{name}", text)
        wheel.writestr("es_service-1.0.dist-info/RECORD", "")
    return "es_service-1.0-py3-none-any.whl"
"""
"""Builds a package without dependencies, and waits as long as a file `wait` is there."""
PYPROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[project]
name = "es-service"
version = "1.0"
optional-dependencies = { dev = [] }
"""


@pytest.fixture
def project(tmp_path):
    """The Makefile with a small package in place of ours."""
    shutil.copy(MAKEFILE, tmp_path)
    (tmp_path / "pyproject.toml").write_text(PYPROJECT)
    (tmp_path / "constraints.txt").touch()
    (tmp_path / "backend.py").write_text(BACKEND)
    return tmp_path


@pytest.fixture(scope="module")
def uv(tmp_path_factory):
    """uv itself, from the package index unless it is installed."""
    if found := shutil.which("uv"):
        return found
    folder = tmp_path_factory.mktemp("uv")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    done = subprocess.run([*pip, "--target", folder, "uv"], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"uv cannot be installed: {done.stderr.strip().splitlines()[-1]}")
    return str(folder / "bin" / "uv")


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = ["make", f"PYTHON={sys.executable}", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)


def test_half_a_virtual_environment_is_not_taken_for_a_whole_one(project):
    python = project / "python"
    python.write_text(DEBIANS_PYTHON)
    python.chmod(0o755)
    for _ in range(2):  # the second time must say the same, and not stumble over what the first one left
        result = make(project, "UV=", f"PYTHON={python}", "run")
        assert result.returncode != 0
        assert "ensurepip is not available" in result.stdout
        assert "install python3-venv" in result.stdout
        assert "then again: make run" in result.stdout
        assert not (project / ".venv").exists()


@pytest.mark.parametrize("installer", [pytest.param("pip", marks=pytest.mark.long), "uv"])
def test_a_command_says_what_it_installs_and_how_long_it_takes_and_an_interruption_leaves_nothing_half(
    project, installer, request, monkeypatch
):
    path = request.getfixturevalue("uv") if installer == "uv" else ""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    first = make(project, f"UV={path}", "run")
    assert first.returncode == 0, first.stderr
    assert re.search(rf"installing \d+ packages, about \d+ MB with {installer}, as constraints\.txt pins", first.stdout)
    assert re.search(r"^installed in \d+ s$", first.stdout, re.MULTILINE)
    config = re.search(r"^CONFIG \?= (\S+)$", MAKEFILE.read_text(), re.MULTILINE)
    assert config is not None
    assert f"it runs run {config[1]}\n" in first.stdout
    assert list(project.glob(".venv/lib/*/site-packages/__pycache__/small.*.pyc")), "bytecode is kept"
    assert re.search(r"^make run: installing \d+ s, running \d+ s$", first.stdout, re.MULTILINE)
    again = make(project, f"UV={path}", "run")
    assert "packages" not in again.stdout
    assert "it runs" in again.stdout

    for name in ("wait", ".venv/half"):
        (project / name).touch()
    command = ["make", f"PYTHON={sys.executable}", f"UV={path}", ".venv/installed-dev"]
    with running(*command, cwd=project, start_new_session=True, stdout=subprocess.DEVNULL) as process:
        wait_until(process, (project / ".venv" / "installing").exists)
        os.killpg(process.pid, signal.SIGKILL)
    (project / "wait").unlink()
    whole = make(project, f"UV={path}", "run")
    assert "it runs" in whole.stdout, whole.stderr
    assert not (project / ".venv" / "half").exists()
    pip = subprocess.run([project / ".venv/bin/python", "-m", "pip", "--version"], capture_output=True, check=False)
    assert pip.returncode == 0  # a test of ours uses it


def test_a_failed_installation_says_what_to_try_and_keeps_what_was_there(project, uv):
    assert make(project, f"UV={uv}", "run").returncode == 0
    (project / "constraints.txt").write_text("no requirement\n")
    for path, way_out in (("", "then again: make run"), (uv, "to install with pip instead: make UV= run")):
        failed = make(project, f"UV={path}", "run")
        assert failed.returncode != 0
        assert way_out in failed.stdout
        assert (project / ".venv" / "installed").exists()


def test_the_size_of_the_download_is_that_of_the_packages_that_constraints_txt_pins():
    """At least their numbers, which change with the dependencies."""
    text = MAKEFILE.read_text()
    run, test = (
        int(re.search(rf"^{name} := (\d+) packages", text, re.MULTILINE)[1]) for name in ("PACKAGES", "PACKAGES_DEV")
    )
    assert (len(needed("")), len(needed("dev"))) == (run, test)


def needed(extra: str) -> set[str]:
    """Names of the packages that are installed with an extra of ours, or with none."""
    from importlib.metadata import requires

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    seen, todo = set(), [("es-service", ""), ("es-service", extra)]
    while todo:
        one = todo.pop()
        if one not in seen:
            seen.add(one)
            for text in requires(one[0]) or ():
                found = Requirement(text)
                if found.marker is None or found.marker.evaluate({"extra": one[1]}):
                    todo += [(canonicalize_name(found.name), of) for of in ("", *found.extras)]
    return {name for name, _ in seen} - {"es-service"}


def test_commits_are_checked_by_what_make_lint_runs():
    recipe = re.search(r"^lint:.*\n((?:\t.*\n)+)", MAKEFILE.read_text(), re.MULTILINE)
    assert recipe is not None
    commands = [line.strip().replace("$(BIN)", ".venv/bin") for line in recipe[1].splitlines()]
    (local,) = yaml.safe_load((MAKEFILE.parent / ".pre-commit-config.yaml").read_text())["repos"]
    assert local["repo"] == "local"
    assert [hook["entry"] for hook in local["hooks"]] == commands
    assert {hook["language"] for hook in local["hooks"]} == {"system"}
