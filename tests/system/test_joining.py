"""Runs that cannot join a cluster, with real heads on this machine: what they say, how soon, and what they leave."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import socket
import sys
import time
from pathlib import Path

import pytest

from tests.system.command_line import es
from tests.system.processes import running, wait_until

pytestmark = pytest.mark.long
TOKEN = secrets.token_hex(32)
SOON_S = 5.0


@contextlib.contextmanager
def head(folder: Path, **settings: str):
    """The address of a head on this machine."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    folder.mkdir()
    options = ["--head", "--block", f"--port={port}", "--num-cpus=1", "--include-dashboard=false"]
    sessions = Path(f"/tmp/{folder.name}-{port}")  # the names of sockets must be short
    options += ["--object-store-memory=100000000", "--disable-usage-stats", f"--temp-dir={sessions}"]
    ray = Path(sys.executable).with_name("ray")
    with (folder / "log").open("w") as log:
        environment = {**os.environ, "HOME": str(folder), **settings}
        command = (ray, "start", *options)
        with running(*command, env=environment, stdout=log, stderr=log, start_new_session=True) as process:
            try:
                wait_until(process, lambda: "Ray runtime started" in (folder / "log").read_text())
                yield f"127.0.0.1:{port}"
            finally:
                process.send_signal(signal.SIGTERM)  # ends the processes that it has started
                process.wait(timeout=60)
                shutil.rmtree(sessions, ignore_errors=True)


def test_what_is_wrong_is_said_soon_in_one_sentence_and_no_folder_is_left(tmp_path):
    out = tmp_path / "run"
    run = ("run", "configs/point_maze_es.yaml", "--out", out, "--set", "budget.generations=1")
    right = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": TOKEN, "HOME": str(tmp_path)}
    es("--version")  # from now on, its files are in memory
    with head(tmp_path / "with", **right) as tokens, head(tmp_path / "without", RAY_AUTH_MODE="disabled") as none:
        for address, settings, sentence in (
            (
                tokens,
                {"RAY_AUTH_MODE": "", "RAY_AUTH_TOKEN": ""},
                "the cluster asks for a token, and this process sends none",
            ),
            (tokens, {"RAY_AUTH_TOKEN": "0" * 64}, "the token in RAY_AUTH_TOKEN is not the cluster's"),
            (none, {}, "the cluster uses no token, but RAY_AUTH_MODE=token is set here"),
            ("127.0.0.1:1", {}, "nothing listens at that address (Connection refused)"),
        ):
            begun = time.monotonic()
            code, printed = es(*run, "--address", address, **right | settings)
            took = time.monotonic() - begun
            assert code == 1, printed
            assert f"error: could not connect to a Ray cluster at {address}: {sentence}" in printed
            assert took < SOON_S, printed
            assert not out.exists()
        code, printed = es(*run, "--address", tokens, **right)
        assert code == 0, printed
