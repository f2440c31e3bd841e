"""The command line as a user meets it: exit codes, messages, signals, resume, fork, status, damage."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from es_service import open_run
from es_service.digest import digest_at
from es_service.store.reader import read_generation
from tests.system.session import ROOT, SMALL, finish

PROGRAM = Path(sys.executable).with_name("es-service")
COMMAND = [str(PROGRAM)]


def es(*arguments, cwd=ROOT, **environment):
    """Run `es-service ...` to its end: (exit code, all it printed, without line breaks inside paragraphs)."""
    result = subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "Traceback" not in result.stderr, result.stderr
    return result.returncode, result.stdout + result.stderr


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run of thirty generations."""
    folder = tmp_path_factory.mktemp("finished")
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    code, printed = es(
        "run", path, "--out", folder / "run", PATH=os.defpath
    )  # as in `make run`: es-service is not in it
    assert code == 0, printed
    return folder / "run", printed


def digest(folder):
    code, printed = es("digest", folder)
    assert code == 0, printed
    return printed.strip()


def test_run_ends_in_a_summary_with_the_next_commands(finished):
    folder, printed = finished
    assert "Done: the budget of 30 generations is spent." in printed
    for command in ("status", "evaluate", "digest", "resume", "fork"):
        assert f"{PROGRAM} {command} {folder}" in printed
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "run.db", "run.lock"}


def test_resolved_config_is_complete_and_runs_to_the_same_digest(finished, tmp_path):
    folder, _ = finished
    recorded = yaml.safe_load((folder / "config.yaml").read_text())
    assert recorded["search"]["sigma"] == 0.02
    assert recorded["compute"]["gradient_block_pairs"] == 8
    assert es("run", folder / "config.yaml", "--out", tmp_path / "again")[0] == 0
    assert digest(tmp_path / "again") == digest(folder)


def test_bench_rollouts_prints_a_row_per_policy_batch_and_number_of_cores():
    code, printed = es("bench", "rollouts", "--task", "point_maze", "--batch", 8, "--seconds", 0, "--json")
    assert code == 0, printed
    rows = json.loads(printed)
    assert {row["policy"] for row in rows} == {"on", "off"}
    assert {(row["policy"], row["rollout"]) for row in rows} == set(itertools.product(("on", "off"), ("xla", "simd")))
    assert {(row["task"], row["batch"]) for row in rows} == {("point_maze", 8)}
    assert all(row["steps_per_second"] > 0 and row["compile_seconds"] >= 0 for row in rows)
    for wrong, message in (
        (("--batch", 7), "must be even"),
        (("--policy", "maybe"), "--policy maybe: must be on or off"),
        (("--task", "ant_maz"), "did you mean ant_maze?"),
        (("--rollout", "gpu"), "--rollout gpu: must be xla or simd, or both"),
    ):
        code, printed = es("bench", "rollouts", *wrong)
        assert code == 2
        assert message in printed


def test_what_simd_cannot_compile_is_said_in_one_line_and_runs_on_xla():
    task = "tests.examples.sorting:Sorting"
    code, printed = es("bench", "rollouts", "--task", task, "--policy", "off", "--batch", 8, "--seconds", 0)
    assert code == 0, printed
    lines = [line for line in printed.splitlines() if line.startswith(task)]
    assert [line.split()[2] for line in lines[:-1]] == ["xla"] * (len(lines) - 1)
    assert "simd cannot compile it: the primitive sort, from" in lines[-1]
    assert "sorting.py:" in lines[-1]
    for policy in ("on", "off"):
        code, printed = es("bench", "rollouts", "--task", task, "--policy", policy, "--rollout", "simd", "--seconds", 0)
        assert code == 1
        assert "simd cannot compile it: the primitive sort" in printed


def test_options_stand_for_keys(config, tmp_path):
    folder = tmp_path / "run"
    code, _ = es(
        "run", config, "--out", folder, "--seed", 5, "--workers", 2, "--engine", "inline",
        "--set", "search.sigma=0.05", "--set", "budget.generations=2",
    )  # fmt: skip
    assert code == 0
    run = open_run(folder)
    assert (run.config["seed"], run.config["search"]["sigma"], run.config["compute"]["workers"]) == (5, 0.05, 2)
    assert run.generation == 2


