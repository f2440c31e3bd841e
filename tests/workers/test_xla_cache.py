"""The cache of compiled xla rollouts: the same bits with it as without, and nobody else's code."""

from __future__ import annotations

import os

import pytest

from es_service import api
from workers.compiling import xla_cache_settings

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [64, 64]},
    "search": {"algorithm": "es", "pairs": 4, "evaluation_episodes": 2},
    "budget": {"generations": 1},
    "compute": {"engine": "inline", "workers": 1, "rollout": "xla"},
}


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "es-service" / "xla"


def entries(folder) -> dict[str, int]:
    """Compiled functions in the cache -> when their files were written, in nanoseconds."""
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("*/*-cache")}


@pytest.mark.long
def test_a_run_has_the_same_bits_with_an_empty_cache_a_full_one_a_damaged_one_and_none(folder, tmp_path, monkeypatch):
    def digest(name: str) -> str:
        return api.run(CONFIG, tmp_path / name).run.digest()

    empty = digest("empty")
    kept = entries(folder)
    assert kept
    assert digest("full") == empty
    after = entries(folder)
    assert {name: after.get(name) for name in kept} == kept, "the second run used what the first one had compiled"
    for path in folder.glob("*/*-cache"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert digest("damaged") == empty
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    assert xla_cache_settings() == {}
    assert digest("none") == empty


def test_a_folder_that_others_can_write_to_is_not_used(folder):
    place = xla_cache_settings()["JAX_COMPILATION_CACHE_DIR"]
    assert place.startswith(str(folder))
    assert os.stat(place).st_mode & 0o777 == 0o700
    os.chmod(place, 0o770)
    assert xla_cache_settings() == {}
