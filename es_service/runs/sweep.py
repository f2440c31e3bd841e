"""Sweeps: several runs of one config, each in a child process, so that one that fails does not touch the others.

A child runs `es-service run CONFIG --or-resume --out FOLDER`, and `es-service evaluate FOLDER --certify` where a run is
to be certified; then those of the next run, whose workers it has started already, unless one has failed. It is bound to
this process: if the sweep is killed, so are its runs, and the same sweep again resumes each from its last finished
generation.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal, cast

import numpy as np

from es_service.config.given import Overrides, Source
from es_service.config.model import RunConfig
from es_service.config.text import unknown_name
from es_service.errors import ConfigError, ForkedError, Interrupted, RunLockedError, StoreError, counted
from es_service.logs import logger
from es_service.loop.budget import limits_of, only_started, spent
from es_service.loop.history import Row
from es_service.protocol.child import Child, NoAnswerError, require_same_process
from es_service.protocol.machine import given_path
from es_service.protocol.process_environment import same_imports
from es_service.protocol.user_code import RaisedError
from es_service.runs.certified import certified_over_time, target_reached
from es_service.runs.run_status import INSIDE, recent_durations, write_groups
from es_service.runs.session import OnNotice
from es_service.runs.signals import stop_on_signals
from es_service.runs.sweep_plan import Labelled, PlannedRun, ValuesOfKeys, plan
from es_service.runs.tracking import FAILING
from es_service.runs.view import open_run
from es_service.runs.worker_count import shared
from es_service.store.folder import explained, holds_run
from es_service.store.lock import acquire_lock
from es_service.store.reader import read_history_columns, read_newest

# The commands of a run of a sweep, one after another: run it, certify it at some points of cost, and at its end.


COSTS = ("env_steps", "rollout_s", "cpu_s")
"""What a run may cost until it is certified: keys of the budget, which are columns of the history, too."""


@dataclass(frozen=True)
class Certifying:
    """When the runs of a sweep are certified: at their ends, and at some points of cost."""

    at: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """One of COSTS -> values at which runs are certified, too."""

    def next_limits(self, planned: PlannedRun, row: Row | None, *, ended: bool) -> dict[str, float] | None:
        """Limits until which a run goes on before it is certified, by keys of COSTS; none for its end. None: all of its
        certifications are there.

        Args:
            ended: whether its budget is spent.
        """
        done = _certified_costs(planned.folder)
        if ended:
            return None if row is not None and row["env_steps"] in done["env_steps"] else {}
        left = {
            key: [
                at
                for at in values
                if at < (getattr(planned.config.budget, key) or math.inf) and not any(was >= at for was in done[key])
            ]
            for key, values in self.at.items()
        }
        return {key: min(values) for key, values in left.items() if values}


@dataclass
class RunCommands:
    """What a run of a sweep consists of, one command after another."""

    planned: PlannedRun
    run: list[str]
    """Words of `es-service` that start it, or continue it."""
    certify: list[str]
    """Words that certify it."""
    certifying: Certifying | None
    before: list[str] = field(default_factory=list)
    """Words of the process before, so that none is repeated that has changed nothing."""

    def next_words(self) -> list[str]:
        """Words of the next process; none if the run is over and certified."""
        row = newest(self.planned.folder)
        state, _ = end(self.planned.folder, self.planned.config, row)
        if self.certifying is None or state == "stopped":
            return self.run if state == "waiting" else []
        limits = self.certifying.next_limits(self.planned, row, ended=state == "finished")
        if limits is None:  # it has ended before a stop, which goes
            return self.run if self._has_a_stop() else []
        if state == "finished" or (
            row is not None and any(row.get(key, -math.inf) >= at for key, at in limits.items())
        ):
            return self.certify
        whole = {key: math.ceil(at) if key == "env_steps" else at for key, at in limits.items()}  # steps are whole
        return [*self.run, *(f"--set=budget.{key}={at}" for key, at in whole.items())]

    def _has_a_stop(self) -> bool:
        """Whether the run's budget is that of a certification before its end."""
        with suppress(StoreError, ConfigError):
            budget = open_run(self.planned.folder).present_config["budget"]
            return any(budget.get(key) != getattr(self.planned.config.budget, key) for key in COSTS)
        return False


