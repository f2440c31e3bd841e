"""What a user gives, as values by dotted key: a config file, a shipped one by its name, a mapping; and overrides."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from es_service.config.keys import GROUPS, not_a_mapping
from es_service.config.text import did_you_mean, in_line, nearest, parse_value, plain, problem_of, read_yaml_file
from es_service.errors import ConfigError, Problem
from es_service.protocol.machine import given_path

PACKAGE = Path(__file__).parents[1]
PLACES = (PACKAGE.parent / "configs", PACKAGE / "shipped_configs")
"""The folder of a clone and that of an installed package; the first one that exists is used."""


def shipped_configs() -> dict[str, Path]:
    """File of each shipped config by its name, such as `point_maze_me_es`, in alphabetical order."""
    place = next((place for place in PLACES if (place / "point_maze_me_es.yaml").is_file()), None)
    return {} if place is None else {file.stem: file for file in sorted(place.glob("*.yaml"))}


def first_sentence(text: str) -> str:
    """The first sentence of the comment that a config begins with: its lines until one ends with a full stop."""
    lines: list[str] = []
    for line in text.splitlines():
        if not line.startswith("#") or (lines and lines[-1].endswith(".")):
            break
        lines.append(line.lstrip("# "))
    return " ".join(lines)


def config_file(source: str | os.PathLike[str]) -> Path:
    """The file at a path or, if it does not exist, the file of the shipped config with this name."""
    path = given_path(source)
    if path.exists() or path.name != os.fspath(source):
        return path
    return shipped_configs().get(path.name.removesuffix(".yaml"), path)


def read_config(source: str | os.PathLike[str]) -> Mapping[object, object]:
    """The top-level mapping of a config file, given by its path or by the name of a shipped config.

    Raises:
        ConfigError: as `read_yaml_file`; if there is no such file, with the shipped config whose name is similar, or
            what to do with the name of a task.
    """
    file = config_file(source)
    near = None if file.exists() else nearest(file.name.removesuffix(".yaml"), shipped_configs())
    hint = f"did you mean the shipped config {near}?"
    if near is None and not file.exists() and ":" in file.name:
        hint = f"a task belongs into a config, such as point_maze_es with task.environment={file.name}"
    elif near is None:
        return read_yaml_file(file)
    problem = Problem(f"no such file; {hint}", "config", str(file), suggestion=near)
    raise ConfigError.listing(f"{file}: 1 problem", [problem])


def shipped_text(name: str) -> str:
    """The text of a shipped config. Raises ConfigError for another name."""
    known = shipped_configs()
    if name not in known:
        hint = did_you_mean(name, known) or f"; the shipped configs are {', '.join(known)}"
        problem = Problem(f"no shipped config has this name{hint}", "config", name, suggestion=nearest(name, known))
        raise ConfigError.listing(f"{name}: 1 problem", [problem])
    return known[name].read_text()


Source = str | os.PathLike[str] | Mapping[str, Any]
"""Where a config comes from: the path of a YAML file, the name of a shipped one, or the content of one."""
Overrides = Iterable[str] | Mapping[str, Any]
"""Changes of a config: strings such as "search.sigma=0.05", with values in YAML, the last one for a key winning; or a
mapping from key to value."""


def by_key(mapping: Mapping[Any, Any], group: str = "") -> tuple[dict[str, Any], set[str], list[Problem]]:
    """Values of a nested mapping: (values by dotted key, names of groups that are not mappings, problems).

    There is a problem for each key with a dot, and each group that is not a mapping. `key_problems` finds unknown keys.
    """
    values: dict[str, Any] = {}
    unusable: set[str] = set()
    problems: list[Problem] = []
    for key, value in mapping.items():
        name = f"{group}{key}"
        if "." in str(key):
            section, leaf = name.rsplit(".", 1)
            problems.append(problem_of(name, value, f"a key in a file has no dots; write {leaf} inside {section}:"))
        elif isinstance(value, Mapping) and (name in GROUPS or group == "search."):
            below = by_key(value, f"{name}.")
            values |= below[0]
            unusable |= below[1]
            problems += below[2]
        elif name in GROUPS:
            unusable.add(name)
            problems.append(not_a_mapping(name, value))
        else:
            values[name] = plain(value)
    return values, unusable, problems


def parse_overrides(overrides: Overrides) -> tuple[dict[str, Any], list[Problem]]:
    """Values by dotted key, and a problem for each override that cannot be read. Its key need not exist."""
    values: dict[str, Any] = {}
    problems: list[Problem] = []
    if isinstance(overrides, Mapping):
        overrides = [f"{name}={in_line(plain(value))}" for name, value in overrides.items()]
    for override in [overrides] if isinstance(overrides, str) else overrides:
        name, equals, text = (part.strip() for part in override.partition("="))
        where = f"override {override}"
        if not equals or not name or not text:
            example = "write KEY=VALUE, such as search.sigma=0.05"
            hint = "the value is missing; write null for no value" if name and equals else example
            problems.append(Problem(f"{where}: {hint}"))
            continue
        try:
            values[name] = parse_value(text)
        except ValueError as error:
            problems.append(Problem(f"{where}: {error}", name, text))
    return values, problems


def start_of(init_from: str) -> tuple[str, str | tuple[int, ...]]:
    """Parse `search.init_from`: (folder of a run, "centre" for the one updated last, "best", or the index of a cell).

    The forms are RUN, RUN:best and RUN:3,17. If a folder has the whole text as its name, that folder is used.
    """
    folder, _, which = init_from.rpartition(":")
    if not folder or os.path.isdir(init_from) or not re.fullmatch(r"best|\d+(,\d+)*", which):
        return init_from, "centre"
    return folder, which if which == "best" else tuple(map(int, which.split(",")))
