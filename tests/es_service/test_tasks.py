"""Tasks by name, where the name is asked of another process."""

from __future__ import annotations

import pytest

from es_service.cli.bench_rollouts import bench_rollouts
from es_service.config.tasks import TASKS
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import ConfigError
from es_service.protocol.messages import TrainingChunk, around
from tests.helpers import SPEC, centre, random_parameters


def test_a_current_folder_with_modules_of_our_names_is_nobody_s_business(tmp_path, monkeypatch):
    """Neither where a task is described, nor where rollouts are measured, nor where they are run."""
    for name in ("workers", "es_service", "jax"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="pathlib:Path has no observation_size"):
        TASKS["pathlib:Path"]
    row = next(bench_rollouts(["point_maze"], policies=[False], rollouts=["xla"], batches=[8], seconds=0.0))
    assert row["batch"] == 8
    with inline_engine(SPEC, Limits(1, max_start_failures=1)) as engine:
        assert len(engine.evaluate(around(centre(random_parameters()), [TrainingChunk(1, 0)]))) == 1
