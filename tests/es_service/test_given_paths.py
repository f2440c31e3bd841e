"""A leading ~ is the home folder in every path that a person or a program gives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import pytest
import typer
from typer.testing import CliRunner

import es_service
from es_service.cli.main import app
from es_service.config.given import shipped_text
from es_service.protocol.machine import given_path
from es_service.report import plots
from es_service.runs.tracking import tracked
from tests.system.session import SMALL

pytestmark = pytest.mark.usefixtures("workers_here")
CONFIG = SMALL | {"budget": {"generations": 1}}


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home folder with a config, and a working folder elsewhere in which nothing may be written."""
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    home.mkdir()
    elsewhere.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(elsewhere)
    (home / "c.yaml").write_text(shipped_text("point_maze_es"))
    yield home
    assert not list(elsewhere.iterdir())


def test_python_writes_and_reads_where_it_is_told(home):
    def there(*names: str) -> bool:
        return all((home / name).exists() for name in names)

    es_service.run(CONFIG, "~/a")
    assert es_service.open_run("~/a").folder == home / "a"
    es_service.resume("~/a", {"budget.generations": 2})
    es_service.run_or_resume(CONFIG, "~/b")
    es_service.run_or_resume(CONFIG, "~/b")
    es_service.fork("~/a", {"budget.generations": 3}, out=Path("~/c"))
    assert there("a/run.db", "b/run.db", "c/run.db")
    es_service.write_report("~/a", "~/a.html", best=False)
    es_service.write_comparison(["~/a", "~/b"], "~/compared.html")
    assert there("a.html", "compared.html")
    assert plots._data("~/a").folder == home / "a"
    assert es_service.polish_config("~/a").search.init_from == str(home / "a")
    assert es_service.load_config("~/c.yaml").search.algorithm == "es"
    es_service.certify_run("~/a", top=0, episodes=2)
    with tracked("~/a", [], print):
        pass
    asks = CONFIG | {"task": {"environment": "caller", "options": {"parameters": 2}}, "map": {"enabled": False}}
    asks = {key: value for key, value in asks.items() if key != "policy"}
    with es_service.ask_tell(asks, "~/asked") as search:
        search.ask()
    assert there("asked/run.db")


@pytest.mark.slow
def test_a_sweep_is_where_it_is_told(home):
    (run,) = es_service.sweep(CONFIG, "~/swept", seeds=[0])
    assert run.folder.parent == home / "swept"


def test_the_command_line_does_too_where_the_shell_has_left_it(home):
    short = ["--set=budget.generations=1", "--set=search.pairs=16", "--set=task.episode_steps=10"]
    for words in (
        ["run", "~/c.yaml", *short, "--out=~/d"],
        ["status", "~/d"],
        ["export", "~/d", "--to=csv", "--out=~/tables"],
        ["report", "~/d", "--out=~/d.html", "--replay=none"],
        ["fork", "~/d", "--set=budget.generations=2", "--out=~/e"],
        ["evaluate", "~/d", "--episodes=2", "--out=~/rows.csv"],
    ):
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, (words, done.output, done.exception)
    assert {"d", "e", "tables", "d.html", "rows.csv"} <= {file.name for file in home.iterdir()}


def test_every_path_of_the_command_line_is_read_by_one_function():
    """That of `submit --out` is text: a path on another machine."""
    groups = [app, *(group.typer_instance for group in app.registered_groups)]
    seen = set()
    for command in (command.callback for group in groups for command in group.registered_commands):
        assert command is not None
        for name, hint in get_type_hints(command, include_extras=True).items():
            if get_origin(hint) is Annotated and Path in _kinds(get_args(hint)[0]):
                (option,) = (one for one in get_args(hint)[1:] if isinstance(one, typer.models.ParameterInfo))
                assert option.parser is given_path, (command.__name__, name)
                seen.add(command.__name__)
    assert {"run", "resume", "fork", "status", "evaluate", "report", "export", "sweep", "watch", "verify"} <= seen


def _kinds(hint: object) -> set[object]:
    """The types of which a hint is made."""
    return {hint}.union(*map(_kinds, get_args(hint)))
