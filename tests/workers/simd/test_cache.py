"""The cache of compiled kernels: entries are whole or not used, and never stop anybody."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from workers.simd.backend import cache
from workers.simd.episodes.kernel import compile_kernel

X = np.linspace(-1, 1, 20, dtype=np.float32)


def kernel(folder: Path, gain: float = 2.0):
    return compile_kernel(lambda x: jnp.tanh(x) * gain, jax.ShapeDtypeStruct((), jnp.float32), folder=folder)


def test_the_second_time_is_from_the_cache_and_gives_the_same(tmp_path: Path) -> None:
    first, second, other = kernel(tmp_path), kernel(tmp_path), kernel(tmp_path, gain=3.0)
    assert [one.facts.cached for one in (first, second, other)] == [False, True, False]
    np.testing.assert_array_equal(first(X), second(X))
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("harm", ["cut", "flipped", "emptied", "another's"])
def test_a_damaged_or_foreign_entry_is_compiled_again_with_one_line(
    harm: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = kernel(tmp_path)(X)
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    if harm == "another's":
        kernel(tmp_path, gain=3.0)
        (foreign,) = (one for one in tmp_path.iterdir() if one != path)
        path.write_bytes(foreign.read_bytes())
    else:
        flipped = content[:-40] + bytes([content[-40] ^ 1]) + content[-39:]
        path.write_bytes({"cut": content[:-7], "flipped": flipped, "emptied": b""}[harm])
    again = kernel(tmp_path)
    assert not again.facts.cached
    np.testing.assert_array_equal(again(X), wanted)
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert "compiling it again" in said[0]
    assert path.read_bytes() == content, "and it is kept again"


def test_a_folder_that_cannot_be_written_is_no_hindrance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("")
    found = kernel(occupied / "kernels")
    np.testing.assert_allclose(found(X), np.tanh(X) * 2.0, rtol=1e-6)
    assert "could not save a compiled kernel" in capsys.readouterr().err


@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_a_folder_into_which_others_may_write_is_not_used_and_this_is_said_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: int
) -> None:
    """Its entries would be executed."""
    wanted = kernel(tmp_path)(X)
    entries = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    tmp_path.chmod(mode)
    for _ in range(2):
        again = kernel(tmp_path)
        assert not again.facts.cached
        np.testing.assert_array_equal(again(X), wanted)
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert f"other users may write into it (mode {mode:o})" in said[0]
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == entries, "nor is it written"
    tmp_path.chmod(0o755)
    assert kernel(tmp_path).facts.cached


def test_a_folder_of_another_user_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kernel(tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    assert not kernel(tmp_path).facts.cached
    assert f"it belongs to user {tmp_path.stat().st_uid}, not to this user" in capsys.readouterr().err


def test_the_folder_is_the_users_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "es-service" / "kernels"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache.cache_folder() == tmp_path / "home" / ".cache" / "es-service" / "kernels"


def key(number: int) -> str:
    return f"{number:064x}"


def test_a_failed_write_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    cache.save(tmp_path, key(0), b"code")
    assert list(tmp_path.iterdir()) == []
    assert ": [Errno 28]" in capsys.readouterr().err


def test_without_a_home_there_is_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert cache.cache_folder() is None
    found = compile_kernel(lambda x: x + 1.0, jax.ShapeDtypeStruct((), jnp.float32))
    assert not found.facts.cached


def test_the_entries_longest_unused_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "MOST_ENTRIES", 3)
    (tmp_path / "thesis.txt").write_text("not ours to remove")
    for number in range(5):
        cache.save(tmp_path, key(number), b"code")
        os.utime(tmp_path / key(number), (number, number))
        assert cache.load(tmp_path, key(0)) == b"code", "used, and so kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([key(0), key(3), key(4), "thesis.txt"])


def test_writers_at_the_same_time_leave_a_whole_entry(tmp_path: Path) -> None:
    def write(number: int) -> None:
        for _ in range(50):
            cache.save(tmp_path, "key", bytes([number]) * 10_000)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        found = cache.load(tmp_path, "key")
        assert found is None or len(set(found)) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["key"]


def test_another_process_uses_it(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path\n"
        "from tests.workers.simd.test_cache import kernel\n"
        "print(kernel(Path(sys.argv[1])).facts.cached)"
    )
    kernel(tmp_path)
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
