"""What of a run's config may change when it goes on, and what a change is called."""

from __future__ import annotations

import re

import pytest

from es_service import api
from es_service.config.changes import changed_constants, refused_changes
from es_service.config.given import shipped_configs
from es_service.config.model import RECYCLING, RunConfig
from es_service.config.text import parse_value
from es_service.errors import ConfigError
from es_service.search.algorithms import ALGORITHMS
from tests.es_service.config_examples import MINIMAL, TASKS, changed_config, left_out, load, load_config
from workers.environments import SHIPPED
from workers.rollouts import BACKENDS


def test_constants_name_what_fixes_the_results():
    constants = load().constants()
    assert constants["search.sigma"] == 0.02
    assert constants["task.options.start"] == "default"
    assert constants["policy.hidden"] == [64, 64]
    assert constants["seed"] == 0
    assert {name for name in constants if name.startswith("compute.")} == {
        "compute.rollout",
        "compute.chunk_pairs",
        "compute.rollout_block_pairs",
        "compute.gradient_block_pairs",
    }
    assert not [name for name in constants if name.startswith("budget.")]


def test_changed_constants_lists_both_values_and_absent_ones():
    old, new = {"a": 1, "b": 2, "c": 3}, {"a": 1, "b": 5, "d": 4}
    assert changed_constants(old, new) == [("b", 2, 5), ("c", 3, "(absent)"), ("d", "(absent)", 4)]


def test_a_key_that_is_younger_than_the_run_counts_as_its_default():
    now = load().constants()
    older = {name: value for name, value in now.items() if name != "novelty.newest"}
    assert changed_constants(older, now) == []
    assert changed_constants(older, load(MINIMAL, "novelty.newest=9").constants()) == [("novelty.newest", None, 9)]


def test_keys_of_another_method_or_of_another_part_go_with_it():
    """A run of another method may have been started with any of them."""
    assert changes("search.algorithm=nsra_es", config=load(MINIMAL, "search.algorithm=ns_es")) == [
        "search.algorithm: ns_es -> nsra_es"
    ]
    ranks = load(MINIMAL, "search.shaping.kind=top_pairs", "search.shaping.count=5")
    assert changes("search.shaping.kind=ranks", config=ranks) == ["search.shaping.kind: top_pairs -> ranks"]


def test_refused_changes_shows_all_and_the_ways_to_make_them():
    changes = [("search.sigma", 0.02, 0.05), ("policy.hidden", [64, 64], [8, 8]), ("task.options.start", "a b", "c d")]
    error = refused_changes("runs/a", changes, ALGORITHMS, besides={"budget.generations": 9})
    assert [(problem.field, problem.suggestion, problem.value) for problem in error.problems] == changes
    assert (error.field, error.value, error.run) == ("search.sigma", 0.05, "runs/a")
    fork, afresh = error.ways_out
    assert (error.way_out, fork.action, fork.run) == (fork, "fork", "runs/a")
    assert fork.settings == {"search.sigma": 0.05, "task.options.start": "c d", "budget.generations": 9}
    assert (afresh.action, afresh.settings) == ("run", {"search.init_from": "runs/a:best"})
    *_, kept, in_python, _ = lines = str(error).splitlines()
    assert {"  search.sigma: 0.02 -> 0.05", "  policy.hidden: [64, 64] -> [8, 8]"} < set(lines)
    assert kept == "a fork cannot change policy.hidden either"
    assert in_python.endswith(f": fork('runs/a', {fork.settings!r})")
    for key in ("search.centres", "search.preset", "map.cells", "task.environment", "task.options.descriptor"):
        assert [way.action for way in refused_changes("runs/a", [(key, "a", "b")], ALGORITHMS).ways_out] == ["run"]


def test_a_target_of_the_fitness_goes_with_its_task():
    source = MINIMAL | {"budget": {"generations": 9, "target_fitness": -26.0, "target_certified": None}}
    other, there = {"tasks": SHIPPED, "algorithms": ALGORITHMS, "rollouts": BACKENDS}, "task.environment=ant_maze"
    assert load_config(source, [there], **other).budget.target_fitness is None
    assert left_out(source, [there], **other) == {"budget.target_fitness": "ant_maze replaces its task"}
    assert load_config(source, [there, "budget.target_fitness=-5"], **other).budget.target_fitness == -5.0
    assert load_config(source, **other).budget.target_fitness == -26.0


def test_another_task_has_its_own_default_options():
    source = MINIMAL | {"task": {"environment": "point_maze", "options": {"start": "corner"}}}
    other = {"tasks": SHIPPED, "algorithms": ALGORITHMS, "rollouts": BACKENDS}
    loaded = load_config(source, ["task.environment=ant_maze"], **other)
    assert (loaded.task.environment, loaded.task.options) == ("ant_maze", {"physics": "spring"})
    assert left_out(source, ["task.environment=ant_maze"], **other) == {
        "task.options.start": "ant_maze replaces its task"
    }
    for same in ([], ["task.environment=point_maze"]):
        assert load_config(source, same, **other).task.options == {"start": "corner"}
        assert left_out(source, same, **other) == {}
    with pytest.raises(ConfigError, match=r"task\.options\.start: unknown option; ant_maze has physics"):
        load_config(source, ["task.environment=ant_maze", "task.options.start=corner"], **other)


