"""What `status`, and a session at its end, say of a run."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from es_service import api
from es_service.cli import status
from es_service.cli.common import settings, text_console
from es_service.cli.main import app
from es_service.cli.status import follow_status, print_overview, print_status, print_summary
from es_service.errors import ConfigError, Interrupted
from es_service.loop.state import Stop
from es_service.report.data import read_run
from es_service.report.summary import what_was_run
from es_service.runs import run_status
from es_service.runs.run_status import RunStatus, more, read_status, state
from es_service.store import reader
from es_service.store.lock import acquire_lock
from tests.database import execute
from tests.run_examples import write_run
from tests.system.session import SMALL

pytestmark = pytest.mark.usefixtures("workers_here")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Five generations of five."""
    return api.run(SMALL | {"budget": {"generations": 5}}, tmp_path_factory.mktemp("status") / "run").run


@pytest.fixture
def console():
    return text_console(width=40)


def test_of_a_long_history_only_the_newest_row_is_read(run, console, monkeypatch, capsys):
    def no_more_than_one(connection, meta, first, limit=None):
        assert first >= 5
        return sound_rows(connection, meta, first, limit)

    sound_rows = reader._sound_rows
    monkeypatch.setattr(reader, "_sound_rows", no_more_than_one)
    monkeypatch.setattr(run_status, "FAULTS_OF", 1)
    monkeypatch.setattr(run_status, "CENTRES", 1)
    print_status(console, run)
    follow_status(console, run)
    print_summary(console, run, "")
    assert "\ngeneration 5 " in capsys.readouterr().out


def test_the_faults_of_the_newest_generations_are_counted(console, tmp_path, monkeypatch, capsys):
    run = api.open_run(write_run(tmp_path / "run", generations=20))  # its only faults are those of generation 5
    counted = "\nfaults handled     1 worker replaced, 2 chunks sent again"
    for most, expected in ((1000, [f"{counted}\n"]), (16, [f"{counted} in the last 16 generations\n"]), (15, [])):
        for module in (run_status, status):
            monkeypatch.setattr(module, "FAULTS_OF", most)
        print_status(console, run)
        assert re.findall("\nfaults .*\n", capsys.readouterr().out) == expected


@pytest.mark.parametrize("invalid", [0, 52])
def test_the_share_of_invalid_members_is_said_after_the_run_if_there_were_any(console, tmp_path, capsys, invalid):
    run = api.open_run(write_run(tmp_path / "run", {"search.pairs": 100}, invalid=invalid))
    print_status(console, run)
    print_summary(console, run, "")
    expected = "26 % of the last generation"
    lines = re.findall("\ninvalid members +(.*)\n", capsys.readouterr().out)
    assert lines == [expected] * 2 * bool(invalid)
    assert dict(what_was_run(read_run(run.folder))).get("invalid members") == (expected if invalid else None)


@pytest.mark.parametrize(
    ("invalid_G", "moved", "evaluated", "expected"),
    [
        ([0, 7, 3], 2, 2, "1.5 % of the last generation"),
        ([float("nan"), 0, 1], 2, 2, "0.5 % of the last generation"),
        ([200], 2, 2, "100 % of the last generation"),
        ([0, 7, 0], 2, 2, "none in the last generation, 7 in the last 3"),
        ([0, 7, 3], 0, 5, "3 in the last generation"),  # policies, which are no population
        ([0, 7, 3], 1, 2, "3 in the last generation"),
        ([0, 0, 0], 2, 2, ""),
        ([], 0, 0, ""),
    ],
)
def test_invalid_members_are_a_share_where_the_number_of_members_is_known(invalid_G, moved, evaluated, expected):
    assert run_status.invalid_members({"search.pairs": 50}, invalid_G, moved, evaluated) == expected


