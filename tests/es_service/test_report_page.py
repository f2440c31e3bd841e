"""The page of a run as text: complete, self-contained, and with everything escaped that a user controls."""

import base64
import json
import os
import re
import shlex
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from es_service.cli.common import error_message
from es_service.errors import StoreError
from es_service.protocol.options import choice
from es_service.report import floor, maps
from es_service.report.data import read_run
from es_service.report.markup import LEVELS, SCALE, Frame, Markup, data_script, level, tag, tick_text, ticks
from es_service.report.page import run_page
from es_service.report.write import python_call, write_report
from tests.database import execute
from tests.run_examples import write_run
from workers.environments import SHIPPED

POINT = SHIPPED["point_maze"]
EVIL = """</script></style><img src=x onerror="alert(1)">'&<!--"""
OPTION = """</script><b>'&<!--"""
"""An option cannot have the letters = and . in its name."""
VOID = {"meta", "input", "link"}


class Elements(HTMLParser):
    """Reads a page: elements by name, data scripts, and the number of elements that are not closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.scripts: dict[str, object] = {}
        self.open: list[str] = []
        self._data = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.names.append(tag)
        self.attributes += attrs
        self._data = dict(attrs).get("id") or "" if tag == "script" else ""
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.names.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self._data:
            self.scripts[self._data] = json.loads(data)
            self._data = ""


def page_of(folder):
    return run_page(read_run(folder), python_call(folder))


def task_with(dimensions, **changes):
    names = tuple(f"d{b}" for b in range(dimensions))
    bounds = ((0.0, 1.0),) * dimensions
    return replace(
        POINT, name="made:Up", descriptor_names=names, descriptor_bounds=bounds, walls=None, goal=None, **changes
    )


def test_a_page_is_whole_and_needs_no_network(tmp_path):
    page = page_of(write_run(tmp_path / "run"))
    elements = Elements(page)
    assert elements.open == []
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")  # the name of a language, not an address
    assert "https://" not in page
    assert not [value for name, value in elements.attributes if name in ("src", "href")]
    assert {"what", "curves", "map", "centres", "time", "faults"} <= {v for n, v in elements.attributes if n == "id"}


def test_all_text_of_a_user_is_escaped(tmp_path):
    """Names of the folder, the task, options, dimensions, and a setting; the page has no element but its own."""
    plain = task_with(2, summary="plain", options={"way": choice("a", "b")})
    evil = replace(
        plain,
        name=f"made:{EVIL}",
        descriptor_names=(f"x{EVIL}", f"y{EVIL}"),
        options={OPTION: choice(f"first{EVIL}", f"other{EVIL}")},
        summary=EVIL,
    )
    harmless = write_run(tmp_path / "run", {"task.options.way": "b", "search.init_from": str(tmp_path)}, task=plain)
    name = "".join(letter for letter in EVIL if letter not in "/\0")
    parent = {"folder": EVIL, "generation": 3, "run_id": "a" * 32, "digest": "b" * 64}
    wanted = {f"task.options.{OPTION}": f"other{EVIL}", "search.init_from": str(tmp_path)}
    folder = write_run(tmp_path / name, wanted, task=evil, parent=parent)
    page = page_of(folder)
    found = Elements(page)
    assert sorted({*found.names}) == sorted({*Elements(page_of(harmless)).names})
    assert "onerror" not in {name for name, _ in found.attributes}
    assert not re.search(r"<(?!/?[a-z!])", page.split("</style>")[1].split("<script>")[0])
    # It is shown, though: the whole text in the title, and in the JSON that the script reads.
    assert "made:&lt;/script&gt;" in page
    assert EVIL in next(iter(found.scripts["data-map"]["rows"].values()))[1]


def test_a_data_script_cannot_be_left():
    text = data_script("name", {"a": "</script><!--&"})
    assert text.count("<") == 2
    assert json.loads(text[text.index(">") + 1 : text.rindex("<")]) == {"a": "</script><!--&"}
    assert tag("b", "<i>", Markup("<i/>"), title='"<') == '<b title="&quot;&lt;">&lt;i&gt;<i/></b>'


@pytest.mark.parametrize(
    ("dimensions", "settings", "shape"),
    [
        (1, {}, "rect"),
        (1, {"map.kind": "cvt", "map.cells": [60]}, "rect"),
        (2, {}, "rect"),
        (2, {"map.kind": "cvt", "map.cells": [60]}, "polygon"),
        (3, {"map.cells": [4, 3, 2]}, "rect"),
        (4, {"map.cells": [3, 3, 3, 3]}, "rect"),
        (5, {"map.kind": "cvt", "map.cells": [60]}, "circle"),
    ],
)
def test_every_kind_of_map_shows_every_filled_cell(tmp_path, dimensions, settings, shape):
    data = read_run(write_run(tmp_path / "run", settings, task=task_with(dimensions)))
    figure = str(maps.draw_map(data)[0])
    drawn = re.findall(rf'<{shape}[^>]* data-c="(\d+)"', figure)
    assert set(drawn) == set(map(str, data.map.cell_N.tolist())) == set(maps.cell_rows(data))
    assert len(drawn) == data.map.size * (6 if shape == "circle" else 1)  # pairs of the first four dimensions
    assert Elements(page_of(data.folder)).open == []


def test_cells_and_paths_are_drawn_where_they_are(tmp_path):
    """The cell of the upper left corner of PointMaze, and its path's end in its middle."""
    data = read_run(write_run(tmp_path / "run", filled=1.0))
    figure = str(maps.draw_map(data)[0])
    cell = 19  # 0,19: lowest x, highest y
    x, y, width, height = (
        float(re.search(rf'<rect[^>]* {name}="([\d.]+)"[^>]* data-c="{cell}"', figure)[1])
        for name in ("x", "y", "width", "height")
    )
    ground = re.search(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)"', figure)
    assert (x, y) == (float(ground[1]), float(ground[2]))
    assert width == height == pytest.approx(float(ground[3]) / 20, abs=0.06)
    found = maps.path_lines(data)
    points = np.frombuffer(base64.b64decode(found["paths"]), "<i2").reshape(400, 64, 2) / 10
    end = points[found["order"].index(cell), -1]
    np.testing.assert_allclose(end, [x + width / 2, y + height / 2], atol=0.2)
    # A path that leaves the map meanwhile is drawn along its edge, not over the text beside it.
    assert any((data.paths[cell] < -1.0).any() for cell in data.paths)
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    assert (low >= [x - 0.1, y - 0.1]).all()
    assert (high <= [x + 20 * width + 0.1, y + 20 * height + 0.1]).all()


