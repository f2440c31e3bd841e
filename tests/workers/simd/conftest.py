"""Where the processor has no vectors no kernel can be compiled; no test finds kernels of a changed compiler; and those
for Arm are run by qemu."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.workers.simd.emulated import emulation
from workers.simd.backend import cache
from workers.simd.backend.target import NoVectorsError, host_target


@pytest.fixture(autouse=True)
def kernels_of_this_compiler(
    request: pytest.FixtureRequest, compiled: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[None]:
    """A test that changes the compiler in memory has an empty cache of its own; the others share one, which keeps all
    kernels of these tests."""
    try:
        host_target()
    except NoVectorsError as error:
        pytest.skip(str(error))
    changes = "monkeypatch" in request.fixturenames
    with emulation(), pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache") if changes else compiled / "simd"))
        patch.setattr(cache, "MOST_ENTRIES", 10_000)
        yield
