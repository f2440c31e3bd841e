"""The Makefile on a machine that lacks something, and the hooks that do what one of its targets does."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import yaml

MAKEFILE = Path(__file__).parents[2] / "Makefile"
DEBIANS_PYTHON = f"""#!/bin/sh
if [ "$1 $2" != "-m venv" ]; then exec {sys.executable} "$@"; fi
mkdir -p .venv/bin
ln -s {sys.executable} .venv/bin/python
echo "The virtual environment was not created successfully because ensurepip is not available."
exit 1
"""
"""As it is without the package python3-venv."""


def test_half_a_virtual_environment_is_not_taken_for_a_whole_one(tmp_path):
    shutil.copy(MAKEFILE, tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    python = tmp_path / "python"
    python.write_text(DEBIANS_PYTHON)
    python.chmod(0o755)
    for _ in range(2):  # the second time must say the same, and not stumble over what the first one left
        result = subprocess.run(
            ["make", f"PYTHON={python}", "run"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
        )
        assert result.returncode != 0
        assert "ensurepip is not available" in result.stdout
        assert "install python3-venv" in result.stdout
        assert "then again: make run" in result.stdout
        assert not (tmp_path / ".venv").exists()


def test_commits_are_checked_by_what_make_lint_runs():
    recipe = re.search(r"^lint:.*\n((?:\t.*\n)+)", MAKEFILE.read_text(), re.MULTILINE)
    assert recipe is not None
    commands = [line.strip().replace("$(BIN)", ".venv/bin") for line in recipe[1].splitlines()]
    (local,) = yaml.safe_load((MAKEFILE.parent / ".pre-commit-config.yaml").read_text())["repos"]
    assert local["repo"] == "local"
    assert [hook["entry"] for hook in local["hooks"]] == commands
    assert {hook["language"] for hook in local["hooks"]} == {"system"}
