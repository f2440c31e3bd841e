"""One word for each thing: none of the words that another one has replaced is in keys, columns, help or messages."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from es_service.cli import main
from es_service.cli.main import app
from es_service.config.keys import FIELDS, GROUPS, RENAMED, all_search_fields
from es_service.loop.history import history_columns
from es_service.search.algorithms import OURS
from workers.environments import SHIPPED

ROOT = Path(__file__).parents[2]
REPLACED = {
    r"\bmeta-populations?\b": "centres",
    r"\bjudge?ments?\b": "evaluation of a centre",
    r"\babsorb": "tell",
    r"\btruth\b": "bool",
    r"\btwins?\b": "reference implementation",
    r"\brepertoire\b": "behaviour map",
    r"\bsolutions?\b": "policy or centre",
}
"""A word that is not used -> what is written instead."""
NAMES = {
    "around": "with_subject",
    "bystander": "charge_item",
    "own_statistics": "per_lane_statistics, elite_statistics",
    "own_weights": "per_lane_weights",
    "standing": "run_status",
    "twin": "reference",
    "unfit": "problem",
    "way_on": "how_to_continue",
}
"""A name of functions, arguments, attributes or variables that is not used -> what has its place."""
MEMBERS = {"task.episodes_per_member", "invalid_members"}
"""Names that speak of members, the perturbed policies of a population."""


def replaced(text: str) -> list[str]:
    """A sentence for each word in a text that another one has replaced."""
    return [f"{word}: write {better}" for word, better in REPLACED.items() if re.search(word, text, re.IGNORECASE)]


def test_keys_and_columns() -> None:
    columns = {column.name for task in SHIPPED.values() for column in history_columns(task, True)}
    known = FIELDS | all_search_fields(OURS)
    for name in {*known, *GROUPS, *columns}:
        assert replaced(name.replace("_", " ")) == []
        assert "member" not in name or name in MEMBERS
    assert not RENAMED.keys() & known.keys()
    assert set(RENAMED.values()) <= known.keys()


def test_the_command_line_s_docstring_names_all_commands():
    """Its owner looks there first."""
    names = re.search(r"es-service (.*?)`", str(main.__doc__), re.DOTALL)
    assert names
    assert {*names[1].replace("|", " ").split()} == {*get_command(app).commands}  # type: ignore[attr-defined]


@pytest.mark.parametrize("command", [[], *([name] for name in get_command(app).commands)])  # type: ignore[attr-defined]
def test_help(command: list[str]) -> None:
    shown = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    assert replaced(shown.stdout) == []


SOURCES = sorted(path for package in ("es_service", "workers") for path in (ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_messages(path: Path) -> None:
    tree = ast.parse(path.read_text())
    documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    for text in texts:
        if id(text) not in documents:
            assert replaced(text.value) == [], text.value


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_names(path: Path) -> None:
    names = set[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        given = (getattr(node, field, None) for field in ("id", "arg", "attr", "name", "asname"))
        names |= {name.lower().lstrip("_") for name in given if isinstance(name, str)}
    assert {name: NAMES[name] for name in names & NAMES.keys()} == {}
