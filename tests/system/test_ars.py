"""ARS from the outside, with a linear policy: the other rollout, and everything that reads its policies."""

from __future__ import annotations

import csv

import numpy as np
import pytest

import es_service
from es_service import api
from es_service.store.digest import digest_parts
from tests.helpers import workers_in_this_process
from tests.system.command_line import command
from tests.system.session import SMALL

CONFIG = SMALL | {
    "policy": {"hidden": []},
    "search": {
        "algorithm": "ars",
        "pairs": 16,
        "shaping": {"count": 5},
        "sigma": 0.2,
        "step": {"learning_rate": 0.1},
        "evaluation_episodes": 4,
    },
    "budget": {"generations": 14},
}


def config_of(**compute):
    return api.load_config(CONFIG | {"compute": SMALL["compute"] | compute})


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A finished run on one worker, for reading only."""
    with workers_in_this_process():
        return api.run(config_of(), tmp_path_factory.mktemp("ars") / "run").run


@pytest.mark.long
def test_xla_computes_a_linear_policy_too(tmp_path, undisturbed):
    one, two = (api.run(config_of(rollout="xla", workers=n), tmp_path / str(n)).run for n in (1, 2))
    assert digest_parts(one.folder) == digest_parts(two.folder) != digest_parts(undisturbed.folder)
    theirs, ours = (run.history["centre_fitness_mean"] for run in (one, undisturbed))
    np.testing.assert_allclose(theirs[:3], ours[:3], rtol=1e-4)
    assert ours.max() > ours[0] + 1.0, "it has learned something"


def test_a_linear_policy_is_read_evaluated_exported_and_started_from(tmp_path, undisturbed):
    best = undisturbed.policy("best")
    assert best.spec.widths == (2, 2)
    weights, biases, seen = best.parameters_D[:4].reshape(2, 2), best.parameters_D[4:], np.array([0.3, -0.8])
    normalised = np.clip((seen - best.observation_mean_O) / best.observation_std_O, -5, 5)
    np.testing.assert_allclose(best(seen), np.tanh(normalised @ weights + biases), rtol=1e-5)

    out = tmp_path / "rows.csv"
    result = command("evaluate", undisturbed.folder, "--all", "--best", "--episodes", 20, "--out", out)
    assert result.returncode == 0, result.stderr
    assert len(list(csv.DictReader(out.read_text().splitlines()))) == len(undisturbed.map) + 1
    for to in ("npz", "csv"):
        result = command("export", undisturbed.folder, "--to", to, "--out", tmp_path / to)
        assert result.returncode == 0, result.stderr
    (file,) = (tmp_path / "npz").glob("*.npz")
    with np.load(file) as exported:
        assert exported["widths"].tolist() == [2, 2]
        np.testing.assert_array_equal(exported["best_parameters"], best.parameters_D)

    start = {"search": CONFIG["search"] | {"init_from": f"{undisturbed.folder}:best"}, "budget": {"generations": 1}}
    begun = api.run(api.load_config(CONFIG | start), tmp_path / "begun").run
    assert begun.history["centre_fitness_mean"][0] > undisturbed.history["centre_fitness_mean"][0]
    with es_service.evaluator(CONFIG) as evaluate:
        assert evaluate(np.stack([best.parameters_D, 0 * best.parameters_D]), episodes=2, seed=0).valid.all()
