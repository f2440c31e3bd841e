"""Options that tasks declare: read, checked, and kept as constants of the run."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from es_service.config.tasks import task_from_fields
from es_service.config.text import parse_value, show
from es_service.errors import ConfigError
from es_service.protocol.options import Option, allowed_text, choice, declared_options
from es_service.search.algorithms import ALGORITHMS
from tests.es_service.config_examples import MINIMAL, POINT_MAZE, changed_config, load_config
from workers.rollouts import BACKENDS

OPTIONS = {
    "start": choice("default", "corner"),
    "legs": choice(4, 6),
    "fast": Option(False),
    "count": Option(3, low=1, high=9),
    "gap": Option(2.0, low=0.5),
    "note": Option("plain"),
}
KNOWN = {"tasks": {"point_maze": replace(POINT_MAZE, options=OPTIONS)}, "algorithms": ALGORITHMS, "rollouts": BACKENDS}


def load(*overrides, source=MINIMAL):
    return load_config(source, overrides, **KNOWN)


def problems(*overrides):
    with pytest.raises(ConfigError) as caught:
        load(*overrides)
    return [problem.sentence for problem in caught.value.problems]


def test_options_have_their_defaults_and_the_types_that_are_declared():
    options = load().task.options
    assert options == {"start": "default", "legs": 4, "fast": False, "count": 3, "gap": 2.0, "note": "plain"}
    values = {"start": "corner", "legs": 6, "fast": True, "count": 9, "gap": 5, "note": "12"}
    source = MINIMAL | {"task": {**MINIMAL["task"], "options": values}}
    given = [f"task.options.{name}={json.dumps(value)}" for name, value in values.items()]
    for found in (load(source=source), load(*given), load(*given[::-1], source=source)):
        options = found.task.options
        assert options == values
        assert {name: type(value) for name, value in options.items()} == {
            name: type(option.default) for name, option in OPTIONS.items()
        }


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
def test_a_wrong_option_is_one_line_with_what_is_allowed(given, message):
    (line,) = problems(f"task.options.{given}")
    expected = message.replace("...", "is not allowed;").replace("OWNER", "point_maze")
    assert line == f"task.options.{given.split('=')[0]}: {expected}"


def test_all_problems_are_told_at_once():
    wrong = ("task.options.gap=0", "task.options.nothing=1", "search.sigma=0")
    assert [line.split(":")[0] for line in problems(*wrong)] == [
        "search.sigma",
        "task.options.gap",
        "task.options.nothing",
    ]
    (line,) = problems("task.options=3")
    assert line == "task.options: this is a section; set its keys one by one, such as task.options.NAME=..."


def test_a_choice_that_yaml_reads_as_another_type_may_be_written_plainly():
    task = replace(POINT_MAZE, options={"legs": choice("4", "6"), "on": choice("true", "false")})
    source = MINIMAL | {"task": {"environment": "point_maze", "options": {"legs": 6, "on": False}}}
    loaded = load_config(source, **KNOWN | {"tasks": {"point_maze": task}})
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
    assert allowed_text(option, show) == text


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


def test_a_task_keeps_its_options_in_the_run_store_and_fields_of_older_versions_are_left_out():
    task = replace(POINT_MAZE, options=OPTIONS)
    stored = json.loads(json.dumps(asdict(task)))
    assert repr(task_from_fields(stored)) == repr(task)  # bounds that are whole numbers stay so
    assert task_from_fields(stored | {"no_simd": "only older ones had it"}) == task


def test_options_are_constants():
    config = load("task.options.gap=3")
    assert config.constants()["task.options.gap"] == 3.0
    stored = parse_value(config.resolved_yaml())
    assert changed_config(stored, **KNOWN) == config
    changed = changed_config(stored, ["task.options.gap=4"], **KNOWN)
    assert changed.task.options == config.task.options | {"gap": 4.0}