def test_resume_in_pieces_equals_one_run_and_another_seed_does_not(config, finished, tmp_path):
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=7")[0] == 0
    assert digest(folder) != digest(finished[0])
    assert es("resume", folder, "--set", "budget.generations=8")[0] == 0
    assert es("resume", folder, "--set", "budget.generations=30", "--workers", 2)[0] == 0
    assert digest(folder) == digest(finished[0])
    assert es("run", config, "--out", tmp_path / "other", "--seed", 1)[0] == 0
    assert digest(tmp_path / "other") != digest(finished[0])


def test_a_longer_budget_stays_with_the_run(config, tmp_path):
    """`resume` with a budget, killed: a plain `resume` then goes on to that budget, not to the first one."""
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=3")[0] == 0
    process = subprocess.Popen(
        [*COMMAND, "resume", str(folder), "--set", "budget.generations=400"], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    while (read_generation(folder) or 0) < 4:
        time.sleep(0.005)
    process.kill()
    process.wait()
    assert (read_generation(folder) or 0) < 400
    assert es("resume", folder)[0] == 0
    assert read_generation(folder) == 400


def test_resume_of_a_finished_run_does_nothing(finished):
    before = digest(finished[0])
    code, printed = es("resume", finished[0])
    assert code == 0
    assert "the budget of 30 generations is spent" in printed
    assert digest(finished[0]) == before


@pytest.mark.parametrize("budget", ["generations=30", "env_steps=100", "wall_clock_s=1e-3", "target_fitness=-1e9"])
def test_a_spent_budget_starts_no_engine(finished, tmp_path, monkeypatch, budget):
    from es_service import api, session

    shutil.copytree(finished[0], tmp_path / "run")
    monkeypatch.delattr(session, "_engine")
    monkeypatch.setattr(session, "platform_info", lambda: {"jax": "99.0"})  # on which nothing is computed
    notices: list[str] = []
    overrides = ["budget.generations=1000", f"budget.{budget}"]
    outcome = api.resume(tmp_path / "run", overrides, on_notice=notices.append)
    assert (outcome.run.generation, notices) == (30, [])
    assert any(word in outcome.reason for word in ("is spent", "is reached"))


def test_fork_without_changes_goes_on_as_its_parent_would(config, finished, tmp_path):
    parent, child = tmp_path / "parent", tmp_path / "child"
    assert es("run", config, "--out", parent, "--set", "budget.generations=10")[0] == 0
    for generation in ([], ["--generation", 9]):
        code, printed = es("fork", parent, *generation, "--out", child, "--set", "budget.generations=30")
        assert code == 0
        assert "note:" not in printed  # the same machine: no other platform to tell of
        assert digest(child) == digest(finished[0])
        origin = open_run(child).meta.parent
        assert origin is not None
        at = generation[1] if generation else 10
        assert (origin["generation"], origin["digest"]) == (at, digest_at(parent, at))
        assert re.search(rf"started from\s+{parent}, generation", es("status", child)[1].replace("\n", ""))
        child = tmp_path / "child9"


def test_fork_with_changes_and_what_does_not_fit(finished, tmp_path):
    more = ("--set", "budget.generations=32")
    code, _ = es("fork", finished[0], "--out", tmp_path / "a", "--set", "search.pairs=24", *more)
    assert code == 0
    assert open_run(tmp_path / "a").config["search"]["pairs"] == 24
    assert len(open_run(tmp_path / "a").history) == 33
    code, printed = es("fork", finished[0], "--out", tmp_path / "b", "--set", "policy.hidden=[16]", *more)
    assert code == 2
    assert "policy.hidden: [8] -> [16]" in printed
    code, printed = es("fork", finished[0], "--generation", 3, "--out", tmp_path / "c", *more)
    assert code == 1
    assert "it keeps that of [29, 30]" in printed
    assert not (tmp_path / "b").exists()
    assert not (tmp_path / "c").exists()


def test_init_from_starts_at_the_other_run_s_centre(config, finished, tmp_path):
    code, printed = es("run", config, "--out", tmp_path / "r", "--set", f"search.init_from={finished[0]}",
                       "--set", "budget.target_fitness=-1e9", "--set", "search.sigma=0.01")  # fmt: skip
    assert code == 0, printed
    child, parent = open_run(tmp_path / "r"), open_run(finished[0])
    assert child.generation == 0
    _, parts = child.parts()
    assert (parts["observations"]["m2_O"] == parent.parts()[1]["observations"]["m2_O"]).all()
    for member in range(5):
        assert (parts[f"member_{member}"]["centre_D"] == parent.policy("centre").parameters_D).all()
    assert child.meta.parent is not None
    assert child.meta.parent["digest"] == digest(finished[0])
    code, printed = es("run", config, "--out", tmp_path / "s", "--set", f"search.init_from={finished[0]}",
                       "--set", "policy.hidden=[16]")  # fmt: skip
    assert code == 2
    assert "has layers [2, 8, 2], this run's has [2, 16, 2]" in printed
    assert not (tmp_path / "s").exists()


def test_init_from_keeps_what_it_started_from(config, finished, tmp_path):
    """The other run goes on, or away; a run that began from it and died at once is resumed to the same digest."""
    origin, whole, killed = tmp_path / "origin", tmp_path / "whole", tmp_path / "killed"
    shutil.copytree(finished[0], origin)
    mapping = yaml.safe_load(config.read_text())
    mapping["search"]["init_from"] = str(origin)
    mapping["budget"]["generations"] = 5
    assert finish(whole, config=mapping) == 0
    assert finish(killed, config=mapping, kill={"at": "opened"}) == -signal.SIGKILL
    assert read_generation(killed) is None
    shutil.rmtree(origin)
    assert es("resume", killed)[0] == 0
    assert digest(killed) == digest(whole)


def test_a_fork_killed_at_once_is_its_parent_s_state_already(config, finished, tmp_path):
    parent, child = tmp_path / "parent", tmp_path / "child"
    assert es("run", config, "--out", parent, "--set", "budget.generations=10")[0] == 0
    process = subprocess.run(
        [sys.executable, "-c", "import os, signal; from es_service import api\n"
         f"api.fork({str(parent)!r}, ['budget.generations=30'], out={str(child)!r}, "
         "hook=lambda name: os.kill(os.getpid(), signal.SIGKILL))"],
        cwd=ROOT, timeout=60, check=False,
    )  # fmt: skip
    assert process.returncode == -signal.SIGKILL
    assert read_generation(child) == 10
    assert es("resume", child)[0] == 0
    assert digest(child) == digest(finished[0])


def test_a_fork_with_another_fitness_forgets_the_best_of_before(finished, tmp_path):
    more = ("--set", "budget.generations=32")
    assert es("fork", finished[0], "--out", tmp_path / "a", "--set", "task.fitness=final", *more)[0] == 0
    history = open_run(tmp_path / "a").history
    assert history["best_fitness"].iloc[-1] == history["centre_fitness_mean"].iloc[31:].max()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_stop_promptly_and_resume_equals_uninterrupted(config, finished, tmp_path, number, code):
    folder = tmp_path / "run"
    long = ["--set", "budget.generations=400"]
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(folder), *long], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    while not (folder / "run.db").exists() or (read_generation(folder) or 0) < 5:
        time.sleep(0.01)
    sent = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert time.monotonic() - sent < 2.0
    assert process.returncode == code
    assert 5 <= (read_generation(folder) or 0) < 400
    way_back = re.search(r"es-service (resume .*)", errors)
    assert way_back is not None
    assert es(*way_back[1].split())[0] == 0
    assert es("run", config, "--out", tmp_path / "whole", *long)[0] == 0
    assert digest(folder) == digest(tmp_path / "whole")


