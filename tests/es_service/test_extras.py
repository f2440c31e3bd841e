"""What is missing without an extra of the package is named with a command that gets it: from a clone, by its pins."""

import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from es_service.api import load_config
from es_service.cli.common import error_message
from es_service.errors import ConfigError, WayOut
from es_service.runs import export

ROOT = Path(__file__).parents[2]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


@pytest.mark.parametrize(("to", "package"), [("ribs", "ribs.archives"), ("parquet", "pyarrow")])
def test_an_export_without_its_package_says_how_to_get_it(tmp_path, monkeypatch, to, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(export, "tables", lambda run: [("history", pd.DataFrame({"generation": [0]}))])
    run = SimpleNamespace(generation=0, folder=tmp_path / "run")
    with pytest.raises(ConfigError, match=f"needs py{package.removeprefix('py').partition('.')[0]}") as error:
        export.export(run, to, tmp_path)
    assert (error.value.field, error.value.value) == ("to", to)
    assert error.value.way_out == WayOut("install", "install it", extra=to)
    command = f"pip install -c constraints.txt -e '.[{to}]'"
    assert error_message(error.value).endswith(f"  to install it: in a clone of es-service: {command}")
    assert to in EXTRAS


def test_a_search_without_its_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    source = {"task": {"environment": "point_maze"}, "search": {"algorithm": "jedi"}, "budget": {"generations": 1}}
    with pytest.raises(ConfigError, match="needs scikit-learn") as error:
        load_config(source)
    assert error.value.way_out.extra in EXTRAS


@pytest.mark.parametrize("folder", ["es_service", "workers", "docker"])
def test_nobody_is_sent_to_a_package_index_for_es_service(folder):
    texts = {path: path.read_text() for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml", ".md")}
    assert texts
    for path, text in texts.items():
        assert not re.search(r"pip install[^\n]*es[-_]service\[", text), path
        for extra in re.findall(r"pip install[^\n]*'\.\[(\w+)\]'", text):
            assert extra in EXTRAS, path


def test_the_packages_of_extras_are_pinned():
    pinned = {line.partition("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines()}
    for packages in EXTRAS.values():
        names = {re.split(r"[\[><=]", package)[0].lower() for package in packages} - {"es-service"}
        assert names <= pinned