def test_of_a_cell_that_a_wall_divides_the_side_of_its_elite_is_drawn(tmp_path):
    """PointMaze's walls are at y = -0.495, from x = -0.5, and at y = 0.205, up to x = 0.5; cells are 0.1 high."""
    data = read_run(write_run(tmp_path / "run", filled=1.0))
    cells = [data.map.geometry.cell_at(place) for place in ((3, 12), (7, 12), (17, 12), (9, 5), (9, 4))]
    descriptor_N_B = data.map.descriptor_N_B.copy()
    descriptor_N_B[cells] = [(-0.65, 0.2), (-0.25, 0.25), (0.75, 0.2), (-0.05, -0.5), (-0.05, -0.55)]
    drawn = floor.beside_walls(replace(data.map, descriptor_N_B=descriptor_N_B), data.task)
    (left, right), (bottom, top) = drawn[cells[0]]
    assert (left, right, bottom, top) == pytest.approx((-0.7, -0.6, 0.175, 0.205)), "under the wall, at the edge"
    assert drawn[cells[1]][1] == pytest.approx((0.205, 0.3)), "above it"
    assert cells[2] not in drawn, "beside the end of the wall"
    assert drawn[cells[3]][1] == pytest.approx((-0.525, -0.495))
    assert cells[4] not in drawn


