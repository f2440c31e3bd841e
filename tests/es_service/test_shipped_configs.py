"""The configs that come with the package: they load, and what their comments say of their numbers is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from es_service.config.search import preset_table
from es_service.config.tasks import TASKS
from es_service.config.workload import config_warnings, worker_spec
from es_service.search.algorithms import ALGORITHMS
from tests.es_service.config_examples import load_config
from workers.rollouts import BACKENDS

CONFIGS = Path(__file__).parents[2] / "configs"
ALL = sorted(CONFIGS.rglob("*.yaml"))
COMMENTED = [path for path in ALL if path.parent.name not in ("paper", "certified")]
"""Configs whose comments explain every key."""


def each(paths: list[Path]) -> pytest.MarkDecorator:
    """A test of each; Brax takes seconds to say what its ant is."""
    marked = [pytest.param(path, marks=pytest.mark.slow if path.name.startswith("brax_") else ()) for path in paths]
    return pytest.mark.parametrize("path", marked, ids=[str(path.relative_to(CONFIGS)) for path in paths])


@each(ALL)
def test_shipped_configs_load_and_are_named_after_task_and_algorithm(path):
    config = load_config(path, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS)
    assert path.stem == f"{config.task.environment.replace(':', '_')}_{config.search.algorithm}"
    assert config_warnings(config, TASKS[config.task.environment], BACKENDS) == []


@each(COMMENTED)
def test_shipped_configs_hide_no_preset_key(path):
    """But the size of the population: or `--set search.preset=uber` would do nothing."""
    config = load_config(path, ["search.preset=uber"], tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS)
    constants = config.constants()
    uber = {row.key: row.uber for row in preset_table(ALGORITHMS) if row.method is None and row.key in constants}
    assert len(uber) >= 3
    assert constants.items() >= (uber | {key: constants[key] for key in ("search.pairs",) if key in uber}).items()


@each(COMMENTED)
def test_comments_of_shipped_configs_say_the_numbers_that_are_used(path):
    config = load_config(path, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS)
    spec, compute = worker_spec(config, TASKS[config.task.environment]), config.compute
    said = dict(re.findall(r"^ *(\w+):.*?# (.*)$", path.read_text(), re.MULTILINE))
    inputs, *_, outputs = spec.policy.widths
    assert f" {inputs} observations -> {outputs} actions " in said["policy"]
    assert said["hidden"].endswith(f"; here {spec.policy.parameters:,} parameters")
    assert said["episode_steps"].endswith(f", here {spec.episode_steps:,}")
    assert f"here {list(config.map.cells)}" in said["cells"]
    if config.search.algorithm == "map_elites":  # which has no pairs
        assert said["centres"].endswith(f"auto: {config.search.centres}")
        assert not said.keys() & {"pairs", "chunk_pairs", "rollout_block_pairs", "gradient_block_pairs"}
        return
    centres = getattr(config.search, "emitters", 1)
    assert said.get("centres", f"auto: {centres}").endswith(f"auto: {config.search.centres}")
    assert said["chunk_pairs"].endswith(f"auto: {compute.chunk_pairs} for {config.search.pairs}")
    block = compute.rollout_block_pairs
    assert said["rollout_block_pairs"].endswith((f"auto: here {block}", f"auto: {block} for {compute.chunk_pairs}"))
    block = compute.gradient_block_pairs
    assert said["gradient_block_pairs"].endswith((f"auto: here {block}", f"auto: here all {block}"))
