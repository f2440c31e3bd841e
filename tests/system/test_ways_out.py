"""Commands that messages name: they can be copied as they are, and do what is said of them."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import pytest

from es_service import api
from es_service.cli import common
from es_service.cli.common import error_message, text_console, way_command
from es_service.cli.status import follow_status, print_summary
from es_service.config.changes import again_with, refused_changes
from es_service.config.model import implied_by
from es_service.errors import ConfigError, NotInRunError, StoreError, WayOut
from es_service.runs.evaluation import candidates
from es_service.search.algorithms import ALGORITHMS
from es_service.store.lock import acquire_lock
from es_service.store.reader import read_generation
from es_service.store.writer import RunStore
from tests.database import execute
from tests.es_service.store_examples import flip_bit, without_root_rights
from tests.run_examples import write_run
from tests.system.command_line import COMPILES, PROGRAM, command
from tests.system.processes import running, wait_until
from tests.system.session import SMALL


def words_after(text: str, verb: str) -> list[str]:
    """Of the first command `es-service VERB ...` in a message."""
    found = re.search(rf"es-service {verb} ([^`\n]*)", text)
    assert found is not None, text
    return shlex.split(found[1])


def next_line(output) -> str:
    """The next line that a run prints; on a busy machine, it may first say that it compiles."""
    return next(line for line in output if not line.startswith(COMPILES))


def test_a_folder_with_spaces_is_one_word_of_every_command(tmp_path, capsys):
    folder = tmp_path / "it's a run"
    console = text_console(width=40)
    outcome = api.run(SMALL | {"budget": {"generations": 1}}, folder)
    print_summary(console, outcome.run, outcome.reason)
    follow_status(console, outcome.run)
    printed = capsys.readouterr().out
    commands = [line for line in printed.splitlines() if line.startswith("  ")]
    assert [shlex.split(line)[1:3] for line in commands] == [
        [verb, str(folder)] for verb in ("status", "report", "evaluate", "digest", "resume", "fork")
    ]
    assert words_after(printed.splitlines()[-1], "resume") == [str(folder), "--set", "budget.generations=2"]
    refused = error_message(refused_changes(folder, [("seed", 0, 1)], ALGORITHMS))
    assert words_after(refused, "fork") == [str(folder), "--set", "seed=1"]
    lock = acquire_lock(folder)
    with pytest.raises(StoreError) as locked:
        RunStore.open(folder)
    lock.release()
    assert words_after(error_message(locked.value), "status") == [str(folder), "--follow"]
    with pytest.raises(StoreError) as taken:
        api.run(SMALL, folder)
    assert words_after(error_message(taken.value), "resume") == [str(folder)]
    (folder / "run.db").rename(folder / "run.db.copy")
    with pytest.raises(StoreError) as missing:
        api.open_run(folder)
    assert words_after(error_message(missing.value), "resume") == [str(folder)]
    with pytest.raises(StoreError) as none:
        api.open_run(folder / "none")
    assert words_after(error_message(none.value), "run") == ["CONFIG", "--out", str(folder / "none")]
    empty_run = write_run(tmp_path / "no generation")
    for table in ("history", "state"):
        execute(empty_run, f"DELETE FROM {table}")
    with pytest.raises(NotInRunError) as empty:
        candidates(api.open_run(empty_run), best=True, centre=False, cells=(), every=False)
    assert words_after(error_message(empty.value), "resume") == [str(tmp_path / "no generation")]


def test_the_fork_that_a_refused_resume_names_goes_on(tmp_path):
    """Where the run's own budget is spent, a fork with it would do nothing."""
    folder = tmp_path / "run"
    api.run(SMALL | {"budget": {"generations": 2}}, folder)
    for wanted, budget in (([], 4), (["budget.generations=3"], 3)):
        with pytest.raises(ConfigError) as refused:
            api.resume(folder, ["search.sigma=0.3", *wanted])
        settings = ["--set", "search.sigma=0.3", "--set", f"budget.generations={budget}"]
        assert words_after(error_message(refused.value), "fork") == [str(folder), *settings]
    (folder / "config.yaml").unlink()
    with pytest.raises(ConfigError) as refused:
        api.run_or_resume(SMALL | {"budget": {"env_steps": 5000}, "seed": 1}, folder)
    wanted = ["seed=1", "budget.generations=null", "budget.env_steps=5000"]
    assert words_after(error_message(refused.value), "fork") == [
        str(folder),
        *(word for key in wanted for word in ("--set", key)),
    ]
    way = refused.value.way_out
    assert way is not None
    assert way.run == str(folder)
    assert (api.fork(way.run, way.settings, out=tmp_path / "fork").run.generation or 0) > 2


