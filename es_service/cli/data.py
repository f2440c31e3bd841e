"""What `--json` prints: the content of the tables as data, in which null stands for NaN and infinities."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from es_service.config.given import shipped_configs
from es_service.config.search import preset_table
from es_service.protocol.messages import TaskSpec
from es_service.runs.recent import Recent, read_recent
from es_service.runs.run_status import RunStatus, state
from es_service.search.algorithms import ALGORITHMS
from es_service.store.digest import digest_of


def print_json(value: object) -> None:
    """Print a value as JSON on stdout."""
    print(json.dumps(_finite(value), indent=1, allow_nan=False))


def status_data(status: RunStatus) -> dict[str, Any]:
    """What `status` shows of a run: `newest` is the newest row of its history, `objectives` says what the centres of
    that generation climb, and those of recent ones, or in `problem` why that is not known; `tries` has the mean fitness
    of each policy that did not reach `target_certified` in new episodes."""
    run, row = status.run, status.row
    recent = read_recent(run, row["generation"]) if row else Recent()
    return {
        "run": str(run.folder),
        "run_id": run.run_id,
        "task": run.constants["task.environment"],
        "algorithm": run.constants["search.algorithm"],
        "seed": run.constants["seed"],
        "state": state(status),
        "driver": status.driver,
        "last_end": status.end,
        "limits": status.limits,
        "target_certified": status.target_certified,
        "tries": status.tries,
        "newest": row,
        "objectives": {
            "newest": recent.newest and recent.newest._asdict(),
            "recent": recent.objectives and recent.objectives._asdict(),
            "problem": recent.problem,
        },
    }


def digest_data(parts: Mapping[str, str], *, mixed: bool) -> dict[str, Any]:
    """What `digest` shows of a run."""
    return {"digest": digest_of(parts), "mixed": mixed, "parts": dict(parts)}


def catalogue_data(tasks: Mapping[str, TaskSpec]) -> dict[str, Any]:
    """What `list` shows: the shipped tasks, algorithms, presets and configs."""
    return {
        "tasks": [asdict(task) for task in tasks.values()],
        "algorithms": list(ALGORITHMS),
        "presets": [asdict(row) for row in preset_table(ALGORITHMS)],
        "configs": list(shipped_configs()),
    }


def _finite(value: Any) -> Any:
    """The value with null for each number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
