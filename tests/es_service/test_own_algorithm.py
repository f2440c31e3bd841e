"""A search of the user's own: found by its name, refused with a reason, and as safe as one of ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service import api
from es_service.errors import ConfigError, EvaluationError, StoreError
from es_service.loop.state import no_observations
from es_service.protocol.messages import EpisodesResult
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import Ask, CentreEvaluation
from es_service.search.algorithms.common import add_to_archive, first_state
from es_service.search.maps.behaviour_map import COLUMNS, insert
from es_service.search.novelty import NoveltyArchive

pytestmark = pytest.mark.usefixtures("workers_here")

EXAMPLE = "tests.examples.minimal_criterion:minimal_criterion"
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"algorithm": EXAMPLE, "pairs": 16, "sigma": 0.2, "step": {"learning_rate": 0.1}},
    "budget": {"generations": 6},
    "compute": {"engine": "inline", "workers": 1},
}


def test_the_example_weighs_novelty_of_the_better_half_alone():
    config = api.load_config(CONFIG)
    assert config.search.centres == 1
    search = ALGORITHMS[EXAMPLE](config)
    state = first_state([np.zeros(3, np.float32)], 2, search.fitness_weight)
    state = add_to_archive(state, CentreEvaluation(0, 0, True, 0.0, np.zeros(2)))
    # Two pairs: the first's + is far and good, its - farther and bad; the other's + near and good, its - invalid.
    fitness = np.array([[4.0, 1.0], [3.0, np.nan]], np.float32)
    descriptor = np.array([[(2.0, 0.0), (9.0, 0.0)], [(1.0, 0.0), (5.0, 0.0)]], np.float32)
    steps = np.ones((2, 2), np.int32)
    population = EpisodesResult(fitness, fitness, descriptor, steps, descriptor, no_observations(2))
    weights_P = search.weights(state, Ask(0, state.centres[0].centre_D, 0.02, 4, 0.0), population)
    lowest, second, best = 0.5 / 3 - 0.5, 2 / 3 - 0.5, 0.5  # two share the ranks 0 and 1
    np.testing.assert_allclose(weights_P, [best - lowest, second - lowest], rtol=1e-6)


def test_a_run_of_it_goes_on_where_it_was_with_the_same_bits(tmp_path):
    whole = api.run(api.load_config(CONFIG), tmp_path / "whole").run
    api.run(api.load_config(CONFIG, ["budget.generations=3"]), tmp_path / "parts")
    assert api.resume(tmp_path / "parts", ["budget.generations=6"]).run.digest() == whole.digest()
    assert api.run(api.load_config(CONFIG, ["search.algorithm=es"]), tmp_path / "es").run.digest() != whole.digest()
    assert whole.constants["search.algorithm"] == EXAMPLE


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "tests.examples.nothing:here",
            r"config: 1 problem\s+search\.algorithm: cannot import tests\.examples\.nothing ",
        ),
        ("tests.examples.minimal_criterion:min", "has no function 'min'"),
        (f"{__name__}:NOT_CALLABLE", "has no function 'NOT_CALLABLE'"),
        (f"{__name__}:raises", r"raises raised KeyError: 'sigma'"),
        (f"{__name__}:something_else", r"returned 3; it must return an es_service\.search\.algorithms\.base\.Alg"),
        (".:x", "cannot import"),
    ],
)
def test_what_is_no_algorithm_is_refused_with_the_reason(name, reason):
    with pytest.raises(ConfigError, match=reason):
        api.load_config(CONFIG, [f"search.algorithm={name}"])


def test_a_fork_that_its_search_refuses_leaves_no_folder(tmp_path):
    wanted = [f"search.algorithm={__name__}:cautious", "search.sigma=0.1", "budget.generations=2"]
    parent = api.run(api.load_config(CONFIG, wanted), tmp_path / "parent").run
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"cautious raised ValueError: sigma is above 0\.1"):
            api.fork(parent.folder, ["search.sigma=0.2"], out=tmp_path / "fork")
    assert not (tmp_path / "fork").exists()


NOT_CALLABLE = 3


def cautious(config):
    if config.search.sigma > 0.1:
        raise ValueError("sigma is above 0.1")
    return ALGORITHMS["es"](config)


def raises(config):
    return {}["sigma"]


def something_else(config):
    return 3


def forgetful(config):
    """Keeps the three newest entries."""
    return _telling(config, lambda state: replace(state, archive=_newest(state.archive, 3)))


def growing(config):
    """One centre more after each generation."""
    return _telling(config, lambda state: replace(state, centres=(*state.centres, state.centres[0])))


def emptying(config):
    """A map of the newest elite alone."""
    return _telling(config, lambda state: replace(state, map=_rows(state.map, slice(-1, None))))


def shrinking(config):
    """Three centres at first, and one less after each generation until there are two."""
    ours = ALGORITHMS["ns_es"](config)

    def tell(state, evaluations):
        told = ours.tell(state, evaluations)
        remaining = max(2, len(told.centres) - (evaluations[0].generation > 0))
        return replace(told, centres=told.centres[:remaining])

    return replace(ours, tell=tell)


def double(config):
    """A cell with two entries."""
    return _telling(config, lambda state: replace(state, map=_rows(state.map, [0, 0])))


def centreless(config):
    return _telling(config, lambda state: replace(state, centres=()))


def _with_first_centre(state, centre_D):
    return replace(state, centres=(replace(state.centres[0], centre_D=centre_D), *state.centres[1:]))


def broken(config):
    return _telling(config, lambda state: _with_first_centre(state, state.centres[0].centre_D * np.float32(np.nan)))


def doubled(config):
    return _telling(config, lambda state: _with_first_centre(state, state.centres[0].centre_D.astype(np.float64)))


def ragged(config):
    """An archive with fewer generations than descriptors."""
    return _telling(
        config,
        lambda state: replace(state, archive=replace(state.archive, generation_N=np.zeros(0, np.int64), room=None)),
    )


def without_map(config):
    return _telling(config, lambda state: replace(state, map=state.map if state.archive.size < 3 else None))


def foreign(config):
    """An elite of a cell far away, which no centre of the run has been to."""

    def tell(state, evaluations):
        (evaluation,) = evaluations
        elsewhere = np.array([-0.9, 0.9])
        return replace(state, map=insert(state.map, elsewhere, 1.0 * evaluation.generation, 10**6, 0, 0.0)[0])

    return replace(ALGORITHMS["es"](config), tell=tell)


def choosy(config):
    """Offers every third centre to the map, and does not tell its centre."""

    def tell(state, evaluations):
        (evaluation,) = evaluations
        if evaluation.generation % 3 != 1:
            return state
        fitness = 1.0 * evaluation.generation  # later ones are fitter, wherever they are
        return replace(state, map=insert(state.map, evaluation.descriptor_B, fitness, evaluation.generation, 0, 0.0)[0])

    return replace(ALGORITHMS["es"](config), tell=tell)


def _telling(config, change):
    ours = ALGORITHMS["es"](config)
    return replace(ours, tell=lambda state, evaluations: change(ours.tell(state, evaluations)))


def _newest(archive, count):
    rows = slice(-count, None)
    return NoveltyArchive(archive.descriptor_N_B[rows], archive.generation_N[rows], archive.centre_N[rows])


def _rows(map_, rows):
    names = ["cell_N", *COLUMNS]
    return replace(map_, **{name: getattr(map_, name)[rows] for name in names})


FAR = ["map.cells=[200, 200]", "search.step.learning_rate=1"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["forgetful", "growing", "shrinking", "emptying"])
def test_a_search_may_lose_what_it_had(tmp_path, name):
    settings = [f"search.algorithm={__name__}:{name}", *FAR, f"search.centres={3 if name == 'shrinking' else 1}"]
    whole = api.run(api.load_config(CONFIG, settings), tmp_path / "whole").run
    api.run(api.load_config(CONFIG, [*settings, "budget.generations=4"]), tmp_path / "parts")
    assert api.resume(tmp_path / "parts", ["budget.generations=6"]).run.digest() == whole.digest()
    assert api.fork(tmp_path / "parts", generation=5, out=tmp_path / "fork").run.digest() == whole.digest()
    sizes = len(whole.novelty), sum(path.endswith("/step") for path in whole.at().nodes), len(whole.map)
    expected = {"forgetful": (3, 1), "growing": (7, 8), "shrinking": (9, 2), "emptying": (7, 1)}[name]
    assert sizes[:2] == expected
    assert (sizes[2] == 1) == (name == "emptying")
    assert len(whole.elites()[1]) == sizes[2]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "foreign",
            r"generation 0: `tell` returned a state that is none: the new elite of cell \d+ is centre 0 of generation "
            "1000000, which was not evaluated now",
        ),
        ("double", r"generation 0 cannot be stored: the map's cells must be different ones from 0 to 39999; "),
        ("broken", r"generation 0 cannot be stored: centre 0 has \d+ values that are not finite"),
        ("doubled", r"generation 0 cannot be stored: centre 0 is float64 \(\d+,\); it must be float32 \(\d+,\)"),
        ("centreless", r"generation 0 cannot be stored: the search has no centre"),
        ("without_map", r"generation 2 cannot be stored: the behaviour map was added or removed, .* 1 is saved"),
    ],
)
def test_what_is_no_state_ends_the_run(tmp_path, name, reason):
    settings = [f"search.algorithm={__name__}:{name}", *FAR]
    with pytest.raises((StoreError, EvaluationError), match=reason):
        api.run(api.load_config(CONFIG, settings), tmp_path / "run")


def test_an_archive_whose_arrays_do_not_fit_ends_the_run(tmp_path):
    with pytest.raises(EvaluationError, match="generation 0: `tell` returned a state that is none: the arrays"):
        api.run(api.load_config(CONFIG, [f"search.algorithm={__name__}:ragged"]), tmp_path / "run")


def test_elites_are_those_that_the_map_says_entered(tmp_path):
    settings = [f"search.algorithm={__name__}:choosy", "map.cells=[2, 2]"]
    run = api.run(api.load_config(CONFIG, settings), tmp_path / "run").run
    assert run.history["cell"].notna().tolist() == [False, True, False, False, True, False, False]
    map_, elites = run.elites()
    assert set(map_.generation_N.tolist()) <= {1, 4}
    norms = run.history["parameter_norm"]
    for cell, generation in zip(map_.cell_N.tolist(), map_.generation_N.tolist(), strict=True):
        norm = np.linalg.norm(elites[cell].parameters_D.astype(np.float64))
        assert norm == pytest.approx(norms[generation], rel=1e-6)


# The other examples


def started(folder, name, **settings):
    """A run of an example in which every episode starts in one corner."""
    search = {"pairs": 32, "sigma": 0.1, "step": {"learning_rate": 0.05}, "evaluation_episodes": 4, "algorithm": name}
    config = CONFIG | {
        "task": {"environment": "point_maze", "episode_steps": 60, "options": {"start": "corner"}},
        "policy": {"hidden": [8], "init": "small_columns"},
        "search": search,
    }
    return api.run(api.load_config(config, settings), folder).run


ADAPTIVE = "tests.examples.adaptive_sigma:adaptive_sigma"


def test_sigma_rises_with_success_and_falls_without(tmp_path):
    """And is stored: a run that was stopped has the same one, and the same bits."""
    settings = {"search.step.learning_rate": 0.4, "budget.generations": 20}
    whole = started(tmp_path / "whole", ADAPTIVE, **settings)
    started(tmp_path / "parts", ADAPTIVE, **settings | {"budget.generations": 9})
    assert api.resume(tmp_path / "parts", ["budget.generations=20"]).run.digest() == whole.digest()
    fitness = whole.history["centre_fitness_mean"].to_numpy()
    is_success = fitness[1:] > np.maximum.accumulate(fitness)[:-1]
    assert 2 <= is_success.sum() <= 18
    sigma = 0.1
    for success in is_success:
        sigma = min(1.0, max(0.01, sigma * (1.5 if success else 1.5**-0.25)))
    extra = whole.at().nodes["extra"]
    assert extra["sigma"] == pytest.approx(sigma, rel=1e-12)
    assert extra["sigma"] != pytest.approx(0.1, rel=0.01)
    assert extra["record"] == fitness.max()


def test_an_adapted_sigma_is_the_one_that_is_asked_for():
    search = ALGORITHMS[ADAPTIVE](api.load_config(CONFIG, {"search.algorithm": ADAPTIVE}))
    state = first_state([np.zeros(3, np.float32)], 2, 1.0, extra=search.extra)
    sigmas = []
    for generation, (fitness, valid) in enumerate([(1, True), (2, True), (2, True), (9, False), (-9, True), (3, True)]):
        told = CentreEvaluation(generation, 0, valid, fitness, np.zeros(2))
        state = search.tell(state, (told,))
        (asked,) = search.ask(state, generation + 1)
        sigmas.append(asked.sigma)
        assert (asked.centre, asked.pairs) == (0, 16)
    exponents = np.array([0, 1, 0.75, 0.5, 0.25, 1.25])
    np.testing.assert_allclose(sigmas, 0.2 * 1.5**exponents, rtol=1e-12)


REPELLING = "tests.examples.repelling_centres:repelling_centres"


def test_repelling_centres_end_apart_where_others_meet(tmp_path):
    def distances(name, **options):
        run = started(tmp_path / name, REPELLING, **{"search.centres": 2, "budget.generations": 30, **options})
        assert run.evaluations["centre"].tolist() == [0, 1] * 31
        assert run.evaluations["generation"].tolist() == np.repeat(np.arange(31), 2).tolist()
        place_C_G_2 = [run.evaluations.query(f"centre == {centre}")[["x", "y"]].to_numpy() for centre in (0, 1)]
        return np.linalg.norm(np.subtract(*place_C_G_2), axis=-1)

    apart = distances("apart")
    assert apart[0] < 0.01
    assert apart[10:].min() > 0.5
    assert distances("together", **{"search.reach": 0})[10:].max() < 0.1


def test_repelling_centres_go_on_where_they_were_with_the_same_bits(tmp_path):
    settings = {"search.centres": 3, "budget.generations": 6}
    whole = started(tmp_path / "whole", REPELLING, **settings)
    started(tmp_path / "parts", REPELLING, **settings | {"budget.generations": 3})
    assert api.resume(tmp_path / "parts", ["budget.generations=6"]).run.digest() == whole.digest()
    alone = started(tmp_path / "alone", REPELLING, **settings | {"search.centres": 1})
    plain = started(tmp_path / "es", "es", **settings | {"search.centres": 1})
    assert alone.digest() == plain.digest(), "one centre has nobody to repel"
