"""The inline engine: workers are child processes of this one, or threads of one child, talked to over pipes.

Children are started by exec with fixed settings (one XLA thread, CPU), never forked, so whatever the caller has done
with JAX changes nothing; that is why threads are not this process's own. Each child has one thread here that reads its
answers and one that writes to it: a child that is stopped in mid-message then blocks nobody but its own threads.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Hashable
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import IO, Any

from es_service.dispatch.dispatch_log import Log, no_log
from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.messages import Failure, Policy, WorkerLost, WorkerUp
from es_service.protocol import Centre, Chunk, WorkerSpec, worker_environment

JOIN_S = 1.0
"""Longest wait for the threads of a child that is dead; they end at once unless a stray process holds its pipe."""


def inline_engine(
    spec: WorkerSpec,
    policy: Policy,
    should_stop: Callable[[], int | None] = lambda: None,
    *,
    threads: bool = False,
    log: Log = no_log,
) -> Engine[ChildProcesses]:
    """An Evaluator on this machine, its `policy.workers` workers starting.

    Args:
        threads: of one child, instead of a child each: less memory, and one that is lost takes the others with it.
    """
    return Engine(ChildProcesses(spec, threads=threads), policy, should_stop, log)


@dataclass(eq=False)
class _Child:
    """One process, of one worker or of all, and the plumbing to it."""

    process: subprocess.Popen[bytes]
    log: IO[bytes]
    """What it wrote to stdout and stderr."""
    outbox: queue.SimpleQueue[bytes | None]
    """Pickled messages to write to it, in order; None: no more."""
    reader: threading.Thread = field(init=False)
    centre: Centre | None = None
    """The one it was sent last."""


class ChildProcesses:
    """A Transport whose workers are child processes, or threads of one."""

    def __init__(self, spec: WorkerSpec, *, threads: bool = False) -> None:
        self._spec, self._threads = spec, threads
        self._children: dict[int, _Child] = {}
        """By worker; with threads, the same for all of them."""
        self._inbox: queue.SimpleQueue[tuple[_Child | int, Any]] = queue.SimpleQueue()
        self._lost: deque[Message] = deque()

    def process_ids(self) -> dict[int, int]:
        """Worker id -> process id of the children not known to be dead; for diagnosis and for tests that kill them."""
        return {worker: child.process.pid for worker, child in self._children.items()}

    def start(self, worker: int) -> None:
        """Start a child and tell it the constants of the run; or have the one that there is start a thread."""
        child = next(iter(self._children.values()), None) if self._threads else None
        if child is None:
            try:
                child = _start_child(worker, self._inbox)
            except OSError as error:  # no process, no file descriptor or no disk space to be had
                self._inbox.put((worker, ("broken", f"worker {worker} cannot be started: {error}")))
                return
            child.outbox.put(pickle.dumps(self._spec, pickle.HIGHEST_PROTOCOL))
        self._children[worker] = child
        child.outbox.put(pickle.dumps(("start", worker), pickle.HIGHEST_PROTOCOL))

    def kill(self, worker: int) -> None:
        """Kill a worker's child, wait for it, free its descriptors and end its threads; its other workers are lost."""
        child = self._children.pop(worker, None)
        if child is not None:
            self._lose(child, f"worker {worker}, a thread of the same process, had to be killed", bystanders=True)

    def send(self, worker: int, centre: Centre, key: Hashable, attempt: int, chunk: Chunk) -> None:
        """Queue the chunk for the child's writer, behind the centre if the child does not know it."""
        child = self._children.get(worker)
        if child is None:
            return  # lost with another thread of its child; that is on its way to the scheduler
        if child.centre is not centre:
            child.centre = centre
            child.outbox.put(pickle.dumps(("centre", centre), pickle.HIGHEST_PROTOCOL))
        child.outbox.put(pickle.dumps(("chunk", worker, key, attempt, chunk), pickle.HIGHEST_PROTOCOL))

    def receive(self, timeout_s: float) -> Message | None:
        """The next message of any child; one that broke or closed its pipe is killed before it is reported lost."""
        while True:
            if self._lost:
                return self._lost.popleft()
            try:
                who, said = self._inbox.get(timeout=timeout_s) if timeout_s else self._inbox.get_nowait()
            except queue.Empty:
                return None
            if (message := self._message(who, said)) is not None:
                return message

    def _message(self, who: _Child | int, said: Any) -> Message | None:
        """What a child said; None of one that is known to be dead, or whose workers are among the lost from now on."""
        match said:
            case ("up", worker):
                return WorkerUp(worker)
            case ("result", worker, key, attempt, result):
                return Answer(worker, key, attempt, result)
            case ("failure", worker, key, attempt, text):
                return Failure(worker, key, attempt, text)
            case ("broken", text) if isinstance(who, int):
                return WorkerLost(who, text)
            case ("broken", text):
                self._lose(who, text)
            case _:
                self._lose(who)
        return None

    def close(self) -> None:
        """Kill all children and wait for them."""
        for child in self._children.values():
            child.process.kill()  # all at once: each takes a while to give its memory back
        for worker in list(self._children):
            self.kill(worker)

    def _lose(self, child: _Child | int, reason: str = "", *, bystanders: bool = False) -> None:
        """Kill a child for good, and report its workers lost; nothing more happens to one that was killed before."""
        workers = [worker for worker, one in self._children.items() if one is child]
        for worker in workers:
            del self._children[worker]
        how = self._end(child, workers) if isinstance(child, _Child) and not child.log.closed else ""
        self._lost.extend(WorkerLost(worker, reason or how, bystander=bystanders) for worker in workers)

    def _end(self, child: _Child, workers: list[int]) -> str:
        """Kill a child; how it ended and what it said last, as a reason."""
        child.process.kill()
        code = child.process.wait()
        child.reader.join(JOIN_S)
        child.log.seek(0)
        last_words = child.log.read()[-2000:].decode(errors="replace").strip()
        child.log.close()
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        whose = f"worker {', '.join(map(str, workers))}"
        return f"{whose} (pid {child.process.pid}) ended with {how}" + (f":\n{last_words}" if last_words else "")


