"""Which sessions store several generations in a transaction, and what those who look at the run see of it."""

import pytest

from es_service import Observer, Stop, api, ask_tell, open_run
from es_service.errors import ConfigError
from es_service.loop import driver
from es_service.runs.certified import all_certifications
from es_service.store.reader import read_generation

GENERATIONS = 5
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 5},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 4, "evaluation_episodes": 1},
    "budget": {"generations": GENERATIONS},
    "compute": {"engine": "inline", "workers": 1},
}
pytestmark = pytest.mark.usefixtures("workers_here")


class Still:
    """A clock by which no interval ever passes."""

    @staticmethod
    def perf_counter():
        return 0.0


@pytest.fixture(autouse=True)
def _clock(monkeypatch):
    monkeypatch.setattr(driver, "time", Still)


def transactions(folder, config=CONFIG, **calls):
    """The newest generation after each commit of a run."""
    reached = []

    def note(at):
        if at == "after_commit" and [read_generation(folder)] != reached[-1:]:  # else it was a certification
            reached.append(read_generation(folder))

    api.run(config, folder, hook=note, **calls)
    return reached


ONE_BY_ONE = list(range(GENERATIONS + 1))


def test_generations_are_stored_together_unless_somebody_may_stop_the_run_or_the_interval_is_0(tmp_path):
    shown = []

    def observe(row):
        shown.append((row["generation"], open_run(tmp_path / "b").generation))

    assert transactions(tmp_path / "a") == [GENERATIONS]
    assert transactions(tmp_path / "b", on_generation=Observer(observe)) == [GENERATIONS]
    assert shown == [(generation, GENERATIONS) for generation in ONE_BY_ONE]
    assert transactions(tmp_path / "c", on_generation=lambda row: None) == ONE_BY_ONE
    assert transactions(tmp_path / "d", CONFIG | {"store": {"commit_interval_s": 0}}) == ONE_BY_ONE
    assert len({open_run(tmp_path / name).digest() for name in "abcd"}) == 1


def test_what_may_not_repeat_is_stored_one_by_one(tmp_path):
    of_function = {key: value for key, value in CONFIG.items() if key != "policy"}
    of_function["task"] = {"environment": "function:tests.workers.functions:hill"}
    assert transactions(tmp_path / "function", of_function) == ONE_BY_ONE
    asked = {"task": {"environment": "caller", "options": {"parameters": 3}}, "map": {"enabled": False}}
    seen = []
    with ask_tell({key: CONFIG[key] for key in ("search", "budget")} | asked, tmp_path / "asked") as search:
        while (ask := search.ask()) is not None:
            seen.append((ask.generation, read_generation(tmp_path / "asked")))
            search.tell(ask, ask.parameters.sum(axis=1))
    assert {(generation, reached) for generation, reached in seen if generation} == {
        (generation, generation - 1) for generation in ONE_BY_ONE[1:]
    }


def test_a_stop_ends_the_run_with_the_generation_of_its_row(tmp_path):
    def stop(row):
        return Stop("enough") if row["generation"] == 2 else None

    assert transactions(tmp_path / "a", on_generation=stop) == [0, 1, 2]
    with pytest.raises(ConfigError, match="the function of an Observer has returned a Stop"):
        transactions(tmp_path / "b", on_generation=Observer(stop))


def test_the_same_is_certified_at_the_same_generation_with_any_interval(tmp_path):
    """A session that ends for a decision has no generation beyond it."""
    config = CONFIG | {"budget": {"generations": 12}}
    target = float(api.run(config, tmp_path / "plain").run.history["best_fitness"].median())
    budget, found = config["budget"] | {"target_certified": target}, []
    for name, interval_s in (("alone", 0.0), ("together", 1.0)):
        settings = config | {"budget": budget, "store": {"commit_interval_s": interval_s}}
        reached = transactions(tmp_path / name, settings, on_notice=[].append)
        certified = all_certifications(tmp_path / name)
        tries = [(one.generation, one.number, one.episodes.return_E.tolist()) for one in certified]
        found.append((tries, open_run(tmp_path / name).digest()))
    assert len(reached) < 13
    assert found[0] == found[1]
    assert found[0][0]
