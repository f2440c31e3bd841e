"""A child process for tests: it runs programs of the shell, and answers with their exit codes.

python -m tests.es_service.shell_child DESCRIPTOR
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable

from es_service.protocol.child import answer_parent


def shell(name: str) -> Callable[[str], int]:
    """Function that runs a program; named "waits", the process has a thread that does not end."""
    if name == "waits":
        threading.Thread(target=threading.Event().wait).start()
    if name == "raises":
        raise ValueError("it cannot be imported")
    return lambda program: os.waitstatus_to_exitcode(os.system(program))


if __name__ == "__main__":
    answer_parent(int(sys.argv[1]), shell)
