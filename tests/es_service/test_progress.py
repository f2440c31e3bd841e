"""The live table fits the screen it is shown on; where there can be none, there are lines."""

import io
from collections import deque
from math import nan

import pytest
from rich.console import Console

from es_service.errors import decimals
from es_service.report.progress import live_table, plain_line, short, show_progress

ROW = {
    "generation": 123456,
    "centre_fitness_mean": -1234.56,
    "centre_fitness_std": 123.45,
    "best_fitness": -1234.56,
    "population_fitness_median": None,
    "env_steps": 123_456_789_012,
    "steps_per_second": 4_567_890.0,
    "invalid_members": 0,
    "lost_workers": 1,
    "update_norm": 0.5,
    **{f"seconds_{part}": 0.1 for part in ("rollout", "gradient", "evaluation", "driver", "store")},
}


@pytest.mark.parametrize(("width", "height"), [(40, 24), (60, 24), (80, 24), (100, 12), (120, 50), (200, 60)])
def test_the_live_table_fits_the_screen(width, height):
    console = Console(width=width, height=height, force_terminal=False)
    with console.capture() as capture:
        console.print(live_table("runs/a", deque([ROW] * 20), width, height))
    lines = capture.get().splitlines()
    assert len(lines) <= height
    assert all(len(line) <= width for line in lines)
    table = [line for line in lines if "123456" in line]
    assert 1 <= len(table) <= 12
    assert all("…" not in line for line in table)
    assert ("4.57 M" in table[0]) == (width >= 75)
    assert "workers replaced: 20" in " ".join(" ".join(lines).split())


@pytest.mark.parametrize(("terminal", "environment"), [(False, {}), (True, {"TERM": "dumb"})])
def test_where_no_table_can_be_shown_lines_come_at_once(terminal, environment):
    console = Console(file=io.StringIO(), force_terminal=terminal, _environ=environment)
    with show_progress(console, console, "runs/a") as (show, note):
        show(ROW)
        note("a worker was lost")
        shown = console.file.getvalue()
    assert shown.splitlines() == [
        "generation 123456  centre -1234.56  best -1234.56  env steps 123,456,789,012  steps/s 4,567,890  "
        "workers replaced 1",
        "note: a worker was lost",
    ]


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({}, "centre"),
        ({"generation": 0, "update_norm": None}, "centre"),
        ({"update_norm": None}, "policy"),
        ({"update_norm": float("nan")}, "policy"),
    ],
)
def test_a_generation_that_moves_no_centre_shows_its_fittest_policy(changes, word):
    row, console = ROW | changes, Console(width=80, force_terminal=False)
    assert f"  {word} -1234.56  best -1234.56  " in plain_line(row)
    with console.capture() as capture:
        console.print(live_table("runs/a", deque([row]), 80, 24))
    assert f"{word} fitness" in capture.get()


@pytest.mark.parametrize(("std", "shown"), [(0.5, "-1234.56 ± 0.50 "), (0.0, "-1234.56 ")])
def test_the_spread_of_one_episode_is_not_shown(std, shown):
    console = Console(width=80, force_terminal=False)
    with console.capture() as capture:
        console.print(live_table("runs/a", deque([ROW | {"centre_fitness_std": std}]), 80, 24))
    assert shown in capture.get()
    assert ("±" in capture.get()) == bool(std)


def test_counts_have_three_digits_at_the_borders_of_units_too():
    counts = {999.4: "999", 999.7: "1 k", 12_345: "12.3 k", 999_499: "999 k", 999_500: "1 M", 1.2345e12: "1.23 T"}
    assert {count: short(count) for count in counts} == counts


@pytest.mark.parametrize(
    ("value", "text"),
    [(-84.784, "-84.78"), (-1234.5, "-1234.50"), (-0.0, "0.00"), (0.01, "0.01"), (0.0026, "2.60e-03"), (nan, "nan")],
)
def test_a_small_value_is_not_shown_as_0(value, text):
    assert decimals(value) == text
    assert f"best {text}  env" in plain_line(ROW | {"best_fitness": value})
