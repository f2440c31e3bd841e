"""Reports in a headless browser: what a pointer does, no complaint of the page, and no request to any network."""

import io

import numpy as np
import pytest
from PIL import Image

from tests.run_examples import write_run
from tests.system.browser import browser
from tests.system.command_line import es


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
    code, printed = es("report", folder)
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
        "const box = document.querySelector('.chosen').getBBox(); "
        "return [(end.x - box.x) / box.width, (end.y - box.y) / box.height]; })()"
    )
    assert (x, y) == pytest.approx((0.5, 0.5), abs=0.1)


def test_a_hover_is_answered_within_100_ms(page, point_maze):
    page.open(point_maze)
    slowest = page.value(
        "(() => { let slowest = 0; for (const cell of document.querySelectorAll('[data-c]')) { "
        "const begin = performance.now(); cell.dispatchEvent(new PointerEvent('pointerover', {bubbles: true})); "
        "slowest = Math.max(slowest, performance.now() - begin); } return slowest; })()"
    )
    assert slowest < 100


def test_curves_show_their_values_and_other_axes(page, point_maze):
    page.open(point_maze)
    assert page.value("getComputedStyle(document.querySelector('.x-env_steps')).display") == "none"
    page.move(".chart .x-generation", 0.999)
    assert page.text(".chart .at").startswith("generation 400: best centre so far -")
    page.click('input[value="env_steps"]')
    assert page.value("getComputedStyle(document.querySelector('.x-env_steps')).display") == "block"
    page.move(".chart .x-env_steps", 0.12)
    assert page.text(".chart .at").startswith("generation 1: ")


def test_the_slider_shows_the_centres_up_to_a_generation(page, point_maze):
    page.open(point_maze)
    drawn = "document.getElementById('cloud').toDataURL()"
    assert page.text("#until-text").startswith("generation 400: 401 centres, best -")
    whole = page.value(drawn)
    page.slide("#until", 10)
    assert page.text("#until-text").startswith("generation 20: 21 centres, best -")
    assert page.value(drawn) != whole


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [1280, 400])
def test_a_page_fits_its_window_in_light_and_dark(page, point_maze, width, dark):
    page.open(point_maze, width, dark=dark)
    assert page.value("document.documentElement.scrollWidth") <= width
    seen = pixels(page.screenshot(whole=False))
    corner = seen[-1, 0].mean()
    assert corner < 60 if dark else corner > 200
    assert seen.std() > 5
