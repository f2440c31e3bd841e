"""A key without effect with a method is refused where a user wrote it; existing runs that recorded one go on.

`tests/laws/test_method_keys.py` checks which keys have an effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from es_service import api
from es_service.cli.common import print_config_notes
from es_service.config.given import shipped_configs
from es_service.config.keys import all_search_fields, has_effect, methods_with, no_effect
from es_service.config.loading import Known, read
from es_service.config.model import flat
from es_service.config.tasks import TASKS
from es_service.config.text import dump_yaml, parse_value, read_yaml_file
from es_service.errors import ConfigError
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import FREE, ParameterSpec
from es_service.runs.lineage import fork_config
from es_service.runs.sweep_plan import plan
from es_service.search.algorithms import ALGORITHMS, OURS
from tests.es_service.config_examples import MINIMAL, left_out, load
from tests.es_service.test_shipped_configs import ALL
from workers.environments import SHIPPED
from workers.rollouts import BACKENDS

pytestmark = pytest.mark.usefixtures("workers_here")

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


def having(key):
    """The methods that have a key, as a sentence lists them."""
    *others, last = methods_with(key, OURS)
    return f"{', '.join(others)} and {last}"


def test_every_method_declares_its_keys():
    for key in all_search_fields(OURS):
        assert methods_with(key, OURS), key
    assert methods_with("search.pairs", OURS) == tuple(name for name in OURS if name != "map_elites")
    assert methods_with("search.block_generations", OURS) == ("me_es",)
    assert methods_with("compute.chunk_pairs", OURS) == methods_with("search.pairs", OURS)
    assert methods_with("novelty.newest", OURS) == tuple(OURS)


def test_a_key_without_effect_is_refused_with_the_methods_that_have_it():
    assert problems(MINIMAL, "search.algorithm=map_elites", "search.sigma=0.3") == [
        f"search.sigma: 0.3 has no effect with map_elites; leave it out (a key of {having('search.sigma')})"
    ]
    source = MINIMAL | {"search": {"algorithm": "es", "iso_sigma": 0.3, "emitters": "many"}, "seed": "a"}
    assert problems(source, "search.shaping.count=513") == [
        "search.iso_sigma: 0.3 has no effect with es; leave it out (a key of map_elites)",
        f"search.emitters: many has no effect with es; leave it out (a key of {having('search.emitters')})",
        "search.shaping.count: 513 has no effect with search.shaping.kind = ranks; leave it out "
        "(a key of kind top_pairs)",
        "seed: a is not allowed; must be a whole number, at least 0 and below 2**63",
    ]
    assert problems(MINIMAL, "search.algorithm=ars", "search.shaping.count=513") == [
        "search.shaping.count: 513 is more than search.pairs (512); try 512, or null for all"
    ]


def test_each_value_of_a_sweep_is_checked(tmp_path):
    grid = {"search.algorithm": ["map_elites"], "search.sigma": [0.02, 0.3]}
    with pytest.raises(ConfigError) as caught:
        plan(MINIMAL, tmp_path, grid, range(2))
    found = [(problem.field, problem.value, problem.suggestion) for problem in caught.value.problems]
    assert found == [("search.sigma", 0.02, None), ("search.sigma", 0.3, None)]
    assert all("has no effect with map_elites; leave it out" in one.sentence for one in caught.value.problems)


@pytest.mark.parametrize(
    ("key", "value", "now"),
    [
        ("learning_rate", "0.1", "search.step.learning_rate"),
        ("l2", "0.1", "search.step.l2"),
        ("shaping", "signs", "search.shaping.kind"),
        ("top_pairs", "5", "search.shaping.count"),
        ("options.reach", "0.2", "search.reach"),
    ],
)
def test_a_renamed_key_is_refused_with_its_name(key, value, now):
    expected = [f"search.{key}: this key is now {now}"]
    assert problems(MINIMAL, f"search.{key}={value}") == expected
    leaf, nested = key.split(".")[-1], parse_value(value)
    section = {"algorithm": "es", **({"options": {leaf: nested}} if "." in key else {key: nested})}
    assert problems(MINIMAL | {"search": section}) == expected


def test_a_part_is_a_section_of_its_own():
    assert problems(MINIMAL, "search.step=plain") == [
        "search.step: this is a section; set its keys one by one, such as search.step.kind=..."
    ]
    (line,) = problems(MINIMAL | {"search": {"algorithm": "es", "step": "plain"}})
    assert line.startswith("search.step: plain is not a mapping of keys; indent its keys below `step:`")
    assert problems(MINIMAL, "search.step.kind=adma", "search.step.learning_rate=-1", "search.step.learning_rat=1") == [
        "search.step.learning_rat: unknown key; did you mean search.step.learning_rate?",
        "search.step.kind: adma is not allowed; must be adam, adamw, plain or clipup; did you mean adam?",
        "search.step.learning_rate: -1 is not allowed; must be a number above 0",
    ]
    config = load(MINIMAL | {"search": {"algorithm": "nsr_es", "step": {"learning_rate": 1}}}, "search.step.kind=plain")
    assert config.search.step.model_dump() == {"kind": "plain", "learning_rate": 1.0, "l2": 0.005}


def test_another_kind_leaves_out_the_keys_of_the_one_it_replaces():
    source = MINIMAL | {"search": {"algorithm": "ars", "shaping": {"count": 5}}}
    assert load(source).search.shaping.model_dump() == {"kind": "top_pairs", "count": 5}
    for wanted, why in (
        ("search.shaping.kind=signs", "signs replaces its search.shaping.kind"),
        ("search.algorithm=es", "ranks replaces its search.shaping.kind"),
    ):
        assert load(source, wanted).search.shaping.kind == why.split()[0]
        assert left_out(source, [wanted]) == {"search.shaping.count": why}
    assert problems(source, "search.shaping.kind=signs", "search.shaping.count=5") == [
        "search.shaping.count: 5 has no effect with search.shaping.kind = signs; leave it out (a key of kind top_pairs)"
    ]


@pytest.mark.parametrize("method", OURS)
def test_values_that_a_key_has_anyway_are_accepted_so_that_a_resolved_config_loads(method):
    chosen = [f"search.algorithm={method}", *(["search.init_from=."] if OURS[method].settings.needs_start else [])]
    for preset in ("literature", "uber"):
        config = load(MINIMAL, *chosen, f"search.preset={preset}")
        assert load(parse_value(config.resolved_yaml())) == config
    assert load(MINIMAL, *chosen, "task.episodes_per_member=1", "compute.chunk_pairs=auto")


def test_another_algorithm_leaves_out_the_keys_of_the_one_it_replaces():
    source = MINIMAL | {"search": {"algorithm": "me_es", "emitters": 4, "sigma": 0.3, "block_generations": 5}}
    config = load(source, "search.algorithm=es")
    assert config.search.model_dump().items() >= {"sigma": 0.3, "centres": 1}.items()
    assert list(left_out(source, ["search.algorithm=es"])) == ["search.emitters", "search.block_generations"]
    why = "memes replaces its algorithm"
    assert left_out(source, ["search.algorithm=memes"]) == {"search.block_generations": why}
    assert left_out(source, ["search.algorithm=me_es", "search.sigma=1"]) == {}
    assert problems(source, "search.algorithm=es", "search.emitters=3") == [
        f"search.emitters: 3 has no effect with es; leave it out (a key of {having('search.emitters')})"
    ]


@pytest.mark.parametrize("path", [path for path in ALL if path.stem.startswith("point_maze_")])
def test_every_method_can_replace_that_of_a_shipped_config(path):
    for method in OURS:
        start = ["search.init_from=."] if OURS[method].settings.needs_start else []  # only the user knows of which run
        assert load(path, f"search.algorithm={method}", *start).search.algorithm == method


def test_values_of_a_file_that_the_chosen_method_does_not_allow_are_left_out():
    observing = {"policy": {"observation_normalization": True, "observation_clip": 4.0}, "map": {"enabled": False}}
    source = MINIMAL | observing | {"search": {"algorithm": "ns_es", "centres": 4}}
    why = "map_elites replaces its algorithm"
    forbidden = ["policy.observation_normalization", "policy.observation_clip", "map.enabled"]
    assert left_out(source, ["search.algorithm=map_elites"]) == dict.fromkeys(forbidden, why)
    config = load(source, "search.algorithm=map_elites")
    assert not config.policy.observation_normalization
    assert (config.policy.observation_clip, config.map.enabled, config.search.centres) == (None, True, 4)
    assert list(left_out(source, ["search.algorithm=es"])) == ["search.centres"]
    assert left_out(source | {"search": {"algorithm": "ns_es", "centres": "auto"}}, ["search.algorithm=es"]) == {}
    assert problems(source, "search.algorithm=map_elites", "policy.observation_normalization=true", "map.enabled=false")
    assert len(problems(source | {"search": {"algorithm": "map_elites"}})) == 2  # the file itself says both


def test_keys_that_are_left_out_are_named_on_the_command_line(tmp_path, capsys):
    file, wanted = tmp_path / "my.yaml", ["search.algorithm=es", "task.environment=ant_maze"]
    task = {"environment": "point_maze", "options": {"start": "corner"}}
    file.write_text(dump_yaml(MAP_ELITES | {"task": task, "search": {"algorithm": "map_elites", "batch": 16}}))
    print_config_notes(file, [api.load_config(file, wanted)])
    printed = " ".join("".join(capsys.readouterr()).split())
    assert f"note: ignored task.options.start of {file}, since ant_maze replaces its task" in printed
    assert f"note: ignored search.batch of {file}, since es replaces its algorithm" in printed


def found(source, *wanted, tasks: Mapping[str, TaskSpec] = TASKS):
    """What stays: key -> (value, default of what has been chosen)."""
    return {
        key: (one.value, one.default)
        for key, one in read(source, wanted, Known(tasks, ALGORITHMS, BACKENDS)).kept.items()
    }


def test_values_that_replace_other_defaults_of_the_chosen_method_are_found():
    search = {"algorithm": "me_es", "sigma": 0.3, "evaluation_episodes": 30, "centres": 4, "emitters": 4, "pairs": 512}
    source = MINIMAL | {"search": search | {"step": {"learning_rate": 0.01, "l2": 0}}, "policy": {"action_noise": 0.01}}
    to_map_elites = {"search.evaluation_episodes": (30, 1), "search.centres": (4, 32)}
    assert found(source, "search.algorithm=map_elites") == to_map_elites
    assert found(source, "search.algorithm=map_elites", "search.centres=4") == {"search.evaluation_episodes": (30, 1)}
    assert found(source, "search.algorithm=es") == {
        "search.sigma": (0.3, 0.02),
        "search.step.l2": (0, 0.005),
    }  # and not search.centres, since es does not allow 4
    assert found(source, "search.algorithm=ars")["policy.action_noise"] == (0.01, 0.0)  # a key of another section
    assert "search.step.l2" not in found(source, "search.algorithm=ars")  # whose default it is
    assert found(source, "search.algorithm=me_es") == found(source, "search.sigma=0.1") == {}
    of_map_elites = MAP_ELITES | {"policy": {"observation_normalization": False}}
    assert found(of_map_elites, "search.algorithm=es") == {"policy.observation_normalization": (False, True)}
    assert (
        found(source | {"search": {"algorithm": "es", "preset": "uber", "centres": "auto"}}, "search.algorithm=me_es")
        == {}
    )


def test_the_defaults_are_those_of_the_preset_and_of_the_task_with_which_the_run_is():
    source = MINIMAL | {"search": {"algorithm": "es", "pairs": 512}}
    assert found(source, "search.algorithm=nsr_es", "search.preset=uber") == {"search.pairs": (512, 5000)}
    once = {"search": {"algorithm": "me_es", "evaluation_episodes": 1}, "task": {"environment": "rastrigin"}}
    deterministic = {
        "rastrigin": replace(
            SHIPPED["point_maze"], parameters=ParameterSpec(("a",), (FREE,), (0.0,)), deterministic=True
        )
    }
    assert found(once, "search.algorithm=es", tasks=deterministic) == {}
    assert found(once, "search.algorithm=es") == {"search.evaluation_episodes": (1, 30)}  # of a task that is not known


def test_values_that_replace_other_defaults_of_a_chosen_kind_are_found():
    source = MINIMAL | {"search": {"algorithm": "map_elites", "elites": {"kind": "eme", "depth": 8, "again": 0.25}}}
    assert found(source, "search.elites.kind=archive_sampling") == {
        "search.elites.depth": (8, 2),
        "search.elites.again": (0.25, "all"),
    }
    assert found(source, "search.elites.kind=eme") == found(source, "search.elites.kind=once") == {}
    step = MINIMAL | {"search": {"algorithm": "es", "step": {"learning_rate": 0.1}}}
    assert found(step, "search.step.kind=plain") == {"search.step.learning_rate": (0.1, 0.01)}
    assert found(step, "search.step.kind=adam") == {}  # what it is without a word


def test_values_that_stay_are_named_on_the_command_line(tmp_path, capsys):
    file, wanted = tmp_path / "my.yaml", ["search.algorithm=map_elites"]
    file.write_text(dump_yaml(MINIMAL | {"search": {"algorithm": "es", "evaluation_episodes": 30}}))
    print_config_notes(file, [api.load_config(file, wanted)])
    printed = " ".join("".join(capsys.readouterr()).split())
    kept_one = f"note: kept search.evaluation_episodes = 30 (by default 1) of {file}, although map_elites replaces its"
    assert f"{kept_one} algorithm" in printed


def test_a_sweep_over_methods_names_the_keys_for_which_they_have_other_defaults(tmp_path):
    """The values of the config were chosen for one of the methods, which would win such a comparison."""
    source = MINIMAL | {"search": {"algorithm": "me_es", "evaluation_episodes": 30, "sigma": 0.3}}
    grid = {"search.algorithm": ["me_es", "map_elites", "es", "nsr_es"]}
    with pytest.raises(ConfigError) as caught:
        plan(source, tmp_path, grid, range(2))
    assert [problem.sentence for problem in caught.value.problems] == [
        "search.evaluation_episodes: the config has 30 for another search.algorithm, and the default is 1 with "
        "map_elites; set it for all runs of the sweep, such as search.evaluation_episodes=30",
        "search.sigma: the config has 0.3 for another search.algorithm, and the default is 0.02 with es and nsr_es; "
        "set it for all runs of the sweep, such as search.sigma=0.3",
    ]
    named = ["search.evaluation_episodes=30"]
    grid = {"search.algorithm": ["me_es", "map_elites"]}
    assert [run.config.search.evaluation_episodes for run in plan(source, tmp_path, grid, overrides=named)] == [30, 30]
    several = grid | {"search.evaluation_episodes": [1, 30]}
    assert [run.config.search.evaluation_episodes for run in plan(source, tmp_path, several)] == [1, 30, 1, 30]
    assert plan(source, tmp_path, {"search.algorithm": ["map_elites"]})  # one method: a note says what stays
    kinds = {"search.step.kind": ["adam", "plain"]}
    stepping = MINIMAL | {"search": {"algorithm": "es", "step": {"learning_rate": 0.1}}}
    with pytest.raises(ConfigError, match=r"learning_rate: .* another search\.step\.kind, .* 0\.01 with plain; set"):
        plan(stepping, tmp_path, kinds)
    with pytest.raises(ConfigError, match=r"search\.step\.kind: \[plain\] is not allowed"):
        plan(stepping, tmp_path, {"search.step.kind": [["plain"], "adam"]})


def test_a_sweep_over_methods_says_of_each_key_only_one_thing(tmp_path):
    normalised = ["policy.observation_normalization=true"]
    with pytest.raises(ConfigError) as caught:
        plan(MINIMAL, tmp_path, {"search.algorithm": ["es", "map_elites", "nope", "no.such:search"]}, None, normalised)
    found = [problem.field for problem in caught.value.problems]
    assert found == ["policy.observation_normalization", "search.algorithm", "search.algorithm"]


def test_a_key_that_no_method_has_is_refused_without_naming_one():
    problem = no_effect("search.of_nobody", 3, "es", ALGORITHMS)
    assert problem.sentence == "search.of_nobody: 3 has no effect with es; leave it out"


def test_a_run_may_be_told_again_what_has_no_effect_but_nothing_else(tmp_path):
    """Its config has the values of keys that every config has."""
    run = api.run(api.load_config(MAP_ELITES), tmp_path / "run").run
    assert "search.sigma" not in run.constants
    resumed = api.resume(tmp_path / "run", ["budget.generations=4", "policy.action_noise=0.01"]).run
    assert resumed.generation == 4
    for refused in (
        lambda given: api.resume(tmp_path / "run", given),
        lambda given: fork_config(tmp_path / "run", given),
    ):
        for given in ("policy.action_noise=0.1", "search.sigma=0.02"):
            with pytest.raises(ConfigError, match=r"has no effect with map_elites; leave it out"):
                refused([given])
    assert fork_config(tmp_path / "run", ["search.iso_sigma=0.1"]).constants()["search.iso_sigma"] == 0.1


def test_a_fork_to_another_method_gives_up_keys_without_effect_there(tmp_path):
    source = MAP_ELITES | {"search": {"algorithm": "nsra_es", "pairs": 16, "fitness_weight_step": 0.2}}
    api.run(api.load_config(source, ["budget.generations=1"]), tmp_path / "run")
    config = fork_config(tmp_path / "run", ["search.algorithm=ns_es"])
    assert config.search.algorithm == "ns_es"
    assert not [key for key in config.constants() if "fitness_weight" in key]


def test_a_run_stores_what_was_given_and_a_fork_resolves_what_it_changes_of_that(tmp_path):
    source = MAP_ELITES | {"search": {"algorithm": "es", "pairs": 16}, "map": {"qd_offset": 3}}
    run = api.run(api.load_config(source, ["budget.generations=1"]), tmp_path / "run").run
    given = flat(source) | {"budget.generations": 1}
    assert run.meta.given == given
    config = fork_config(tmp_path / "run", ["search.pairs=128", "task.fitness=final"])
    assert (config.compute.chunk_pairs, config.map.qd_offset) == (16, 3.0)
    assert run.config["compute"]["chunk_pairs"] == 16 == run.config["search"]["pairs"]
    assert fork_config(tmp_path / "run", ["search.pairs=256"]).compute.chunk_pairs == 32
    assert config.made.given == given | {"search.pairs": 128, "task.fitness": "final", "search.init_from": None}


@pytest.mark.parametrize("path", ALL, ids=lambda path: path.stem)
def test_shipped_configs_have_no_key_without_effect(path):
    written = flat(read_yaml_file(path))
    settings = OURS[written["search.algorithm"]].settings
    assert all(has_effect(key, settings) for key in written)
    assert shipped_configs()


def test_without_a_known_algorithm_only_what_no_algorithm_allows_is_wrong():
    search = {"algorithm": "ess", "pairs": 8, "batch": 16, "sigma": 0, "elites": {"kind": "me_sampling", "depth": "x"}}
    with pytest.raises(ConfigError) as caught:
        load({**MINIMAL, "search": search})
    assert [problem.sentence for problem in caught.value.problems][:-1] == [
        "search.sigma: 0 is not allowed; must be a number above 0",
        "search.elites.depth: x is not allowed; must be a whole number, at least 1",
    ]


def test_what_overrides_set_in_vain_is_known_although_their_section_is_unusable():
    reading = read(
        {**MINIMAL, "search": None},
        ["search.algorithm=map_elites", "search.pairs=8"],
        Known(TASKS, ALGORITHMS, BACKENDS),
    )
    assert reading.idle == {"search.pairs": "map_elites"}
