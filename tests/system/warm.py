"""Processes that have the modules of `es-service` already, which are most of what a short command takes.

Each is forked from a process that has imported them. A command is otherwise like one that a user starts: its standard
streams, working folder, environment, arguments and `sys.path` are those of the program.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from multiprocessing.context import ForkServerContext
from pathlib import Path

MODULES = ["es_service.__main__", "es_service.cli.main", "es_service.api", "pandas", "scipy.spatial", "pytest"]
TESTED = str(Path(__file__).parents[2])


@cache
def _server() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(MODULES)
    return context


def run(words: Sequence[str], cwd: Path, environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a command to its end: as `subprocess.run`, without input. It is killed after ten minutes."""
    return call(be_program, list(words), str(cwd), dict(environment))


def call(function: Callable[..., None], *arguments: object, limit_s: float = 600) -> subprocess.CompletedProcess[str]:
    """Call a function in a process of its own, to the end of both. It is killed after `limit_s` seconds."""
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, name) for name in ("out", "err")]
        for file in files:
            file.touch()
        process = _server().Process(target=_printing, args=(list(map(str, files)), function, *arguments))
        process.start()
        process.join(limit_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(repr(arguments), limit_s)
        code = process.exitcode
        process.close()
        return subprocess.CompletedProcess(arguments, code, *(file.read_text() for file in files))


def _printing(files: list[str], function: Callable[..., None], *arguments: object) -> None:
    """Call a function with its standard output and error in files."""
    for number, file in enumerate(files, start=1):
        opened = os.open(file, os.O_WRONLY)
        os.dup2(opened, number)
        os.close(opened)
    function(*arguments)


def be_program(words: list[str], cwd: str, environment: dict[str, str]) -> None:
    """Be the program, in its process from now on."""
    from es_service.__main__ import main

    _settle(cwd, environment, str(Path(words[0]).parent))
    sys.argv = words
    main()


def be_script(code: str, cwd: str, environment: dict[str, str]) -> None:
    """Be `python -c CODE`, in its process from now on."""
    _settle(cwd, environment, "")
    sys.argv = ["-c"]
    exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})


def _settle(cwd: str, environment: dict[str, str], first: str) -> None:
    """Have the folder, the environment and the `sys.path` of a program of which `first` is the folder."""
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    named = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path = [first, *named, *(path for path in sys.path if path not in ("", TESTED))]