def command_of(
    run: PlannedRun,
    workers: int | Literal["auto"],
    inside: Path,
    options: Sequence[str],
    certifying: Certifying | None,
) -> RunCommands:
    """The commands of a run. Its config is written now, so that an edited file does not reach runs that start later."""
    file = inside / f"{run.name}.yaml"
    try:
        file.write_text(run.config.given_yaml({"compute.workers": workers}))
    except OSError as error:
        raise explained(error, inside, f"writing {file.name}", "start the sweep again") from error
    share = [] if workers == "auto" else ["--workers", str(workers)]
    return RunCommands(
        run,
        ["run", str(file), "--or-resume", "--out", str(run.folder), *options],
        ["evaluate", str(run.folder), "--certify", *share],
        certifying,
    )


def _certified_costs(folder: Path) -> dict[str, list[float]]:
    """One of COSTS -> what a run had cost when it was certified, each time; nothing if this cannot be read, which its
    own process tells."""
    done: dict[str, list[float]] = {key: [] for key in COSTS}
    with suppress(StoreError):
        steps = [row["env_steps"] for row in certified_over_time(folder)] if holds_run(folder) else []
        if steps := [at for at in steps if at is not None]:
            history = read_history_columns(folder)
            is_certified_G = np.isin(history["env_steps"], steps)
            done |= {key: np.asarray(history[key], float)[is_certified_G].tolist() for key in COSTS if key in history}
    return done


def end(folder: Path, config: RunConfig, row: Row | None) -> tuple[Literal["waiting", "finished", "stopped"], str]:
    """Whether a run that no process computes is over, and why; it is "waiting" if it is not, or if it cannot be read,
    which its own process tells, and "stopped" if starting took all of its time."""
    if row is None:
        return "waiting", ""
    with suppress(StoreError):
        if reached := target_reached(folder, config.budget.target_certified, config.task.fitness):
            return "finished", reached
    limits = limits_of(config.budget)
    reason = next(iter(spent(limits, row, recent_durations(folder, limits, row)).values()), "")
    return ("stopped" if only_started(limits, row) else "finished" if reason else "waiting"), reason


def newest(folder: Path) -> Row | None:
    """Newest history row of a run; None if there is none, or if the run cannot be read, which its own process tells."""
    try:
        return read_newest(folder) if holds_run(folder) else None
    except StoreError:
        return None


_LOG = logger(__name__)
COMMANDS = "es_service.cli.in_turn"
POLL_S = 0.1
ROWS_S = 1.0
"""Seconds between two readings of the newest generation of each run."""
LEAVE_S = 20.0
"""Longest time in seconds in which a process with nothing left to do may end by itself; leaving Ray takes a few."""
LAST_WORDS_BYTES = 4000
"""At most this many bytes of what a failed run printed are searched for its error."""


@dataclass(frozen=True)
class SweptRun:
    name: str
    """Its settings in the sweep, such as "sigma=0.05_seed=0"."""
    folder: Path
    limits: Mapping[str, float]
    """Limits of its budget, by key."""
    state: Literal["waiting", "running", "finished", "failed", "stopped"]
    row: Row | None
    """History row of the newest generation; None before the first."""
    reason: str = ""
    """Why it has finished or failed, or stopped because starting took all of its time."""


OnProgress = Callable[[Sequence[SweptRun]], None]
"""Called with all runs of a sweep, in their order, when a run starts or ends and about once a second."""


