"""The unit tests with a newer Python and the JAX that constraints.txt has for it, and with the lowest versions."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYTHONS = ("python3.13", "python3.12")
pytestmark = [pytest.mark.long, pytest.mark.alone, pytest.mark.timeout(7200)]


def other_python() -> str:
    """A newer Python than this one; skips without one. A version manager's name for one that is not chosen does not
    start."""
    for name in PYTHONS:
        path = shutil.which(name)
        if path is None or Path(path).resolve() == Path(sys.executable).resolve():
            continue
        if subprocess.run([path, "--version"], capture_output=True, check=False).returncode == 0:
            return path
    pytest.skip(f"none of {', '.join(PYTHONS)} is installed")


def lowest() -> str:
    """Constraints: the lowest version of each dependency. Others are free, since the pinned ones need newer ones."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    low = dict(re.findall(r"^([\w.-]+)>=([\d.]+)", "\n".join(project["dependencies"]), re.MULTILINE))
    return "".join(f"{name}=={version}\n" for name, version in (low | {"jaxlib": low["jax"]}).items())


@pytest.mark.parametrize("versions", ["newest", "lowest"])
def test_the_unit_tests_pass_with_other_versions(versions, tmp_path):
    python = other_python() if versions == "newest" else sys.executable
    constraints = tmp_path / "constraints.txt"
    constraints.write_text(lowest() if versions == "lowest" else (ROOT / "constraints.txt").read_text())
    subprocess.run([python, "-m", "venv", tmp_path / "venv"], check=True)
    environment = tmp_path / "venv/bin/python"
    subprocess.run([environment, "-m", "pip", "install", "-q", "-c", constraints, "-e", f"{ROOT}[dev]"], check=True)
    quick = ["-m", "not slow and not long and not image", "-p", "no:cacheprovider", "-n", "auto", "--dist", "loadfile"]
    folders = ["tests/es_service", "tests/laws", "tests/workers"]
    cleaned = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "JAX_"))}
    done = subprocess.run([environment, "-m", "pytest", *quick, *folders], cwd=ROOT, env=cleaned, check=False)
    assert done.returncode == 0
