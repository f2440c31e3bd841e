"""Record evaluation episodes for replays, in a separate process because most rollouts import JAX.

python -m workers.recording DESCRIPTOR     # run by `es_service.protocol.child`
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

from es_service.protocol.child import answer_parent
from es_service.protocol.messages import WorkerSpec
from es_service.protocol.recordings import Recordings, RecordRequest
from workers.rollouts import BACKENDS
from workers.xla_cache import xla_cache_settings


def recorder(name: str, spec: WorkerSpec) -> Callable[[Sequence[RecordRequest]], Recordings]:
    """Function that records episodes with the run's own rollout, so that they have the bits of the run's own.

    Args:
        name: that of the task.
    """
    os.environ.update(xla_cache_settings())
    return lambda requests: BACKENDS[spec.rollout].record(spec, requests)


if __name__ == "__main__":
    answer_parent(int(sys.argv[1]), recorder)
