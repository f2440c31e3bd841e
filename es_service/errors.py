"""The error family. Each one carries a message for a tired user: what is wrong, the value seen, the way out.

Every error survives pickling, for callers that have runs in processes of a pool.
"""


class ServiceError(Exception):
    """Base of everything this package raises on purpose; the command line prints it without a traceback."""


class ConfigError(ServiceError, ValueError):
    """A config file, an override or a command-line value is wrong; lists every problem found (exit code 2)."""


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
        super().__init__(signal_number)
        self.signal_number = signal_number