@pytest.mark.parametrize(
    "task", ["gymnasium:CartPole-v1", "gymnasium:Pendulum-v1", "point_maze", "function:tests.workers.functions:hill"]
)
def test_any_task_can_replace_that_of_any_shipped_config(task):
    for name in shipped_configs():
        config = api.load_config(name, [f"task.environment={task}"])
        assert {*config.made.left_out.values()} <= {f"{task} replaces its task"}
    config = api.load_config("point_maze_es", ["task.environment=gymnasium:CartPole-v1", "policy.output=categorical"])
    assert (config.policy.action_noise, config.policy.output) == (0.0, "categorical")


def test_what_another_task_forbids_goes_with_its_task_unless_it_is_asked_for():
    source = MINIMAL | {"policy": {"output": "linear", "action_noise": 0.1}, "map": {"cells": [9, 9], "kind": "grid"}}
    source |= {"task": {"environment": "point_maze", "fitness": "final"}}
    there = "task.environment=gymnasium:CartPole-v1"
    gone = ["map.cells", "policy.action_noise", "policy.output", "task.fitness"]
    assert sorted(api.load_config(source, [there]).made.left_out) == gone
    for key, value in {"map.cells": "[9, 9]", "policy.output": "tanh", "task.fitness": "final"}.items():
        with pytest.raises(ConfigError, match=re.escape(f"{key}: ")):
            api.load_config(source, [there, f"{key}={value}"])
    with pytest.raises(ConfigError, match=r"policy\.action_noise: quiet"):
        api.load_config(source | {"policy": {"action_noise": "quiet"}}, [there])


@pytest.mark.parametrize(
    ("changes", "overrides", "wrong"),
    [
        ({"compute": {"worker_memory_mb": 900}}, ["compute.inline_workers=threads"], "compute.worker_memory_mb: 900"),
        ({"policy": {"output": "categorical", "action_noise": 0.1}}, [], "policy.action_noise: 0.1"),
        ({"policy": {"action_noise": 0.1}}, ["policy.output=categorical"], "policy.action_noise: 0.1"),
        ({"map": {"cells": [20, 20]}}, ["map.kind=cvt"], "map.cells: [20, 20]"),
        ({"map": {"cells": [5000, 5000]}}, [], "map.cells: [5000, 5000]"),
        ({"map": {"bounds": "nonsense"}}, [], "map.bounds: nonsense"),
    ],
)
def test_what_is_wrong_with_the_old_task_too_is_reported(changes, overrides, wrong):
    with pytest.raises(ConfigError, match=re.escape(wrong)):
        api.load_config(MINIMAL | changes, ["task.environment=ant_maze", *overrides])


def test_what_a_function_has_no_policy_for_goes_with_the_task_unless_it_is_wrong():
    there = "task.environment=function:tests.workers.functions:hill"
    noise = {"search": {**MINIMAL["search"], "noise": {"kind": "low_rank", "rank": 1}}}
    config = api.load_config(MINIMAL | noise | {"policy": {"hidden": [8]}}, [there])
    assert {"policy.hidden", "search.noise.kind", "search.noise.rank"} <= config.made.left_out.keys()
    for wrong in ({"policy": {"action_noize": 0.1}}, {"policy": {"hidden": "wrong"}}):
        with pytest.raises(ConfigError, match=f"policy.{next(iter(wrong['policy']))}: "):
            api.load_config(MINIMAL | wrong, [there])


def test_bounds_of_a_descriptor_go_with_its_task():
    source = MINIMAL | {"map": {"bounds": [[0.0, 1.0], [0.0, 1.0]]}}
    config = api.load_config(source, ["task.environment=ant_trap"])
    assert (list(config.made.left_out), config.map.bounds) == (["map.bounds"], ((0.0, 30.0), (-8.0, 8.0)))
    assert api.load_config(source, ["task.environment=point_maze"]).map.bounds == ((0.0, 1.0), (0.0, 1.0))


def changed(*overrides: str, config: RunConfig | None = None) -> RunConfig:
    config = config or load()
    stored = parse_value(config.resolved_yaml())
    assert isinstance(stored, dict)
    return changed_config(stored, overrides, given=config.made.given)


def changes(*overrides: str, config: RunConfig | None = None) -> list[str]:
    """Constants that overrides of a run's config would change."""
    old, new = (config or load()).constants(), changed(*overrides, config=config).constants()
    return [f"{name}: {before} -> {after}" for name, before, after in changed_constants(old, new)]


