"""What Ray changes and leaves on this machine, without Ray."""

from __future__ import annotations

import os

from es_service.dispatch import ray_cluster


def test_variables_that_nobody_changed_are_never_touched(monkeypatch):
    """Threads of Ray's read the environment while ours is restored, and must not find it empty."""
    monkeypatch.setenv("OLD", "old")
    monkeypatch.setenv("SAME", "same")
    monkeypatch.delenv("NEW", raising=False)
    before, touched = dict(os.environ), []
    for function in ("putenv", "unsetenv"):
        monkeypatch.setattr(os, function, lambda name, *_: touched.append(name))
    with ray_cluster._environment_kept({"OLD": "new", "NEW": "new"}):
        os.environ["RAYS_OWN"] = "1"
        assert os.environ["OLD"] == os.environ["NEW"] == "new"
    assert dict(os.environ) == before
    assert set(touched) == {b"OLD", b"NEW", b"RAYS_OWN"}