def test_a_call_with_too_many_workers_is_repeated_whole_by_its_way_out(config, tmp_path):
    """Of a new run, of a fork, and of a run that had the workers of a cluster: each with the settings asked for."""
    run, fork = tmp_path / "a run", tmp_path / "a fork"
    asked = ["search.sigma=0.3", "budget.generations=2"]
    options = [word for setting in asked for word in ("--set", setting)]
    refused = command("run", config, "--out", run, *options, "--workers", 10**6, "--engine", "inline")
    assert (refused.returncode, run.exists()) == (2, False)
    assert command("run", *words_after(refused.stderr, "run")).returncode == 0
    with pytest.raises(ConfigError) as error:
        api.fork(run, (*asked, "search.sigma=0.4", "compute.workers=1000000"), generation=1, out=fork)
    words = words_after(error_message(error.value), "fork")
    options[1] = "search.sigma=0.4"
    assert words == [str(run), "--generation", "1", "--out", str(fork), *options, "--set", "compute.workers=auto"]
    assert command("fork", *words).returncode == 0
    for folder, sigma in ((run, 0.3), (fork, 0.4)):
        made = api.open_run(folder)
        assert (made.config["search"]["sigma"], made.config["compute"]["workers"]) == (sigma, "auto")
        assert made.generation == 2
    assert (api.open_run(fork).meta.parent or {})["generation"] == 1
    recorded = run / "config.yaml"
    recorded.write_text(recorded.read_text().replace("workers: auto", "workers: 1000000"))
    with pytest.raises(ConfigError) as error:
        api.resume(run, {"compute.engine": "inline", "budget.generations": 3})
    way = error.value.way_out
    assert way is not None
    assert words_after(error_message(error.value), "resume") == [
        *[str(run), "--engine", "inline"],
        *["--set", "budget.generations=3", "--set", "compute.workers=auto"],
    ]
    assert api.resume(run, way.settings).run.generation == 3


def test_a_way_out_to_another_engine_takes_nothing_from_the_one_that_was_asked_for():
    asked = {"search.sigma": 0.3, "compute.address": "a:1", **implied_by(None, "a:1"), "compute.dispatch_log": True}
    inline = {"compute.engine": "inline", **implied_by("inline", None), "compute.workers": "auto"}
    way = again_with(WayOut("fork", "", "r", asked, generation=3), "go on here", inline)
    assert way.settings == {"search.sigma": 0.3, "compute.dispatch_log": True, **inline}
    assert way_command(way).endswith(
        " fork r --generation 3 --engine inline --set search.sigma=0.3 --set compute.dispatch_log=true"
        " --set compute.workers=auto"
    )


def test_commands_start_what_is_there(tmp_path, monkeypatch):
    """`make run` leaves es-service in .venv/bin, which is not in PATH; from a clone without an installation there is
    only the package."""
    assert common.command("list") == "es-service list"
    monkeypatch.setenv("PATH", os.defpath)
    assert shlex.split(common.command("list")) == [str(PROGRAM), "list"]
    (tmp_path / "a b").mkdir()
    python = tmp_path / "a b" / "python"
    python.symlink_to(sys.executable)
    monkeypatch.setattr(sys, "executable", str(python))
    assert shlex.split(common.command("list")) == [str(python), "-m", "es_service", "list"]
    for name, words in ((sys.executable, f"'{python}' -m es_service"), ("", "python -m es_service")):
        monkeypatch.setattr(sys, "executable", name)
        assert common.command("list") == f"{words} list"


