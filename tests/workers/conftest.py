"""What tests of rollouts share."""

from functools import partial

import pytest


@pytest.fixture
def no_jax(tmp_path, monkeypatch):
    """No new process can import JAX."""
    from tests.workers.numpy_rollout import NO_JAX

    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(NO_JAX)
    monkeypatch.syspath_prepend(tmp_path / "site")


@pytest.fixture(params=["xla", "simd"])
def spec(request):
    """The tiny spec with changes, for each value of `compute.rollout`."""
    from tests import helpers  # imports JAX, which must not be before its settings

    return partial(helpers.spec, rollout=request.param)
