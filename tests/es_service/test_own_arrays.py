"""Arrays of a search's own: stored and digested with the rest, read-only, and refused if they are no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service import api
from es_service.errors import StoreError
from es_service.search.algorithms import ALGORITHMS
from es_service.store.digest import digest_parts
from tests.database import execute

pytestmark = pytest.mark.usefixtures("workers_here")

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"algorithm": f"{__name__}:counting", "pairs": 16, "sigma": 0.2, "step": {"learning_rate": 0.1}},
    "budget": {"generations": 6},
    "compute": {"engine": "inline", "workers": 1},
}
SEEN: list = []
"""States that `watching` was asked with and told."""


def begin(folder, name="counting", generations=6):
    settings = [f"search.algorithm={__name__}:{name}", f"budget.generations={generations}"]
    return api.run(api.load_config(CONFIG, settings), folder).run


def telling(config, extra, change):
    """ES that has arrays of its own and changes them when it is told: `change(own, evaluation) -> own`."""
    ours = ALGORITHMS["es"](config)

    def tell(state, evaluations):
        return replace(ours.tell(state, evaluations), extra=change(state.extra, evaluations[0]))

    return replace(ours, tell=tell, extra=extra)


def counting(config, extra=0.0):
    """Sigma depends on what it remembers: a count, a list that grows, and a scalar that NumPy makes of a sum."""

    def change(extra, evaluation):
        heard = np.append(extra["heard"], evaluation.fitness)
        return {"count": extra["count"] + 1, "heard": heard, "sum": extra["sum"] + evaluation.fitness, "x": extra["x"]}

    extra = {"count": np.array(0), "heard": np.zeros(0), "sum": np.array(0.0, np.float32), "x": np.array(extra)}
    search = telling(config, extra, change)

    def ask(state, generation):
        assert state.extra["count"] == generation == state.extra["heard"].size
        (asked,) = ALGORITHMS["es"](config).ask(state, generation)
        return (replace(asked, sigma=0.2 / (1 + float(state.extra["sum"]) ** 2)),)

    return replace(search, ask=ask)


def counting_otherwise(config):
    """The same, with another number that nothing depends on."""
    return counting(config, extra=-0.0)


def test_they_outlive_a_stop_and_a_fork_to_the_bit(tmp_path):
    whole = begin(tmp_path / "whole")
    begin(tmp_path / "parts", generations=3)
    assert api.resume(tmp_path / "parts", ["budget.generations=6"]).run.digest() == whole.digest()
    begin(tmp_path / "parent", generations=4)
    forked = api.fork(tmp_path / "parent", ["budget.generations=6"], out=tmp_path / "fork", generation=3).run
    assert forked.digest() == whole.digest()
    for run in (whole, forked, api.open_run(tmp_path / "parts")):
        extra = run.at().nodes["extra"]
        assert (extra["count"], extra["heard"].size, extra["sum"].dtype) == (7, 7, np.float32)
        np.testing.assert_array_equal(extra["heard"], run.history["centre_fitness_mean"])
        assert extra["sum"] == pytest.approx(extra["heard"].sum(), rel=1e-5)


def test_they_are_in_the_digest(tmp_path):
    parts = [digest_parts(begin(tmp_path / name, name).folder) for name in ("counting", "counting_otherwise")]
    assert {name for name in parts[0] if parts[0][name] != parts[1][name]} == {"state/extra"}


def watching(config):
    """ES that shows every state, of a search without arrays of its own."""
    return _watching(ALGORITHMS["es"](config))


def watching_own(config):
    return _watching(counting(config))


def _watching(ours):
    def ask(state, generation):
        SEEN.append(state)
        return ours.ask(state, generation)

    def tell(state, evaluations):
        SEEN.append(state)
        return ours.tell(state, evaluations)

    return replace(ours, ask=ask, tell=tell)


def test_they_cannot_be_changed_in_place_also_after_a_resume(tmp_path):
    """A change in place would change the state before, with which the store compares."""
    SEEN.clear()
    begin(tmp_path / "run", "watching_own", generations=2)
    assert len(SEEN) == 5
    api.resume(tmp_path / "run", ["budget.generations=3"])
    assert len(SEEN) == 7
    for state in SEEN:
        with pytest.raises(ValueError, match="read-only"):
            state.extra["x"][...] = 1.0
        with pytest.raises(TypeError, match="does not support item assignment"):
            state.extra["x"] = np.array(1.0)


def test_a_part_that_nothing_changes_is_written_once(tmp_path):
    folder = begin(tmp_path / "run", "idle").folder
    api.resume(folder, ["budget.generations=8"])
    assert execute(folder, "SELECT generation FROM state WHERE part = 'extra#000000'") == [(0,)]


def idle(config):
    return telling(config, {"x": np.arange(3)}, lambda extra, evaluation: extra)


def from_generation_2(extra, evaluation, **changes):
    return {**extra, **changes} if evaluation.generation == 2 else extra


OWN = {"x": np.zeros(2), "n": np.array(1)}


def other_type(config):
    return telling(config, OWN, lambda extra, told: from_generation_2(extra, told, x=np.zeros(2, np.float32)))


def another(config):
    return telling(config, OWN, lambda extra, told: from_generation_2(extra, told, y=np.zeros(2)))


def fewer(config):
    return telling(config, OWN, lambda extra, told: {"x": extra["x"]} if told.generation == 2 else extra)


def no_array(config):
    return telling(config, OWN, lambda extra, told: from_generation_2(extra, told, x=[0.0, 0.0]))


def later_objects(config):
    return telling(config, OWN, lambda extra, told: from_generation_2(extra, told, x=np.array([None, 0.0])))


def longer(config):
    return telling(config, OWN, lambda extra, told: from_generation_2(extra, told, x=np.zeros((3, 4))))


@pytest.mark.parametrize("name", ["other_type", "another", "fewer", "longer"])
def test_other_names_types_and_shapes_are_stored(tmp_path, name):
    whole = begin(tmp_path / "whole", name)
    begin(tmp_path / "parts", name, generations=2)
    resumed = api.resume(tmp_path / "parts", ["budget.generations=6"]).run
    assert resumed.digest() == whole.digest()
    extra = resumed.at().nodes["extra"]
    kinds = {name: (str(array.dtype), array.shape) for name, array in extra.items()}
    n, x = {"n": ("int64", ())}, {"x": ("float64", (2,))}
    assert (
        kinds
        == {
            "other_type": {**n, "x": ("float32", (2,))},
            "another": {**n, **x, "y": ("float64", (2,))},
            "fewer": x,
            "longer": {**n, "x": ("float64", (3, 4))},
        }[name]
    )


@pytest.mark.parametrize(("name", "kind"), [("no_array", "a list"), ("later_objects", "an array of object")])
def test_what_is_no_array_of_numbers_ends_the_run(tmp_path, name, kind):
    with pytest.raises(StoreError, match="generation 2 cannot be stored") as error:
        begin(tmp_path / "run", name)
    assert f"its own value 'x' is {kind}; it must be a NumPy array of bools, numbers" in str(error.value)
    assert "Everything up to generation 1 is saved" in str(error.value)
    assert api.open_run(tmp_path / "run").generation == 1


def objects(config):
    return telling(config, {"x": np.array([None, 1.0]), "n": np.array(1)}, lambda extra, told: extra)


def lists(config):
    return telling(config, {"x": [0.0, 1.0]}, lambda extra, told: extra)


def words(config):
    return telling(config, {"x": np.array(["a", "b"])}, lambda extra, told: extra)


@pytest.mark.parametrize("name", ["objects", "lists", "words"])
def test_what_cannot_be_stored_is_refused_before_the_first_generation(tmp_path, name):
    with pytest.raises(
        StoreError, match=r"generation 0 cannot be stored: its own value 'x' is an? .*; it must be a NumPy"
    ):
        begin(tmp_path / "run", name)
