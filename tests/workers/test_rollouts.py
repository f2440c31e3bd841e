"""A rollout is one object in the registry: one that the service does not ship does all that the shipped ones do."""

from __future__ import annotations

import numpy as np
import pytest

from es_service import api, load_config
from es_service.cli.bench import bench_rollouts
from es_service.config.workload import config_warnings
from es_service.errors import ConfigError, EvaluationError
from es_service.runs.replay import record
from tests.workers.numpy_rollout import REGISTERING, NumPy
from workers.environments import SHIPPED
from workers.rollouts import BACKENDS

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 30},
    "policy": {"hidden": [8]},
    "map": {"cells": [8, 8]},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 2},
}
ES = {"algorithm": "es", "pairs": 8, "sigma": 0.1, "evaluation_episodes": 3}
MAP_ELITES = {"algorithm": "map_elites", "batch": 20, "centres": 3, "iso_sigma": 0.2}


@pytest.fixture
def numpy_is_registered(tmp_path, monkeypatch):
    """Here and in all new processes, which cannot import JAX."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(REGISTERING)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setitem(BACKENDS, "numpy", NumPy())


@pytest.mark.slow
@pytest.mark.parametrize(
    "search", [pytest.param(ES, marks=pytest.mark.long), MAP_ELITES], ids=lambda search: search["algorithm"]
)
def test_a_run_and_its_replays_with_another_rollout_are_those_of_xla(search, tmp_path, request):
    xla = api.run(CONFIG | {"search": search, "compute": {"workers": 1, "rollout": "xla"}}, tmp_path / "xla").run
    request.getfixturevalue("numpy_is_registered")
    run = api.run(CONFIG | {"search": search}, tmp_path / "numpy").run
    assert run.config["compute"]["rollout"] == "numpy", "the last of the registry is what `auto` chooses"
    for column in ("best_fitness", "env_steps", "coverage"):
        np.testing.assert_allclose(run.history[column], xla.history[column], rtol=1e-3, err_msg=column)
    np.testing.assert_allclose(run.policy("best").parameters_D, xla.policy("best").parameters_D, atol=1e-3)
    cells = list(run.map[["cell_x", "cell_y"]].head(2).itertuples(index=False, name=None))
    replays, recordings = record(run, best=True, cells=cells)
    assert [one.is_the_stored for one in replays] == [True] * (1 + len(cells))
    assert recordings.scene is None


@pytest.mark.slow
@pytest.mark.usefixtures("numpy_is_registered")
def test_another_rollout_is_measured():
    rows = list(bench_rollouts(["point_maze"], rollouts=["numpy"], batches=[4], seconds=0.0))
    assert {(row["rollout"], row["policy"]) for row in rows} == {("numpy", "off"), ("numpy", "on")}
    assert all(row["steps_per_second"] > 0 for row in rows)
    with pytest.raises(EvaluationError, match="ant_maze: numpy cannot run it: it knows no other task than point_maze"):
        list(bench_rollouts(["ant_maze"], rollouts=["numpy"], batches=[4], seconds=0.0))


@pytest.mark.usefixtures("numpy_is_registered")
def test_a_config_asks_another_rollout_what_it_can_do():
    config = CONFIG | {"search": ES}
    assert load_config(config).compute.chunk_pairs == 1
    assert load_config(config, ["compute.rollout=xla"]).compute.chunk_pairs == 8
    for overrides, problem in (
        (["compute.rollout=numpy", "task.environment=ant_trap"], "numpy cannot run ant_trap: it knows no other task"),
        (["compute.rollout=numpy", "compute.engine=ray", "compute.worker_resources.gpu=1"], "numpy runs only on CPUs"),
        (["compute.rollout=numpy", "compute.inline_workers=threads"], "threads needs .* compute.rollout = simd"),
        (["compute.rollout=numpi"], "must be auto or xla, simd or numpy; did you mean numpy?"),
    ):
        with pytest.raises(ConfigError, match=problem):
            load_config(config, overrides)
    ant = load_config(config, ["task.environment=ant_trap"])
    assert ant.compute.rollout == "simd"
    (warning,) = config_warnings(ant, SHIPPED["ant_trap"], BACKENDS)
    assert warning.endswith("simd is used because numpy cannot run ant_trap: it knows no other task than point_maze")
