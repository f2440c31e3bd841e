"""Errors that both sides raise: the base class of all, and what it says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Action = Literal["run", "resume", "fork", "polish", "watch", "report", "certify", "ask_tell", "install"]


@dataclass(frozen=True)
class WayOut:
    """A remedy for an error: a function of this package and its arguments."""

    action: Action
    """run, resume, fork and ask_tell are functions; watch stands for `open_run`, report for `write_report`, certify for
    `certify_run`, polish for the command, and install for an installation of an extra."""
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


class TaskError(ServiceError):
    """A task does not exist or cannot be used; the message says why."""


class ForkedError(ServiceError, RuntimeError):
    """A process uses what the process from which it was forked has made, such as its workers."""
