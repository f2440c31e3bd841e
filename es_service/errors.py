"""The errors of this package. Each has a sentence for the user and, as data, its field, value and ways out.

    try:
        resume("runs/a", ["search.sigma=0.3"])
    except ConfigError as error:
        way = error.way_out                  # WayOut(action="fork", run="runs/a", settings={"search.sigma": 0.3}, ...)
        fork(way.run, way.settings)

`str(error)` ends with the ways out as Python calls; the command line prints the same ones as shell commands. Every
error can be pickled, for callers that run in the processes of a pool.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import indent
from typing import Any, Literal

Action = Literal["run", "resume", "fork", "watch", "report", "certify", "ask_tell", "install"]


def counted(how_many: int, singular: str, plural: str = "") -> str:
    """A number and a noun, such as "1 worker", "3 workers" or, with a plural of its own, "2 policies"."""
    return f"{how_many:,} {singular if how_many == 1 else plural or f'{singular}s'}"


@dataclass(frozen=True)
class WayOut:
    """A remedy for an error: a function of this package and its arguments."""

    action: Action
    """run, resume, fork and ask_tell are functions; watch stands for `open_run`, report for `write_report`, certify for
    `certify_run`, and install for an installation of an extra."""
    purpose: str
    """What it achieves, as words that follow "to", such as "continue it"."""
    run: str | None = None
    """Folder of the run that it is about; None if it is not known where the error is raised."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the config to set, and their values."""
    config: str | None = None
    """For the action run: file or name of the config; None if it is not known where the error is raised."""
    generation: int | None = None
    """For the action fork: the generation whose state it continues from; None: the newest."""
    out: str | None = None
    """Folder of the new run, for the actions run and fork; file to write, for report."""
    extra: str | None = None
    """Extra of this package that is needed, for the action install."""

    def call(self) -> str:
        """The Python call as text; for an installation, the shell command."""
        settings = repr(dict(self.settings)) if self.settings else ""
        match self.action:
            case "install":
                # es-service is on no package index, so a clone is needed.
                return f"in a clone of es-service: pip install -c constraints.txt -e '.[{self.extra}]'"
            case "run":
                config = repr(self.config) if self.config else "config"
                config = f"load_config({config}, {settings})" if settings else config
                return f"run({config}, {self.out!r})" if self.out else f"run({config})"
            case "ask_tell":
                return f"ask_tell(config, {self.run!r})"
            case "watch":
                return f"open_run({self.run!r})"
            case "report":
                return f"write_report({self.run!r}, {self.out!r})"
            case "certify":
                return f"certify_run({self.run!r})"
        options = {"generation": self.generation, "out": self.out}
        named = [f"{name}={value!r}" for name, value in options.items() if value is not None]
        words = [repr(self.run) if self.run else "folder", *([settings] if settings else []), *named]
        return f"{self.action}({', '.join(words)})"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a config."""

    sentence: str
    """A line for the user, which begins with the field, if there is one; frames of the user's code may follow it."""
    field: str | None = None
    """Dotted key of the config."""
    value: Any = None
    """The value given."""
    allowed: str | None = None
    """The allowed values, in words."""
    suggestion: Any = None
    """The name or value that was probably meant."""


class ServiceError(Exception):
    """Base class of all errors that this package raises; the command line prints them without a traceback. A request to
    stop is none: see `Interrupted`."""

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
        """See the attributes; `run` is converted with `str`."""
        super().__init__(sentence)
        self.sentence = sentence
        """What is wrong, with the value seen."""
        self.field = field
        """Dotted key of the config, or name of the argument, that is wrong."""
        self.value = value
        """The value given for it."""
        self.allowed = allowed
        """The allowed values, in words."""
        self.suggestion = suggestion
        """The name or value that was probably meant."""
        self.run = None if run is None else str(run)
        """Folder of the run that the error is about."""
        self.ways_out = tuple(ways_out)
        """Remedies, the best first."""

    @property
    def way_out(self) -> WayOut | None:
        """The first of `ways_out`, if there is one."""
        return self.ways_out[0] if self.ways_out else None

    def __str__(self) -> str:
        return "\n".join([self.sentence, *(f"  to {way.purpose}: {way.call()}" for way in self.ways_out)])


class ConfigError(ServiceError, ValueError):
    """A config file, an override or an argument is wrong; lists every problem found (exit code 2)."""

    problems: tuple[Problem, ...] = ()
    """The problems of a config; `field`, `value`, `allowed` and `suggestion` of the error are those of the first."""

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
        """An error that lists one or more problems, each on a line, between a heading and a note."""
        lines = [heading, *(indent(problem.sentence, "  ") for problem in problems), *([note] if note else [])]
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
    """Rollouts cannot continue: a chunk failed in every attempt, no worker is live, or too many members are invalid."""


class StartError(EvaluationError):
    """The workers of a session cannot be started at all, for example because no cluster is at the address given."""


class StoreError(ServiceError, RuntimeError):
    """A run folder cannot be read, written or continued."""


class NotInRunError(ServiceError, LookupError):
    """A run does not have what was requested, such as a map, a cell or an elite (exit code 2)."""


class RunLockedError(StoreError):
    """Another driver is writing to this run."""


class Interrupted(KeyboardInterrupt):
    """SIGINT or SIGTERM arrived; everything committed is safe. `signal_number` gives the exit code 128 + n.

    It is no ServiceError and no Exception, so that what goes on after an error, such as a study of Optuna or a loop
    with `except Exception`, ends as it does with Ctrl-C at any other moment.
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal_number)
        self.signal_number = signal_number

    def __str__(self) -> str:
        return f"interrupted by {signal.Signals(self.signal_number).name}"
