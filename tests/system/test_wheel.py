"""The wheel is the whole product: it works without a clone and without make, if its dependencies are there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import urllib.request
import zipfile
from pathlib import Path

import pytest

from tests.system.processes import running

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.long


def listed(*folders: str) -> list[str]:
    """Files that git knows."""
    command = ["git", "ls-files", "-z", *folders]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in out.split("\0") if (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Folder with the sdist of this clone, and the wheel that is made from that sdist alone."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("built")
    for name in listed():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes((ROOT / name).read_bytes())
    subprocess.run([sys.executable, "-m", "build", "--outdir", out, source], check=True)
    return out


@pytest.fixture(scope="module")
def environment(built, tmp_path_factory) -> Path:
    """A virtual environment with the wheel. It finds the packages of this one, but not this clone."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    [packages] = folder.glob("lib/python*/site-packages")
    packages.joinpath("others.pth").write_text(f"{Path(pytest.__file__).parents[1]}\n")
    pip = [sys.executable, "-m", "pip", "--python", folder / "bin/python"]
    subprocess.run([*pip, "install", "--no-deps", "--ignore-installed", *built.glob("*.whl")], check=True)
    return folder


@pytest.fixture(scope="module")
def variables(environment) -> dict[str, str]:
    """Environment variables of whoever has activated it."""
    cleaned = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return cleaned | {"PATH": f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}"}


@pytest.fixture
def command(environment, variables, tmp_path):
    """Run a command outside of any clone; returns what it prints."""

    def run(program: str, *words: str) -> str:
        given = {"cwd": tmp_path, "env": variables, "capture_output": True, "text": True, "timeout": 300}
        done = subprocess.run([environment / "bin" / program, *words], check=False, **given)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_a_wheel_runs_resumes_reports_watches_and_helps(command, environment, variables, tmp_path):
    where = "import es_service, workers; print(es_service.__file__, workers.__file__)"
    assert command("python", "-c", where).count(str(environment)) == 2
    command("es-service", "run", "point_maze_memes", "--out", "runs/first", "--set", "budget.generations=3")
    command("es-service", "resume", "runs/first", "--set", "budget.generations=5")
    [status] = json.loads(command("es-service", "status", "runs/first", "--json"))
    assert status["newest"]["generation"] == 5
    command("es-service", "report", "runs/first")
    assert (tmp_path / "runs/first/report.html").stat().st_size > 100_000
    assert command("es-service", "help") != command("es-service", "help", "certify")
    watch = environment / "bin/es-service", "watch", "runs", "--port", 0
    with running(*watch, cwd=tmp_path, env=variables) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        for asset in ("page.css", "live.js", "three.bundle.js"):
            with urllib.request.urlopen(f"{address}assets/{asset}", timeout=60) as answer:
                assert len(answer.read()) > 1000


def test_a_wheel_has_every_file_of_the_packages_and_the_sdist_no_tests(built):
    [wheel], [sdist] = built.glob("*.whl"), built.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        has = set(archive.namelist())
    assert set(listed("es_service", "workers")) <= has
    others = {
        f"es_service/shipped_configs/{Path(name).name}" for name in listed("configs/*.yaml") if name.count("/") == 1
    }
    others |= {f"es_service/launch_files/{Path(name).name}" for name in listed("docker")}
    assert others <= has
    with tarfile.open(sdist) as archive:
        assert not [name for name in archive.getnames() if "/tests/" in name]