def test_voronoi_cells_fill_the_map_and_hold_their_centroids(tmp_path):
    settings = {"map.kind": "cvt", "map.cells": [40]}
    data = read_run(write_run(tmp_path / "run", settings, task=task_with(2), filled=1.0))
    figure, _, frame = maps.draw_map(data)
    total = 0.0
    for cell, points in re.findall(r'<polygon[^>]* points="([^"]*)"[^>]* data-c="(\d+)"', str(figure)):
        corners = np.array([pair.split(",") for pair in cell.split()], float)
        following = np.roll(corners, -1, axis=0)
        total += abs((corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()) / 2
        x, y = data.map.geometry.centroid_C_B[int(points)]
        middle = np.array([frame.across(x), frame.down(y)])
        sides = [
            np.cross(np.append(b - a, 0), np.append(middle - a, 0))[2] for a, b in zip(corners, following, strict=True)
        ]
        assert all(side > 0 for side in sides) or all(side < 0 for side in sides)
    assert total == pytest.approx(frame.width * frame.height, rel=1e-3)


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_elites_of_a_dominated_map_are_points_at_their_descriptors(tmp_path, dimensions):
    settings = {"map.kind": "dominated", "map.slots": 30}
    data = read_run(write_run(tmp_path / "run", settings, task=task_with(dimensions)))
    figure, text, frame = maps.draw_map(data)
    assert not maps.has_area(data.map)
    assert text.startswith("Each point is an elite")
    points = re.findall(r'<circle cx="([^"]*)" cy="([^"]*)"[^>]* data-c="(\d+)"', str(figure))
    assert len(points) == 15 * {1: 1, 2: 1, 3: 3}[dimensions]
    assert [int(slot) for _, _, slot in points[:15]] == data.map.cell_N.tolist()
    if frame is not None:
        x_N, y_N = frame.across(data.map.descriptor_N_B[:, 0]), frame.down(data.map.descriptor_N_B[:, 1])
        assert [point[:2] for point in points] == [(f"{x:.1f}", f"{y:.1f}") for x, y in zip(x_N, y_N, strict=True)]
    assert "15 of 30 cells" not in page_of(data.folder)


@pytest.mark.parametrize("settings", [{"map.enabled": False, "search.algorithm": "es"}, {}])
def test_generation_0_alone_and_a_run_without_a_map_have_pages(tmp_path, settings):
    page = page_of(write_run(tmp_path / "run", settings, generations=0, filled=0.0))
    assert Elements(page).open == []
    assert ("no behaviour map" if settings else "No cell is filled yet") in page


def test_captions_are_true_of_a_run_that_moves_no_centre(tmp_path):
    moving = read_run(write_run(tmp_path / "run"))
    still = replace(moving, history={**moving.history, "update_norm": np.full(21, np.nan)})
    pages = [run_page(data, python_call(data.folder)) for data in (moving, still)]
    for page, one, several in zip(pages, ("centre", "policy"), ("centres", "policies"), strict=True):
        assert f"<h2>Evaluated {several}</h2>" in page
        assert f'aria-label="Evaluated {several}"' in page
        assert f"Each point is an evaluated {one}, at its mean descriptor" in page
        assert f"generation 20: 21 {several}, best" in page
        assert "single training episodes" not in page
        assert "training episodes with noise where a centre moves" in page
        assert "nearest ones that were in the novelty archive before it" in page
        assert "episodes of the population" in page


def test_a_run_before_its_first_generation_has_a_page(tmp_path):
    folder = write_run(tmp_path / "run")
    execute(folder, "DELETE FROM history")
    execute(folder, "DELETE FROM state")
    assert "No generation is finished yet" in page_of(folder)


def test_a_damaged_run_says_so(tmp_path):
    folder = write_run(tmp_path / "run")
    execute(folder, "UPDATE history SET best_fitness = 5 WHERE generation = 7")
    assert "the history rows of generations 7 are damaged or missing" in page_of(folder)


def test_a_report_is_written_into_the_folder_or_elsewhere(tmp_path):
    folder = write_run(tmp_path / "run")
    assert write_report(folder, best=False) == [folder / "report.html"]
    elsewhere = tmp_path / "new" / "page.html"
    assert write_report(folder, elsewhere, best=False) == [elsewhere]
    assert elsewhere.read_text() == (folder / "report.html").read_text()
    assert [path.name for path in elsewhere.parent.iterdir()] == ["page.html"]


def test_a_place_that_cannot_be_written_is_one_sentence_with_the_way_out(tmp_path):
    """Also for root: below a file, and on a file system that is read-only (`/proc`, or one that is mounted so)."""
    folder = write_run(tmp_path / "run")
    for file, why in (
        (folder / "config.yaml" / "page.html", "File exists"),
        (Path(), "(Is a directory|Device or resource busy)"),
        (Path("/proc/page.html"), "No such file or directory"),
        (Path("/sys/page.html"), "(Permission denied|Read-only file system)"),
    ):
        with pytest.raises(StoreError, match=f"^cannot write {file}: {why}; choose another file") as caught:
            write_report(folder, file, best=False)
        assert (caught.value.field, caught.value.value) == ("out", str(file))
        printed = error_message(caught.value).splitlines()
        assert len(printed) == 2
        assert shlex.split(printed[1])[-4:] == ["report", str(folder), "--out", "FILE"]


def test_a_run_in_a_read_only_folder_has_its_report_elsewhere(small_disk, tmp_path):
    subprocess.run(["mount", "-o", "remount,size=50m", str(small_disk)], check=True)
    folder = write_run(small_disk / "run")
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(StoreError, match=r"cannot write .*report\.html: Read-only file system; choose another file"):
        write_report(folder, best=False)
    assert write_report(folder, tmp_path / "page.html", best=False) == [tmp_path / "page.html"]


def test_a_folder_whose_name_is_no_utf_8_has_a_page(tmp_path):
    folder = write_run(tmp_path / os.fsdecode(b"run\xff"))
    [page] = write_report(folder, best=False)
    assert "<h1>run?: me_es on point_maze</h1>" in page.read_text(encoding="utf-8")


def test_colours_rise_evenly_in_lightness():
    """So they keep their order in a grey print, and for every colour vision."""
    rgb = np.array([[int(one[i : i + 2], 16) for i in (1, 3, 5)] for one in SCALE]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lightness = np.cbrt(linear @ [0.2126, 0.7152, 0.0722])
    steps = np.diff(lightness)
    assert steps.min() > 0.5 * steps.mean()
    assert level([-5.0, 0.0, 0.5, 1.0, 9.0], 0.0, 1.0).tolist() == [0, 0, LEVELS // 2, LEVELS - 1, LEVELS - 1]


def test_axes_have_round_numbers():
    assert ticks(-132.0, -20.0) == [-120.0, -100.0, -80.0, -60.0, -40.0, -20.0]
    assert ticks(0.0, 1.0) == [0.0, 0.2, 0.4, pytest.approx(0.6), 0.8, 1.0]
    assert tick_text(2_500_000, 500_000) == "2.5M"
    assert tick_text(-20.0, 10.0) == "-20"
    frame = Frame((0.0, 2.0), (-1.0, 1.0), 10.0, 5.0, 100.0, 50.0)
    assert (float(frame.across(1.0)), float(frame.down(1.0)), float(frame.down(0.0))) == (60.0, 5.0, 30.0)


def test_a_full_map_fits_into_five_megabytes(tmp_path):
    assert len(page_of(write_run(tmp_path / "run", generations=2000, filled=1.0))) < 5e6
