"""`bench rollouts` measures a task with its options."""

from __future__ import annotations

from typing import Any

from workers.measure import measure


def test_options_that_change_sizes_are_known() -> None:
    options: Any = {"include_cfrc_ext_in_observation": False}
    found = measure("gymnasium:Ant-v5", options, [4], policy=True, batch=2, seconds=0.0, rollout="host")
    assert found["steps_per_second"] > 0