@pytest.mark.parametrize(
    ("search", "expected"),
    [
        (
            {"algorithm": "me_es", "emitters": 4},
            ["centres            2 exploring, 2 exploiting; of the last 12, 50.0 % explored"],
        ),
        ({"algorithm": "ns_es"}, ["weight of fitness  0 (novelty: 1)"]),
        ({"algorithm": "jedi"}, ["objectives         nearness to targets, and fitness"]),
        (
            {"algorithm": "memes", "emitters": 2, "objectives": [{"kind": "novelty"}, {"kind": "goal_distance"}]},
            ["objectives         novelty, goal_distance"],
        ),
        ({"algorithm": "map_elites", "batch": 16}, []),
    ],
)
def test_what_the_centres_climb_is_told_of_all_and_not_of_the_fittest(search, expected, console, tmp_path, capsys):
    config = {"search": {"pairs": 16, "evaluation_episodes": 1} | search, "budget": {"generations": 3}}
    if "batch" in search:  # no populations, so neither pairs nor chunks of them
        del config["search"]["pairs"]
        config["compute"] = {"engine": "inline", "workers": 1}
    run = api.run(SMALL | config, tmp_path / "run").run
    print_status(console, run)
    assert re.findall("\n((?:centres|weight of fitness|objectives) .*)", capsys.readouterr().out) == expected


def test_the_spread_of_one_episode_is_not_told(console, tmp_path, capsys):
    for episodes, spread in ((1, ""), (2, " ± 1.00")):
        run = api.open_run(write_run(tmp_path / str(episodes), {"search.evaluation_episodes": episodes}))
        print_status(console, run)
        [shown] = re.findall("\ncentre fitness +(.*)\n", capsys.readouterr().out)
        assert shown == f"{read_status(run).row['centre_fitness_mean']:.2f}{spread}"


def test_with_one_centre_a_generation_the_share_is_that_of_recent_generations(console, tmp_path, monkeypatch, capsys):
    """It exploited in generations 10 to 19, and explored before and after."""
    run = api.open_run(write_run(tmp_path / "run", generations=20))
    for centres, expected in ((1000, "of the last 20, 50.0 % explored"), (3, "of the last 3, 33.3 % explored")):
        monkeypatch.setattr(run_status, "CENTRES", centres)
        print_status(console, run)
        assert f"\ncentres            1 exploring, 0 exploiting; {expected}\n" in capsys.readouterr().out


def test_a_damaged_row_hides_only_what_is_read_from_it(console, tmp_path, capsys):
    """The newest row, of which the rest is read, is intact."""
    run = api.open_run(write_run(tmp_path / "run", generations=10))
    print_status(console, run)
    whole = capsys.readouterr().out.splitlines()
    execute(run.folder, "UPDATE history SET sha256 = x'00' WHERE generation = 4")
    problem = f"{run.folder} cannot be read: the history row of generation 4 is damaged or missing"
    gone = f"not known          objectives and faults of the recent generations: {problem}"
    print_status(console, run)
    left = [line for line in whole if not line.startswith(("centres ", "faults handled"))]
    assert len(left) == len(whole) - 2
    assert capsys.readouterr().out.splitlines() == [*left, gone]
    print_summary(console, run, "")
    assert f"\n{gone}\n" in capsys.readouterr().out
    shown = CliRunner().invoke(app, ["status", str(run.folder), "--json"])
    [data] = json.loads(shown.stdout)
    assert (shown.exit_code, data["newest"]["generation"]) == (0, 10)
    assert data["objectives"] == {"newest": None, "recent": None, "problem": problem}


@pytest.mark.parametrize(
    ("budget", "spent", "options"),
    [
        ({"generations": 3}, "generations is spent", {"budget.generations=6"}),
        ({"env_steps": 6000, "generations": 90}, "steps is spent", {"budget.env_steps=12000"}),
        ({"env_steps": 10}, "steps is spent", {"budget.env_steps=1200"}),
        pytest.param({"wall_clock_s": 1e-6}, "s was spent", None, marks=pytest.mark.slow),
        ({"target_fitness": -1e9, "generations": 4}, "is reached", {"budget.target_fitness=null"}),
        ({"target_fitness": -1e9}, "is reached", {"budget.target_fitness=null", "budget.generations=2"}),
    ],
)
def test_what_it_suggests_goes_on(budget, spent, options, console, tmp_path, capsys, noticed):
    """With more of the budget that is spent: more of another one would change nothing."""
    run = api.run(SMALL | {"budget": budget}, tmp_path / "run").run
    print_summary(console, run, "")
    print_status(console, run)
    printed = capsys.readouterr().out
    suggested = settings(more(read_status(run)))
    how = "stopped before its first generation: only starting" if "was spent" in spent else "finished: the"
    assert f"state              {how} " in printed
    assert ("\nNot done: ." if "was spent" in spent else "\nDone: .") in printed
    assert spent in printed
    assert printed.count(f"resume {run.folder} {' '.join(suggested)}") == 2
    assert suggested[::2] == ["--set"] * len(suggested[1::2])
    assert options is None or set(suggested[1::2]) == options
    before = run.generation or 0
    with pytest.raises(ConfigError, match="to continue from its state") as refused:
        api.resume(run.folder, {"search.sigma": 0.05})
    way = refused.value.way_out
    assert way is not None
    assert (way.action, way.run) == ("fork", str(run.folder))
    assert way.settings == {"search.sigma": 0.05, **more(read_status(run))}
    empty = api.fork(run.folder, ["search.sigma=0.05"], out=tmp_path / "empty").run
    assert noticed[-1].startswith("note: no generation was run")
    assert more(read_status(empty)) == more(read_status(run))
    for going_on in (
        api.fork(way.run, way.settings, out=tmp_path / "fork"),
        api.resume(empty.folder, suggested[1::2]),
        api.resume(run.folder, suggested[1::2]),
    ):
        assert (going_on.run.generation or 0) > before


