"""What is printed: the text of a user as it is, and commands that work when they are pasted."""

from __future__ import annotations

import io
import re
import shlex
from collections import deque
from dataclasses import replace
from pathlib import Path

import pytest
from rich.live import Live

import es_service.cli
from es_service import api
from es_service.cli import common, sweep
from es_service.cli.common import command, print_line, text_console
from es_service.cli.show import print_catalogue
from es_service.cli.status import print_overview, print_status, print_summary
from es_service.config.text import show
from es_service.errors import ConfigError, StoreError
from es_service.protocol.options import choice
from es_service.report import progress
from es_service.runs.sweep import SweptRun
from tests.es_service.test_progress import ROW
from tests.system.command_line import command as run_command
from tests.system.session import SMALL
from workers.environments import SHIPPED

STRANGE = ":smile: [red]x[/red] :V: [/]"
"""For rich, two emoji and three styles, of which the last is an error."""


@pytest.fixture
def console():
    made = text_console(width=200)
    made.file = io.StringIO()
    return made


def test_only_one_module_makes_consoles():
    """Others would have rich's defaults."""
    others = r"\bConsole\(|from rich import|typer\.(echo|secho|style)"
    files = Path(es_service.cli.__file__).parent.rglob("*.py")
    assert [file.name for file in files if re.search(others, file.read_text())] == ["common.py"]


@pytest.mark.slow
def test_names_and_values_of_a_user_are_printed_as_they_are(console, tmp_path, monkeypatch):
    folder = tmp_path / STRANGE.replace("/", "|")
    outcome = api.run(SMALL | {"budget": {"generations": 1}}, folder)
    print_summary(console, outcome.run, outcome.reason)
    print_status(console, outcome.run)
    print_overview(console, [folder, tmp_path / ":smile:"])
    task = replace(SHIPPED["point_maze"], name="my:T", summary=STRANGE, options={"[red]": choice(":V:", "[/]")})
    print_catalogue(console, {"my:T": task})
    runs = [SweptRun(STRANGE, folder, {}, "failed", None, STRANGE)]
    console.print(sweep.live_table(STRANGE, runs, 200, 40))
    monkeypatch.setattr(common, "console", console)
    monkeypatch.setattr(common, "errors", console)
    common.print_finding("FAIL", STRANGE)
    common.print_note(STRANGE)
    common.print_error(StoreError(STRANGE))
    printed = console.file.getvalue()
    assert printed.count(folder.name) >= 5
    assert printed.count(STRANGE) == 6
    assert f"option [red]: {show(':V:')} | {show('[/]')}" in printed
    assert not re.search("[\u2600-\U0010ffff]", printed.replace("●", ""))


def test_a_live_table_shows_the_name_of_a_run_as_it_is(console):
    with Live(console=console) as live:
        live.update(progress.live_table(STRANGE, deque([ROW]), 200, 40))
    assert STRANGE in console.file.getvalue()


def test_commands_can_be_pasted_from_a_narrow_terminal(tmp_path):
    """Also where the output is a pipe, which rich takes to have 80 columns, and for every kind of line."""
    folder = tmp_path / ("it's a 'long' $name " + "with words " * 9)
    for lines in (text_console(width=20), text_console()):
        lines.file = io.StringIO()
        print_line(lines, command("resume", folder))
        assert shlex.split(lines.file.getvalue())[1:] == ["resume", str(folder)]
    result = run_command("status", folder, COLUMNS="20")
    assert shlex.split(result.stderr.splitlines()[-1].partition(": ")[2])[1:] == ["run", "CONFIG", "--out", str(folder)]


@pytest.mark.slow
def test_the_error_of_a_config_shows_a_value_as_it_is(tmp_path):
    with pytest.raises(ConfigError, match=re.escape(STRANGE)):
        api.load_config(SMALL, [f"task.options.start='{STRANGE}'"])
    result = run_command("run", tmp_path / ":V:.yaml", "--set", f"task.options.start='{STRANGE}'")
    assert f"{tmp_path}/:V:.yaml" in result.stderr
