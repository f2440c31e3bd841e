"""The live page in a headless browser, of a server in a process of its own, as users have it.

`make long` runs all but the last test.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest

from es_service.runs.view import open_run
from tests.database import execute
from tests.run_examples import write_run
from tests.system.browser import browser
from tests.system.command_line import PROGRAM
from tests.system.me_es_runs import run as me_es_run
from tests.system.processes import committed, running, wait_until
from tests.system.session import SMALL, start
from workers.environments import SHIPPED

GOES_ON = SMALL | {
    "search": {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 4, "block_generations": 5},
    "budget": {"generations": 100_000},
}
GENERATIONS = (
    "Number(document.querySelector('#what .fields').textContent.match(/generations([\\d,]+)/)[1].replaceAll(',', ''))"
)
CELLS = "document.querySelectorAll('#map [data-c]').length"


@pytest.fixture
def page():
    with browser() as found:
        yield found
        assert found.complaints == []
        assert all(one.startswith("http://127.0.0.1:") for one in found.requests)


def used_s(process):
    """Seconds of the processor that a process has used."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def watching(*folders, options=()):
    """The address that `es-service watch` prints, while it runs."""
    with served(*folders, options=options) as (address, _):
        yield address


@contextlib.contextmanager
def served(*folders, options=()):
    """The same, and the process."""
    with running(PROGRAM, "watch", *folders, "--port", 0, *options) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        address = process.stdout.readline().strip()
        assert address.startswith("http://"), process.communicate()
        yield address, process
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 128 + signal.SIGINT
        assert process.stderr.read().count("\n") == (1 if "token=" in address else 0)


def sections(address, page, least=1):
    """What an event of a page has, after so many of them."""
    with urllib.request.urlopen(f"{address}events/{page}", timeout=120) as answer:
        for line in answer:
            if line.startswith(b"data: "):
                least -= 1
                if not least:
                    return json.loads(line[6:])
    raise AssertionError("the stream has ended")


def links(address):
    """Name of each run -> its key."""
    html = sections(address, "list")["sections"]["runs"]["html"]
    return {name: key for key, name in re.findall(r'<a href="/run/(\w+)">([^<]*)</a>', html)}


def opened(page, address, name, **window):
    """Open the page of a run and wait for its first picture."""
    key = links(address)[name]
    page.open(f"{address}run/{key}", **window)
    page.until("document.body?.dataset.pictures > 0")
    return key


@pytest.mark.long
def test_a_run_that_goes_on_is_killed_and_is_resumed_is_seen(page, tmp_path):
    folder = tmp_path / "runs/a"
    (tmp_path / "runs").mkdir()
    with watching(tmp_path / "runs") as address:
        page.open(address)
        page.until("document.body?.dataset.pictures > 0")
        assert "There is no run yet" in page.text("main")
        with start(folder, config=GOES_ON) as process:
            page.until("/^1 run, 1 of them running/.test(document.querySelector('.verdict')?.textContent)")
            page.click("a[href^='/run/']")
            page.until("!!document.querySelector('#map .way')")
            generation, cells = page.value(GENERATIONS), page.value(CELLS)
            assert "running on" in page.text("#what")
            page.until(f"{GENERATIONS} > {generation + 5} && {CELLS} > {cells}")
            process.kill()
        page.until("/stopped before its budget was spent/.test(document.getElementById('what').textContent)")
        page.until(f"{GENERATIONS} === {committed(folder)}")
        assert page.value(CELLS) == open_run(folder).behaviour_map.size
        stopped = committed(folder)
        with start(folder) as process:
            page.until(f"/running on/.test(document.getElementById('what').textContent) && {GENERATIONS} > {stopped}")


@pytest.mark.long
def test_a_driver_is_never_locked_out(tmp_path):
    """While pages are read again and again, a run is finished, and another driver takes it at once."""
    folder = tmp_path / "runs/a"
    with watching(tmp_path) as address:
        for generations in (20, 40, 60):
            budget = {"budget": {"generations": generations}}
            with (
                start(folder, config=GOES_ON | budget) if generations == 20 else resumed(folder, generations) as process
            ):
                wait_until(process, lambda: committed(folder) is not None)
                key = links(address)[f"{tmp_path.name}/runs/a"]
                while process.poll() is None:
                    sections(address, f"run/{key}")
                assert process.returncode == 0, process.communicate()
            assert committed(folder) == generations


def resumed(folder, generations):
    return running(PROGRAM, "resume", folder, "--set", f"budget.generations={generations}")


