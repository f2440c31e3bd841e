"""Optimisers of evosax as methods: the populations are those of a plain loop over evosax, bit for bit, and a run of one
keeps what a run of any method promises."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from es_service import api
from es_service.config.text import parse_value
from es_service.errors import ConfigError, EvaluationError, StoreError
from es_service.report.write import write_report
from es_service.runs.certification import certify_run
from es_service.runs.checked_config import changed_config
from es_service.runs.export import export
from es_service.runs.lineage import polish_config
from es_service.runs.sweep_plan import plan
from es_service.runs.verification import verify
from es_service.search.algorithms import ALGORITHMS, evosax
from es_service.search.algorithms.base import CentreEvaluation, PolicyAsk
from es_service.search.algorithms.common import first_state
from es_service.search.arrays import read_only
from tests.helpers import workers_in_this_process

HILL, NOISY, FRAGILE = (f"function:tests.workers.functions:{name}" for name in ("hill", "Noisy", "fragile"))
CASES = {
    "CMA_ES": {},
    "Open_ES": {"optimizer": "adam", "learning_rate": 0.1, "use_antithetic_sampling": False},
    "SNES": {},
    "DifferentialEvolution": {"crossover_rate": 0.5},
}
"""Name in evosax -> options."""
OF_ADAM = {"population_size": 64, "options": {"optimizer": "adam", "learning_rate": 0.05}}
OF_SGD = {"population_size": 24, "options": {"optimizer": "sgd", "learning_rate": 1.0}}


def config_of(name="CMA_ES", task=HILL, generations=5, seed=0, workers=1, **search):
    return {
        "task": {"environment": task},
        "search": {"algorithm": f"evosax:{name}", "population_size": 12, **search},
        "budget": {"generations": generations},
        "compute": {"engine": "inline", "workers": workers},
        "seed": seed,
    }


def cost_of(population_N_D):
    return np.square(np.asarray(population_N_D, np.float64) - 0.3).sum(axis=1)


def reference(name, options, seed, start_D, members, sigma, generations, invalid):
    """Populations and centres of a loop over evosax alone, which minimises.

    Args:
        invalid: (generation, member) that counts as the worst of the others.
    """
    import jax
    import optax
    from evosax import algorithms

    kind, options, has_population = getattr(algorithms, name), dict(options), name == "DifferentialEvolution"
    made = {}
    if "optimizer" in options:
        made = {"optimizer": optax.adam(options.pop("learning_rate")), "std_schedule": lambda generation: sigma}
        made["use_antithetic_sampling"] = options.pop("use_antithetic_sampling")
        options.pop("optimizer")
    algorithm = kind(members, start_D, **made)
    params = algorithm.default_params.replace(**options)
    if hasattr(params, "std_init"):
        params = params.replace(std_init=sigma)
    key, populations, centres, state = jax.random.key(seed), [], [], None
    if not has_population:
        state = algorithm.init(jax.random.fold_in(key, 0), start_D, params)
    for generation in range(1, generations + 1):
        ask_key, tell_key = jax.random.split(jax.random.fold_in(key, generation))
        if state is None:
            population = start_D + np.float32(sigma) * jax.random.normal(ask_key, (members, start_D.size))
        else:
            population, state = algorithm.ask(ask_key, state, params)
        cost = cost_of(population).astype(np.float32)
        if generation == invalid[0]:
            cost[invalid[1]] = np.delete(cost, invalid[1]).max()
        if state is None:
            state = algorithm.init(jax.random.fold_in(key, 0), population, cost, params)
        else:
            state, _ = algorithm.tell(tell_key, population, cost, state, params)
        populations.append(np.asarray(population))
        centres.append(np.asarray(state.best_solution if has_population else state.mean))
    return populations, centres


def evaluations(generation, fitness_N, invalid=()):
    return tuple(
        CentreEvaluation(generation, 1 + n, n not in invalid, np.nan if n in invalid else float(fitness), np.zeros(2))
        for n, fitness in enumerate(fitness_N)
    )


def driven(config, start_D, generations, invalid=(0, 0)):
    """Populations and states of the same search by its pure functions."""
    search = ALGORITHMS[config.search.algorithm](config)
    state = first_state([start_D], 2, 1.0, extra=search.extra)
    state = search.tell(state, evaluations(0, [0.0]))
    populations, states = [], [state]
    for generation in range(1, generations + 1):
        (asked,) = search.ask(state, generation)
        assert isinstance(asked, PolicyAsk)
        populations.append(asked.parameters_N_D)
        wrong = {invalid[1]} if invalid[0] == generation else set()
        state = search.tell(state, evaluations(generation, -cost_of(asked.parameters_N_D), wrong))
        states.append(state)
    return search, populations, states


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_populations_are_those_of_a_loop_over_evosax(name):
    options, start_D = CASES[name], np.array([0.5, -0.25, 1.0], np.float32)
    config = api.load_config(config_of(name, seed=7, sigma=0.25, options=options))
    _, populations, states = driven(config, start_D, 4, invalid=(2, 5))
    expected, centres = reference(name, options, 7, start_D, 12, 0.25, 4, (2, 5))
    for ours, theirs in zip(populations, expected, strict=True):
        assert (ours.dtype, ours.tobytes()) == (np.float32, theirs.tobytes())
    for state, theirs_D in zip(states[1:], centres, strict=True):
        assert state.centres[0].centre_D.tobytes() == theirs_D.tobytes()


@pytest.mark.slow
def test_a_killed_process_and_settings_of_jax_change_no_bit(monkeypatch):
    start_D = np.array([0.5, -0.25, 1.0], np.float32)
    config = api.load_config(config_of(seed=2**40 + 3))
    search, populations, states = driven(config, start_D, 3)
    os.kill(evosax._optimisers(os.getpid())._child.pid, signal.SIGKILL)
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    monkeypatch.setenv("PJRT_NPROC", "2")
    for generation, (population_N_D, state) in enumerate(zip(populations, states[:-1], strict=True), 1):
        (again,) = search.ask(state, generation)
        assert again.parameters_N_D.tobytes() == population_N_D.tobytes()
    other = api.load_config(config_of(seed=3))
    assert driven(other, start_D, 1)[1][0].tobytes() != populations[0].tobytes()


@pytest.mark.slow
def test_a_generation_without_a_valid_member_teaches_nothing():
    config = api.load_config(config_of())
    search, _, states = driven(config, np.zeros(3, np.float32), 2)
    after = search.tell(states[-1], evaluations(3, [0.0] * 12, range(12)))
    assert after is states[-1]
    (asked,), (next_asked,) = search.ask(after, 3), search.ask(after, 4)
    assert not np.array_equal(asked.parameters_N_D, next_asked.parameters_N_D)


@pytest.mark.slow
def test_an_invalid_member_is_not_the_best_one_if_all_others_are_equal():
    """As where no reward is found yet: the first of equal members would be the best one, and so the centre."""
    config = api.load_config(config_of("DifferentialEvolution"))
    search, populations, states = driven(config, np.zeros(3, np.float32), 1)
    after = search.tell(states[0], evaluations(1, [0.0] * 12, {0, 3}))
    assert after.centres[0].centre_D.tobytes() == populations[0][1].tobytes()
    assert after.extra[evosax.STATE]["best_fitness"] == 0.0


@pytest.mark.slow
def test_a_state_of_another_form_is_refused_with_what_differs():
    config = api.load_config(config_of())
    search, _, states = driven(config, np.zeros(3, np.float32), 1)
    stored = dict(states[-1].extra)
    assert stored[evosax.VERSION].tolist()[0] == 0
    assert states[-1].extra[evosax.STATE]["C"].shape == (3, 3)
    renamed = {("covariance" if name == "C" else name): array for name, array in stored[evosax.STATE].items()}
    for changed, reason in (
        (
            renamed,
            r"its C is missing, and must be float32 \(3, 3\) for evosax 0\.\d+\.\d+, 12 members and 3 parameters",
        ),
        ({**stored[evosax.STATE], "mean": np.zeros(4, np.float32)}, r"its mean is float32 \(4,\), and must be"),
        ({**stored[evosax.STATE], "std": np.zeros(())}, r"its std is float64 \(\), and must be float32 \(\)"),
    ):
        state = replace(
            states[-1], extra=read_only({**stored, evosax.STATE: changed, evosax.VERSION: np.array([0, 2])})
        )
        with pytest.raises(EvaluationError, match=rf"generation 2: the stored state.*{reason}.*evosax 0\.2 has made"):
            search.ask(state, 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "search"),
    [
        ("CMA_ES", {}),
        pytest.param("Open_ES", OF_ADAM, marks=pytest.mark.long),
        pytest.param("SNES", OF_SGD, marks=pytest.mark.long),
        ("PSO", {"population_size": 32, "sigma": 0.5}),
    ],
)
def test_they_climb_the_hill(tmp_path, name, search):
    with workers_in_this_process():
        run = api.run(config_of(name, generations=60, **{"sigma": 0.2, **search}), tmp_path / "run").run
    assert run.history.best_fitness.iloc[-1] > 9.95
    np.testing.assert_allclose(list(run.parameters("best").values()), [3.0, 0.2, 0.0], atol=0.25)
    assert run.history.best_fitness.iloc[0] < -39.0
    if name == "CMA_ES":
        sigma = run.history.metric_sigma.to_numpy()
        assert np.isnan(sigma[0])
        assert sigma[-1] == pytest.approx(float(run.at().nodes["extra/evosax"]["std"]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CMA_ES", "DifferentialEvolution"])
def test_a_run_goes_on_where_it_was_with_the_same_bits(tmp_path, name):
    config = config_of(name, NOISY, generations=7, evaluation_episodes=2)
    with workers_in_this_process():
        whole = api.run(config, tmp_path / "whole").run
        api.run(config | {"budget": {"generations": 3}}, tmp_path / "parts")
        assert api.resume(tmp_path / "parts", ["budget.generations=7"]).run.digest() == whole.digest()
        forked = api.fork(tmp_path / "parts", ["budget.generations=7"], generation=6, out=tmp_path / "fork").run
        assert forked.digest() == whole.digest()
        fewer = {"overrides": ["search.population_size=10"], "generation": 6, "out": tmp_path / "fewer"}
        if name == "CMA_ES":
            assert api.fork(tmp_path / "parts", **fewer).run.history.env_steps.diff().iloc[-1] == 20
        else:
            with pytest.raises(EvaluationError, match=r"its fitness is float32 \(12,\), and must be float32 \(10,\)"):
                api.fork(tmp_path / "parts", **fewer)
    assert whole.history.env_steps.iloc[-1] == 2 + 7 * 12 * 2


def generation_of(folder):
    """The newest generation of a run that another process may just begin; 0 for none."""
    try:
        return api.open_run(folder).generation or 0
    except StoreError:
        return 0


@pytest.mark.slow
def test_one_and_two_workers_and_a_killed_driver_give_the_same_bits(tmp_path):
    config = config_of(task=NOISY, generations=40, population_size=48)
    whole = api.run(config, tmp_path / "one").run
    two = api.load_config(config, ["compute.workers=2"])
    assert api.run(two, tmp_path / "two").run.digest() == whole.digest()
    (tmp_path / "run.yaml").write_text(api.load_config(config, ["budget.generations=100000"]).resolved_yaml())
    program = [sys.executable, "-m", "es_service", "run", tmp_path / "run.yaml", "--out", tmp_path / "killed"]
    with subprocess.Popen(list(map(str, program)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
            if generation_of(tmp_path / "killed") >= 2:
                break
        process.send_signal(signal.SIGKILL)
    longest = max(40, generation_of(tmp_path / "killed") + 3)
    resumed = api.resume(tmp_path / "killed", [f"budget.generations={longest}"]).run
    if longest > 40:
        whole = api.resume(tmp_path / "one", [f"budget.generations={longest}"]).run
    assert resumed.digest() == whole.digest()


@pytest.mark.slow
def test_what_is_done_with_runs_is_done_with_these(tmp_path):
    """Targets, policies, certified values, verification, a report, an export and polish."""
    policy = {
        "task": {"environment": "point_maze", "episode_steps": 20},
        "policy": {"hidden": [4]},
        "search": {"algorithm": "evosax:Sep_CMA_ES", "population_size": 10, "sigma": 0.5},
    }
    with workers_in_this_process():
        target = ["budget.target_fitness=9", "budget.generations=400"]
        hill = api.run(api.load_config(config_of(sigma=0.3), target), tmp_path / "hill").run
        assert 9.0 <= hill.history.best_fitness.iloc[-1] < 10.0
        assert hill.history.best_fitness.iloc[-2] < 9.0
        run = api.run(config_of() | policy, tmp_path / "run").run
        observation_O = np.array([0.5, -0.5], np.float32)
        assert np.isfinite(run.policy("best")(observation_O)).all()
        assert len(run.evaluations) == 1 + 5 * 10
        assert len(certify_run(run.folder, episodes=32)) == 1
        recomputed = list(verify(run, 5))
        assert recomputed
        assert not any(found.differences for found in recomputed)
        page, *_ = write_report(run.folder, certified=False)
        assert "evosax:Sep_CMA_ES" in page.read_text()
        assert export(run, "csv", tmp_path / "csv")
        overrides = ["search.screened=1", "search.candidates=1", "search.pairs=8", "budget.generations=1"]
        polished = api.run(polish_config(run.folder, overrides), tmp_path / "polished").run
    best_D = run.policy("best").parameters_D
    assert polished.history.parameter_norm[0] == pytest.approx(np.linalg.norm(best_D.astype(np.float64)), rel=1e-6)


@pytest.mark.slow
def test_options_are_swept_and_left_out_for_optimisers_without_them(tmp_path):
    grid = {"search.algorithm": ["evosax:CMA_ES", "evosax:SNES"], "search.options.c_mean": [0.8, 1.0]}
    runs = plan(config_of(), tmp_path, grid, [0, 1], ["search.population_size=12"])
    assert len(runs) == 2 * (2 + 1)


def problems(source, *overrides):
    with pytest.raises(ConfigError) as caught:
        api.load_config(source, overrides)
    return [problem.sentence for problem in caught.value.problems] or [str(caught.value)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "search.algorithm=evosax:OpenES",
            "search.algorithm: evosax has no algorithm OpenES; did you mean evosax:Open_ES?",
        ),
        ("search.algorithm=evosax:zz", "search.algorithm: evosax has no algorithm zz; it has ARS, "),
        ("search.algorithm=evosax:RandomSearch", "evosax:RandomSearch needs sampling_fn, which no config can give"),
        (
            "search.options.c_men=1",
            "unknown option; evosax:CMA_ES has c_1, c_c, c_mean, c_mu, c_std, chi_n, d_std, mu_eff",
        ),
        ("search.options.c_men=1", "did you mean c_mean?"),
        ("search.options.c_mean=fast", "search.options.c_mean: fast is not allowed; must be a number"),
        (
            "search.options=3",
            "search.options: this is a section; set its keys one by one, such as search.options.c_1=...",
        ),
        ("search.sigma=0", "search.sigma: 0 is not allowed; must be a number above 0"),
        ("search.pairs=4", "search.pairs: 4 has no effect with evosax:CMA_ES; leave it out (a key of "),
        ("map.enabled=true", "map.enabled: true has no effect with evosax:CMA_ES; leave it out"),
        ("map.cells=[5, 5]", "map.cells: [5, 5] has no effect with evosax:CMA_ES; leave it out"),
        ("novelty.neighbours=3", "novelty.neighbours: 3 has no effect with evosax:CMA_ES; leave it out"),
        ("policy.observation_normalization=true", "which has no training episodes to gather statistics from"),
        ("search.centres=2", "search.centres: 2 is not allowed for evosax:CMA_ES, which has one centre; must be 1"),
    ],
)
def test_what_it_cannot_have_is_refused_with_what_is_allowed(given, message):
    source = config_of() if not given.startswith("policy") else config_of(task="point_maze")
    (found,) = problems(source, given)
    assert message in found


@pytest.mark.slow
def test_settings_that_evosax_refuses_are_refused_before_a_run():
    (found,) = problems(config_of("Open_ES", population_size=7))
    assert "evosax:Open_ES refuses 7 members, 3 parameters and these options: Population size must be even" in found
    (found,) = problems(config_of("ESMC", population_size=13))
    assert "evosax:ESMC asks for 12 members instead of 13" in found
    (found,) = problems(config_of("Open_ES", options={"learning_rate": 0.1}))
    assert "optimizer and learning_rate belong together" in found
    found, _ = problems(config_of("Open_ES", options={"optimizer": "adan", "learning_rate": 0.1}))
    assert "optimizer: adan is not allowed; must be adam, adamw, clipup, rmsprop or sgd or null" in found
    (found,) = problems(config_of("GradientlessDescent", sigma=0.3))
    assert found.startswith("search.sigma: 0.3 has no effect with evosax:GradientlessDescent; leave it out")


@pytest.mark.slow
def test_a_config_says_the_values_of_all_options_and_is_read_again():
    config = api.load_config(config_of(options={"c_mean": 0.9, "c_1": 0.05}))
    options = parse_value(config.resolved_yaml())["search"]["options"]
    assert (options["c_mean"], options["c_1"], options["c_mu"], options["std_min"]) == (0.9, 0.05, None, 0.0)
    again = parse_value(config.resolved_yaml())
    assert api.load_config(again) == changed_config(again) == config
    assert api.load_config(config_of(), ["search.options.c_mean=0.9", "search.options.c_1=0.05"]) == config


def test_without_evosax_its_extra_is_named(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "evosax" else found(name))
    evosax.named.cache_clear()
    with pytest.raises(ConfigError, match=r"evosax:CMA_ES needs the extra `evosax`, which is not installed") as error:
        api.load_config(config_of())
    assert error.value.way_out.extra == "evosax"
    evosax.named.cache_clear()


@pytest.mark.long
def test_all_that_can_be_made_of_a_config_run():
    """Three generations of each optimiser: finite populations, and states of the form that is expected.

    There are 22 parameters: a loop over evosax 0.3.2 alone has NaN in LM_MA_ES with five or fewer.
    """
    policy = {"task": {"environment": "point_maze"}, "policy": {"hidden": [4]}}
    names = evosax._answer("names")
    refused = []
    for name in names:
        try:
            config = api.load_config(config_of(name) | policy)
        except ConfigError:
            refused.append(name)
            continue
        _, populations, states = driven(config, np.zeros(22, np.float32), 3)
        assert all(np.isfinite(population_N_D).all() for population_N_D in populations), name
        assert np.isfinite(states[-1].centres[0].centre_D).all(), name
    assert sorted(refused) == ["RandomSearch", "SV_CMA_ES", "SV_Open_ES"]
