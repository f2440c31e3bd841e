"""A key without effect with a method is refused where a user wrote it; existing runs that recorded one go on.

`tests/laws/test_method_keys.py` checks which keys have an effect.
"""

from __future__ import annotations

import re

import pytest

from es_service import api
from es_service.cli.options import print_config_notes
from es_service.config.keys import FIELDS
from es_service.config.loading import left_out
from es_service.config.method_keys import METHOD_KEYS, SOME_METHODS, keys_without_effect, methods_with
from es_service.config.model import flat
from es_service.config.shipped import shipped_configs
from es_service.config.yaml_text import dump_yaml, parse_value, read_yaml_file
from es_service.errors import ConfigError
from es_service.report.settings import changed_settings
from es_service.runs.lineage import fork_config
from es_service.runs.sweep_plan import plan
from es_service.search.algorithms import OURS
from tests.es_service.config_examples import MINIMAL, load
from tests.es_service.test_shipped_configs import ALL
from workers.environments import SHIPPED

pytestmark = pytest.mark.usefixtures("workers_here")

OWN = "tests.examples.minimal_criterion:minimal_criterion"
MAP_ELITES = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "map_elites", "batch": 16, "centres": 4},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1},
}


def problems(source, *overrides):
    with pytest.raises(ConfigError) as caught:
        load(source, *overrides)
    return [problem.sentence for problem in caught.value.problems]


def test_the_table_is_about_the_shipped_methods_and_keys_of_a_config():
    assert list(METHOD_KEYS) == list(OURS)
    assert set(SOME_METHODS) <= FIELDS.keys()
    assert all(0 < len(methods_with(key)) < len(OURS) for key in SOME_METHODS)
    assert keys_without_effect(OWN) == frozenset()


def test_a_key_without_effect_is_refused_with_the_methods_that_have_it():
    assert problems(MINIMAL, "search.algorithm=map_elites", "search.sigma=0.3") == [
        "search.sigma: 0.3 has no effect with map_elites; leave it out "
        "(a key of es, ns_es, nsr_es, nsra_es, me_es, memes and ars)"
    ]
    source = MINIMAL | {"search": {"algorithm": "es", "iso_sigma": 0.3, "emitters": "many"}, "seed": "a"}
    assert problems(source, "search.top_pairs=513") == [
        "seed: a is not allowed; must be a whole number, at least 0 and below 2**63",
        "search.iso_sigma: 0.3 has no effect with es; leave it out (a key of map_elites)",
        "search.emitters: many has no effect with es; leave it out (a key of me_es and memes)",
        "search.top_pairs: 513 has no effect with es; leave it out (a key of ars)",
    ]
    assert problems(MINIMAL, "search.algorithm=ars", "search.top_pairs=513") == [
        "search.top_pairs: 513 is more than search.pairs (512); try 512, or null for all"
    ]


def test_each_value_of_a_sweep_is_checked(tmp_path):
    grid = {"search.algorithm": ["es", "map_elites"], "search.sigma": [0.02, 0.3]}
    with pytest.raises(ConfigError) as caught:
        plan(MINIMAL, tmp_path, grid, range(2))
    (problem,) = caught.value.problems
    assert problem.sentence.startswith("search.sigma: 0.3 has no effect with map_elites; leave it out")
    assert (problem.field, problem.value, problem.suggestion) == ("search.sigma", 0.3, 0.02)


def test_a_search_of_the_user_may_use_any_key():
    config = load(MINIMAL, f"search.algorithm={OWN}", "search.iso_sigma=0.3", "search.emitters=3")
    assert (config.search.iso_sigma, config.search.emitters) == (0.3, 3)


@pytest.mark.parametrize("method", OURS)
def test_values_that_a_key_has_anyway_are_accepted_so_that_a_resolved_config_loads(method):
    for preset in ("literature", "uber"):
        config = load(MINIMAL, f"search.algorithm={method}", f"search.preset={preset}")
        assert load(parse_value(config.resolved_yaml())) == config
    assert load(MINIMAL, f"search.algorithm={method}", "search.sigma=0.02", "compute.chunk_pairs=auto")