def wait_until_it_listens(pid):
    """Until a program has a handler of SIGTERM, which Python itself has not."""
    caught = 0
    while not caught >> (signal.SIGTERM - 1) & 1:
        time.sleep(0.005)
        caught = int(re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())[0], 16)


@pytest.mark.parametrize("delay_s", [0.0, 0.15, 0.3, 0.5, 0.9, 1.5])
def test_a_signal_during_start_up_ends_quietly(config, tmp_path, delay_s):
    """From the first moment in which it is the program, and no longer Python alone, that is told."""
    long = ["--set", "budget.generations=100000"]  # a fast machine finishes the 30 of the config before the signal
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(tmp_path / "run"), *long],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until_it_listens(process.pid)
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in errors


@pytest.mark.parametrize("delay_s", [0.5, 1.0, 1.5, 2.5])
def test_sigterm_while_ray_starts_ends_as_at_any_other_time(config, tmp_path, delay_s):
    """Ray has a handler of its own meanwhile. Seconds count from when the run folder is there, before Ray starts."""
    folder = tmp_path / "run"
    long = ["--engine", "ray", "--workers", "1", "--set", "budget.generations=100000"]
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(folder), *long], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    while not (folder / "run.db").exists():
        time.sleep(0.01)
    time.sleep(delay_s)
    process.terminate()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert errors.endswith(f"Go on with: es-service resume {folder}\n")
    assert "Traceback" not in errors


