"""What Ray changes and leaves on this machine, without Ray."""

from __future__ import annotations

import os
import signal
import sys
from types import SimpleNamespace

import pytest
from test.support import catch_unraisable_exception

from es_service.dispatch import ray_cluster, ray_side_effects
from es_service.errors import EvaluationError, Interrupted


def test_variables_that_nobody_changed_are_never_touched(monkeypatch):
    """Threads of Ray's read the environment while ours is restored, and must not find it empty."""
    monkeypatch.setenv("OLD", "old")
    monkeypatch.setenv("SAME", "same")
    monkeypatch.delenv("NEW", raising=False)
    before, touched = dict(os.environ), []
    for function in ("putenv", "unsetenv"):
        monkeypatch.setattr(os, function, lambda name, *_: touched.append(name))
    with ray_side_effects.environment_kept({"OLD": "new", "NEW": "new"}):
        os.environ["RAYS_OWN"] = "1"
        assert os.environ["OLD"] == os.environ["NEW"] == "new"
    assert dict(os.environ) == before
    assert set(touched) == {b"OLD", b"NEW", b"RAYS_OWN"}


def test_a_sentence_of_ray_s_ends_with_one_full_stop(monkeypatch):
    ray = pytest.importorskip("ray")

    def refuse(**_):
        raise ConnectionError("Could not find any running Ray instance. Please specify one.")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(EvaluationError, match=r"at auto: Could not find .* specify one\. Check the address\."):
        ray_cluster.connect("auto", ray_cluster.ONE_CORE, 1)


def test_sigterm_is_not_lost_where_python_ignores_the_exception_of_ray_s_handler(monkeypatch):
    ray = pytest.importorskip("ray")
    ended, before = [], signal.getsignal(signal.SIGTERM)

    class Finalized:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def start(**_):
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(number))
        Finalized()

    monkeypatch.setattr(ray, "init", start)
    monkeypatch.setattr(ray, "shutdown", lambda: ended.append(True))
    with catch_unraisable_exception() as shown:
        with pytest.raises(Interrupted):
            ray_cluster.connect("auto", ray_cluster.ONE_CORE, 1)
        assert shown.unraisable is None
    assert ended == [True]
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("is_latest", [True, False])
def test_a_session_is_forgotten_with_the_link_to_it_and_with_no_other(tmp_path, is_latest):
    ours, other, latest = tmp_path / "session_ours", tmp_path / "session_other", tmp_path / "session_latest"
    for folder in (ours, other):
        (folder / "logs").mkdir(parents=True)
    latest.symlink_to(ours if is_latest else other)
    node = SimpleNamespace(get_session_dir_path=lambda: str(ours))
    worker = SimpleNamespace(_global_node=node)
    ray = SimpleNamespace(_private=SimpleNamespace(worker=worker), shutdown=lambda: delattr(worker, "_global_node"))
    assert latest.exists()
    ray_cluster.disconnect(ray, forget=True)
    assert (ours.exists(), other.exists(), latest.is_symlink()) == (False, True, not is_latest)
    worker._global_node = node
    node.get_session_dir_path = lambda: str(other)
    ray_cluster.disconnect(ray)
    assert other.exists()
