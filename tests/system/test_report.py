"""Reports in a headless browser: what a pointer does, no complaint of the page, and no request to any network.

`make test` opens one page; `make long` does the rest.
"""

import io
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from es_service.config.tasks import TASKS
from tests import run_examples
from tests.run_examples import write_run
from tests.system.browser import browser
from tests.system.command_line import es
from tests.system.processes import ROOT
from workers.environments import SHIPPED


@pytest.fixture(scope="module")
def page():
    with browser() as found:
        yield found
        assert found.complaints == []
        assert found.requests == []


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), int)


@pytest.fixture(scope="module")
def point_maze(tmp_path_factory):
    folder = write_run(tmp_path_factory.mktemp("runs") / "a run", generations=400)
    code, printed = es("report", folder, "--replay", "none")
    assert (code, printed.strip()) == (0, str(folder / "report.html"))
    return folder / "report.html"


def test_a_cell_is_shown_and_chosen_by_a_pointer(page, point_maze):
    page.open(point_maze)
    first = page.text("#cell")
    page.move("[data-c]:nth-of-type(30)")
    hovered = page.text("#cell")
    assert hovered != first
    assert page.text("#command").endswith(first.split(":")[0])
    page.click("[data-c]:nth-of-type(30)")
    assert page.text("#cell") == hovered
    place = hovered.split(":")[0]
    assert page.text("#command").endswith(f"evaluate '{point_maze.parent}' --cell {place}")
    # The path ends in the middle of the cell.
    x, y = page.value(
        "(() => { const way = document.querySelector('#map .way'); const end = way.getPointAtLength(1e9); "
        "const box = document.querySelector('#map .outline > *').getBBox(); "
        "return [(end.x - box.x) / box.width, (end.y - box.y) / box.height]; })()"
    )
    assert (x, y) == pytest.approx((0.5, 0.5), abs=0.1)


@pytest.mark.long
def test_no_path_that_is_drawn_crosses_a_wall(page, tmp_path, monkeypatch):
    """The paths of this run go to and fro round the end of the lower wall, in long steps, and once through a wall."""
    monkeypatch.setattr(
        run_examples, "_path", lambda end_B, rng: np.array([(-0.6, -0.4), (-0.2, -0.6)] * 31 + [(0.0, 0.5), end_B])
    )
    write_run(tmp_path / "run", generations=1)
    assert es("report", tmp_path / "run", "--replay", "none")[0] == 0
    page.open(tmp_path / "run/report.html")
    found = page.value(
        "[[...document.querySelectorAll('#map .wall')].map((one) => ['x1', 'y1', 'x2', 'y2'].map((name) => "
        "Number(one.getAttribute(name)))), [...document.querySelectorAll('#map [data-c]')].map((cell) => { "
        "cell.dispatchEvent(new MouseEvent('click', {bubbles: true})); "
        "return [...document.querySelectorAll('#map .way')].map((one) => one.getAttribute('d')); })]"
    )
    walls, (paths, rounds) = np.array(found[0]).reshape(-1, 2, 2), zip(*found[1], strict=True)
    assert len(walls) == 2
    assert len(paths) == 200
    assert all(way.count("M") >= 61 for way in rounds)
    for way in (*paths, *rounds):
        for part in filter(None, way.split("M")):
            points = np.array([place.split() for place in part.split("L")], float)
            for (x0, y), (x1, _) in walls:
                rise = np.diff(points[:, 1])
                with np.errstate(divide="ignore", invalid="ignore"):
                    x = points[:-1, 0] + np.diff(points[:, 0]) * (y - points[:-1, 1]) / rise
                apart = (np.abs(points[:, 1] - y) > 0.1) * np.sign(points[:, 1] - y)  # places are rounded to 0.1
                assert not ((apart[:-1] * apart[1:] < 0) & (min(x0, x1) < x) & (x < max(x0, x1))).any()


def slowest_hover(page) -> float:
    """Milliseconds of the slowest answer to a pointer that enters a cell, over all cells."""
    return page.value(
        "(() => { let slowest = 0; for (const cell of document.querySelectorAll('[data-c]')) { "
        "const begin = performance.now(); cell.dispatchEvent(new PointerEvent('pointerover', {bubbles: true})); "
        "slowest = Math.max(slowest, performance.now() - begin); } return slowest; })()"
    )


