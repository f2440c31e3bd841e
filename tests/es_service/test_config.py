"""Configs load, resolve to one value per key, and survive the way through the run folder."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from es_service.cli.main import app
from es_service.config.changes import changed_constants
from es_service.config.keys import FIELDS, all_search_fields
from es_service.config.resolution import default_chunk_pairs, default_gradient_block_pairs, default_rollout_block_pairs
from es_service.config.search import PRESETS, preset_rows, preset_table
from es_service.config.text import dump_yaml, parse_value
from es_service.config.values import described_keys
from es_service.config.workload import config_warnings, worker_spec
from es_service.errors import ConfigError
from es_service.search.algorithms import ALGORITHMS, OURS
from tests.es_service.config_examples import MINIMAL, MINIMAL_TEXT, POINT_MAZE, WORDS, changed_config, load, load_config
from workers.rollouts import BACKENDS
from workers.rollouts.simd import Simd

# What a config resolves to


def test_minimal_config_resolves_every_value():
    config = load()
    assert config.task.episode_steps == 200
    assert config.task.options == {"start": "default"}
    assert config.policy.hidden == (64, 64)
    assert (config.policy.init, config.policy.observation_clip) == ("unit_columns", 5.0)
    assert (config.search.pairs, config.search.common_random_numbers) == (512, True)
    assert (config.search.sigma, config.search.step.learning_rate, config.search.step.l2) == (0.02, 0.01, 0.005)
    assert (config.compute.rollout, config.compute.workers, config.compute.engine) == ("simd", "auto", "inline")
    assert (config.compute.chunk_pairs, config.compute.rollout_block_pairs) == (64, 32)
    assert config.compute.gradient_block_pairs == 512
    assert config.seed == 0


def test_uber_preset_and_explicit_keys_over_it():
    config = load(MINIMAL, "search.preset=uber")
    assert (config.search.pairs, config.search.common_random_numbers) == (5000, False)
    assert (config.policy.init, config.policy.observation_clip) == ("small_columns", None)
    assert (config.compute.chunk_pairs, config.compute.gradient_block_pairs) == (40, 920)
    config = load(MINIMAL, "search.preset=uber", "search.pairs=64", "policy.observation_clip=10")
    assert (config.search.pairs, config.policy.observation_clip) == (64, 10.0)
    assert load(MINIMAL, "policy.observation_clip=null").policy.observation_clip is None


def test_preset_clips_only_normalised_observations():
    assert load(MINIMAL, "policy.observation_normalization=false").policy.observation_clip is None
    both = load(MINIMAL, "policy.observation_normalization=false", "policy.observation_clip=2")
    assert both.policy.observation_clip == 2.0


def test_preset_table_has_a_source_for_every_row_and_differs_in_each():
    table = preset_table(ALGORITHMS)
    for row in table:
        assert row.literature != row.uber or row.method in ALGORITHMS
        assert "literature:" in row.source
        assert "uber:" in row.source
    for preset in PRESETS:
        for name, method in OURS.items():
            rows = {row.key: getattr(row, preset) for row in table if row.method in (None, name)}
            values = {row.key: getattr(row, preset) for row in preset_rows(method.settings)}
            assert values == {key: rows[key] for key in values}
            assert {row.key for row in table if row.method == name} <= values.keys()
        assert load(MINIMAL, f"search.preset={preset}").search.preset == preset


@pytest.mark.parametrize(
    ("pairs", "chunk"),
    [(5000, 40), (512, 64), (256, 32), (7, 7), (127, 1), (1, 1), (64, 16), (62, 2), (496, 16), (130, 13)],
)
def test_default_chunk_pairs(pairs, chunk):
    assert default_chunk_pairs(pairs) == chunk


@given(st.integers(1, 100_000))
def test_default_shapes_fit_together(pairs):
    chunk = default_chunk_pairs(pairs)
    rollout, gradient = default_rollout_block_pairs(chunk, 4482), default_gradient_block_pairs(pairs, chunk, 4482)
    assert pairs % chunk == 0
    assert chunk % rollout == 0
    assert chunk <= 64
    assert rollout <= 32
    assert gradient % chunk == 0
    assert gradient <= pairs
    assert -(-pairs // gradient) <= 32


@pytest.mark.parametrize(
    ("chunk", "parameters", "block"), [(64, 4482, 32), (40, 75_528, 8), (40, 4482, 20), (7, 10**9, 1)]
)
def test_default_rollout_block_pairs(chunk, parameters, block):
    """Thirty-two pairs at most, and no more than five megabytes of weights."""
    assert default_rollout_block_pairs(chunk, parameters) == block


def test_awkward_populations_load_with_a_warning():
    assert config_warnings(load(), POINT_MAZE, BACKENDS) == []
    (warning,) = config_warnings(load(MINIMAL, "search.pairs=127"), POINT_MAZE, BACKENDS)
    assert warning.startswith("compute.chunk_pairs: 1 makes 127 small chunks")
    assert "search.pairs = 128" in warning
    (warning,) = config_warnings(load(MINIMAL, "compute.chunk_pairs=4"), POINT_MAZE, BACKENDS)
    assert "auto would choose 64" in warning
    endless = load(MINIMAL, "budget.generations=null", "budget.target_fitness=-25")
    (warning,) = config_warnings(endless, POINT_MAZE, BACKENDS)
    assert "target_fitness (-25.0)" in warning


def test_auto_chooses_simd_by_this_machine_unless_a_cluster_runs_the_workers():
    class OnAnOldProcessor(Simd):
        def why_not_here(self):
            return why

    why, rollouts = "the processor (i486) has no AVX2", BACKENDS | {"simd": OnAnOldProcessor()}
    of = {"tasks": {"point_maze": POINT_MAZE}, "algorithms": ALGORITHMS, "rollouts": rollouts}
    here = load_config(MINIMAL, **of)
    assert here.compute.rollout == "xla"
    (warning,) = config_warnings(here, POINT_MAZE, rollouts)
    assert warning == f"compute.rollout: xla is used because simd cannot run point_maze: {why}"
    there = load_config(MINIMAL, {"compute.address": "auto", "compute.engine": "ray"}, **of)
    assert (there.compute.rollout, config_warnings(there, POINT_MAZE, rollouts)) == ("simd", [])


def test_the_engine_is_ray_where_something_needs_it():
    assert load().compute.engine == "inline"
    for needs in ("compute.address=auto", "compute.worker_resources.cpu=4"):
        assert load(MINIMAL, needs).compute.engine == "ray", needs
    assert load(MINIMAL, "compute.worker_resources.gpu=1").compute.engine == "inline"
    with pytest.raises(ConfigError, match=r"compute.address: auto needs compute.engine = ray"):
        load(MINIMAL, "compute.address=auto", "compute.engine=inline")


def test_workers_are_whole_actors():
    assert load(MINIMAL, "compute.worker_resources.cpu=4", "compute.workers=8").compute.workers == 8
    with pytest.raises(ConfigError, match=r"workers: 6 is not a multiple of compute.worker_resources.cpu \(4\)"):
        load(MINIMAL, "compute.worker_resources.cpu=4", "compute.workers=6")


def test_on_a_gpu_all_pairs_step_together_as_far_as_their_weights_fit():
    wide = MINIMAL | {"policy": {"hidden": [256, 256]}}
    for pairs, chunk in ((64, 64), (4096, 4096), (6000, 3000)):
        sizes = load(wide, f"search.pairs={pairs}", "compute.worker_resources.gpu=1").compute
        assert (sizes.chunk_pairs, sizes.rollout_block_pairs) == (chunk, chunk)
    assert default_rollout_block_pairs(4096, 1_000_000, gpu=True) == 1024, "8 bytes of 1,000,000 weights in 8 GiB"


def test_simd_is_what_auto_chooses_where_it_can_be_had():
    assert load().compute.rollout == "simd"
    assert load(MINIMAL, "compute.worker_resources.gpu=1").compute.rollout == "simd"
    elites = load(MINIMAL | {"search": {"algorithm": "map_elites"}}, "compute.worker_resources.gpu=1")
    (warning,) = config_warnings(elites, POINT_MAZE, BACKENDS)
    assert warning.endswith("simd computes only training episodes there, and map_elites has none")
    low_rank = load(MINIMAL, "compute.worker_resources.gpu=1", "search.noise.kind=low_rank")
    (warning,) = config_warnings(low_rank, POINT_MAZE, BACKENDS)
    assert warning.endswith("and only those with search.noise.kind = full")
    no_simd = replace(POINT_MAZE, unsupported={"simd": "the primitive fft"})
    here = {"point_maze": no_simd}
    config = load_config(MINIMAL, tasks=here, algorithms=ALGORITHMS, rollouts=BACKENDS)
    assert config.compute.rollout == "xla"
    (warning,) = config_warnings(config, no_simd, BACKENDS)
    assert warning == "compute.rollout: xla is used because simd cannot run point_maze: the primitive fft"
    with pytest.raises(ConfigError, match=r"simd cannot run point_maze: the primitive fft; must be auto or xla"):
        load_config(MINIMAL, ("compute.rollout=simd",), tasks=here, algorithms=ALGORITHMS, rollouts=BACKENDS)


def test_a_new_run_is_refused_if_its_rollout_would_hide_what_is_not_finite():
    where = "its reward is NaN in step 1 with actions of 0: my_maze.py:7 (step) multiplies by 0 what is not finite"
    of = {"tasks": {"point_maze": replace(POINT_MAZE, hidden={"simd": where})}}
    of |= {"algorithms": ALGORITHMS, "rollouts": BACKENDS}
    with pytest.raises(
        ConfigError, match=r"or set compute.rollout to xla, which finds such episodes invalid"
    ) as caught:
        load_config(MINIMAL, **of)
    (problem,) = caught.value.problems
    assert problem.field == "task.environment"
    assert problem.sentence.startswith(f"task.environment: point_maze: {where}. With simd such a product is 0")
    assert load_config(MINIMAL, ("compute.rollout=xla",), **of).compute.rollout == "xla"
    stored = yaml.safe_load(load().resolved_yaml())
    assert changed_config(stored, **of).compute.rollout == "simd", "a run that exists goes on and can be evaluated"


def test_threads_are_for_simd_inside_one_process():
    for overrides in (("compute.engine=ray",), ("compute.engine=inline", "compute.rollout=xla")):
        with pytest.raises(ConfigError, match=r"inline_workers: threads needs compute.engine = inline and .*simd"):
            load(MINIMAL, "compute.inline_workers=threads", *overrides)
    assert load(MINIMAL, "compute.inline_workers=threads", "compute.engine=inline").compute.inline_workers == "threads"


def test_overrides_win_over_the_file_and_later_ones_over_earlier(file):
    path = file(MINIMAL_TEXT + "seed: 1\n")
    config = load(path, "seed=2", "seed=3", "policy.hidden=[8]", "task.options.start=corner", "search.sigma=1e-3")
    assert config.seed == 3
    assert config.policy.hidden == (8,)
    assert config.task.options == {"start": "corner"}
    assert config.search.sigma == 0.001


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 0.001), ("1E+2", 100.0), (".5", 0.5), ("-1.5e3", -1500.0), ("1", 1.0), ("1_000.5", 1000.5)],
)
def test_numbers_as_people_write_them_are_floats(file, text, value):
    config = load(file(MINIMAL_TEXT.replace("generations: 3", f"target_fitness: {text}")))
    assert type(config.budget.target_fitness) is float
    assert config.budget.target_fitness == value


def test_a_single_number_of_cells_is_a_list_of_one():
    for text in ("50", "[50]"):
        assert load(MINIMAL, "map.kind=cvt", f"map.cells={text}").map.cells == (50,)
    assert load(MINIMAL | {"map": {"kind": "cvt", "cells": 50}}).map.cells == (50,)


def test_whole_numbers_may_have_underscores_and_leading_zeros(file):
    assert load(file(MINIMAL_TEXT.replace("generations: 3", "env_steps: 1_000_000"))).budget.env_steps == 1_000_000
    assert load(file(MINIMAL_TEXT + "seed: 012\n")).seed == 12


def test_init_from_is_made_absolute(tmp_path, monkeypatch):
    (tmp_path / "old").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load(MINIMAL, "search.init_from=old").search.init_from == str(tmp_path / "old")


def test_members_follow_from_the_algorithm():
    assert load().search.centres == 1
    assert load(MINIMAL, "search.algorithm=ns_es").search.centres == 5
    assert load(MINIMAL, "search.algorithm=nsra_es", "search.centres=3").search.centres == 3
    for name in ("es", "ars"):
        with pytest.raises(ConfigError, match=rf"search\.centres: 3 is not allowed for {name}, which has one centre; "):
            load(MINIMAL, f"search.algorithm={name}", "search.centres=3")


# Round trip and constants


def overrides(values):
    return [f"{name}={dump_yaml([value]).strip()[1:-1]}" for name, value in values.items()]


POSITIVE = st.floats(min_value=1e-9, max_value=1e9)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "search.pairs": st.integers(1, 20_000),
            "search.preset": st.sampled_from(["literature", "uber"]),
            "search.sigma": POSITIVE,
            "search.step.l2": st.floats(min_value=0, max_value=1),
            "search.common_random_numbers": st.booleans(),
            "policy.hidden": st.lists(st.integers(1, 512), max_size=4),
            "policy.observation_clip": st.none() | POSITIVE,
            "policy.observation_normalization": st.booleans(),
            "task.options.start": st.sampled_from(["default", "corner"]),
            "task.episode_steps": st.none() | st.integers(1, 5000),
            "budget.target_fitness": st.none() | st.floats(allow_nan=False, allow_infinity=False),
            "compute.workers": st.just("auto") | st.integers(1, 64),
            "seed": st.integers(0, 2**63 - 1),
        },
    )
)
def test_resolved_yaml_loads_to_an_equal_config(values):
    config = load(MINIMAL, *overrides(values))
    again = load(parse_value(config.resolved_yaml()))
    assert again == config
    assert again.resolved_yaml() == config.resolved_yaml()
    assert changed_constants(config.constants(), again.constants()) == []
    given = parse_value(config.given_yaml({"compute.workers": 2}))
    assert isinstance(given, dict)
    assert load(given) == load(MINIMAL, *overrides(values | {"compute.workers": 2}))
    assert load(given).made.given.keys() == config.made.given.keys() | {"compute.workers"}


@given(WORDS | st.floats(allow_nan=False) | st.integers() | st.booleans() | st.none() | st.lists(WORDS, max_size=3))
def test_dumped_values_read_back(value):
    assert parse_value(dump_yaml({"key": value})) == {"key": value}


def test_resolved_yaml_is_plain_yaml_for_other_readers():
    for sigma in (0.02, 1e-5, 1e22):
        assert yaml.safe_load(load(MINIMAL, f"search.sigma={sigma}").resolved_yaml())["search"]["sigma"] == sigma


def test_worker_spec_says_what_the_config_says():
    config = load(MINIMAL, "policy.hidden=[8, 4]", "task.options.start=corner", "task.fitness=final", "seed=5")
    spec = worker_spec(config, POINT_MAZE)
    assert pickle.loads(pickle.dumps(spec)) == spec
    assert (spec.seed, spec.environment, spec.environment_options) == (5, "point_maze", {"start": "corner"})
    assert (spec.episode_steps, spec.fitness, spec.episodes_per_member) == (200, "final", 1)
    assert (spec.policy.widths, spec.observation_clip, spec.action_noise) == ((2, 8, 4, 2), 5.0, 0.01)
    assert (spec.chunk_pairs, spec.rollout_block_pairs, spec.gradient_block_pairs) == (64, 32, 512)
    assert spec.common_random_numbers is True


def test_every_key_is_described():
    rows = {row.key: row for row in described_keys(OURS)}
    assert rows.keys() == FIELDS.keys() | all_search_fields(OURS).keys() | {"task.options.NAME"}
    assert all(row.meaning and row.allowed and row.default for row in rows.values())
    assert rows["search.sigma"].default == "0.02; 0.05 with jedi; 0.025 with polish"
    assert (rows["policy.init"].default, rows["map.cells"].default) == ("unit_columns / small_columns", "auto")
    assert (rows["task.environment"].default, rows["search.batch"].methods) == ("required", ("map_elites",))
    assert rows["map.qd_offset"].allowed == "auto or a number"


def test_the_command_line_describes_the_keys_of_a_section_and_names_the_nearest_one():
    def said(*words):
        result = CliRunner().invoke(app, ["config", "--keys", *words], env={"COLUMNS": "200"})
        return result.stdout if result.exit_code == 0 else result.exception

    step = said("search.step")
    assert [line.split(" = ")[0] for line in step.splitlines() if line[0] != " "] == [
        f"search.step.{leaf}" for leaf in ("kind", "learning_rate", "l2", "max_speed", "momentum")
    ]
    assert "Must be a number, at least 0. A key of all but map_elites." in " ".join(step.split())
    assert "\nseed = 0\n" in said()
    assert json.loads(said("seed", "--json"))[0]["allowed"] == "a whole number, at least 0 and below 2**63"
    assert str(said("search.sgima")) == "search.sgima: unknown key; did you mean search.sigma?"
