"""Record evaluation episodes for replays, in a separate process because most rollouts import JAX.

    python -m workers.recording REQUESTS ANSWER

REQUESTS is a file with the pickled (WorkerSpec, [RecordRequest]); the pickled Recordings are written to ANSWER.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.parent import end_soon, write_answer
from es_service.protocol.recordings import Recordings, RecordRequest
from workers.rollouts import BACKENDS
from workers.xla_cache import xla_cache_settings


def record(spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
    """Record the requested episodes with the run's own rollout, so that they have the bits of the run's own."""
    return BACKENDS[spec.rollout].record(spec, requests)


def main(requests: str, file: str) -> None:
    """Answer the requests of a file."""
    os.environ.update(xla_cache_settings())
    spec, wanted = pickle.loads(Path(requests).read_bytes())
    write_answer(file, pickle.dumps(record(spec, wanted)))


if __name__ == "__main__":
    main(*sys.argv[1:])
    end_soon()