@pytest.mark.long
def test_a_hover_is_answered_within_100_ms(page, point_maze):
    page.open(point_maze)
    assert slowest_hover(page) < 100


@pytest.mark.long
def test_curves_show_their_values_and_other_axes(page, point_maze):
    page.open(point_maze)
    assert page.value("getComputedStyle(document.querySelector('.x-env_steps')).display") == "none"
    page.move(".chart .x-generation", 0.999)
    assert page.text(".chart .at").startswith("generation 400: best centre so far -")
    page.click('input[value="env_steps"]')
    assert page.value("getComputedStyle(document.querySelector('.x-env_steps')).display") == "block"
    page.move(".chart .x-env_steps", 0.12)
    assert page.text(".chart .at").startswith("generation 1: ")


@pytest.mark.long
def test_the_slider_shows_the_centres_up_to_a_generation(page, point_maze):
    page.open(point_maze)
    drawn = "document.getElementById('cloud').toDataURL()"
    assert page.text("#until-text").startswith("generation 400: 401 centres, best -")
    whole = page.value(drawn)
    page.slide("#until", 10)
    assert page.text("#until-text").startswith("generation 20: 21 centres, best -")
    assert page.value(drawn) != whole


@pytest.mark.long
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [1280, 400])
def test_a_page_fits_its_window_in_light_and_dark(page, point_maze, width, dark):
    page.open(point_maze, width, dark=dark)
    assert page.value("document.documentElement.scrollWidth") <= width
    seen = pixels(page.screenshot(whole=False))
    corner = seen[-1, 0].mean()
    assert corner < 60 if dark else corner > 200
    assert seen.std() > 5


def replayed(folder, settings, task, *options, **environment):
    """Report of a made-up run of a task, with a recorded episode of its policy."""
    write_run(folder, {"policy.hidden": [8], "task.episode_steps": 40, **settings}, task=task, filled=0.01)
    code, printed = es("report", folder, *options, **environment)
    assert code == 0, printed
    return folder / "report.html"


def test_a_point_is_replayed_in_the_plane(page, tmp_path):
    page.open(replayed(tmp_path / "run", {"map.enabled": False, "search.algorithm": "es"}, SHIPPED["point_maze"]))
    assert page.text("#step").startswith("step 0 of 40; return so far 0")
    start = page.value("document.querySelector('#plan circle.body').outerHTML")
    page.slide("#scrub", 40)
    assert page.text("#step").startswith("step 40 of 40; return so far -")
    assert page.value("document.querySelector('#plan circle.body').outerHTML") != start
    # The time of the first frame may be before the click.
    page.value("{ const now = performance.now.bind(performance); performance.now = () => now() + 1000; }")
    page.click("#play")  # from the beginning again
    page.until("/^step [1-9]/.test(document.getElementById('step').textContent)")
    page.until("document.getElementById('play').textContent === 'Play'")
    assert page.text("#step").startswith("step 40 of 40")


SLALOM = "tests.examples.ant_slalom:AntSlalom"


@pytest.mark.long
@pytest.mark.parametrize("name", ["ant_maze", "ant_trap", "brax:hopper", "mujoco:Reacher-v5", SLALOM])
def test_bodies_are_replayed_in_three_dimensions(page, tmp_path, name):
    environment = {"PYTHONPATH": str(ROOT)}
    settings = {"map.enabled": False, "search.algorithm": "es"}
    page.open(replayed(tmp_path / "run", settings, TASKS[name], "--replay", "best", **environment))
    page.until("Number(document.getElementById('stage').dataset.triangles) > 500")
    if not page.value("document.getElementById('follow').checked"):
        page.click("#follow")
    seen = []
    for step in (0, 39):
        page.slide("#scrub", min(step, int(page.value("document.getElementById('scrub').max"))))
        page.value("document.getElementById('stage-box').scrollIntoView()")
        seen.append(pixels(page.screenshot(whole=False)))
    assert seen[0].std() > 5
    assert (seen[0] != seen[1]).mean() > 1e-4, "the body does not move"


