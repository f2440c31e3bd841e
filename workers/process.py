"""Workers as threads of a child process, most often one: chunks in, results out, each over a socket of its own. Started
by the inline engine.

The parent sets the environment (one XLA thread, CPU) before this interpreter starts, so the numbers never depend on
what else the parent has done with JAX.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

from es_service.protocol.wire import framed, receive

PR_SET_PDEATHSIG = 1


def main(descriptor: int, parent: int) -> None:
    """Serve until the parent closes its end.

    Over the socket `descriptor`: the WorkerSpec, then a byte with the descriptor of a socket for each worker. Over a
    worker's, in: ("centre", Centre) and ("chunks", key, attempt, [Chunk]). Out: ("broken", text), or ("up",) and then
    ("results", key, attempt, [ChunkResult]) or ("failure", key, attempt, text).
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # a killed driver leaves no orphans computing
    if os.getppid() != parent:
        return
    with socket.socket(fileno=descriptor) as control:
        try:
            run_chunks = _make_run_chunks(receive(control))
            while (given := _descriptor(control)) is not None:
                threading.Thread(target=_work, args=(given, run_chunks), daemon=True).start()
        except Exception:
            traceback.print_exc()
    os._exit(0)  # without waiting for threads, which may be in the middle of a chunk


def _descriptor(control: socket.socket) -> int | None:
    """Of the next worker's socket; None when the parent has closed its end.

    Raises:
        OSError: there is none to be had.
    """
    byte, descriptors, _, _ = socket.recv_fds(control, 1, 1, socket.MSG_CMSG_CLOEXEC)
    if byte and not descriptors:
        raise OSError("no file descriptor for a worker's socket")
    return descriptors[0] if descriptors else None


def _make_run_chunks(spec: Any) -> Callable[..., Any] | str:
    """What runs the chunks, or why there is nothing that could."""
    try:
        from workers.worker import make_worker, run_chunks

        return partial(run_chunks, make_worker(spec))
    except Exception:
        return traceback.format_exc()


def _work(descriptor: int, run_chunks: Callable[..., Any] | str) -> None:
    """A worker until the parent closes its end. However it ends otherwise, the parent sees that and why."""
    with socket.socket(fileno=descriptor) as parent:
        try:
            _serve(parent, run_chunks)
        except (EOFError, ConnectionError):
            pass
        except Exception:
            traceback.print_exc()


def _serve(parent: socket.socket, run_chunks: Callable[..., Any] | str) -> None:
    if isinstance(run_chunks, str):
        parent.sendall(framed(("broken", run_chunks)))
        return
    parent.sendall(framed(("up",)))
    centre = None
    while True:
        match receive(parent):
            case ("centre", centre):
                pass
            case ("chunks", key, attempt, chunks):
                try:
                    assert centre is not None, "the engine sends the centre first"
                    answer = ("results", key, attempt, run_chunks(centre, chunks))
                except BaseException:  # sys.exit in an environment, too
                    answer = ("failure", key, attempt, traceback.format_exc())
                parent.sendall(framed(answer))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
