"""Records for the standard `logging` module, each with the run and the generation it belongs to.

Every logger is below `es_service`, which is quiet until somebody adds a handler: the command line's `--log-level`, or
`logging.basicConfig` in Python. A record has two attributes besides the standard ones: `run`, the run's id, and
`generation`, the one being computed; "-" where there is none.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

FORMAT = "%(asctime)s %(levelname)s %(name)s run=%(run)s generation=%(generation)s: %(message)s"

_run: ContextVar[str] = ContextVar("run", default="-")
_generation: ContextVar[int | str] = ContextVar("generation", default="-")

logging.getLogger("es_service").addHandler(logging.NullHandler())  # else Python prints warnings that nobody asked for


def _in_context(record: logging.LogRecord) -> bool:
    """Add `run` and `generation` to a record, and keep every record."""
    record.run, record.generation = _run.get(), _generation.get()
    return True


def logger(name: str) -> logging.Logger:
    """The logger of a module of es_service, `logger(__name__)`."""
    module_logger = logging.getLogger(name)
    module_logger.addFilter(_in_context)
    return module_logger


@contextmanager
def in_run(run_id: str) -> Iterator[None]:
    """Records of this thread belong to a run until the block ends."""
    run, generation = _run.set(run_id), _generation.set("-")
    try:
        yield
    finally:
        _run.reset(run)
        _generation.reset(generation)


def in_generation(generation: int) -> None:
    """Records of this thread belong to a generation of the run from now on, until `in_run` ends."""
    _generation.set(generation)
