"""The error family. Each error has a sentence for a tired user and, as data, what it knows: field, value, ways out.

    try:
        resume("runs/a", ["search.sigma=0.3"])
    except ConfigError as error:
        way = error.way_out                  # WayOut(action="fork", run="runs/a", settings={"search.sigma": 0.3}, ...)
        fork(way.run, way.settings)

`str(error)` ends with the ways out as Python calls; the command line prints the same ones as shell commands. Every
error survives pickling, for callers that have runs in processes of a pool.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Action = Literal["run", "resume", "fork", "watch", "install"]


@dataclass(frozen=True)
class WayOut:
    """Something to do about an error: one of the functions of `es_service.api`, and its arguments."""

    action: Action
    """run, resume and fork are functions; watch is `open_run`; install is about this package's own extras."""
    purpose: str
    """What it is good for, to be read after "to": "continue it"."""
    run: str | None = None
    """Folder of the run to resume, fork or watch; None where whoever raised the error did not know it."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the config to set, and their values."""
    out: str | None = None
    """With run: the folder of the new run."""
    extra: str | None = None
    """With install: the extra of this package that is needed."""

    def call(self) -> str:
        """The Python call; of an installation, the command, which no call stands for."""
        settings = repr(dict(self.settings)) if self.settings else ""
        match self.action:
            case "install":
                # No package index has es-service itself.
                return f"in a clone of es-service: pip install -c constraints.txt -e '.[{self.extra}]'"
            case "run":
                config = f"load_config(config, {settings})" if settings else "config"
                return f"run({config}, {self.out!r})" if self.out else f"run({config})"
            case "watch":
                return f"open_run({self.run!r})"
        folder = repr(self.run) if self.run else "folder"
        return f"{self.action}({folder}{', ' if settings else ''}{settings})"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a config."""

    sentence: str
    """A line for the user; it begins with the field where there is one."""
    field: str | None = None
    """Dotted key."""
    value: Any = None
    """What was given."""
    allowed: str | None = None
    """What would be right, in words."""
    suggestion: Any = None
    """What was probably meant: a name or a value."""


class ServiceError(Exception):
    """Base of everything this package raises on purpose; the command line prints it without a traceback."""

    def __init__(
        self,
        sentence: str,
        *,
        field: str | None = None,
        value: Any = None,
        allowed: str | None = None,
        suggestion: Any = None,
        run: object = None,
        ways_out: Sequence[WayOut] = (),
    ) -> None:
        """As the attributes; `run` is anything that `str` makes a folder's name of."""
        super().__init__(sentence)
        self.sentence = sentence
        """What is wrong, with the value seen."""
        self.field = field
        """Dotted key of the config, or name of the argument, that is wrong."""
        self.value = value
        """What was given for it."""
        self.allowed = allowed
        """What would be right, in words."""
        self.suggestion = suggestion
        """What was probably meant: a name or a value."""
        self.run = None if run is None else str(run)
        """Folder of the run that this is about."""
        self.ways_out = tuple(ways_out)
        """What can be done, the best first."""

    @property
    def way_out(self) -> WayOut | None:
        """The first of `ways_out`, if there is one."""
        return self.ways_out[0] if self.ways_out else None

    def __str__(self) -> str:
        return "\n".join([self.sentence, *(f"  to {way.purpose}: {way.call()}" for way in self.ways_out)])


class ConfigError(ServiceError, ValueError):
    """A config file, an override or an argument is wrong; lists every problem found (exit code 2)."""

    problems: tuple[Problem, ...] = ()
    """Each problem of a config by itself; the error's own `field` and what belongs to it are those of the first."""

    @classmethod
    def listing(
        cls,
        heading: str,
        problems: Sequence[Problem],
        note: str = "",
        *,
        run: object = None,
        ways_out: Sequence[WayOut] = (),
    ) -> ConfigError:
        """The error that lists problems, at least one, a line each between a heading and a note."""
        lines = [heading, *(f"  {problem.sentence}" for problem in problems), *([note] if note else [])]
        first = problems[0]
        error = cls(
            "\n".join(lines),
            field=first.field,
            value=first.value,
            allowed=first.allowed,
            suggestion=first.suggestion,
            run=run,
            ways_out=ways_out,
        )
        error.problems = tuple(problems)
        return error


class EvaluationError(ServiceError, RuntimeError):
    """Rollouts cannot go on: a chunk that fails everywhere, no live worker, too many invalid members."""


class StoreError(ServiceError, RuntimeError):
    """A run folder cannot be read, written or continued."""


class NotInRunError(ServiceError, LookupError):
    """A run does not have what was asked of it: a map, a cell, an elite (exit code 2)."""


class RunLockedError(StoreError):
    """Another driver is writing to this run."""


class Interrupted(ServiceError):  # noqa: N818 (a request to stop, not a fault)
    """SIGINT or SIGTERM arrived; everything committed is safe. `signal_number` gives the exit code 128 + n."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"interrupted by signal {signal_number}")
        self.args = (signal_number,)
        self.signal_number = signal_number
