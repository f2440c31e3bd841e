"""Settings every test shares. Must run before anything imports jax: rollouts are compared at one XLA thread."""

import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile(
    "repeatable", derandomize=True, deadline=None
)  # --hypothesis-profile=default looks at new examples
settings.load_profile("repeatable")
os.environ["PJRT_NPROC"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # as in an activated environment


def pytest_configure(config: pytest.Config) -> None:
    """Compiled code is shared by all processes of a test run, and kept for the next one: `--cache-clear` removes it.

    XLA's code depends on the number of threads, which its key does not contain: a process with another PJRT_NPROC must
    not have this JAX_COMPILATION_CACHE_DIR.
    """
    assert "jax" not in sys.modules, "a conftest.py of a folder imports JAX before it has these settings"
    kept = getattr(config, "cache", None)  # there is none with `-p no:cacheprovider`
    folder = Path(kept.mkdir("compiled")) if kept else Path(tempfile.gettempdir(), f"es-service-tests-{os.geteuid()}")
    folder.mkdir(exist_ok=True)
    folder.chmod(0o700)  # or it would not be used
    os.environ["XDG_CACHE_HOME"] = str(folder)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "tests-xla")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    if hasattr(config.option, "loadscopereorder"):  # pytest-xdist keeps the order of files, see below
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files come in the order of how many slow tests they have, so that no process of pytest-xdist begins one of those
    when the others have ended. The first one compiles what others then find in the cache."""
    if hasattr(config, "workerinput"):
        slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
        items.sort(key=lambda item: (item.path.name != "test_ant.py", -slow[item.path]))


@pytest.fixture(scope="session", autouse=True)
def notices_fail() -> Iterator[None]:
    """A notice that a test does not expect is an error, as a warning is. By default, it would only be printed."""

    def fail(line: str, **where: object) -> None:
        raise AssertionError(f"a notice that the test does not expect: {line}")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("es_service.runs.session.print", fail, raising=False)
        yield


@pytest.fixture
def noticed(monkeypatch) -> list[str]:
    """The lines of notices that a test expects where it gives no `on_notice`."""
    lines: list[str] = []
    monkeypatch.setattr("es_service.runs.session.print", lambda line, **where: lines.append(line), raising=False)
    return lines


@pytest.fixture(scope="session")
def compiled() -> Path:
    """Folder of what all processes of the tests have compiled."""
    return Path(os.environ["XDG_CACHE_HOME"])


@pytest.fixture(scope="module")
def workers_here() -> Iterator[None]:
    """Runs, evaluations, verifications and replays start no process; for tests of what is done with a run."""
    from tests.helpers import workers_in_this_process  # imports JAX

    with workers_in_this_process():
        yield


@pytest.fixture
def one_process() -> Iterator[None]:
    """As `workers_here`, for one test: those of other tests of the file start processes."""
    from tests.helpers import workers_in_this_process  # imports JAX

    with workers_in_this_process():
        yield


@pytest.fixture
def small_disk(tmp_path):
    """A file system of one megabyte of its own; remount it to make it larger."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"cannot mount a small disk: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)
