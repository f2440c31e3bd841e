"""Workers as threads of a child process that the inline engine starts, usually one thread per process.

Each worker receives chunks and sends results over its own socket. The parent sets the environment (one XLA thread; the
CPU or a GPU) before this interpreter starts, so the results never depend on the parent's use of JAX.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager, nullcontext, suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.sent import LackingError, Received
from es_service.protocol.sources import why_refused
from es_service.protocol.user_code import RaisedError, raised
from es_service.protocol.wire import framed, receive
from workers import progress
from workers.compiling import xla_cache_settings
from workers.progress import Seen
from workers.reports import Reports, reports_of, require_room
from workers.rollouts import BACKENDS, platform_of_gpu

if TYPE_CHECKING:  # it imports JAX, whose settings are made here
    from workers.rollouts.backend import ChunkFunctions
    from workers.worker import Made

REPORT_S = 0.5
"""Seconds between two looks at how far a worker is. Nothing is sent of work that is done sooner."""


def main(descriptor: int) -> None:
    """Serve workers until the parent closes its end of the socket `descriptor`.

    The parent sends over this socket the byte "s" and the WorkerSpec of a run, and then for each of its workers one
    byte with the descriptor of the worker's socket; for another run, when these workers have ended, the same again. A
    worker receives ("arrays", {name: array}) and ("work", item, attempt, origins, work), in which `item` names the work
    item, and the rest is as in a `Parcel`. It sends ("broken", RaisedError), or ("up", `platform_of_gpu`) and then for
    each work item ("results", item, attempt, [ChunkResult]), ("failure", item, attempt, RaisedError) or, if it has not
    been sent all arrays, ("lacks", item, attempt). Before it computes the first work item of a kind, it compiles for it
    and sends ("compiled", kind, seconds). While it takes long for something, its start included, it sends ("progress",
    doing, done, total) as in `progress.Seen` when it has done more of it; and ("report", Report) when there is anything
    to report.
    """
    os.set_inheritable(descriptor, False)
    with socket.socket(fileno=descriptor) as control:
        runs: SimpleQueue[tuple[Future[Made | RaisedError], WorkerSpec]] = SimpleQueue()
        before: dict[str, tuple[ChunkFunctions, set[str]]] = {}
        try:
            threading.Thread(target=_accept, args=(control, runs), daemon=True).start()
            while True:  # in the main thread, since some libraries of users demand it
                made, spec = runs.get()
                made.set_result(_made(spec, before))
        except Exception:
            traceback.print_exc()
    os._exit(0)


def _accept(control: socket.socket, runs: SimpleQueue[tuple[Future[Made | RaisedError], WorkerSpec]]) -> None:
    """Serve a worker for each socket that comes, until the parent closes its end; this ends the process."""
    try:
        run = reports = None
        while (given := _next(control)) is not None:
            if not isinstance(given, int):
                runs.put(run := (Future(), given))
                reports = reports_of(given, before=reports)  # one for all threads, which print and leak together
            elif run is not None:
                threading.Thread(target=_work, args=(given, *run, reports), daemon=True).start()
    except Exception:
        traceback.print_exc()
    os._exit(0)  # do not wait for threads, which may be in the middle of a chunk


def _next(control: socket.socket) -> int | WorkerSpec | None:
    """The file descriptor of a worker's socket, or the constants of a run; None when the parent has closed its end.

    Raises:
        OSError: the parent's message came without a descriptor.
    """
    byte, descriptors, _, _ = socket.recv_fds(control, 1, 1, getattr(socket, "MSG_CMSG_CLOEXEC", 0))
    if byte == b"s":
        return receive(control)
    if byte and not descriptors:
        raise OSError(
            "the parent's message has no file descriptor for a worker's socket; the limit of open files may be too low"
        )
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)  # macOS has no such flag of the call itself
    return descriptors[0] if descriptors else None


def _made(spec: WorkerSpec, before: dict[str, tuple[ChunkFunctions, set[str]]]) -> Made | RaisedError:
    """What computes the chunks of a run, or the reason why there is nothing: other code, or an error.

    Args:
        before: functions for the constants of earlier runs, and for which kinds they have been compiled.
    """
    if problem := why_refused(spec.sources, spec.task_code, spec.platform):
        return RaisedError(problem, "")
    os.environ.update(xla_cache_settings())
    try:
        from workers.worker import compiled_before

        is_new = not before  # else what it has besides is of earlier runs, and it is replaced after its first work item
        made = compiled_before(before, spec)
        if is_new:
            require_room(spec)
        return made
    except BaseException as error:  # also sys.exit in an environment
        return raised(error, *spec.task_code)


def _work(descriptor: int, made: Future[Made | RaisedError], spec: WorkerSpec, reports: Reports) -> None:
    """Run one worker until the parent closes its end. After any other end, the parent sees that and the reason."""
    with socket.socket(fileno=descriptor) as parent:
        try:
            _serve(parent, made, spec, reports)
        except (EOFError, ConnectionError):
            pass
        except Exception:
            traceback.print_exc()


def _serve(parent: socket.socket, made: Future[Made | RaisedError], spec: WorkerSpec, reports: Reports) -> None:
    """Receive chunks and send their results; does not return unless the worker is broken."""
    with closing(_Said(parent, reports)) as said:
        with said.progress():
            ready = made.result()
        if isinstance(ready, RaisedError):
            said.say("broken", ready)
            return
        said.say("up", platform_of_gpu(spec.rollout))
        received = Received(spec.parent_cache_bytes, BACKENDS[spec.rollout].made)
        compiled: set[str] = set()
        # Threads of one process would report the progress of others, and hide one that hangs.
        progress_of_item = nullcontext if BACKENDS[spec.rollout].runs_in_threads else said.progress
        while True:
            match receive(parent):
                case ("arrays", arrays):
                    received.add(arrays)
                case ("work", item, attempt, origins, pickled):
                    try:
                        with progress_of_item():
                            work = received.work(origins, pickled)
                            if (kind := type(work[0][1]).__name__) not in compiled:
                                seconds = ready.seconds_to_compile(work)
                                compiled.add(kind)
                                said.say("compiled", kind, seconds)
                            answer = ("results", item, attempt, results := ready.run_chunks(work))
                            reports.note(results)
                    except LackingError:
                        answer = ("lacks", item, attempt)
                    except BaseException as error:  # also sys.exit in an environment
                        answer = ("failure", item, attempt, raised(error, *spec.task_code))
                    said.report()  # first, since nobody may listen after the last answer
                    said.say(*answer)


class _Said:
    """What a worker says to its parent: answers, and from a thread of its own how far it is with what takes long."""

    def __init__(self, parent: socket.socket, reports: Reports) -> None:
        self._parent, self._reports, self._now = parent, reports, 0
        self._turn, self._closed = threading.Lock(), threading.Event()
        threading.Thread(target=self._report, daemon=True, name="reports progress").start()

    def say(self, *message: Any) -> None:
        with self._turn:
            self._parent.sendall(framed(message))

    def report(self) -> None:
        if (report := self._reports.report()) is not None:
            self.say("report", report)

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

    def close(self) -> None:
        """Report nothing any more."""
        self._closed.set()

    def _report(self) -> None:
        """Send what has changed between two looks, if both are at the same work."""
        before: tuple[int, Seen] | None = None
        with suppress(OSError):  # the parent has closed its end
            while not self._closed.wait(REPORT_S):
                self.report()
                with self._turn:
                    now = self._now, progress.seen()
                    if self._now % 2 and before is not None and before[0] == now[0] and before[1] != now[1]:
                        self._parent.sendall(framed(("progress", *now[1][1:])))
                before = now


if __name__ == "__main__":
    main(int(sys.argv[1]))
