"""Run as a program: write to a run and be killed by SIGKILL at a named instant. Each job is a forked child.

python -m tests.es_service.store_killer FOLDER  < lines "job name instant count together"
"""

import math
import os
import signal
import sys
from pathlib import Path

from es_service.store import upkeep as store_upkeep
from es_service.store import writer as store
from es_service.store.writer import RunStore
from tests.es_service.store_examples import OTHER, advance, certified, create, policy

GENERATIONS = 6
EVENTS = ("open", "mkdir", "os.rename", "os.remove", "shutil.copyfile", "sqlite3.connect")


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def killed_at(instant, count):
    """A hook that dies when it is called with this name for the count-th time."""
    seen = []

    def hook(name):
        if name == instant:
            seen.append(name)
            if len(seen) == count:
                die()

    return hook


def die_at_file_operation(count):
    """Die at the count-th file operation of the kinds that make or move files."""
    seen = []

    def hook(event, arguments):
        if event in EVENTS:
            seen.append(event)
            if len(seen) == count:
                die()

    sys.addaudithook(hook)


def main():
    root = Path(sys.argv[1])
    for line in sys.stdin:
        job, name, instant, count, together = line.split()
        child = os.fork()
        if child == 0:
            folder = root / name
            if job == "network":
                store.is_network_filesystem = lambda path: True
            if job in ("hook", "network"):
                store_upkeep.CHECKPOINT_INTERVAL_S = 0.0
                store_upkeep.NETWORK_COPY_INTERVAL_S = 0.0
                store_upkeep.COPY_TIME_FRACTION = math.inf
                with create(folder, hook=killed_at(instant, int(count))) as run:
                    if job == "network":
                        # Pages go to the file before the end of the transaction: its journal must be rolled back.
                        run._connection.execute("PRAGMA cache_size = 1")
                    advance(run, GENERATIONS - 1, together=int(together))
            elif job == "create":
                die_at_file_operation(int(count))
                create(folder).close()
            elif job == "open":
                die_at_file_operation(int(count))
                RunStore.open(folder).close()
            elif job == "certify":
                store_upkeep.CHECKPOINT_INTERVAL_S = 0.0
                with RunStore.open(folder, hook=killed_at(instant, int(count))) as run:
                    run.add_certification(*certified(OTHER, policy(0)))
            os._exit(0)
        _, status = os.waitpid(child, 0)
        print(name, "killed" if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL else status)


if __name__ == "__main__":
    main()
