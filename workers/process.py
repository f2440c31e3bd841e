"""Workers as threads of a child process that the inline engine starts, usually one thread per process.

Each worker receives chunks and sends results over its own socket. The parent sets the environment (one XLA thread; the
CPU or a GPU) before this interpreter starts, so the results never depend on the parent's use of JAX.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from es_service.protocol.kept import Kept
from es_service.protocol.kept_parents import LackingError
from es_service.protocol.kept_subjects import forget_old_subjects
from es_service.protocol.messages import Subject, WorkerSpec
from es_service.protocol.raised import RaisedError, raised
from es_service.protocol.sources import why_refused
from es_service.protocol.wire import framed, receive
from workers import progress
from workers.gpu import platform_of_gpu
from workers.parents import Parents
from workers.progress import Seen
from workers.rollouts import BACKENDS
from workers.xla_cache import xla_cache_settings

if TYPE_CHECKING:  # it imports JAX, whose settings are made here
    from workers.compilable import Compilable

REPORT_S = 0.5
"""Seconds between two looks at how far a worker is. Nothing is sent of work that is done sooner."""


def main(descriptor: int) -> None:
    """Serve workers until the parent closes its end of the socket `descriptor`.

    The parent sends over this socket the WorkerSpec, and then for each worker one byte with the descriptor of the
    worker's socket. A worker receives ("subject", number, Subject), ("parents", {name: parameters or Origin}) and
    ("chunks", item, attempt, [(number, Chunk)]); `item` names their work item, and `number` the subject of each. It
    sends ("broken", RaisedError), or ("up", `platform_of_gpu`) and then for each work item ("results", item, attempt,
    [ChunkResult]), ("failure", item, attempt, RaisedError) or, if it has not been sent the parents of policies,
    ("lacks", item, attempt). Before it computes the first work item of a kind, it compiles for it and sends
    ("compiled", kind, seconds). While it takes long for something, its start included, it sends ("progress", doing,
    done, total) as in `progress.Seen` when it has done more of it.
    """
    os.set_inheritable(descriptor, False)
    with socket.socket(fileno=descriptor) as control:
        try:
            spec = receive(control)
            made: Future[Compilable | RaisedError] = Future()
            threading.Thread(target=_accept, args=(control, made, spec), daemon=True).start()
            made.set_result(_make_run_chunks(spec))  # in the main thread, since some libraries of users demand it
            threading.Event().wait()
        except Exception:
            traceback.print_exc()
    os._exit(0)


def _accept(control: socket.socket, made: Future[Compilable | RaisedError], spec: WorkerSpec) -> None:
    """Serve a worker for each socket that comes, until the parent closes its end; this ends the process."""
    try:
        while (given := _descriptor(control)) is not None:
            threading.Thread(target=_work, args=(given, made, spec), daemon=True).start()
    except Exception:
        traceback.print_exc()
    os._exit(0)  # do not wait for threads, which may be in the middle of a chunk


def _descriptor(control: socket.socket) -> int | None:
    """File descriptor of the next worker's socket; None when the parent has closed its end.

    Raises:
        OSError: the parent's message came without a descriptor.
    """
    byte, descriptors, _, _ = socket.recv_fds(control, 1, 1, getattr(socket, "MSG_CMSG_CLOEXEC", 0))
    if byte and not descriptors:
        raise OSError(
            "the parent's message has no file descriptor for a worker's socket; the limit of open files may be too low"
        )
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)  # macOS has no such flag of the call itself
    return descriptors[0] if descriptors else None


def _make_run_chunks(spec: Any) -> Compilable | RaisedError:
    """Function that runs chunks, or the reason why there is none: other code, or an error."""
    if problem := why_refused(spec.sources, spec.task_code, spec.platform):
        return RaisedError(problem, "")
    os.environ.update(xla_cache_settings())
    try:
        from workers.worker import make_worker

        return make_worker(spec)
    except BaseException as error:  # also sys.exit in an environment
        return raised(error, *spec.task_code)


def _work(descriptor: int, made: Future[Compilable | RaisedError], spec: WorkerSpec) -> None:
    """Run one worker until the parent closes its end. After any other end, the parent sees that and the reason."""
    with socket.socket(fileno=descriptor) as parent:
        try:
            _serve(parent, made, spec)
        except (EOFError, ConnectionError):
            pass
        except Exception:
            traceback.print_exc()


def _serve(parent: socket.socket, made: Future[Compilable | RaisedError], spec: WorkerSpec) -> None:
    """Receive chunks and send their results; does not return unless the worker is broken."""
    said = _Said(parent)
    with said.progress():
        run_chunks = made.result()
    if isinstance(run_chunks, RaisedError):
        said.say("broken", run_chunks)
        return
    said.say("up", platform_of_gpu(spec.rollout))
    subjects: Kept[int, Subject] = Kept(attrgetter("nbytes"))
    parents = Parents(spec.parent_cache_bytes, BACKENDS[spec.rollout].made)
    compiled: set[str] = set()
    # Threads of one process would report the progress of others, and hide one that hangs.
    progress_of_item = nullcontext if BACKENDS[spec.rollout].runs_in_threads else said.progress
    while True:
        match receive(parent):
            case ("subject", number, subject):
                subjects.add(number, subject)
            case ("parents", given):
                parents.receive(given)
            case ("chunks", item, attempt, chunks):
                try:
                    with progress_of_item():
                        work = parents.complete([(subjects[number], chunk) for number, chunk in chunks])
                        if (kind := type(work[0][1]).__name__) not in compiled:
                            seconds = run_chunks.seconds_to_compile(work)
                            compiled.add(kind)
                            said.say("compiled", kind, seconds)
                        answer = ("results", item, attempt, run_chunks(work))
                except LackingError:
                    answer = ("lacks", item, attempt)
                except BaseException as error:  # also sys.exit in an environment
                    answer = ("failure", item, attempt, raised(error, *spec.task_code))
                said.say(*answer)
                forget_old_subjects(subjects)


class _Said:
    """What a worker says to its parent: answers, and from a thread of its own how far it is with what takes long."""

    def __init__(self, parent: socket.socket) -> None:
        self._parent, self._turn, self._now = parent, threading.Lock(), 0
        threading.Thread(target=self._report, daemon=True, name="reports progress").start()

    def say(self, *message: Any) -> None:
        """Send a message."""
        with self._turn:
            self._parent.sendall(framed(message))

    @contextmanager
    def progress(self) -> Iterator[None]:
        """Report progress of what is done in the block, if it takes long."""
        with self._turn:
            self._now += 1
        try:
            yield
        finally:
            with self._turn:
                self._now += 1

    def _report(self) -> None:
        """Send what has changed between two looks, if both are at the same work."""
        before: tuple[int, Seen] | None = None
        with suppress(OSError):  # the parent has closed its end
            while True:
                time.sleep(REPORT_S)
                with self._turn:
                    now = self._now, progress.seen()
                    if self._now % 2 and before is not None and before[0] == now[0] and before[1] != now[1]:
                        self._parent.sendall(framed(("progress", *now[1][1:])))
                before = now


if __name__ == "__main__":
    main(int(sys.argv[1]))