@pytest.mark.long
def test_without_webgl_the_path_is_shown_from_above(tmp_path):
    report = replayed(tmp_path / "run", {"map.enabled": False, "search.algorithm": "es"}, SHIPPED["ant_trap"])
    with browser() as page:
        page.without_webgl()
        page.open(report)
        assert page.value("document.getElementById('stage-box').hidden")
        assert not page.value("document.getElementById('plan').hidden")
        before = page.value("document.querySelector('#plan circle.body').outerHTML")
        page.slide("#scrub", 40)
        assert page.value("document.querySelector('#plan circle.body').outerHTML") != before
        assert page.complaints == []


@pytest.mark.long
def test_a_task_that_is_gone_is_reported_without_a_replay(page, tmp_path):
    gone = replace(SHIPPED["point_maze"], name="no_such_package:Task")
    page.open(replayed(tmp_path / "run", {}, gone))
    assert "A replay would execute no_such_package:Task, which the config of this run names" in page.text("#replay")
    (tmp_path / "run/report.html").unlink()
    code, printed = es("report", tmp_path / "run", "--replay", "best")
    assert code == 0, printed
    page.open(tmp_path / "run/report.html")
    assert "No episode could be recorded on this machine" in page.text("#replay")
    assert "no_such_package" in page.text("#replay")


def test_wrong_replays_are_refused(tmp_path):
    folder = write_run(tmp_path / "run", filled=0.5)
    for options, message in (
        (["--against", "generation"], "--against generation is for figures; add --figures DIR"),
        (["--metric", "coverage"], "--metric coverage is for figures; add --figures DIR"),
        (["--replay", "x"], "--replay x: must be whole numbers"),
        (["--replay", "99,99"], "cell 99,99 is not in the map"),
        (["--replay", "none", "--replay", "best"], "cannot be combined"),
        ([word for cell in range(9) for word in ("--replay", f"{cell},0")], "9 cells are too many"),
    ):
        code, printed = es("report", folder, *options)
        assert code == 2
        assert message in printed


@pytest.mark.long
def test_a_comparison_is_shown_and_different_tasks_are_refused(page, tmp_path):
    runs = [write_run(tmp_path / f"run{seed}", {"seed": seed}) for seed in range(3)]
    code, printed = es("report", *runs, "--out", tmp_path / "all.html", "--group-by", "seed", "--threshold", "-70")
    assert (code, printed.strip()) == (0, str(tmp_path / "all.html"))
    page.open(tmp_path / "all.html", 1200)
    table = "document.querySelector('#final .scroll')"
    assert page.value(f"{table}.scrollWidth <= {table}.clientWidth"), "no column is cut off"
    page.move(".chart .x-env_steps", 0.5)
    assert "environment steps: seed = 0 -" in page.text(".chart .at")
    page.click('input[value="wall_clock_s"]')
    page.move(".chart .x-wall_clock_s", 0.5)
    assert "seconds: seed = 0 -" in page.text(".chart .at")
    other = write_run(tmp_path / "other", task=SHIPPED["ant_trap"])
    code, printed = es("report", runs[0], other, "--out", tmp_path / "wrong.html")
    assert code == 2
    assert "task.environment differs" in printed
    code, printed = es("report", *runs)
    assert (code, "add --out FILE" in printed) == (2, True)


@pytest.mark.long
def test_a_long_run_with_a_large_map_is_reported_in_seconds(page, tmp_path):
    """8,000 generations and 2,500 elites: ten seconds of a core and a gigabyte; six times the seconds are allowed."""
    folder = write_run(tmp_path / "run", {"map.cells": [50, 50]}, generations=8000, filled=1.0)
    code = (
        "import sys, time; from es_service.cli.main import main; sys.argv[1:] = ['report', sys.argv[1]]\n"
        "from es_service.protocol.machine import peak_memory_mib\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(time.process_time(), peak_memory_mib())"
    )
    done = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, check=True)
    seconds, memory = map(float, done.stdout.split()[-2:])
    report = folder / "report.html"
    print(f"{seconds:.1f} s, {memory:.0f} MiB of memory, a page of {report.stat().st_size / 1e6:.1f} MB")
    assert seconds < 60
    assert memory < 1000
    page.open(report)
    assert slowest_hover(page) < 100