def test_another_algorithm_leaves_out_the_keys_of_the_one_it_replaces():
    source = MINIMAL | {"search": {"algorithm": "me_es", "emitters": 4, "sigma": 0.3, "block_generations": 5}}
    config = load(source, "search.algorithm=es")
    assert (config.search.sigma, config.search.emitters, config.search.block_generations) == (0.3, 1, 10)
    assert left_out(source, ["search.algorithm=es"]) == ["search.emitters", "search.block_generations"]
    assert left_out(source, ["search.algorithm=memes"]) == ["search.block_generations"]
    assert left_out(source, ["search.algorithm=me_es", "search.sigma=1"]) == []
    assert problems(source, "search.algorithm=es", "search.emitters=3") == [
        "search.emitters: 3 has no effect with es; leave it out (a key of me_es and memes)"
    ]


def test_keys_that_are_left_out_are_named_on_the_command_line(tmp_path, capsys):
    file, wanted = tmp_path / "my.yaml", ["search.algorithm=es", "task.environment=ant_maze"]
    task = {"environment": "point_maze", "options": {"start": "corner"}}
    file.write_text(dump_yaml(MAP_ELITES | {"task": task, "search": {"algorithm": "map_elites", "batch": 16}}))
    print_config_notes(file, [(wanted, api.load_config(file, wanted))])
    printed = " ".join("".join(capsys.readouterr()).split())
    assert f"note: ignored task.options.start of {file}, since ant_maze replaces its task" in printed
    assert f"note: ignored search.batch of {file}, since es replaces its algorithm" in printed


def test_a_run_that_recorded_a_key_without_effect_goes_on_and_may_be_forked(tmp_path):
    """As versions up to 0.11 did."""
    config = api.load_config(MAP_ELITES)
    search = config.search.model_copy(update={"sigma": 0.3})
    older = config.model_copy(update={"search": search})
    found = api.run(older, tmp_path / "run").run
    whole = api.run(api.load_config(MAP_ELITES, ["budget.generations=5"]), tmp_path / "whole").run
    assert "search.sigma" in {setting.key for setting in changed_settings(found.meta.config, SHIPPED["point_maze"])}
    resumed = api.resume(tmp_path / "run", ["budget.generations=4", "search.sigma=0.3"]).run
    assert (resumed.generation, resumed.constants["search.sigma"]) == (4, 0.3)
    with pytest.raises(ConfigError, match=r"search.sigma: 0.1 has no effect with map_elites"):
        api.resume(tmp_path / "run", ["search.sigma=0.1"])
    with pytest.raises(ConfigError, match=r"search.sigma: 0.1 has no effect with map_elites"):
        fork_config(tmp_path / "run", ["search.sigma=0.1"])
    assert fork_config(tmp_path / "run", ["search.iso_sigma=0.1"]).search.sigma == 0.3
    # The error of a new run asks to leave the key out; the same run then goes on.
    with pytest.raises(ConfigError, match=r"search.sigma: 0.3 has no effect with map_elites; leave it out"):
        api.load_config(MAP_ELITES, ["search.sigma=0.3"])
    wanted = api.load_config(MAP_ELITES, ["budget.generations=5"])
    assert api.run_or_resume(wanted, tmp_path / "run").run.digest() == whole.digest()


def test_a_fork_to_another_method_gives_up_keys_without_effect_there(tmp_path):
    source = MAP_ELITES | {"search": {"algorithm": "nsra_es", "pairs": 16, "fitness_weight_step": 0.2}}
    api.run(api.load_config(source, ["budget.generations=1"]), tmp_path / "run")
    config = fork_config(tmp_path / "run", ["search.algorithm=ns_es"])
    assert (config.search.algorithm, config.search.fitness_weight_step) == ("ns_es", 0.05)


@pytest.mark.parametrize("path", ALL, ids=lambda path: path.stem)
def test_shipped_configs_have_no_key_without_effect(path):
    written = flat(read_yaml_file(path))
    assert not written.keys() & keys_without_effect(written["search.algorithm"])
    assert shipped_configs()


def test_descriptions_of_keys_of_a_few_methods_name_these():
    for key in SOME_METHODS:
        if len(methods := methods_with(key)) <= 3:
            text = str(FIELDS[key].description)
            assert {name for name in OURS if re.search(rf"\b{name}\b", text)} == set(methods), key
            assert re.match(rf"(\w+, )*{methods[0]}\b.*?: ", text), key