def sweep(
    config: Source | Sequence[Labelled],
    out: str | os.PathLike[str],
    *,
    grid: ValuesOfKeys = MappingProxyType({}),
    seeds: Iterable[int] | None = None,
    overrides: Overrides = (),
    parallel: int | None = None,
    certify: bool = False,
    certify_at: Iterable[float] | Mapping[str, Iterable[float]] = (),
    on_progress: OnProgress = lambda runs: None,
) -> list[SweptRun]:
    """Run a config with every combination of some settings and every seed; each run has a folder in `out`.

    The same call continues after any interruption: finished runs are left alone, interrupted and failed ones are
    resumed. A run that fails does not stop the others.

    Args:
        config: a YAML file, the name of a shipped config, or a mapping with the content of one; or a list of
            `Labelled(label, config)`, each of which is a group with its own settings.
        out: folder of the sweep, which is created with its parents.
        grid: key of the config -> its values, such as {"search.sigma": [0.05, 0.1]}.
        seeds: such as range(5); None: the seed of the config.
        overrides: settings of all runs, as in `load_config`.
        parallel: number of runs at a time, which share the cores of the machine or the cluster unless
            `compute.workers` is a number; None: as many as there are cores, or one if they use GPUs.
        certify: whether each run is certified at its end, by `certify_run`.
        certify_at: numbers of environment steps at which runs are certified, too: after the generation that reaches
            them. Or a mapping from "env_steps", "rollout_s" or "cpu_s", as a budget has them, to such numbers. Given
            any, runs are also certified at their ends.

    Returns:
        The runs, for example for `write_comparison`: each "finished", "failed", or "stopped" since starting took all of
            its `budget.wall_clock_s`.

    Raises:
        ConfigError: a config, the grid or the seeds are wrong, or a folder holds a run with other settings. StoreError:
            the folder cannot be used, or another sweep is running in it. EvaluationError: the cluster cannot be
            reached. Interrupted: SIGINT or SIGTERM arrived; all runs were stopped as single ones are.
    """
    folder = given_path(out)
    is_named = isinstance(certify_at, Mapping)
    given = cast("Mapping[str, Iterable[float]]", certify_at if is_named else {"env_steps": certify_at})
    if unknown := [key for key in given if key not in COSTS]:
        raise unknown_name("cost", unknown[0], COSTS, "certify_at")
    points = {key: values for key, of in given.items() if (values := tuple(of))}
    certifying = Certifying(points) if certify or points else None
    return run_planned(
        plan(config, folder, grid, seeds, overrides), folder, parallel, on_progress, certifying=certifying
    )


def run_planned(
    planned: Sequence[PlannedRun],
    out: Path,
    parallel: int | None = None,
    on_progress: OnProgress = lambda runs: None,
    on_notice: OnNotice = _LOG.info,
    options: Sequence[str] = (),
    certifying: Certifying | None = None,
) -> list[SweptRun]:
    """Run what `plan` has returned for the folder `out`; otherwise as `sweep`.

    Args:
        on_notice: called with a sentence on how the cores are shared, and what a run says of a tracker that failed.
        options: further options of `es-service run` for each run.
        certifying: when runs are certified; None: never.
    """
    with _locked(out) as inside, stop_on_signals() as should_stop:
        try:
            write_groups(inside, {run.name: run.group for run in planned})
        except OSError as error:
            raise explained(error, inside, "writing the groups", "start the sweep again") from error
        runs = {run.name: _at_first(run, certifying) for run in planned}
        left = [run for run in planned if runs[run.name].state == "waiting"]
        shares = shared([run.config for run in left], parallel)  # a few that are left have more cores each
        waiting = deque(
            command_of(run, workers, inside, options, certifying)
            for run, workers in zip(left, shares.workers, strict=True)
        )
        if left:
            todo = f"{len(left)} of {counted(len(runs), 'run')} to do in {out}, {shares.at_once} at a time"
            on_notice(f"{todo}; workers of each: {' or '.join(dict.fromkeys(map(str, shares.workers)))}")
        running: dict[str, _Running] = {}
        idle: list[Child] = []
        shown, read_s, maker = None, float("-inf"), os.getpid()
        try:
            while shown is None or waiting or running:
                require_same_process(maker, "a sweep", "end this one: the sweep goes on in the other")
                if (number := should_stop()) is not None:
                    raise Interrupted(number)
                for name in [name for name, of in running.items() if of.has_ended()]:
                    of = running.pop(name)
                    runs[name] = _ended(runs[name], of)
                    for said in _said_of_trackers(of):
                        on_notice(f"{name}: {said}")
                    idle += [] if of.code else [of.process]  # what has failed may have left something behind
                    if runs[name].state == "waiting":
                        _start(of.command, inside, runs, running, idle)
                while waiting and len(running) < shares.at_once:
                    _start(waiting.popleft(), inside, runs, running, idle)
                while idle:
                    idle.pop().end(LEAVE_S)  # by itself, so that it closes what it has read, and ends its Ray
                if time.monotonic() - read_s > ROWS_S:
                    read_s = time.monotonic()
                    runs |= {name: replace(runs[name], row=newest(runs[name].folder)) for name in running}
                if (now := list(runs.values())) != shown:
                    on_progress(shown := now)
                if running:
                    time.sleep(POLL_S)
        except ForkedError:
            raise  # the runs go on
        except BaseException:
            _stop(runs, running)
            with suppress(Exception):
                on_progress(list(runs.values()))
            raise
        finally:
            for process in (*idle, *(of.process for of in running.values())):
                process.end(LEAVE_S)
    return list(runs.values())


