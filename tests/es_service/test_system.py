"""What the operating system says: in the way of Linux, and where the names that only Linux has are missing."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from es_service.protocol import machine
from es_service.store.folder import is_network_filesystem

ROOT = Path(__file__).parents[2]
MISSING = ROOT / "tests" / "without_linux"
PARENT = """
import subprocess, sys, time
from es_service.protocol import child
process = subprocess.Popen(child.bound("tests.es_service.test_system"))
print(process.pid, flush=True)
time.sleep(60)
"""
if __name__ == "__main__":
    time.sleep(60)  # the child of PARENT


def without_linux(*command: str, **options) -> subprocess.Popen:
    """A process of Python in which the names are missing, as in all that it starts."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(MISSING), str(ROOT)])}
    return subprocess.Popen([sys.executable, *command], env=environment, cwd=ROOT, text=True, **options)


SAME = """
import os, time
from es_service.protocol import machine
from es_service.store.folder import is_network_filesystem
print(machine.usable_cpus(), *machine.memory_bytes(), machine.process_start_s(), is_network_filesystem(os.getcwd()))
"""


def test_every_question_has_an_answer_without_what_only_linux_has() -> None:
    before = time.time()
    asked = without_linux("-c", SAME, stdout=subprocess.PIPE)
    cpus, memory, is_free, start, is_network = asked.communicate()[0].split()
    assert int(cpus) == os.cpu_count()
    assert int(memory) == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert (is_free, is_network) == ("False", "False")
    assert before - 3 < float(start) <= time.time() or float(start) == 0.0  # without `ps`


def test_a_process_starts_when_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    exactly = machine.process_start_s()
    assert exactly <= time.time()

    def no_file(path: Path) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", no_file)
    ages = {"05": 5, "01:02\n": 62, " 03:00:01": 10801, "2-00:00:00": 172800}
    for said, age in ages.items():
        monkeypatch.setattr(machine, "_said", lambda *command, said=said: said)
        assert machine.process_start_s() == pytest.approx(time.time() - age - 1, abs=1)
    monkeypatch.setattr(machine, "_said", lambda *command: "")
    assert machine.process_start_s() == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("killed", [True, False], ids=["parent killed", "parent ended"])
def test_a_child_ends_with_its_parent_where_the_kernel_does_not_see_to_it(killed: bool) -> None:
    parent = without_linux("-c", PARENT, stdout=subprocess.PIPE)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    time.sleep(1.0)
    assert os.path.exists(f"/proc/{child}")
    parent.kill() if killed else parent.terminate()
    parent.wait()
    deadline = time.monotonic() + 20
    while is_running(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_running(child)
    parent.stdout.close()


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


MACOS = """\
/dev/disk3s1s1 on / (apfs, sealed, local, read-only, journaled)
/dev/disk3s5 on /System/Volumes/Data (apfs, local, journaled, nobrowse)
map auto_home on /System/Volumes/Data/home (autofs, automounted, nobrowse)
//me@nas.local/runs on /Volumes/my runs (smbfs, nodev, nosuid, mounted by me)
nas:/export on /Volumes/nfs (nfs)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux says it of a process alone")
def test_the_memory_of_a_process_is_not_that_of_the_one_that_started_it() -> None:
    large = bytearray(os.urandom(1 << 20) * 300)
    code = "from es_service.protocol.machine import peak_memory_mib; print(peak_memory_mib())"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert 5 < int(printed) < len(large) >> 20 <= machine.peak_memory_mib()


def test_mounts_of_macos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("es_service.store.folder.mounts", lambda: machine.mounts_of_macos(MACOS))
    assert [kind for _, kind in machine.mounts_of_macos(MACOS)] == ["apfs", "apfs", "autofs", "smbfs", "nfs"]
    for folder, is_network in {"/Volumes/my runs/a": True, "/Volumes/nfs": True, "/Users/me": False}.items():
        assert is_network_filesystem(Path(folder)) is is_network


@pytest.mark.parametrize(
    ("fields", "machine_name", "kind"),
    [
        ({"vendor_id": "A", "cpu family": "26", "model": "2", "flags": "sse2 avx2"}, "x86_64", "A 26/2 avx2"),
        ({"CPU implementer": "0x41", "CPU part": "0xd0c"}, "aarch64", "0x41/0xd0c aarch64"),
        ({"brand": "Apple M1"}, "arm64", "Apple M1 aarch64"),
        ({}, "arm64", "aarch64"),
        ({}, "riscv64", "riscv64"),
    ],
)
def test_kinds_of_processors(fields, machine_name, kind, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "processor_fields", lambda: fields)
    monkeypatch.setattr("platform.machine", lambda: machine_name)
    assert machine.cpu_kind() == kind


@pytest.mark.parametrize(
    "files",
    [
        pytest.param(("es_service/test_run_lock", "es_service/test_user_code"), marks=pytest.mark.slow),
        pytest.param(
            (
                *(f"es_service/test_{name}" for name in ("store_upkeep", "novelty", "platforms", "inline_engine")),
                "workers/test_xla_cache",
            ),
            marks=pytest.mark.long,
        ),
    ],
    ids=["few", "all"],
)
def test_unit_tests_pass_without_what_only_linux_has(files: tuple[str, ...], tmp_path: Path) -> None:
    """Those of the modules that ask the system: locks, file systems, user code, novelty's threads, workers' memory."""
    paths = [f"tests/{file}.py" for file in files]
    options = ["-q", "-p", "no:cacheprovider", "-m", "not long and not image", f"--basetemp={tmp_path / 'tests'}"]
    asked = without_linux("-m", "pytest", *options, *paths, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    said = asked.communicate()[0]
    assert asked.returncode == 0, said
