"""A child process for tests: it runs programs of the shell, and answers with their exit codes."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable


def shell(name: str) -> Callable[[str], int]:
    """Function that runs a program; named "waits", the process has a thread that does not end."""
    if name == "waits":
        threading.Thread(target=threading.Event().wait).start()
    if name == "raises":
        raise ValueError("it cannot be imported")
    return lambda program: os.waitstatus_to_exitcode(os.system(program))
