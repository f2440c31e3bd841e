"""A virtual environment with reinforcement learners of others beside this project, since they bring PyTorch.

    python -m tests.learners.environment               # once: below runs/learners; about 1.5 GB

It is also that of the learners in tests/benchmarks.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "runs" / "learners"
PINS = {
    "sbx-rl": "0.28.0",
    "stable-baselines3": "2.9.2",
    "torch": "2.13.0",
    "torchrl": "0.14.1",
    "evotorch": "0.6.1",
}
"""Packages of learners and their versions. Others are those of constraints.txt, or what pip takes."""
FOR_TESTS = ("hypothesis", "pytest", "pytest-timeout")


def python_of(folder: Path = FOLDER) -> Path:
    """The Python of the environment."""
    return folder / "bin" / "python"


def versions() -> dict[str, str]:
    """Versions of the packages of learners that this Python has."""
    found = {}
    for name in PINS:
        try:
            found[name] = metadata.version(name).partition("+")[0]  # PyTorch for CPUs has +cpu
        except metadata.PackageNotFoundError:
            continue
    return found


def problem(folder: Path = FOLDER) -> str:
    """Why the environment cannot be used; empty if it can."""
    if not python_of(folder).exists():
        return "it does not exist"
    code = "import json; from tests.learners.environment import versions; print(json.dumps(versions()))"
    done = subprocess.run([python_of(folder), "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    found = json.loads(done.stdout)
    return ", ".join(
        f"{name} {found.get(name, 'is missing')}, not {pin}" for name, pin in PINS.items() if found.get(name) != pin
    )


def build(folder: Path = FOLDER) -> Path:
    """Make the environment if it is not there or cannot be used; returns its Python.

    Raises:
        RuntimeError: it cannot be used after it was made.
    """
    if problem(folder):
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        pins = [f"{name}=={pin}" for name, pin in PINS.items()]
        pip = [python_of(folder), "-m", "pip", "install", "-qq", "-c", "constraints.txt", "-e", ".[gymnasium]"]
        subprocess.run([*pip, *pins, *FOR_TESTS], cwd=ROOT, check=True)
        if still := problem(folder):
            raise RuntimeError(f"{folder} is not the environment of the learners: {still}")
    return python_of(folder)


if __name__ == "__main__":
    print(f"{build()} is ready")