def test_an_interruption_names_a_command_that_is_there(config, tmp_path):
    """Not in PATH, as after `make run`."""
    folder = tmp_path / "run"
    arguments = ["run", config, "--out", folder, "--set", "budget.generations=10000"]
    with running(PROGRAM, *arguments, env=os.environ | {"PATH": os.defpath}) as run:
        assert run.stdout is not None
        assert run.stdout.readline().startswith("generation 0")
        run.send_signal(signal.SIGINT)
        assert run.communicate(timeout=60)[1].endswith(f"Continue with: {PROGRAM} resume {folder}\n")


def test_run_or_resume_goes_on_where_only_the_copy_is_left(tmp_path):
    """As a kill between the renames of a restoration leaves it."""
    folder = tmp_path / "run"
    wanted = SMALL | {"budget": {"generations": 2}}
    api.run(wanted, folder)
    (folder / "run.db").rename(folder / "run.db.copy")
    notices = []
    assert api.run_or_resume(wanted, folder, on_notice=notices.append).run.generation == 2
    assert "Restored run.db.copy" in notices[0]
    (folder / "run.db").rename(folder / "run.db.copy")
    config = tmp_path / "config.yaml"
    config.write_text(api.load_config(wanted).resolved_yaml())
    assert command("run", config, "--or-resume", "--out", folder).returncode == 0


@pytest.mark.parametrize("folder", ["locked/run", "a" * 300])
def test_a_folder_that_cannot_be_looked_at(tmp_path, folder):
    (tmp_path / "locked").mkdir()
    (tmp_path / "locked").chmod(0)
    with without_root_rights(), pytest.raises(StoreError, match=r"looking for a run: .*Errno") as error:
        api.run_or_resume(SMALL, tmp_path / folder)
    assert str(tmp_path / folder) in str(error.value)
    config = tmp_path / "config.yaml"
    config.write_text(api.load_config(SMALL).resolved_yaml())
    result = command("run", config, "--or-resume", "--out", tmp_path / ("a" * 300))
    assert result.returncode == 1
    assert "Check that the folder" in result.stderr


def test_a_repair_is_told_once_also_if_the_command_is_then_refused(tmp_path):
    folder = tmp_path / "run"
    run = api.run(SMALL | {"budget": {"generations": 3}}, folder).run
    sound = (folder / "run.db").read_bytes()
    at = sound.rindex(run.policy("centre").parameters_D.tobytes())
    flip_bit(folder / "run.db", at + 8)
    refusal = command("digest", folder, "--parts")
    assert (refusal.returncode, refusal.stdout) == (1, "")
    assert re.search(r"state of 'centres/\d' at generation 3 does not match its SHA-256", refusal.stderr)
    assert words_after(refusal.stderr, "resume") == [str(folder)]
    for wanted, refused in (("search.sigma=0.3", True), ("budget.generations=3", False)):
        (folder / "run.db").write_bytes(sound)
        flip_bit(folder / "run.db", at + 8)
        notices: list[str] = []
        with pytest.raises(ConfigError) if refused else contextlib.nullcontext():
            api.resume(folder, [wanted], on_notice=notices.append)
        (notice,) = notices
        assert "fell back to generation 2" in notice
        assert run.generation == (2 if refused else 3)


@pytest.mark.parametrize("errors", [subprocess.PIPE, subprocess.STDOUT])
def test_a_run_goes_on_where_nobody_reads_its_output(tmp_path, errors):
    """With STDOUT, nobody reads its notes either."""
    folder, config = tmp_path / "run", tmp_path / "config.yaml"
    config.write_text(api.load_config(SMALL | {"budget": {"generations": 10**6}}).resolved_yaml())
    with running(sys.executable, "-m", "es_service", "run", config, "--out", folder, stderr=errors) as run:
        assert run.stdout is not None
        assert next_line(run.stdout).startswith("generation 0")
        run.stdout.close()
        time.sleep(2.5)  # it prints once a second
        if run.stderr:
            assert next_line(run.stderr).endswith(f"the run continues. Watch: es-service status {folder} --follow\n")
        reached = read_generation(folder) or 0
        wait_until(run, lambda: (read_generation(folder) or 0) > reached)
        run.terminate()
        assert run.wait(timeout=60) == 143


def test_output_that_has_no_sign_for_plus_or_minus(tmp_path):
    outcome = api.run(SMALL | {"budget": {"generations": 1}}, tmp_path / "run")
    assert " ? " in command("status", outcome.run.folder, PYTHONIOENCODING="ascii").stdout
