"""Keys that a search of the user declares: read, checked, swept, and kept as constants of the run."""

from __future__ import annotations

import ast
import inspect
import json
import sys

import pytest

from es_service import api
from es_service.config import search
from es_service.config.text import parse_value
from es_service.errors import ConfigError
from es_service.report.summary import changed_settings
from es_service.runs.checked_config import changed_config, changes_from
from es_service.runs.sweep_plan import plan
from tests.es_service.config_examples import MINIMAL, POINT_MAZE, left_out

pytestmark = pytest.mark.usefixtures("workers_here")

REPELLING = "tests.examples.repelling_centres:repelling_centres"
SMALL = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"algorithm": REPELLING, "centres": 2, "pairs": 16, "sigma": 0.2, "evaluation_episodes": 2},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1},
}
KINDS_OF_KEYS = """
from typing import Literal

from pydantic import Field

from es_service.config.search import PopulationConfig
from es_service.search.algorithms.es import es
from es_service.search.algorithms.method import method


class Settings(PopulationConfig):
    start: Literal["default", "corner"] = "default"
    fast: bool = False
    count: int = Field(3, ge=1, le=9)
    gap: float = Field(2.0, gt=0.5)
    note: str = "plain"


@method(Settings)
def search(config):
    return es(config)


def plain(config):
    return es(config)


@method(dict)
def wrong(config):
    return es(config)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module of the user with a search that has keys of its own, and one that declares none."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "kinds_of_keys", raising=False)
    (tmp_path / "kinds_of_keys.py").write_text(KINDS_OF_KEYS)
    return MINIMAL | {"search": {"algorithm": "kinds_of_keys:search"}}


def problems(source, *overrides):
    with pytest.raises(ConfigError) as caught:
        api.load_config(source, overrides)
    return [problem.sentence for problem in caught.value.problems]


def test_keys_have_their_defaults_and_the_types_that_are_declared(own):
    defaults = {"start": "default", "fast": False, "count": 3, "gap": 2.0, "note": "plain"}
    values = {"start": "corner", "fast": True, "count": 9, "gap": 5, "note": "12"}
    assert api.load_config(own).search.model_dump(include=defaults.keys()) == defaults
    given = [f"search.{name}={json.dumps(value)}" for name, value in values.items()]
    source = own | {"search": own["search"] | values}
    for found in (api.load_config(source), api.load_config(own, given)):
        assert found.search.model_dump(include=values.keys()) == values
        assert type(found.search.gap) is float
        again = parse_value(found.resolved_yaml())
        assert api.load_config(again) == changed_config(again) == found


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("gap=0.4", "0.4 is not allowed; must be a number, above 0.5"),
        ("gap=.nan", ".nan is not allowed; must be a number, above 0.5"),
        ("gap='2.0'", "'2.0' is not allowed; must be a number, above 0.5; remove the quotes around 2.0"),
        ("count=10", "10 is not allowed; must be a whole number, at least 1, at most 9"),
        ("fast=1", "1 is not allowed; must be true or false"),
        ("note=12", "12 is not allowed; must be text; write it in quotes"),
        ("start=conrer", "conrer is not allowed; must be default or corner; did you mean corner?"),
        ("gup=1", "unknown key; did you mean search.gap?"),
        ("iso_sigma=1", "1 has no effect with kinds_of_keys:search; leave it out (a key of map_elites)"),
        ("options.gap=1", "this key is now search.gap"),
    ],
)
def test_a_wrong_value_is_one_line_with_what_is_allowed(own, given, message):
    assert problems(own, f"search.{given}") == [f"search.{given.split('=')[0]}: {message}"]


def test_what_validators_of_the_class_find_is_told_with_all_other_problems(own, tmp_path):
    """Also where a preset gives keys that the config leaves out, such as search.pairs."""
    validators = """
    @field_validator("note")
    @classmethod
    def _is_short(cls, note: str) -> str:
        assert len(note) < 9, "must be short"
        return note

    @model_validator(mode="after")
    def _fits(self) -> "Settings":
        if self.gap > self.count:
            raise ValueError("gap must not be above count")
        return self
