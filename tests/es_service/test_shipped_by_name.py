"""Shipped configs are there by name, also for whoever has no clone."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from es_service import load_config
from es_service.api import default_folder
from es_service.cli.main import app
from es_service.config.given import config_file, first_sentence, shipped_configs, shipped_text
from es_service.errors import ConfigError

ROOT = Path(__file__).parents[2]
NAMES = sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))


def test_a_name_is_taken_where_no_such_file_exists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert list(shipped_configs()) == NAMES
    assert load_config("point_maze_me_es") == load_config(ROOT / "configs" / "point_maze_me_es.yaml")
    assert config_file("point_maze_me_es.yaml") == ROOT / "configs" / "point_maze_me_es.yaml"
    assert config_file("configs/point_maze_me_es.yaml") == Path("configs/point_maze_me_es.yaml"), "a path is a path"
    Path("point_maze_me_es").write_text("search: {}")
    assert config_file("point_maze_me_es") == Path("point_maze_me_es")


def test_a_config_is_described_by_its_whole_first_sentence():
    first = {name: first_sentence(file.read_text()) for name, file in shipped_configs().items()}
    assert all(sentence.endswith(".") for sentence in first.values())
    assert first["ant_maze_memes"].endswith(" the direct path ends in a pocket.")
    assert first_sentence("# A. B.\n# C.\na: 1  # D") == "A. B."
    assert first_sentence("a: 1") == ""


@pytest.mark.parametrize("missing", ["point_maze_me_e", "point_maze_me_es.yml", "configs/point_maze_me_es.yaml"])
def test_a_missing_file_with_a_similar_name_names_the_shipped_config(tmp_path, monkeypatch, missing):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="did you mean the shipped config point_maze_me_es") as caught:
        load_config(missing)
    assert caught.value.suggestion == "point_maze_me_es"
    with pytest.raises(ConfigError, match=r"no such file$"):
        load_config("another")


@pytest.mark.slow
def test_a_run_s_own_folder_has_no_colon_in_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = default_folder(load_config("brax_ant_es")).as_posix()
    assert name.startswith("runs/brax_ant_es_seed0_"), "scp and `docker compose cp` would take it for HOST:PATH"
    assert default_folder(load_config("brax_ant_es")) != default_folder(load_config("brax_ant_es")), "of two threads"
    pole = {"task": {"environment": "gymnasium:phys2d/CartPole-v1"}, "search": {"algorithm": "es"},
            "budget": {"generations": 1}}  # fmt: skip
    assert default_folder(load_config(pole)).parent.as_posix() == "runs"


def test_a_shipped_config_is_printed_to_be_edited(tmp_path):
    shown = CliRunner().invoke(app, ["config", "point_maze_es"])
    assert (shown.exit_code, shown.stdout) == (0, (ROOT / "configs" / "point_maze_es.yaml").read_text())
    mine = tmp_path / "mine.yaml"
    mine.write_text(shown.stdout)
    assert load_config(mine) == load_config("point_maze_es")
    with pytest.raises(ConfigError, match="no shipped config has this name; did you mean point_maze_es"):
        shipped_text("point_maze_ess")
    listed = CliRunner().invoke(app, ["list"], env={"COLUMNS": "200"}).stdout
    assert all(name in listed for name in NAMES)


def test_every_package_is_installed():
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for root in ("es_service", "workers")
        for path in (ROOT / root).rglob("__init__.py")
    }
    data = {"es_service.guides", "es_service.report.assets", "es_service.watch.assets"}
    assert set(packages) == found | data | {"es_service.shipped_configs", "es_service.launch_files"}
    assert len(packages) == len(set(packages))


def test_a_task_in_the_place_of_a_config_says_where_it_belongs():
    with pytest.raises(ConfigError, match=r"point_maze_es with task\.environment=gymnasium:Pendulum-v1"):
        load_config("gymnasium:Pendulum-v1")