@pytest.mark.long
def test_a_damaged_run_says_so_and_hides_no_other(page, tmp_path):
    for name in ("broken", "damaged", "whole"):
        write_run(tmp_path / name, generations=40)
    (tmp_path / "broken/run.db").write_bytes(b"nothing")
    execute(tmp_path / "damaged", "UPDATE history SET centre_fitness_mean = 0 WHERE generation = 7")
    with watching(tmp_path) as address:
        page.open(address)
        page.until("document.querySelectorAll('.runs tbody tr').length === 3")
        assert "is not a run folder" in page.text(".runs tbody tr:nth-child(1)")
        opened(page, address, f"{tmp_path.name}/damaged")
        assert "Damaged: the history rows of generations 7 are damaged or missing" in page.text("#what")
        opened(page, address, f"{tmp_path.name}/broken")
        assert "is not a run folder" in page.text("#live")
        opened(page, address, f"{tmp_path.name}/whole")
        assert page.value("document.querySelector('.problem')") is None


@pytest.mark.long
def test_a_run_that_is_moved_or_deleted_stays_in_sight(page, tmp_path):
    write_run(tmp_path / "a")
    with watching(tmp_path) as address:
        opened(page, address, f"{tmp_path.name}/a")
        (tmp_path / "a").rename(tmp_path / "b")
        page.until("!!document.querySelector('#live a')")
        assert page.value(CELLS) == 200
        page.click("#live a")
        page.until("document.querySelector('h1')?.textContent.startsWith('b: ')")
        shutil.rmtree(tmp_path / "b")
        page.until("!!document.querySelector('#live')")
        assert page.value(CELLS) == 200


@pytest.mark.long
def test_fifty_runs_are_listed_within_two_seconds(page, tmp_path):
    """Of a free processor: what the server takes is measured, since others may use the machine."""
    first = write_run(tmp_path / "runs/0", generations=50)
    for number in range(1, 50):
        shutil.copytree(first, tmp_path / f"runs/{number}")
    with served(tmp_path / "runs") as (address, server):
        began, before_s = time.monotonic(), used_s(server)
        page.open(address)
        page.until("document.querySelectorAll('.runs tbody tr').length === 50")
        took_s = used_s(server) - before_s
        print(f"fifty runs: {took_s:.2f} s of the server, after {time.monotonic() - began:.2f} s")
        assert took_s < 2.0


@pytest.mark.long
def test_100_000_generations_have_their_first_picture_within_two_seconds_and_a_megabyte(page, tmp_path):
    write_run(tmp_path / "a", {"map.cells": [50, 50]}, generations=100_000, filled=1.0)
    with served(tmp_path) as (address, server):
        key = links(address)[f"{tmp_path.name}/a"]
        began, before_s = time.monotonic(), used_s(server)
        with urllib.request.urlopen(f"{address}events/run/{key}") as answer:
            size = len(next(line for line in answer if line.startswith(b"data: ")))
        took_s = used_s(server) - before_s
        print(f"first picture: {took_s:.2f} s of the server, {size / 1e6:.2f} MB, {time.monotonic() - began:.2f} s")
        page.open(f"{address}run/{key}")
        page.until("!!document.querySelector('#map [data-c]')")
        assert page.value(CELLS) == 2500
        page.until(f"!document.getElementById('live') && {GENERATIONS} === 100000")
        print(f"all generations: {used_s(server) - before_s:.2f} s of the server")
        assert took_s < 2.0
        assert size < 1e6


@pytest.mark.long
def test_a_cell_is_chosen_by_pointer_or_keys_and_replayed(page, tmp_path):
    me_es_run(tmp_path / "a")
    with watching(tmp_path) as address:
        opened(page, address, f"{tmp_path.name}/a")
        page.until("!!document.querySelector('#map .way')")
        first, way = page.text("#cell"), page.value("document.querySelector('#map .way').getAttribute('d')")
        page.value("document.querySelector('#map svg.map').focus()")
        for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
            page.key(key)
        page.until(f"document.querySelector('#map .way')?.getAttribute('d') !== {json.dumps(way)}")
        chosen = page.text("#cell")
        assert chosen != first
        command = json.dumps(f"--cell {chosen.split(':')[0]}")  # it comes with the path of the last cell
        page.until(f"document.querySelector('#command').textContent.endsWith({command})")
        page.key("Enter")
        page.until("!!document.querySelector('#shown #scrub')")
        assert "equal the stored ones bit for bit" in page.text("#shown")
        assert page.text("#recording") == f"cell {chosen.split(':')[0]}"
        page.slide("#scrub", 5)
        assert page.text("#step").startswith("step 5 of")
        page.click("button.replay[value=best]")
        page.until("document.getElementById('recording').textContent === 'the best centre'")
        assert "best centre" in page.text("#episode")


