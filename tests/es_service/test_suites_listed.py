"""`es-service list --suite NAME` shows what a suite has, or how it is installed."""

from __future__ import annotations

import json
from importlib.util import find_spec

import pytest
from typer.testing import CliRunner

from es_service.cli.main import app
from es_service.errors import ConfigError


def test_a_suite_that_does_not_exist_gets_the_nearest():
    done = CliRunner().invoke(app, ["list", "--suite", "gymnaks"])
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception).endswith("jumanji, kheperax or playground; did you mean gymnax?")


@pytest.mark.parametrize("library", ["brax", "gymnasium", "mujoco"])
def test_a_library_that_is_no_suite_is_answered_with_its_guide(library):
    done = CliRunner().invoke(app, ["list", "--suite", library])
    assert f"{library} is no suite" in str(done.exception)
    assert str(done.exception).endswith("es-service help other_suites has them")


@pytest.mark.slow
def test_a_suite_is_listed_with_its_sizes_or_with_its_extra():
    done = CliRunner().invoke(app, ["list", "--suite", "kheperax", "--json"])
    if find_spec("kheperax") is None:
        assert isinstance(done.exception, ConfigError)
        assert "es-service with its extra, 140 MB with qdax, in a clone of es-service: pip" in str(done.exception)
        return
    rows = json.loads(done.stdout)
    assert {row["name"] for row in rows} == {f"kheperax:{maze}" for maze in ("standard", "pointmaze", "snake")}
    assert {(row["observation_size"], row["action_size"], row["episode_steps"]) for row in rows} == {(5, 2, 1000)}
    shown = CliRunner().invoke(app, ["list", "--suite", "kheperax"]).stdout
    assert shown.startswith("3 environments: kheperax:standard, ")
    assert "option descriptor: null (a list of places in an observation" in shown
    assert "observation 5, action 2, steps 1000" in shown
