"""Workers as threads of a child process, most often one: chunks in, results out, over the pipe it was given. Started by
the inline engine.

The parent sets the environment (one XLA thread, CPU) before this interpreter starts, so the numbers never depend on
what else the parent has done with JAX.
"""

from __future__ import annotations

import ctypes
import os
import queue
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

PR_SET_PDEATHSIG = 1
Say = Callable[[tuple[Any, ...]], None]


def main(descriptor: int, parent: int) -> None:
    """Serve until the parent closes the pipe.

    In: the WorkerSpec, then ("start", worker), ("centre", Centre) and ("chunk", worker, key, attempt, Chunk).
    Out: ("broken", text), or for each worker ("up", worker), then ("result", worker, key, attempt, ChunkResult) or
    ("failure", worker, key, attempt, text).
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # a killed driver leaves no orphans computing
    if os.getppid() != parent:
        return
    connection = Connection(descriptor)
    try:
        _serve(connection)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        os._exit(0)  # without waiting for threads, which may be in the middle of a chunk


def _serve(connection: Connection) -> None:
    lock = threading.Lock()

    def say(message: tuple[Any, ...]) -> None:
        with lock:
            connection.send(message)

    try:
        from workers.worker import make_worker

        run_chunk = make_worker(connection.recv())
    except EOFError:
        raise
    except Exception:
        say(("broken", traceback.format_exc()))
        return
    queues: dict[int, queue.SimpleQueue[Any]] = {}
    centre = None
    while True:
        match connection.recv():
            case ("start", worker):
                chunks = queues[worker] = queue.SimpleQueue()
                threading.Thread(target=_work, args=(worker, run_chunk, chunks, say), daemon=True).start()
            case ("centre", centre):
                pass
            case ("chunk", worker, key, attempt, chunk):
                queues[worker].put((centre, key, attempt, chunk))


def _work(worker: int, run_chunk: Callable[..., Any], chunks: queue.SimpleQueue[Any], say: Say) -> None:
    say(("up", worker))
    while True:
        centre, key, attempt, chunk = chunks.get()
        try:
            assert centre is not None, "the engine sends the centre first"
            answer = ("result", worker, key, attempt, run_chunk(centre, chunk))
        except Exception:
            answer = ("failure", worker, key, attempt, traceback.format_exc())
        say(answer)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
