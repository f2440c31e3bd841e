"""A worker as a child process: chunks in, results out, over the pipe it was given. Started by the inline engine.

The parent sets the environment (one XLA thread, CPU) before this interpreter starts, so the numbers never depend on
what else the parent has done with JAX.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection

PR_SET_PDEATHSIG = 1


def main(descriptor: int, parent: int) -> None:
    """Serve until the parent closes the pipe.

    In: the WorkerSpec, then ("centre", Centre) and ("chunk", key, attempt, Chunk).
    Out: ("up", pid) or ("broken", text), then ("result", key, attempt, ChunkResult) or ("failure", key, attempt, text).
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # a killed driver leaves no orphans computing
    if os.getppid() != parent:
        return
    connection = Connection(descriptor)
    try:
        _serve(connection)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _serve(connection: Connection) -> None:
    try:
        from workers.worker import make_worker

        run_chunk = make_worker(connection.recv())
    except EOFError:
        raise
    except Exception:
        connection.send(("broken", traceback.format_exc()))
        return
    connection.send(("up", os.getpid()))
    centre = None
    while True:
        message = connection.recv()
        if message[0] == "centre":
            centre = message[1]
            continue
        _, key, attempt, chunk = message
        try:
            assert centre is not None, "the engine sends the centre first"
            answer = ("result", key, attempt, run_chunk(centre, chunk))
        except Exception:
            answer = ("failure", key, attempt, traceback.format_exc())
        connection.send(answer)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
