"""A run as a notebook shows it."""

import html
import re

from es_service import open_run
from es_service.report.data import read_run
from es_service.report.maps import draw_map
from es_service.report.summary import verdict
from tests.database import execute
from tests.es_service.test_report_page import Elements
from tests.run_examples import write_run


def page_of(folder):
    """The page in the frame that a notebook shows."""
    shown = open_run(folder)._repr_html_()
    assert Elements(f"<!DOCTYPE html>{shown}").names == ["iframe"]
    assert 'sandbox="allow-scripts"' in shown
    return html.unescape(re.search('srcdoc="([^"]*)"', shown)[1])


def test_a_run_is_shown_by_its_summary_its_curves_and_its_map(tmp_path):
    folder = write_run(tmp_path / "run")
    data, page = read_run(folder), page_of(folder)
    assert html.escape(verdict(data)) in page
    assert draw_map(data)[0] in page
    assert re.findall("<figcaption><b>([^<]*)", page) == ["Fitness", "Coverage of the behaviour map", "Behaviour map"]
    assert len(page) < 200_000


def test_a_run_without_a_map_or_a_generation_is_shown(tmp_path):
    page = page_of(write_run(tmp_path / "a", {"map.enabled": False, "search.algorithm": "es"}))
    assert re.findall("<figcaption><b>([^<]*)", page) == ["Fitness"]
    folder = write_run(tmp_path / "b")
    execute(folder, "DELETE FROM history")
    execute(folder, "DELETE FROM state")
    assert "No generation is finished yet" in page_of(folder)


def test_markup_in_a_name_stays_text(tmp_path):
    page = page_of(write_run(tmp_path / "<img src=x onerror=alert(1)>"))
    assert "img" not in Elements(page).names


def test_a_run_that_is_gone_is_shown_as_a_sentence(tmp_path):
    run = open_run(write_run(tmp_path / "a<b"))
    (tmp_path / "a<b").rename(tmp_path / "c")
    assert (
        run._repr_html_() == f"<pre>{html.escape(str(tmp_path / 'a<b'))} is not a run folder: it does not exist</pre>"
    )
