"""A task that does not repeat itself: its run says so, and `verify` does not call the run wrong."""

from __future__ import annotations

import json
from io import StringIO

import pytest
import typer
from rich.console import Console

from es_service import api
from es_service.cli.session import verify
from es_service.cli.status import print_status
from es_service.config.tasks import TASKS
from tests.helpers import workers_in_this_process

FORGETFUL, DRIFT = (f"python:tests.workers.host_tasks:{name}" for name in ("Forgetful", "Drift"))
RESTLESS = "function:tests.workers.functions:restless"


def done(environment, folder, notices):
    config = {
        "task": {"environment": environment},
        "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 2},
        "map": {"enabled": False},
        "budget": {"generations": 2},
        "compute": {"engine": "inline", "workers": 1},
    }
    if environment != RESTLESS:
        config |= {"policy": {"hidden": [4]}}
    with workers_in_this_process():
        return api.run(config, folder, on_notice=notices.append).run


def verified(run, capsys):
    with pytest.raises(typer.Exit) as ended:
        verify(run.folder, generations=1, workers=1, as_json=True)
    said = capsys.readouterr()
    return ended.value.exit_code, json.loads(said.out)


@pytest.mark.slow
def test_a_run_records_that_its_task_does_not_repeat_itself_and_verify_says_so(tmp_path, capsys):
    notices: list[str] = []
    run = done(FORGETFUL, tmp_path / "run", notices)
    assert TASKS[FORGETFUL].does_not_repeat == run.meta.task["does_not_repeat"] == "after another episode"
    assert notices[0].startswith(
        f"{FORGETFUL} does not repeat itself: with the same seed and actions it returns other "
    )
    console = Console(file=StringIO(), width=200)
    print_status(console, run)
    assert "not repeatable     the task returns other numbers for the same seed after another episode\n" in (
        console.file.getvalue()
    )
    code, said = verified(run, capsys)
    assert (code, said["equal"], said["does_not_repeat"]) == (3, False, "after another episode")
    with pytest.raises(typer.Exit):
        verify(run.folder, generations=1, workers=1)
    assert "So the differences do not say that the run is wrong" in capsys.readouterr().err


@pytest.mark.slow
def test_what_a_function_does_is_found_by_verify_and_a_task_that_repeats_is_equal(tmp_path, capsys):
    notices: list[str] = []
    code, said = verified(done(RESTLESS, tmp_path / "restless", notices), capsys)
    assert (code, said["does_not_repeat"]) == (3, "after another call and in another process")
    code, said = verified(done(DRIFT, tmp_path / "drift", notices), capsys)
    assert (code, said["equal"], said["does_not_repeat"]) == (0, True, "")
    assert notices == []