@dataclass(eq=False)
class _Running:
    """A run whose command a process runs."""

    command: RunCommands
    process: Child
    log: Path
    """What its commands print, one after another."""
    begin: int
    """Where in the log the output of this command begins."""
    due: int
    """Answers that its process has not given."""
    code: int = 0
    """Exit code of the command; 1 if its process has ended."""
    how: str = ""
    """How it has failed, in words."""

    def has_ended(self) -> bool:
        while self.due and self.process.is_answered:
            self.due -= 1
            try:
                self.code = self.process.answer() or 0
                self.how = f"it ended with exit code {self.code}"
            except (NoAnswerError, RaisedError) as error:
                self.due, self.code, self.how = 0, 1, f"it {error}" if isinstance(error, NoAnswerError) else str(error)
        return not self.due


def _start(
    command: RunCommands, inside: Path, runs: dict[str, SweptRun], running: dict[str, _Running], idle: list[Child]
) -> None:
    """Start the next command of a run, in a process that has ended another one, or a new one; the run has failed if
    that is impossible."""
    name, words = command.planned.name, command.next_words() or command.run
    command.before, log, is_new = words, inside / f"{name}.log", not idle
    try:
        with log.open("ab") as file:
            begin = file.tell()
        process = Child(COMMANDS, os.environ | same_imports()) if is_new else idle.pop()
    except OSError as error:
        runs[name] = replace(runs[name], state="failed", reason=f"its process cannot be started: {error}")
        return
    if is_new:
        process.ask("es-service")
    process.ask(words, str(log))
    running[name] = _Running(command, process, log, begin, 1 + is_new)
    runs[name] = replace(runs[name], state="running")


def _stop(runs: dict[str, SweptRun], running: Mapping[str, _Running]) -> None:
    """Ask all processes to end as Ctrl-C would, and wait for them. A second signal to this process ends it at once, and
    with it all that are bound to it."""
    for of in running.values():
        of.process.terminate()
    for name, of in running.items():
        while not of.has_ended():
            time.sleep(POLL_S)
        ended = _ended(runs[name], of)
        runs[name] = ended if ended.state == "finished" else replace(ended, state="stopped", reason="")


def _ended(run: SweptRun, of: _Running) -> SweptRun:
    """A run after its command has ended; "waiting" if another one follows."""
    row = newest(run.folder)
    if not of.code:
        state, reason = end(run.folder, of.command.planned.config, row)
        if of.command.next_words() not in ([], of.command.before):
            return replace(run, state="waiting", row=row)
        return replace(run, state="finished" if state == "waiting" else state, row=row, reason=reason)
    lines = _last_lines(of)
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    last = f"{of.how}; its last line is: {lines[-1]}" if lines else of.how
    why = errors[-1] if errors else last
    return replace(run, state="failed", row=row, reason=f"{why} (all that it printed is in {of.log})")


def _last_lines(of: _Running) -> list[str]:
    """The last lines that the command of a run has printed."""
    try:
        with of.log.open("rb") as log:
            log.seek(max(of.begin, log.seek(0, os.SEEK_END) - LAST_WORDS_BYTES))
            return log.read(LAST_WORDS_BYTES).decode(errors="replace").strip().splitlines()
    except OSError:
        return []


def _said_of_trackers(of: _Running) -> list[str]:
    """What the command of a run has said of trackers that failed, which nobody reads in its log."""
    return [line.removeprefix("note: ") for line in _last_lines(of) if line.startswith(f"note: {FAILING}")]


def _at_first(planned: PlannedRun, certifying: Certifying | None) -> SweptRun:
    """A run that the sweep has not started: finished, if its budget was spent or its target reached before, and if it
    is certified where it is to be."""
    row = newest(planned.folder)
    state, reason = end(planned.folder, planned.config, row)
    if state == "finished" and certifying and certifying.next_limits(planned, row, ended=True) is not None:
        state, reason = "waiting", ""
    return SweptRun(planned.name, planned.folder, limits_of(planned.config.budget), state, row, reason)


@contextmanager
def _locked(out: Path) -> Iterator[Path]:
    """The folder `.sweep` of a sweep, in which no other process runs a sweep meanwhile."""
    inside = out / INSIDE
    try:
        inside.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"cannot create {inside}: {error.strerror}; choose another folder", run=out) from error
    try:
        lock = acquire_lock(inside)
    except RunLockedError as error:
        raise StoreError(f"another sweep is running in {out}: {error.sentence}", run=out) from None
    try:
        yield inside
    finally:
        lock.release()