def test_a_second_driver_is_refused_and_told_who_holds_the_run(config, tmp_path):
    folder = tmp_path / "run"
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(folder), "--set", "budget.generations=100000"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
    )
    try:
        while not (folder / "run.db").exists() or read_generation(folder) is None:
            time.sleep(0.01)
        code, printed = es("resume", folder)
        assert code == 1
        assert f"{process.pid}" in printed
        assert socket.gethostname() in printed
        assert f"pid {process.pid}" in es("status", folder)[1]
        follower = subprocess.Popen(
            [*COMMAND, "status", str(folder), "--follow"], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        time.sleep(3.0)
    finally:
        process.terminate()
        process.wait(timeout=20)
    followed, _ = follower.communicate(timeout=20)
    seen = [int(number) for number in re.findall(r"^generation (\d+)", followed, re.MULTILINE)]
    assert len(seen) >= 2
    assert seen == sorted(set(seen))
    assert seen[-1] == read_generation(folder)
    assert "no driver is running" in followed


def test_a_disk_that_fills_up_stops_the_run_and_resume_goes_on(config, small_disk, tmp_path):
    folder, wide = small_disk / "run", ["--set", "policy.hidden=[64]", "--set", "budget.generations=400"]
    code, printed = es("run", config, "--out", folder, *wide)
    assert code == 1
    assert f"disk full while storing generation {read_generation(folder) + 1}" in printed
    assert f"free space, then `es-service resume {folder}`" in printed
    subprocess.run(["mount", "-o", "remount,size=50m", str(small_disk)], check=True)
    assert es("resume", folder)[0] == 0
    assert es("run", config, "--out", tmp_path / "whole", *wide)[0] == 0
    assert digest(folder) == digest(tmp_path / "whole")


def damage(path: Path, at: int) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        byte = file.read(1)
        file.seek(at)
        file.write(bytes([byte[0] ^ 0x10]))


def test_damage_gives_the_same_digest_or_a_named_error(config, finished, tmp_path):
    """A flipped byte in the newest state, in the file header, a truncated file."""
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=20")[0] == 0
    sound = (folder / "run.db").read_bytes()
    newest = open_run(folder).policy("centre").parameters_D.tobytes()
    last = ["--set", "budget.generations=30"]

    damage(folder / "run.db", sound.rindex(newest) + 8)
    code, printed = es("resume", folder, *last)
    assert code == 0
    assert re.search(r"generation 20.*19", printed.replace("\n", " "))
    assert digest(folder) == digest(finished[0])

    for position, length in ((3, None), (40, None), (None, 5000), (None, len(sound) // 2)):
        (folder / "run.db").write_bytes(sound[:length])
        if position is not None:
            damage(folder / "run.db", position)
        code, printed = es("resume", folder, *last)
        if code == 0:
            assert digest(folder) == digest(finished[0])
        else:
            assert code == 1
            assert str(folder) in printed.replace("\n", "")


def test_other_versions_on_resume_are_told_and_make_the_digest_mixed(config, tmp_path, monkeypatch):
    from es_service import api, session

    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=3")[0] == 0
    assert "mixed" not in digest(folder)
    monkeypatch.setattr(session, "platform_info", lambda: {"jax": "99.0"})
    notices: list[str] = []
    api.resume(folder, ["budget.generations=4"], on_notice=notices.append)
    assert any("from generation 4 on" in notice for notice in notices)
    assert digest(folder).endswith("mixed")


BAD_CONFIGS = [
    ({"search.sgima": 0.1}, "did you mean search.sigma?"),
    ({"search.sigma": "big"}, "search.sigma: big"),
    ({"search.sigma": 0}, "search.sigma: 0"),
    ({"search.pairs": -4}, "search.pairs: -4"),
    ({"task.environment": "point_mase"}, "point_maze"),
    ({"search.algorithm": "ess"}, "es"),
    ({"search.pairs": 20, "compute.chunk_pairs": 8}, "24"),
    ({"budget": None}, "budget"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_CONFIGS)
def test_bad_configs_get_one_message_and_exit_code_two(tmp_path, changes, message):
    mapping = yaml.safe_load(yaml.safe_dump(SMALL))
    for name, value in changes.items():
        *section, key = name.split(".")
        target = mapping[section[0]] if section else mapping
        target[key] = value
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(mapping))
    code, printed = es("run", path, "--out", tmp_path / "run")
    assert code == 2
    assert message in " ".join(printed.split())
    assert not (tmp_path / "run").exists()


def test_bad_paths(config, finished, tmp_path):
    malformed = tmp_path / "malformed.yaml"
    malformed.write_text("task: {environment: point_maze\nsearch: [\n")
    cases = [
        (("run", tmp_path / "none.yaml"), 2, "no such file"),
        (("run", malformed), 2, "line"),
        (("run", config, "--out", finished[0]), 1, f"es-service resume {finished[0]}"),
        (("run", config, "--out", "/proc/nowhere/run"), 1, "/proc/nowhere"),
        (("run", config, "--set", "search.sigma"), 2, "search.sigma"),
        (("run", config, "--wrokers", "2"), 2, "--workers"),
        (("rnu", config), 2, "run"),
        (("resume", tmp_path), 1, "not a run folder"),
        (("status", tmp_path / "nothing"), 1, "does not exist"),
        (("digest", config), 1, "not a run folder"),
        (("resume", finished[0], "--set", "search.sigma=0.5", "--set", "seed=3"), 2, "search.sigma: 0.02 -> 0.5"),
        (("resume", finished[0], "--set", "search.sigma=a", "--set", "budget.generatons=3"), 2, "did you mean budget."),
        (("resume", finished[0], "--set", "compute.rollout_block_pairs=auto"), 0, "is spent"),
    ]
    for arguments, expected, message in cases:
        code, printed = es(*arguments)
        assert (code, message in " ".join(printed.split())) == (expected, True), (arguments, code, printed)


def test_resume_with_an_edited_config_lists_every_changed_constant(config, tmp_path):
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=2")[0] == 0
    recorded = folder / "config.yaml"
    recorded.write_text(recorded.read_text().replace("sigma: 0.02", "sigma: 0.5").replace("seed: 0", "seed: 9"))
    code, printed = es("resume", folder)
    assert code == 2
    for change in ("search.sigma: 0.02 -> 0.5", "seed: 0 -> 9", "es-service fork"):
        assert change in printed


def test_a_folder_where_no_runs_folder_can_be_made(config, tmp_path):
    (tmp_path / "runs").write_text("in the way")
    code, printed = es("run", config, cwd=tmp_path)
    assert code == 1
    assert "choose another --out" in printed


def test_unwritable_home_does_not_matter(config, tmp_path):
    code, printed = es("run", config, "--out", tmp_path / "run", HOME="/proc/nowhere", XDG_CACHE_HOME="/proc/nowhere")
    assert code == 0, printed


def test_list_and_doctor(tmp_path):
    code, printed = es("list")
    assert code == 0
    assert "point_maze" in printed
    assert "search.pairs" in printed
    code, printed = es("doctor", cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert code == 0, printed
    assert "noise equals its" in printed
    assert "FAIL" not in printed


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_doctor_without_a_finding(tmp_path, number, code):
    """While its worker starts."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen([*COMMAND, "doctor"], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert any("noise equals" in line for line in process.stdout)
    time.sleep(0.2)
    process.send_signal(number)
    printed, _ = process.communicate(timeout=20)
    assert process.returncode == code
    assert "FAIL" not in printed
