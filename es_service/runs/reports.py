"""What becomes of the reports of workers: what they print, and why they are replaced by new processes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from es_service.logs import logger
from es_service.protocol.messages import Report
from es_service.store.lock import MOST_LINE, MOST_LINES, RunLock

_LOG = logger(__name__)
NOTED_S = 1.0
"""Least time in seconds between two changes of what `status` reads."""


def reader_of_reports(
    on_notice: Callable[[str], None], on_output: Callable[[str], None], lock: RunLock | None = None
) -> Callable[[str, Report], None]:
    """Function of a worker's name and a report of it.

    Args:
        on_notice: called with a sentence when a worker is replaced for the first time.
        on_output: called with each line that a worker has printed.
        lock: gets the newest lines, for `status`; None: nobody else reads them.
    """
    newest: deque[str] = deque(maxlen=MOST_LINES)
    noted_s, replaced = 0.0, 0

    def read(worker: str, report: Report) -> None:
        nonlocal noted_s, replaced
        for line in report.printed.splitlines():
            newest.append(f"{worker}: {line}"[:MOST_LINE])
            on_output(f"{worker}: {line}")
        if report.printed and lock is not None:
            is_due = (now_s := time.monotonic()) >= noted_s + NOTED_S
            lock.note_output(newest, write=is_due)
            noted_s = now_s if is_due else noted_s
        if report.spent:
            sentence = f"{worker} is replaced by a new process, since {report.spent}"
            _LOG.info(sentence)
            replaced += 1
            if replaced == 1:
                on_notice(f"{sentence}. Later replacements are in the log (--log-level info)")

    return read
