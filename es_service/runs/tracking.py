"""Sending the history of a run to trackers while it runs.

Each tracker has a thread, which reads committed rows from the store and sends those that the tracker does not have. So
the driver never waits for a tracker, and a tracker that stopped in the middle gets what it lacks in the next session.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from es_service.loop.history import Row
from es_service.runs.session import OnNotice
from es_service.runs.trackers import Tracker, check_trackers, fill, open_tracker
from es_service.runs.view import Run, open_run

PAUSE_S = 1.0
"""Seconds between two readings of the history, so that a fast run is read in larger pieces."""
FINISH_S = 30.0
"""Longest wait for a tracker at the end of a session."""
_LATER = "the run does not need it, and the next session that uses this tracker sends what it lacks"

Open = Callable[[str, Run], Tracker]


@contextmanager
def tracked(
    folder: str | os.PathLike[str], names: Sequence[str], on_notice: OnNotice, opened: Open = open_tracker
) -> Iterator[Callable[[Row], None]]:
    """Context manager around a session of a run, which sends its history to trackers.

    A tracker that fails, or is too slow at the end, costs a notice and never the run.

    Args:
        folder: folder of the run, which need not exist yet.
        names: keys of `trackers.PACKAGES`.
        on_notice: called with a notice, from another thread.
        opened: opens a tracker by its name.

    Yields:
        what is to be called after each committed generation.

    Raises:
        ConfigError: a tracker is unknown, or its package is not installed.
    """
    check_trackers(names)
    ended = threading.Event()

    def thread(name: str) -> threading.Thread:
        work = (folder, name, opened, ended, on_notice)
        return threading.Thread(target=_follow, args=work, name=f"tracker {name}", daemon=True)

    threads = {name: thread(name) for name in names}

    def begin(_: Row | None = None) -> None:
        for tracker_thread in threads.values():
            if tracker_thread.ident is None:
                tracker_thread.start()

    try:
        yield begin
        begin()  # a session without a generation: a tracker may lack rows of earlier ones
    finally:
        ended.set()
        for name, tracker_thread in threads.items():
            if tracker_thread.ident is not None:  # else no generation was run, and the folder may hold another run
                tracker_thread.join(FINISH_S)
            if tracker_thread.is_alive():
                on_notice(f"the tracker {name} did not finish within {FINISH_S:g} s; {_LATER}")


def _follow(
    folder: str | os.PathLike[str], name: str, opened: Open, ended: threading.Event, on_notice: OnNotice
) -> None:
    """The work of a tracker's thread."""
    try:
        run = open_run(folder)
        tracker = opened(name, run)
        newest = tracker.newest()
        while True:
            last = ended.is_set()  # read before the history, so that its last row is not missed
            newest = fill(tracker, run, newest)
            if last:
                break
            ended.wait(PAUSE_S)
        tracker.close()
    except Exception as error:  # whatever a tracker raises must not end the run
        reason = str(error).partition("\n")[0]
        on_notice(f"the tracker {name} failed ({type(error).__name__}: {reason}); {_LATER}")
