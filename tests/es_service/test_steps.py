"""Steps and shaping as parts: what a run stores of a step, and forks that change a part."""

from __future__ import annotations

import numpy as np
import pytest

from es_service import api
from es_service.config.parts import AdamStep, AdamWStep, ClipUpStep, PlainStep
from es_service.errors import StoreError
from es_service.runs.snapshot import sound_nodes, stored_policy_spec
from es_service.search.algorithms import ALGORITHMS
from es_service.search.steps import STEPS, restarted
from tests.es_service.store_examples import CONSTANTS, meta

pytestmark = pytest.mark.usefixtures("workers_here")

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "nsr_es", "centres": 2, "pairs": 16, "sigma": 0.2, "evaluation_episodes": 2},
    "budget": {"generations": 4},
    "compute": {"engine": "inline", "workers": 1},
}
ADAM = {"adam_m_D", "adam_v_D", "adam_step"}


def step_arrays(run) -> list[dict[str, np.ndarray]]:
    """What each centre's step remembers."""
    return [run.at().nodes[f"centres/{index}/step"] for index in (0, 1)]


@pytest.mark.parametrize("settings", [AdamStep(), AdamWStep(), PlainStep(), ClipUpStep()])
def test_a_state_is_all_zeros_before_the_first_step_and_when_it_begins_again(settings):
    step, gradient_D = STEPS[settings.kind], np.arange(5, dtype=np.float32)
    fresh = step.fresh(5)
    assert not any(values.any() for values in fresh.values())
    used, centre_D = step.take(settings, fresh, np.ones(5, np.float32), gradient_D)
    assert used.keys() == fresh.keys()
    assert centre_D.dtype == np.float32
    assert not np.array_equal(centre_D, np.ones(5))
    again = restarted(used)
    assert {name: (values.dtype, values.shape) for name, values in again.items()} == {
        name: (values.dtype, values.shape) for name, values in fresh.items()
    }
    assert not any(values.any() for values in again.values())


def test_a_plain_step_stores_nothing_and_a_fork_with_another_step_begins_it_anew(tmp_path):
    adam = api.run(api.load_config(CONFIG), tmp_path / "adam").run
    assert sum(int(one["adam_step"]) for one in step_arrays(adam)) == 4
    more = "budget.generations=6"
    plain = api.fork(adam.folder, ["search.step.kind=plain", more], out=tmp_path / "plain").run
    assert step_arrays(plain) == [{}, {}]
    assert plain.constants["search.step.kind"] == "plain"
    back = api.fork(plain.folder, ["search.step.kind=adam", "budget.generations=9"], out=tmp_path / "back").run
    assert [one.keys() for one in step_arrays(back)] == [ADAM, ADAM]
    assert sum(int(one["adam_step"]) for one in step_arrays(back)) == 3
    whole = api.run(api.load_config(CONFIG, ["search.step.kind=plain", more]), tmp_path / "whole").run
    part = api.run(api.load_config(CONFIG, ["search.step.kind=plain"]), tmp_path / "part").run
    assert api.resume(part.folder, [more]).run.digest() == whole.digest() != plain.digest()


def test_the_shaping_of_a_fork_may_be_another(tmp_path):
    origin = api.run(api.load_config(CONFIG), tmp_path / "run").run
    settings = ["search.shaping.kind=top_pairs", "search.shaping.count=4", "budget.generations=6"]
    fork = api.fork(origin.folder, settings, out=tmp_path / "fork").run
    assert {key: value for key, value in fork.constants.items() if "shaping" in key} == {
        "search.shaping.kind": "top_pairs",
        "search.shaping.count": 4,
    }
    again = api.fork(fork.folder, ["search.shaping.kind=signs", "budget.generations=8"], out=tmp_path / "again").run
    assert "search.shaping.count" not in again.constants


@pytest.mark.parametrize("algorithm", [name for name in ALGORITHMS if name != "map_elites"])
def test_every_method_with_a_gradient_takes_every_part(algorithm, tmp_path):
    search = {"algorithm": algorithm, "pairs": 16, "evaluation_episodes": 2}
    if ALGORITHMS[algorithm].settings.needs_start:
        search["init_from"] = str(api.run(api.load_config(CONFIG), tmp_path / "parent").run.folder)
    source = CONFIG | {"search": search}
    for step in STEPS:
        for shaping in ("ranks", "signs", "returns", "top_pairs"):
            config = api.load_config(source, [f"search.step.kind={step}", f"search.shaping.kind={shaping}"])
            assert (config.search.step.kind, config.search.shaping.kind) == (step, shaping)
    config = api.load_config(
        source, ["search.step.kind=plain", "search.shaping.kind=top_pairs", "budget.generations=2"]
    )
    run = api.run(config, tmp_path / "run").run
    assert run.generation == 2
    assert run.history.update_norm.iloc[-1] > 0


@pytest.mark.parametrize("kind", STEPS)
def test_a_stored_centre_has_the_arrays_of_its_step(tmp_path, kind):
    run = meta(constants=CONSTANTS | {"search.step.kind": kind})
    size = stored_policy_spec(run).parameters
    arrays, node = STEPS[kind].fresh(size), "centres/0/step"
    sound_nodes(tmp_path, run, {node: {**arrays, "of_user_D": np.zeros(size, np.float32)}}, [node])
    for name, values in arrays.items():
        without = {other: array for other, array in arrays.items() if other != name}
        forged = [values.astype(str)] + ([np.int64(-1), np.int64(2**62)] if values.dtype.kind == "i" else [])
        for wrong, what in [(without, "lacks"), *(({**arrays, name: np.asarray(value)}, "has") for value in forged)]:
            with pytest.raises(StoreError, match=f"{node} {what} .*array .?{name}"):
                sound_nodes(tmp_path, run, {node: wrong}, [node])