@pytest.mark.long
def test_a_body_is_replayed_in_three_dimensions(page, tmp_path):
    settings = {"policy.hidden": [8], "task.episode_steps": 40}
    write_run(tmp_path / "a", settings, task=SHIPPED["ant_trap"], filled=0.01)
    with watching(tmp_path) as address:
        opened(page, address, f"{tmp_path.name}/a")
        for _ in range(2):  # one replaces the other
            page.value("document.querySelector('#shown').replaceChildren()")
            page.click("button.replay[value=best]")
            page.until("Number(document.getElementById('stage')?.dataset.triangles) > 500")


@pytest.mark.long
def test_a_task_of_a_user_is_only_replayed_if_it_is_trusted(page, tmp_path):
    task = replace(SHIPPED["point_maze"], name="no_such_package:Task")
    write_run(tmp_path / "a", task=task)
    with watching(tmp_path) as address:
        opened(page, address, f"{tmp_path.name}/a")
        page.click("button.replay[value=best]")
        page.until("/would execute/.test(document.getElementById('shown').textContent)")


@pytest.mark.long
def test_ticked_runs_are_compared_while_one_goes_on(page, tmp_path):
    with start(tmp_path / "a", config=GOES_ON), start(tmp_path / "b", config=GOES_ON | {"seed": 3}) as process:
        wait_until(process, lambda: committed(tmp_path / "a") and committed(tmp_path / "b"))
        with watching(tmp_path) as address:
            page.open(address)
            page.until("document.querySelectorAll('.runs input').length === 2")
            page.click(".runs tr:nth-child(1) input")
            page.click(".runs tr:nth-child(2) input")
            seen = "document.querySelector('.runs tbody').textContent"
            page.until(f"{seen} !== {json.dumps(page.value(seen))}")
            assert page.value("document.querySelectorAll('.runs input:checked').length") == 2  # also in the new table
            page.click("button[type=submit]")
            page.until("document.querySelector('h1')?.textContent === '2 runs on point_maze'")
            page.until(f"!!document.querySelector('#final td') && {CELLS.replace('map', 'maps')} > 0")
            before = page.text("#final")
            page.until(f"document.querySelector('#final')?.textContent !== {json.dumps(before)}")


@pytest.mark.long
def test_names_with_markup_run_no_script(page, tmp_path):
    name = "<img src=x onerror=document.title='stolen'><script>document.title='stolen'<"
    write_run(tmp_path / name / name)
    with watching(tmp_path / name) as address:
        page.open(address)
        page.until("!!document.querySelector('.runs a')")
        page.click(".runs a")
        page.until("!!document.querySelector('#map .way')")
        assert page.value(
            "[document.querySelectorAll('img, main script').length, document.title.includes('onerror')]"
        ) == [0, True]


@pytest.mark.long
def test_a_stranger_is_turned_away(page, tmp_path):
    write_run(tmp_path / "a")
    with watching(tmp_path, options=["--host", "0.0.0.0"]) as address:
        base = re.sub("//[^:]*:", "//127.0.0.1:", address)
        for stranger in (base.partition("?")[0], f"{base}x"):
            with pytest.raises(urllib.error.HTTPError, match="401"):
                urllib.request.urlopen(stranger)
        page.send("Page.navigate", url=base)
        page.until("!!document.querySelector('.runs a')")
        assert page.value("[location.search, document.cookie]") == ["", ""]


@pytest.mark.long
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [1280, 400])
def test_the_pages_fit_their_window(page, tmp_path, width, dark):
    keys = [write_run(tmp_path / f"a long name of a run, seed {seed}", {"seed": seed}) for seed in range(2)]
    with watching(tmp_path) as address:
        found = list(links(address).values())
        assert len(found) == len(keys)
        for path in ("", f"run/{found[0]}", f"compare?run={found[0]}&run={found[1]}"):
            page.open(address + path, width, dark=dark)
            page.until("document.body?.dataset.pictures > 0")
            assert page.value("document.documentElement.scrollWidth") <= width


def test_without_its_packages_the_command_says_how_to_get_them(tmp_path):
    code = (
        "import sys; sys.modules['starlette'] = sys.modules['uvicorn'] = None; "
        "sys.argv[1:] = ['watch', '.']; from es_service.cli.main import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert "pip install -c constraints.txt -e '.[watch]'" in done.stderr
