"""Virtual environments with learners of others beside this project, since what they bring does not go together.

    python -m tests.learners.environment               # once: below runs/learners, about 1.5 GB
    python -m tests.learners.environment qdax          # below runs/qdax, about 1.4 GB

They are also those of the systems in tests/benchmarks/baselines.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "runs"
"""Folder of all environments, one below it for each name."""


@dataclass(frozen=True)
class Environment:
    """Packages of learners with their versions. Others are those of constraints.txt, or what pip takes."""

    pins: dict[str, str]
    alone: tuple[str, ...] = ()
    """Those that are installed without what they ask for."""
    others: tuple[str, ...] = ()
    """What these need of it."""


ENVIRONMENTS = {
    "learners": Environment(
        {"sbx-rl": "0.28.0", "stable-baselines3": "2.9.2", "torch": "2.13.0", "torchrl": "0.14.1", "evotorch": "0.6.1"}
    ),
    # One of the requirements of evorl-jax, a tracker of experiments, cannot be built.
    "qdax": Environment(
        {"qdax": "0.5.0", "evorl-jax": "0.1.1"}, alone=("evorl-jax",), others=("hydra-core", "omegaconf")
    ),
}
FOR_TESTS = ("hypothesis", "pytest", "pytest-timeout")


def python_of(name: str = "learners", folder: Path = FOLDER) -> Path:
    """The Python of an environment."""
    return folder / name / "bin" / "python"


def versions(name: str) -> dict[str, str]:
    """Versions of the packages of an environment that this Python has."""
    found = {}
    for package in ENVIRONMENTS[name].pins:
        try:
            found[package] = metadata.version(package).partition("+")[0]  # PyTorch for CPUs has +cpu
        except metadata.PackageNotFoundError:
            continue
    return found


def problem(name: str = "learners", folder: Path = FOLDER) -> str:
    """Why an environment cannot be used; empty if it can."""
    python = python_of(name, folder)
    if not python.exists():
        return "it does not exist"
    code = f"import json; from tests.learners.environment import versions; print(json.dumps(versions({name!r})))"
    done = subprocess.run([python, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    found, pins = json.loads(done.stdout), ENVIRONMENTS[name].pins
    return ", ".join(
        f"{package} {found.get(package, 'is missing')}, not {pin}"
        for package, pin in pins.items()
        if found.get(package) != pin
    )


def build(name: str = "learners", folder: Path = FOLDER) -> Path:
    """Make an environment if it is not there or cannot be used; returns its Python.

    Raises:
        RuntimeError: it cannot be used after it was made.
    """
    if problem(name, folder):
        wanted = ENVIRONMENTS[name]
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder / name], check=True)
        pip = [python_of(name, folder), "-m", "pip", "install", "-qq", "-c", "constraints.txt"]
        pins = {package: f"{package}=={pin}" for package, pin in wanted.pins.items()}
        alone = [pins.pop(package) for package in wanted.alone]
        subprocess.run([*pip, "-e", ".[gymnasium]", *pins.values(), *wanted.others, *FOR_TESTS], cwd=ROOT, check=True)
        if alone:
            subprocess.run([*pip, "--no-deps", *alone], cwd=ROOT, check=True)
        if still := problem(name, folder):
            raise RuntimeError(f"{folder / name} is not the environment {name}: {still}")
    return python_of(name, folder)


if __name__ == "__main__":
    print(f"{build(*sys.argv[1:2])} is ready")