def test_without_a_folder_the_newest_runs_are_shown(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = CliRunner().invoke(app, ["status"])
    assert (told.exit_code, told.stdout) == (0, "")
    for age, name in ((5, "old"), (1, "new")):
        shutil.copytree(run.folder, tmp_path / "runs" / name)
        os.utime(tmp_path / "runs" / name / "run.db", (1e9 - age, 1e9 - age))
    shown = CliRunner().invoke(app, ["status"], env={"COLUMNS": "200"}).stdout.splitlines()
    assert [line.split()[0] for line in shown] == ["run", "runs/new", "runs/old"]
    monkeypatch.setattr("es_service.cli.status.NEWEST", 1)
    found = CliRunner().invoke(app, ["status"], env={"COLUMNS": "200"})
    assert [line.split()[0] for line in found.stdout.splitlines()] == ["run", "runs/new"]
    assert "the 1 newest of 2 runs under runs/; all: es-service status runs/" in found.stderr
    assert len(json.loads(CliRunner().invoke(app, ["status", "--json"]).stdout)) == 1
    refused = CliRunner().invoke(app, ["status", "--follow"])
    assert "--follow: needs exactly one folder, got 0" in str(refused.exception)


def test_budgets_are_shown_beside_what_is_reached(run, console, capsys):
    api.resume(run.folder, ["budget.env_steps=1_000_000", "budget.target_fitness=-1.5", "budget.wall_clock_s=600"])
    print_status(console, run)
    printed = capsys.readouterr().out
    assert "\ngeneration         5 of 5\n" in printed
    assert " of 1,000,000 in " in printed
    assert "(target: -1.5)" in printed
    assert " of 600.0 s, " in printed


def test_stopped_and_running(run, console, capsys):
    api.resume(run.folder, ["budget.generations=5", "budget.wall_clock_s=1e9"])
    config = run.folder / "config.yaml"
    text = config.read_text()
    config.write_text(text.replace("generations: 5", "generations: 8000"))  # as a driver leaves it that was killed
    print_status(console, run)
    assert (
        f"stopped before its budget was spent; continue with: es-service resume {run.folder}\n"
        in capsys.readouterr().out
    )
    lock = acquire_lock(run.folder)
    lock.say(waiting=True)
    print_status(console, run)
    assert "state              waiting for a first place in the cluster since 2" in (printed := capsys.readouterr().out)
    assert f"; driver on {socket.gethostname()}, pid {os.getpid()}\n" in printed
    lock.say(doing="compiling for point_maze")
    print_status(console, run)
    assert re.search(r"state +running on .*; compiling for point_maze\n", capsys.readouterr().out)
    lock.say()
    print_status(console, run)
    lock.release()
    assert "state              running on " in (printed := capsys.readouterr().out)
    assert " left\n" in printed
    assert "\ngeneration         5 of 8,000\n" in printed
    config.write_text(text)


@pytest.mark.parametrize(
    ("end", "told"),
    [
        (Stop("that is enough"), "that is enough"),
        (ValueError("no\n luck"), "ValueError: no luck"),
        (Interrupted(signal.SIGTERM), "interrupted by SIGTERM"),
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (SystemExit(0), "the program that ran it has ended it with sys.exit(0), as tuners end their trials"),
        (SystemExit(), "the program that ran it has ended it with sys.exit(), as tuners end their trials"),
    ],
)
def test_why_a_run_has_stopped_is_told_until_it_is_finished(end, told, tmp_path):
    def ends(row):
        if isinstance(end, BaseException):
            raise end
        return end

    folder = tmp_path / "run"
    with contextlib.suppress(ValueError, KeyboardInterrupt, SystemExit):
        api.run(SMALL | {"budget": {"generations": 2}}, folder, on_generation=ends)
    assert state(read_status(api.open_run(folder))) == f"stopped before its budget was spent: {told}"
    assert state(read_status(api.resume(folder).run)) == "finished: the budget of 2 generations is spent"
    (folder / "config.yaml").write_text(
        (folder / "config.yaml").read_text().replace("generations: 2", "generations: 3")
    )
    assert state(read_status(api.open_run(folder))) == "stopped before its budget was spent"


def test_who_follows_a_run_is_told_once_that_it_waits_or_compiles(run, console, monkeypatch, capsys):
    lock = acquire_lock(run.folder)
    waits, compiles, works = {"waiting": True}, {"doing": "compiling"}, {}
    seconds = iter((works, waits, waits, compiles, compiles, works, waits, None))

    def a_second_later(_: float) -> None:
        said = next(seconds)
        lock.release() if said is None else lock.say(**said)

    monkeypatch.setattr(status, "time", SimpleNamespace(sleep=a_second_later))
    follow_status(console, run)
    printed = capsys.readouterr().out
    assert (printed.count("waiting for a first place"), printed.count("; compiling\n")) == (2, 1)


def test_time_to_go_is_that_of_the_budget_that_is_spent_first(run):
    row = {"generation": 100, "env_steps": 10**6, "wall_clock_s": 3600.0, "best_fitness": 0.0}

    def running(limits):
        return state(RunStatus(run, {"host": "a", "pid": 1, "waiting_since": None, "doing": ""}, row, limits))

    assert running({}) == running({"target_fitness": 1.0}) == "running on a, pid 1"
    assert running({"generations": 500}) == "running on a, pid 1; about 4 h left"
    assert running({"generations": 500, "env_steps": 1_500_000}) == "running on a, pid 1; about 30 min left"
    assert running({"wall_clock_s": 3610.0}) == "running on a, pid 1; about 10 s left"


@pytest.mark.parametrize("budget", ["budget: {generations: many}", "budget: 3", "[", "budget: null"])
def test_a_config_that_cannot_be_read_is_told_of_and_hides_nothing(run, console, budget, capsys):
    config = run.folder / "config.yaml"
    text = config.read_text()
    config.write_text(budget)
    print_status(console, run)
    print_summary(console, run, "")
    config.write_text(text)
    printed = capsys.readouterr().out
    assert f"stopped, and its budget cannot be read: {config}" in printed
    assert printed.count("best fitness ") == 2


def test_several_runs_are_a_line_each(run, console, tmp_path, capsys):
    api.resume(run.folder, ["budget.generations=5", "budget.env_steps=1_000_000", "budget.wall_clock_s=1e9"])
    (tmp_path / "empty").mkdir()
    assert print_overview(console, [run.folder])
    assert not print_overview(console, [run.folder, tmp_path / "empty", run.folder])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6, "none is wrapped"
    assert " ".join(lines[0].split()) == "run algorithm task seed generation env steps best cells state"
    row = reader.read_newest(run.folder)
    steps, best, cells = f"{row['env_steps'] / 1000:.3g}", f"{row['best_fitness']:.2f}", str(row["map_cells"])
    shown = f"{run.folder} nsra_es point_maze 0 5 of 5 {steps} k of 1 M {best} {cells} finished: the budget of 5 gen"
    assert " ".join(lines[1].split()).startswith(shown)
    assert lines[3].split() == lines[5].split() == lines[1].split()
    assert re.match(rf"{tmp_path}/empty .* - +error: .* is not a run folder", lines[4])
    assert {line.index(word) for line, word in zip(lines[2:], ("state", "fini", "error", "fini"), strict=True)} == {
        lines[2].index("state")
    }


def test_the_command_takes_several_runs_and_follows_one(run, tmp_path):
    cli = CliRunner()
    assert cli.invoke(app, ["status", str(run.folder), str(run.folder)]).exit_code == 0
    assert cli.invoke(app, ["status", str(run.folder), str(tmp_path)]).exit_code == 1
    refused = cli.invoke(app, ["status", str(run.folder), str(run.folder), "--follow"])
    assert isinstance(refused.exception, ConfigError)
    assert "--follow: needs exactly one folder, got 2" in str(refused.exception)
