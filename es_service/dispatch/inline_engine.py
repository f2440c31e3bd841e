"""The inline engine: workers are child processes of this one, talked to over pipes. A thin shell on the scheduler.

Children are started by exec with fixed settings (one XLA thread, CPU), never forked, so whatever the caller has done
with JAX changes nothing. Each child has one thread here that reads its answers and one that writes to it: a child that
is stopped in mid-message then blocks nobody but its own threads.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import IO, Any, NamedTuple

from es_service.dispatch import messages, scheduler
from es_service.errors import EvaluationError, Interrupted
from es_service.protocol import Centre, Chunk, ChunkResult, DispatchCounts, WorkerSpec

POLL_S = 0.1
"""Longest wait before a request to stop is noticed."""
FIXED_ENVIRONMENT = {
    "PJRT_NPROC": "1",
    "JAX_PLATFORMS": "cpu",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONSAFEPATH": "1",
}
"""One thread, on the CPU. Children start with these, and without any other setting named below, so that nothing the
caller has set can change the bits of a rollout."""
NOT_INHERITED = ("JAX_", "XLA_", "PJRT_")
"""Beginnings of the names of environment variables that children do not inherit."""


class _Key(NamedTuple):
    """What the scheduler calls a chunk."""

    phase: int
    """Number of the `evaluate` call, so that a late answer of an earlier call is never taken for one of this call."""
    kind: str
    generation: int
    chunk_id: int

    def __str__(self) -> str:
        return f"{self.kind} {self.chunk_id} of generation {self.generation}"


@dataclass(frozen=True)
class _Child:
    """One worker process and the plumbing to it."""

    process: subprocess.Popen
    connection: Connection
    outbox: queue.SimpleQueue[bytes | None]
    log: IO[bytes]
    centres_sent: list[Centre]
    """The centre it knows, if any: at most one."""


class InlineEngine:
    """An Evaluator on this machine. Use as a context manager: leaving it kills the children, who hold nothing."""

    def __init__(
        self, spec: WorkerSpec, policy: messages.Policy, should_stop: Callable[[], int | None] = lambda: None
    ) -> None:
        """Start `policy.workers` children.

        Args:
            should_stop: asked every POLL_S while waiting; a signal number makes `evaluate` raise Interrupted.
        """
        self._spec = spec
        self._should_stop = should_stop
        self._children: dict[int, _Child] = {}
        self._inbox: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
        self._state = scheduler.initial_state(policy)
        self._chunks: dict[_Key, Chunk] = {}
        self._centre: Centre | None = None
        self._phase = 0
        self._results: dict[_Key, ChunkResult] = {}
        self._step(messages.Tick())

    @property
    def counts(self) -> DispatchCounts:
        """Faults survived so far."""
        state = self._state
        return DispatchCounts(state.retries, state.lost_workers, state.duplicates, state.wanted)

    def process_ids(self) -> dict[int, int]:
        """Worker id -> process id of the children alive now; for diagnosis and for tests that kill them."""
        return {worker: child.process.pid for worker, child in self._children.items()}

    def evaluate(self, centre: Centre, chunks: Sequence[Chunk]) -> list[ChunkResult]:
        """Results in the order of `chunks`, however many workers there are and whatever happens to them.

        Raises:
            EvaluationError: a chunk that fails everywhere, workers that do not start. Interrupted: asked to stop.
        """
        self._centre = centre
        self._phase += 1
        self._chunks = {
            _Key(self._phase, type(chunk).__name__, chunk.generation, chunk.chunk_id): chunk for chunk in chunks
        }
        self._results = {}
        tasks = [messages.Task(key, key.kind) for key in self._chunks]
        self._step(messages.Submit(tuple(tasks)))
        while scheduler.pending(self._state):
            if (number := self._should_stop()) is not None:
                raise Interrupted(number)
            self._handle_messages()
        return [self._results.pop(key) for key in self._chunks]

    def close(self) -> None:
        """Kill all children and wait for them."""
        for worker in list(self._children):
            self._kill(worker)

    def __enter__(self) -> InlineEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _handle_messages(self) -> None:
        """Wait for one message, take all that are there, and only then look at the clock."""
        wait_s = min(POLL_S, max(0.0, scheduler.next_deadline(self._state) - time.monotonic()))
        try:
            worker, message = self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait()
            while True:
                self._handle(worker, message)
                worker, message = self._inbox.get_nowait()
        except queue.Empty:
            self._step(messages.Tick())

    def _handle(self, worker: int, message: Any) -> None:
        if worker not in self._children and message[0] != "broken":
            return  # killed meanwhile; what it still said is of no use
        match message:
            case ("up", _):
                self._step(messages.WorkerUp(worker))
            case ("result", key, attempt, result):
                if self._step(messages.Result(worker, key, attempt)):
                    self._results[key] = result
            case ("failure", key, attempt, text):
                self._step(messages.Failure(worker, key, attempt, text))
            case ("broken", text):
                self._kill(worker)
                self._step(messages.WorkerLost(worker, text))
            case ("lost",):
                reason = self._kill(worker)
                self._step(messages.WorkerLost(worker, reason))

    def _step(self, event: messages.Event) -> bool:
        """Feed the scheduler and do as it says; whether it accepted a result."""
        self._state, commands = scheduler.step(self._state, event, time.monotonic())
        delivered, failure = False, None
        for command in commands:
            match command:
                case messages.StartWorker(worker):
                    self._start(worker)
                case messages.StopWorker(worker, _):
                    self._kill(worker)
                case messages.Assign(worker, key, attempt):
                    self._send(worker, key, attempt)
                case messages.Deliver(_):
                    delivered = True
                case messages.Fail(text):
                    failure = text
        if failure is not None:
            raise EvaluationError(failure)
        return delivered

    def _start(self, worker: int) -> None:
        try:
            child = _start_child()
        except OSError as error:  # no process, no file descriptor or no disk space to be had
            self._inbox.put((worker, ("broken", f"worker {worker} cannot be started: {error}")))
            return
        self._children[worker] = child
        threading.Thread(target=_read, args=(worker, child, self._inbox), daemon=True, name=f"worker-{worker}").start()
        child.outbox.put(pickle.dumps(self._spec, pickle.HIGHEST_PROTOCOL))

    def _send(self, worker: int, key: Any, attempt: int) -> None:
        child = self._children[worker]
        assert self._centre is not None
        if not child.centres_sent or child.centres_sent[0] is not self._centre:
            child.centres_sent[:] = [self._centre]
            child.outbox.put(pickle.dumps(("centre", self._centre), pickle.HIGHEST_PROTOCOL))
        message = ("chunk", key, attempt, self._chunks[key])
        child.outbox.put(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))

    def _kill(self, worker: int) -> str:
        """Kill a child for good; what it said last, as a reason."""
        child = self._children.pop(worker, None)
        if child is None:
            return "killed before"
        child.process.kill()
        code = child.process.wait()
        child.log.seek(0)
        last_words = child.log.read()[-2000:].decode(errors="replace").strip()
        child.log.close()
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return f"worker {worker} (pid {child.process.pid}) ended with {how}" + (
            f":\n{last_words}" if last_words else ""
        )


def _start_child() -> _Child:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(NOT_INHERITED)}
    environment |= FIXED_ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    ours, theirs = Pipe(duplex=True)
    with theirs:
        log = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the child)
        process = subprocess.Popen(
            [sys.executable, "-m", "workers.process", str(theirs.fileno()), str(os.getpid())],
            env=environment,
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    return _Child(process, ours, queue.SimpleQueue(), log, [])


def _read(worker: int, child: _Child, inbox: queue.SimpleQueue[tuple[int, Any]]) -> None:
    """Pass on what the child says until it is dead; then close the connection, once nobody uses it any more.

    Closing it from elsewhere could let a thread read or write a new connection that was given the same number.
    """
    writer = threading.Thread(target=_write, args=(child,), daemon=True, name=f"to-worker-{worker}")
    writer.start()
    try:
        while True:
            inbox.put((worker, child.connection.recv()))
    except Exception:  # end of file, or a message cut short by a kill
        child.outbox.put(None)
        writer.join()
        child.connection.close()
        inbox.put((worker, ("lost",)))


def _write(child: _Child) -> None:
    while (message := child.outbox.get()) is not None:
        try:
            child.connection.send_bytes(message)
        except OSError:
            return  # gone; the reader reports it
