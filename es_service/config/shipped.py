"""The configs that come with the package, by name: the folder `configs` of a clone, or data of an installed package."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from es_service.config.problems import did_you_mean, nearest
from es_service.config.yaml_text import read_yaml_file
from es_service.errors import ConfigError, Problem
from es_service.protocol.system import given_path

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
        ConfigError: as `read_yaml_file`; if there is no such file, with the shipped config whose name is similar.
    """
    file = config_file(source)
    near = None if file.exists() else nearest(file.name.removesuffix(".yaml"), shipped_configs())
    if near is None:
        return read_yaml_file(file)
    problem = Problem(f"no such file; did you mean the shipped config {near}?", "config", str(file), suggestion=near)
    raise ConfigError.listing(f"{file}: 1 problem", [problem])


def shipped_text(name: str) -> str:
    """The text of a shipped config. Raises ConfigError for another name."""
    known = shipped_configs()
    if name not in known:
        hint = did_you_mean(name, known) or f"; the shipped configs are {', '.join(known)}"
        problem = Problem(f"no shipped config has this name{hint}", "config", name, suggestion=nearest(name, known))
        raise ConfigError.listing(f"{name}: 1 problem", [problem])
    return known[name].read_text()
