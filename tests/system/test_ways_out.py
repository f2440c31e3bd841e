"""Commands that messages name: they can be copied as they are, and do what is said of them."""

from __future__ import annotations

import re
import shlex

import pytest
from rich.console import Console

from es_service import api
from es_service.config.model import describe_changes
from es_service.errors import NotInRunError, StoreError
from es_service.evaluation import candidates
from es_service.report.status import follow_status, print_summary
from es_service.store.lock import acquire_lock
from es_service.store.writer import RunStore
from tests.es_service.store_examples import finished
from tests.system.session import SMALL


def words_after(text: str, verb: str) -> list[str]:
    """Of the first command `es-service VERB ...` in a message."""
    found = re.search(rf"(?:es-service|\S*pytest\S*|\S*__main__.py) {verb} ([^`\n]*)", text)
    assert found is not None, text
    return shlex.split(found[1])


def test_a_folder_with_spaces_is_one_word_of_every_command(tmp_path, capsys):
    folder = tmp_path / "it's a run"
    console = Console(width=40)
    outcome = api.run(SMALL | {"budget": {"generations": 1}}, folder)
    print_summary(console, outcome.run, outcome.reason)
    follow_status(console, outcome.run)
    printed = capsys.readouterr().out
    commands = [line for line in printed.splitlines() if line.startswith("  ")]
    assert [shlex.split(line)[1:3] for line in commands] == [
        [verb, str(folder)] for verb in ("status", "evaluate", "digest", "resume", "fork")
    ]
    assert words_after(printed.splitlines()[-1], "resume") == [str(folder)]
    assert words_after(describe_changes([("seed", 0, 1)], str(folder)), "fork") == [str(folder), "--set", "seed=1"]
    lock = acquire_lock(folder)
    with pytest.raises(StoreError) as locked:
        RunStore.open(folder)
    lock.release()
    assert words_after(str(locked.value), "status") == [str(folder), "--follow"]
    with pytest.raises(StoreError) as taken:
        api.run(SMALL, folder)
    assert words_after(str(taken.value), "resume") == [str(folder)]
    (folder / "run.db").rename(folder / "run.db.copy")
    with pytest.raises(StoreError) as missing:
        api.open_run(folder)
    assert words_after(str(missing.value), "resume") == [str(folder)]
    with pytest.raises(StoreError) as none:
        api.open_run(folder / "none")
    assert words_after(str(none.value), "run") == ["CONFIG", "--out", str(folder / "none")]
    with pytest.raises(NotInRunError) as empty:
        candidates(
            api.open_run(finished(tmp_path / "no generation", 0)), best=True, centre=False, cells=(), every=False
        )
    assert words_after(str(empty.value), "resume") == [str(tmp_path / "no generation")]
