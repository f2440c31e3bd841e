"""Binds the life of a child process to that of its parent.

`python -m es_service.protocol.parent PARENT MODULE ARGUMENT...` runs a module in a process that is bound like this.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1
"""Linux's `prctl` option that sets the signal sent to a process when its parent dies."""


def end_with(parent: int) -> None:
    """Have this process killed when its parent ends, for whatever reason; end it if the parent has ended already."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def bound(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in a child process bound to this process."""
    return [sys.executable, "-m", "es_service.protocol.parent", str(os.getpid()), module, *arguments]


if __name__ == "__main__":
    end_with(int(sys.argv[1]))
    del sys.argv[:2]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