"""
    text = KINDS_OF_KEYS.replace('note: str = "plain"\n', f'note: str = "plain"\n{validators}')
    text = text.replace("import Field\n", "import Field, field_validator, model_validator\n")
    (tmp_path / "kinds_of_keys.py").write_text(text)
    assert problems(own, "search.gap=5", "map.cells=[0]") == [
        "map.cells: [0] is not allowed; must be auto or a list of whole numbers, each at least 1, such as [20, 20], or "
        "one such number",
        "search: gap must not be above count",
    ]
    assert problems(own, "search.note=much too long") == ["search.note: must be short"]
    assert api.load_config(own, ["search.gap=5", "search.count=6"]).search.gap == 5.0


def test_a_key_without_a_default_must_be_given(own, tmp_path):
    (tmp_path / "kinds_of_keys.py").write_text(KINDS_OF_KEYS.replace("fast: bool = False", "fast: bool"))
    assert problems(own, "seed=-1")[1:] == ["search.fast: missing; must be true or false"]
    assert api.load_config(own, ["search.fast=true"]).search.model_dump()["fast"]


def test_a_search_that_declares_nothing_has_the_keys_of_methods_with_several_centres(own):
    source = own | {"search": {"algorithm": "kinds_of_keys:plain"}}
    config = api.load_config(source, ["search.update=all", "search.centres=3", "search.step.kind=plain"])
    assert (config.search.update, config.search.populations(), config.search.step.kind) == ("all", 3, "plain")
    (line,) = problems(source, "search.gap=1")
    assert line.startswith("search.gap: unknown key; ")
    (line,) = problems(own | {"search": {"algorithm": "kinds_of_keys:wrong"}})
    assert "its settings are <class 'dict'>; they must be a class that derives from" in line


def test_another_search_leaves_out_the_keys_of_the_one_it_replaces(own):
    source = own | {"search": own["search"] | {"gap": 3.0, "sigma": 0.3}}
    config = api.load_config(source, ["search.algorithm=es"])
    assert (config.search.sigma, "gap" in config.search.model_dump()) == (0.3, False)
    assert left_out(source, ["search.algorithm=es"]) == {"search.gap": "es replaces its algorithm"}


def test_a_search_that_calls_one_of_ours_with_more_keys_is_told_to_declare_them(own, tmp_path):
    text = "from es_service.search.algorithms.me_es import me_es\n\n\ndef search(config):\n    return me_es(config)\n"
    (tmp_path / "calls_me_es.py").write_text(text)
    with pytest.raises(ConfigError, match="what it calls needs MeEsSettings; declare a class that derives from it"):
        api.load_config(own, ["search.algorithm=calls_me_es:search"])


def test_a_sweep_over_a_key_of_a_search_has_a_run_for_each_value(tmp_path):
    runs = plan(SMALL, tmp_path, {"search.reach": [0, 0.25]}, [0])
    assert [(run.name, run.config.search.reach) for run in runs] == [
        ("reach=0_seed=0", 0.0),
        ("reach=0.25_seed=0", 0.25),
    ]
    with pytest.raises(ConfigError) as caught:
        plan(SMALL, tmp_path, {"search.reach": [0.5, -1], "search.raech": [1]}, [0])
    assert [problem.sentence for problem in caught.value.problems] == [
        "search.raech: unknown key; did you mean search.reach?",
        "search.reach: -1 is not allowed; must be a number, at least 0",
    ]


def test_a_run_keeps_its_keys_and_a_run_from_before_them_goes_on(tmp_path):
    run = api.run(api.load_config(SMALL, ["search.reach=0.25"]), tmp_path / "run").run
    assert run.constants["search.reach"] == 0.25
    assert parse_value((tmp_path / "run" / "config.yaml").read_text())["search"]["reach"] == 0.25
    assert "search.reach" in {one.key for one in changed_settings(run.meta.config, POINT_MAZE)}
    with pytest.raises(ConfigError, match=r"search\.reach: 0\.25 -> 0\.5"):
        api.resume(tmp_path / "run", ["search.reach=0.5"])
    fork = api.fork(tmp_path / "run", ["search.reach=0.5", "budget.generations=4"], out=tmp_path / "fork").run
    assert (fork.generation, fork.constants["search.reach"]) == (4, 0.5)
    assert api.resume(tmp_path / "run", ["budget.generations=4"]).run.digest() != fork.digest()
    config = api.load_config(SMALL)
    older = {key: value for key, value in config.constants().items() if key != "search.reach"}
    assert changes_from(older, config) == []
    assert changes_from(older, api.load_config(SMALL, ["search.reach=0.25"])) == [("search.reach", 0.5, 0.25)]


def test_a_search_whose_keys_have_changed_since_the_config_was_loaded_is_refused(own, tmp_path):
    """Otherwise the run would have values of keys that its search does not have."""
    config = api.load_config(own)
    (tmp_path / "kinds_of_keys.py").write_text(KINDS_OF_KEYS.replace("gap", "range_"))
    with pytest.raises(ConfigError, match="the settings of the search kinds_of_keys:search have changed since this"):
        api.run(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_language_server_knows_the_keys_of_methods_that_perturb_centres():
    """They are declared for it in SearchConfig, since that is the type of `config.search`."""
    of_search = ast.parse(inspect.getsource(search.SearchConfig)).body[0]
    assert isinstance(of_search, ast.ClassDef)
    (declared,) = (part.body for part in of_search.body if isinstance(part, ast.If))
    names = {
        part.target.id for part in declared if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
    }
    assert names == search.PopulationConfig.model_fields.keys() - search.SearchConfig.model_fields.keys()