def test_budget_workers_and_limits_are_no_constants():
    limits = ("compute.chunk_timeout_s=5", "compute.max_attempts=1")
    config = changed("budget.generations=9", "compute.workers=2", "store.keep_every=50", *limits)
    assert (config.budget.generations, config.compute.workers, config.compute.max_attempts) == (9, 2, 1)
    assert (config.store.keep_every, load().store.keep_every) == (50, None)
    assert config.constants() == load().constants()


@pytest.mark.parametrize("override", ["search.sigma=2e-2", "compute.chunk_pairs=auto", "task.episode_steps=null"])
def test_saying_what_is_so_changes_nothing(override):
    assert changed(override) == changed()


def test_what_follows_from_a_changed_key_is_resolved_anew():
    assert changes("search.sigma=0.05", "seed=7") == ["search.sigma: 0.02 -> 0.05", "seed: 0 -> 7"]
    assert changes("search.pairs=120") == [
        "search.pairs: 512 -> 120",
        "compute.chunk_pairs: 64 -> 8",
        "compute.rollout_block_pairs: 32 -> 8",
        "compute.gradient_block_pairs: 512 -> 120",
    ]
    assert changes("compute.chunk_pairs=8") == ["compute.chunk_pairs: 64 -> 8", "compute.rollout_block_pairs: 32 -> 8"]
    clipped = ["policy.observation_normalization: True -> False", "policy.observation_clip: 5.0 -> None"]
    assert changes("policy.observation_normalization=false") == clipped
    assert changes("policy.observation_normalization=false", "policy.observation_clip=5") == clipped[:1]
    assert changes("search.algorithm=ns_es") == ["search.algorithm: es -> ns_es", "search.centres: 1 -> 5"]
    shaped = load(MINIMAL, "search.pairs=16", "compute.chunk_pairs=4", "map.qd_offset=3")
    assert changes("search.pairs=16", "task.fitness=sum", config=shaped) == []
    assert changes("task.fitness=final", "map.qd_offset=3", config=shaped) == ["task.fitness: sum -> final"]


def test_what_the_user_gave_remains_where_a_default_would_change():
    shaped = load(MINIMAL, "search.pairs=16", "compute.chunk_pairs=4", "map.qd_offset=3")
    assert changes("task.fitness=final", config=shaped) == ["task.fitness: sum -> final"]
    assert changes("search.pairs=32", config=shaped) == [
        "search.pairs: 16 -> 32",
        "compute.gradient_block_pairs: 16 -> 32",
    ]
    assert changed("search.pairs=32", config=shaped).made.given == shaped.made.given | {"search.pairs": 32}


def test_what_a_change_leaves_as_it_was_has_the_defaults_of_the_version_that_began_the_run():
    """The stored config is that of a version with other defaults: 256 pairs, chunks of 32, 7 evaluation episodes."""
    older = load(MINIMAL, "search.pairs=256", "search.evaluation_episodes=7", "search.sigma=0.5")
    assert older.compute.chunk_pairs == 32
    stored, given = parse_value(older.resolved_yaml()), load().made.given
    assert "search.pairs" not in given
    assert changed_config(stored, given=given) == older
    for override, differs in (
        ("policy.action_noise=0.1", {"policy.action_noise"}),
        ("compute.chunk_pairs=auto", set()),
        ("compute.chunk_pairs=16", {"compute.chunk_pairs", "compute.rollout_block_pairs"}),
        ("compute.worker_resources.gpu=1", set()),
        ("search.pairs=128", {"search.pairs", "compute.chunk_pairs", "compute.rollout_block_pairs"}),
    ):
        new = changed_config(stored, [override], given=given).constants()
        found = {key for key, _, _ in changed_constants(older.constants(), new)}
        assert found - {"compute.gradient_block_pairs"} == differs, override


def test_every_problem_of_a_change_is_told():
    with pytest.raises(ConfigError) as caught:
        changed("search.sigma=abc", "budget.generatons=3")
    assert "search.sigma: abc is not allowed" in str(caught.value)
    assert "did you mean budget.generations?" in str(caught.value)


def test_a_run_outlives_the_run_it_started_from(tmp_path):
    (tmp_path / "old").mkdir()
    stored = parse_value(load(MINIMAL, f"search.init_from={tmp_path / 'old'}").resolved_yaml())
    (tmp_path / "old").rmdir()
    changed = changed_config(stored, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS)
    assert changed.search.init_from == str(tmp_path / "old")
    with pytest.raises(ConfigError, match="old does not exist; must be the folder of another run, with :best"):
        load(stored)


def test_every_key_of_the_science_is_a_constant():
    config = load()
    sections = {name for name, value in config.model_dump().items() if isinstance(value, dict)} - {"budget", "store"}
    assert {name.split(".")[0] for name in config.constants() if "." in name} == sections
    for section in sections - {"compute"}:
        keys = {name.split(".")[1] for name in config.constants() if name.startswith(f"{section}.")}
        of_results = {key for key, value in getattr(config, section).model_dump().items() if value != {}}
        assert keys >= {key for key in of_results if f"{section}.{key}" != RECYCLING}
