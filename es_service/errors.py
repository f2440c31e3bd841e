"""The errors of this package. Each has a sentence for the user and, as data, its field, value and ways out.

    try:
        resume("runs/a", ["search.sigma=0.3"])
    except ConfigError as error:
        if (way := error.way_out) and way.run:  # WayOut("fork", ..., run="runs/a", settings={"search.sigma": 0.3})
            fork(way.run, way.settings)

`str(error)` ends with the ways out as Python calls; the command line prints the same ones as shell commands. Every
error can be pickled, for callers that run in the processes of a pool.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import indent
from typing import Any

from es_service.protocol.errors import Action as Action
from es_service.protocol.errors import ForkedError as ForkedError
from es_service.protocol.errors import ServiceError as ServiceError
from es_service.protocol.errors import TaskError as TaskError
from es_service.protocol.errors import WayOut as WayOut


def decimals(value: float, form: str = "z.2f") -> str:
    """A value with two decimals, or in scientific form where these would show nothing of it: -84.78, 1.30e-05."""
    return f"{value:.2e}" if 0.0 < abs(value) < 0.01 else f"{value:{form}}"


def counted(how_many: int, singular: str, plural: str = "") -> str:
    """A number and a noun, such as "1 worker", "3 workers" or, with a plural of its own, "2 policies"."""
    return f"{how_many:,} {singular if how_many == 1 else plural or f'{singular}s'}"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a config."""

    sentence: str
    """A line for the user, which begins with the field, if there is one; frames of the user's code may follow it."""
    field: str | None = None
    """Dotted key of the config."""
    value: Any = None
    allowed: str | None = None
    suggestion: Any = None
    """The name or value that was probably meant."""


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


class DatabaseHeldError(StoreError):
    """Another program, such as a viewer, holds the database of a run."""


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
