"""Kernels of these tests are compiled afresh for each test; where the processor has no vectors none can be."""

from __future__ import annotations

from pathlib import Path

import pytest

from workers.simd.backend.target import NoVectorsError, host_target


@pytest.fixture(autouse=True)
def kernel_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, set as the user's."""
    try:
        host_target()
    except NoVectorsError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder / "es-service" / "kernels"