def _start_child(worker: int, inbox: queue.SimpleQueue[tuple[_Child | int, Any]]) -> _Child:
    environment = worker_environment(os.environ)
    environment["PYTHONSAFEPATH"] = "1"
    environment["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
    with ExitStack() as undo:
        log = undo.enter_context(tempfile.TemporaryFile())
        ours, theirs = Pipe(duplex=True)
        undo.enter_context(ours)
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "workers.process", str(theirs.fileno()), str(os.getpid())],
                env=environment,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        undo.pop_all()
    outbox: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    child = _Child(process, log, outbox)
    child.reader = threading.Thread(target=_read, args=(child, ours, inbox), daemon=True, name=f"worker-{worker}")
    child.reader.start()
    return child


def _read(child: _Child, connection: Connection, inbox: queue.SimpleQueue[tuple[_Child | int, Any]]) -> None:
    """Pass on what the child says until it is dead; then close the connection, once nobody uses it any more.

    Closing it from elsewhere could let a thread read or write a new connection that was given the same number.
    """
    writer = threading.Thread(target=_write, args=(connection, child.outbox), daemon=True, name="to-a-worker")
    writer.start()
    try:
        while True:
            inbox.put((child, connection.recv()))
    except Exception:  # end of file, or a message cut short by a kill
        inbox.put((child, ("lost",)))  # first of all: the writer may be blocked until the child is killed for it
        child.outbox.put(None)
        writer.join()
        connection.close()


def _write(connection: Connection, outbox: queue.SimpleQueue[bytes | None]) -> None:
    while (message := outbox.get()) is not None:
        try:
            connection.send_bytes(message)
        except OSError:
            return  # gone; the reader reports it
