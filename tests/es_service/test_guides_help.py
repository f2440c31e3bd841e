"""`es-service help`: sections of the guides in the terminal."""

from __future__ import annotations

import pytest

from es_service.cli.show import GUIDES, help_, named, sections
from es_service.errors import ConfigError


def test_a_section_is_its_heading_and_what_stands_below_it(capsys):
    help_(["the", "run", "folder"])
    printed = capsys.readouterr().out
    assert printed.startswith("## The run folder\n")
    assert "`run.db`" in printed
    assert "## Limits" not in printed


def test_lines_of_code_are_no_headings():
    assert not [section for section in sections() if section.heading.startswith(("make", "first:"))]
    assert {section.guide for section in sections()} == GUIDES.keys()


def test_the_shortest_heading_with_all_words_is_shown_first():
    found = named("certified values", sections())
    assert found[0].heading == "Certified values"


def test_without_a_topic_all_sections_are_listed(capsys):
    help_(None)
    assert "    The run folder\n" in capsys.readouterr().out


def test_an_unknown_topic_hints_at_a_similar_one():
    with pytest.raises(ConfigError, match=r"no heading of the guides has these words; did you mean Tokens\?"):
        help_(["tokns"])
