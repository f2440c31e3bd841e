"""Options that tasks and searches declare: read, checked, swept, and kept as constants of the run."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace

import pytest

from es_service import api
from es_service.config.loading import changed_config, left_out, load_config
from es_service.config.options import allowed_text
from es_service.config.tasks import task_from_fields
from es_service.config.yaml_text import parse_value
from es_service.errors import ConfigError
from es_service.protocol.options import Option, choice, declared_options, has_options
from es_service.report.settings import changed_settings
from es_service.runs.checked_config import changes_from
from es_service.runs.sweep_plan import plan
from tests.es_service.config_examples import MINIMAL, POINT_MAZE

pytestmark = pytest.mark.usefixtures("workers_here")

OPTIONS = {
    "start": choice("default", "corner"),
    "legs": choice(4, 6),
    "fast": Option(False),
    "count": Option(3, low=1, high=9),
    "gap": Option(2.0, low=0.5),
    "note": Option("plain"),
}
REPELLING = "tests.examples.repelling_centres:repelling_centres"
KNOWN = {
    "tasks": {"point_maze": replace(POINT_MAZE, options=OPTIONS)},
    "algorithms": {"mine:search": has_options(**OPTIONS)(lambda config: None), "mine:plain": None, "es": None},
}
GROUPS = pytest.mark.parametrize("group", ["task", "search"])


def load(*overrides, source=MINIMAL, algorithm="mine:search"):
    return load_config(source | {"search": {"algorithm": algorithm, **source.get("search", {})}}, overrides, **KNOWN)


def problems(*overrides, **given):
    with pytest.raises(ConfigError) as caught:
        load(*overrides, **given)
    return [problem.sentence for problem in caught.value.problems]


BARE = {key: MINIMAL[key] for key in ("task", "budget")}


@GROUPS
def test_options_have_their_defaults_and_the_types_that_are_declared(group):
    options = getattr(load(source=BARE), group).options
    assert options == {"start": "default", "legs": 4, "fast": False, "count": 3, "gap": 2.0, "note": "plain"}
    values = {"start": "corner", "legs": 6, "fast": True, "count": 9, "gap": 5, "note": "12"}
    source = BARE | {group: {**BARE.get(group, {}), "options": values}}
    given = [f"{group}.options.{name}={json.dumps(value)}" for name, value in values.items()]
    for found in (load(source=source), load(*given, source=BARE), load(*given[::-1], source=source)):
        options = getattr(found, group).options
        assert options == values
        assert {name: type(value) for name, value in options.items()} == {
            name: type(option.default) for name, option in OPTIONS.items()
        }


@GROUPS
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("gap=0.4", "0.4 ... must be a number, at least 0.5"),
        ("gap=.nan", ".nan ... must be a number, at least 0.5"),
        ("gap=.inf", ".inf ... must be a number, at least 0.5"),
        ("gap='2.0'", "'2.0' ... must be a number, at least 0.5; remove the quotes around 2.0"),
        ("gap=true", "true ... must be a number, at least 0.5"),
        ("gap=null", "null ... must be a number, at least 0.5; leave the key out to use its default"),
        ("count=10", "10 ... must be a whole number from 1 to 9"),
        ("count=2.0", "2.0 ... must be a whole number from 1 to 9; write 2"),
        ("fast=1", "1 ... must be true or false"),
        ("note=12", "12 ... must be text; write it in quotes"),
        ("note=[a]", "[a] ... must be text"),
        ("legs=5", "5 ... must be 4 or 6"),
        ("start=conrer", "conrer ... must be default or corner; did you mean corner?"),
        ("gup=1", "unknown option; OWNER has start, legs, fast, count, gap or note; did you mean gap?"),
    ],
)  # fmt: skip
def test_a_wrong_option_is_one_line_with_what_is_allowed(group, given, message):
    (line,) = problems(f"{group}.options.{given}", source=BARE)
    owner = {"task": "point_maze", "search": "mine:search"}[group]
    expected = message.replace("...", "is not allowed;").replace("OWNER", owner)
    assert line == f"{group}.options.{given.split('=')[0]}: {expected}"


def test_all_problems_are_told_at_once_and_shipped_methods_have_no_options():
    wrong = ("task.options.gap=0", "search.options.count=0", "search.options.nothing=1", "search.sigma=0")
    assert [line.split(":")[0] for line in problems(*wrong, source=BARE)] == [
        "search.sigma",
        "task.options.gap",
        "search.options.count",
        "search.options.nothing",
    ]
    for name in ("es", "mine:plain"):
        (line,) = problems("search.options.gap=1", source=BARE, algorithm=name)
        assert line == f"search.options.gap: unknown option; {name} has none"
    (line,) = problems("search.options=3", source=BARE)
    assert "search.options is a section; set its keys one by one, such as search.options.NAME=..." in line


def test_a_choice_that_yaml_reads_as_another_type_may_be_written_plainly():
    task = replace(POINT_MAZE, options={"legs": choice("4", "6"), "on": choice("true", "false")})
    source = BARE | {"task": {"environment": "point_maze", "options": {"legs": 6, "on": False}}}
    loaded = load_config(source | {"search": {"algorithm": "es"}}, **KNOWN | {"tasks": {"point_maze": task}})
    assert loaded.task.options == {"legs": "6", "on": "false"}


@pytest.mark.parametrize(
    ("option", "text"),
    [
        (Option(1), "a whole number"),
        (Option(1.0, high=2), "a number, at most 2"),
        (Option(1.0, low=-1, high=2.5), "a number from -1 to 2.5"),
        (choice(4, 6, 8), "4, 6 or 8"),
    ],
)
def test_bounds_are_said_in_words(option, text):
    assert allowed_text(option) == text


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("gap", "options = 'gap' is not a mapping"),
        ({"gap": 2.0}, "option 'gap' = 2.0 is neither an Option nor a tuple"),
        ({"gap": ()}, "option 'gap' = () is neither an Option nor a tuple"),
        ({"the gap": ("a",)}, "option 'the gap' has a name that no argument can have"),
        ({"gap": (1, 2.0)}, "has values that are not all of one type"),
        ({"gap": Option(None)}, "has values that are not all of one type"),
        ({"gap": Option(1.0, low=2.0)}, "has a number outside its bounds"),
        ({"gap": Option(float("inf"))}, "or one that is not finite"),
        ({"gap": Option("a", high=2)}, "has bounds that are not numbers, or a default that is none"),
        ({"gap": Option(1, choices=(2, 3))}, "its default must be one of them"),
    ],
)
def test_a_wrong_declaration_says_what_is_wrong(options, problem):
    class Declares:
        pass

    Declares.options = options
    found, (wrong,) = declared_options(Declares)
    assert (found, problem in wrong) == ({}, True), wrong


def test_a_task_keeps_its_options_in_the_run_store_and_those_of_older_versions_are_read():
    task = replace(POINT_MAZE, options=OPTIONS)
    stored = json.loads(json.dumps(asdict(task)))
    assert task_from_fields(stored) == task
    older = stored | {"options": {"start": ["default", "corner"]}}
    assert task_from_fields(older).options == {"start": choice("default", "corner")}


def test_options_are_constants_and_a_config_without_them_has_no_new_ones():
    config = load("search.options.gap=3", source=BARE)
    assert config.constants()["search.options.gap"] == 3.0
    again = changed_config(parse_value(config.resolved_yaml()), **KNOWN)
    assert again == config
    assert changed_config(parse_value(config.resolved_yaml()), ["search.options.gap=4"], **KNOWN).search.options == (
        config.search.options | {"gap": 4.0}
    )
    assert not [key for key in api.load_config(MINIMAL).constants() if key.startswith("search.options")]


def test_another_search_leaves_out_the_options_of_the_one_it_replaces():
    source = BARE | {"search": {"algorithm": "mine:search", "options": {"gap": 3.0}}}
    assert load("search.algorithm=es", source=source).search.options == {}
    assert left_out(source, ["search.algorithm=es"]) == ["search.options.gap"]
    assert problems("search.algorithm=es", "search.options.gap=1", source=source) == [
        "search.options.gap: unknown option; es has none"
    ]


SMALL = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"algorithm": REPELLING, "centres": 2, "pairs": 16, "sigma": 0.2, "evaluation_episodes": 2},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1},
}


def test_a_sweep_over_an_option_of_a_search_has_a_run_for_each_value(tmp_path):
    runs = plan(SMALL, tmp_path, {"search.options.reach": [0, 0.25]}, [0])
    assert [(run.name, run.config.search.options) for run in runs] == [
        ("reach=0_seed=0", {"reach": 0.0}),
        ("reach=0.25_seed=0", {"reach": 0.25}),
    ]
    with pytest.raises(ConfigError) as caught:
        plan(SMALL, tmp_path, {"search.options.reach": [0.5, -1], "search.options.raech": [1]}, [0])
    assert [problem.sentence for problem in caught.value.problems] == [
        f"search.options.raech: unknown option; {REPELLING} has reach; did you mean reach?",
        "search.options.reach: -1 is not allowed; must be a number, at least 0.0",
    ]


def test_a_run_keeps_its_options_and_a_run_from_before_them_goes_on(tmp_path):
    run = api.run(api.load_config(SMALL, ["search.options.reach=0.25"]), tmp_path / "run").run
    assert run.constants["search.options.reach"] == 0.25
    assert parse_value((tmp_path / "run" / "config.yaml").read_text())["search"]["options"] == {"reach": 0.25}
    assert "search.options.reach" in {one.key for one in changed_settings(run.meta.config, POINT_MAZE)}
    with pytest.raises(ConfigError, match=r"search\.options\.reach: 0\.25 -> 0\.5"):
        api.resume(tmp_path / "run", ["search.options.reach=0.5"])
    fork = api.fork(tmp_path / "run", ["search.options.reach=0.5", "budget.generations=4"], out=tmp_path / "fork").run
    assert (fork.generation, fork.constants["search.options.reach"]) == (4, 0.5)
    assert api.resume(tmp_path / "run", ["budget.generations=4"]).run.digest() != fork.digest()
    config = api.load_config(SMALL)
    older = {key: value for key, value in config.constants().items() if not key.startswith("search.options")}
    assert changes_from(older, config) == []
    assert changes_from(older, api.load_config(SMALL, ["search.options.reach=0.25"])) == [
        ("search.options.reach", 0.5, 0.25)
    ]


def test_a_search_whose_options_have_changed_since_the_config_was_loaded_is_refused(tmp_path, monkeypatch):
    """Otherwise the run would have values of options that its search does not have."""
    text = "from es_service.protocol.options import Option, has_options\n"
    text += "from es_service.search.algorithms.es import es\n\n\n"
    text += "@has_options(reach=Option(0.5))\ndef search(config):\n    return es(config)\n"
    (tmp_path / "renamed_option.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    config = api.load_config("point_maze_es", ["search.algorithm=renamed_option:search"])
    assert config.search.options == {"reach": 0.5}
    (tmp_path / "renamed_option.py").write_text(text.replace("reach", "range_"))
    with pytest.raises(ConfigError, match="the options of the search renamed_option:search have changed since this"):
        api.run(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()
