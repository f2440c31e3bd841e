"""Policies from anybody's optimiser, evaluated as a service: the same bits wherever, whatever happens, or an error."""

from __future__ import annotations

import importlib
import os
import pickle
import signal
import sys
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path
from threading import Event

import numpy as np
import pytest

import es_service
from es_service import api
from es_service.dispatch.inline_engine import ChildProcesses
from es_service.dispatch.ray_engine import Actors
from es_service.errors import ConfigError, EvaluationError, ServiceError
from es_service.loop.contents import no_statistics
from tests.helpers import stop, workers_in_this_process
from tests.system import cluster
from tests.system.cluster import Cluster
from tests.system.processes import children, wait_for, without_copies

pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # Ray leaves files and processes to the garbage collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
CONFIG = {
    "task": {"environment": "point_maze"},
    "policy": {"hidden": [8, 8]},
    "search": {"algorithm": "me_es"},
    "budget": {"generations": 1},
    "compute": {"engine": "inline", "workers": 1},
    "seed": 4,
}
D = 2 * 8 + 8 + 8 * 8 + 8 + 8 * 2 + 2
POLICIES = np.random.default_rng(0).normal(size=(100, D))
FIELDS = ("fitness", "returns", "descriptor", "steps", "valid", "success")
EXAMPLES = Path(__file__).parents[1] / "examples"


def bits(result) -> list[bytes]:
    return [getattr(result, name).tobytes() for name in FIELDS]


@pytest.fixture(scope="module")
def reference():
    """Bits of two generations of the policies, three episodes each, on one worker."""
    with es_service.evaluator(CONFIG) as evaluate:
        return [bits(evaluate(POLICIES, episodes=3, seed=7, generation=generation)) for generation in (0, 1)]


def all_steps(**where) -> list[bytes]:
    """Bits of results with their transitions."""
    with es_service.evaluator(CONFIG, transitions=True, **where) as evaluate:
        result = evaluate(POLICIES, episodes=3, seed=7)
    return bits(result) + [array.tobytes() for array in vars(result.transitions).values()]


def twice(evaluate) -> list[list[bytes]]:
    return [bits(evaluate(POLICIES, episodes=3, seed=7, generation=generation)) for generation in (0, 1)]


@pytest.mark.parametrize("where", [{"workers": 2}, {"workers": 3}, {"engine": "inline", "workers": "auto"}], ids=str)
def test_bits_are_the_same_with_any_workers_and_engine(reference, where):
    before = children()
    with es_service.evaluator(CONFIG, **where) as evaluate:
        assert twice(evaluate) == reference
    assert children() == before


def test_calls_from_several_threads_wait_for_each_other(reference):
    with es_service.evaluator(CONFIG, workers=2) as evaluate, ThreadPoolExecutor(4) as threads:
        made = threads.map(lambda _: twice(evaluate), range(4))
        assert all(bits_of_two == reference for bits_of_two in made)


def test_transitions_are_the_same_with_any_workers_and_change_no_other_bit(reference):
    found = all_steps(workers=1)
    assert found == all_steps(workers=3)
    assert found[: len(FIELDS)] == reference[0]


def test_bits_are_the_same_with_threads_and_from_a_run_config(reference):
    config = api.load_config(CONFIG, ["compute.inline_workers=threads"])
    with es_service.evaluator(config, workers=2) as evaluate:
        assert twice(evaluate) == reference
        assert evaluate.config.compute.workers == 2
    assert reference[0] != reference[1]


@pytest.mark.parametrize(
    ("engine", "transport", "pid_of"),
    [
        ("inline", ChildProcesses, lambda transport, worker: transport.process_ids()[worker]),
        ("ray", Actors, lambda transport, worker: transport.places()[worker].pid),
    ],
    ids=["inline", "ray"],
)
@pytest.mark.alone
@pytest.mark.slow
def test_workers_that_are_killed_and_stopped_in_mid_evaluation_change_no_bit(
    reference, monkeypatch, engine, transport, pid_of
):
    """One in each of the two evaluations. Without copies, only a deadline of ours notices a worker that is stopped."""
    strikes, send, before = {1: signal.SIGKILL, 2: signal.SIGSTOP}, transport.send, children()

    def send_and_strike(self, worker, item_id, attempt, work):
        strike = strikes.pop(item_id.phase, None)
        if strike == signal.SIGSTOP:
            stop(pid_of(self, worker))  # or it might have answered before it is struck
        send(self, worker, item_id, attempt, work)
        if strike == signal.SIGKILL:
            os.kill(pid_of(self, worker), strike)

    monkeypatch.setattr(transport, "send", send_and_strike)
    without_copies(monkeypatch)
    config = CONFIG | {"compute": {"chunk_timeout_s": 1.0, "compile_timeout_s": 20.0}}
    with es_service.evaluator(config, engine=engine, workers=2) as evaluate:
        assert twice(evaluate) == reference
        assert evaluate._engine.counts.lost_workers == 2
    assert not strikes
    assert children() == before


@pytest.mark.alone
@pytest.mark.slow
@pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))
def test_a_cluster_gives_the_same_bits_also_when_a_node_dies(tmp_path, reference):
    """The node dies between two calls of the first evaluation, in which its workers have run."""
    script = f"""
import pickle, sys, time
import es_service
from tests.system.test_evaluator import CONFIG, twice
with es_service.evaluator(CONFIG, workers="auto", address=sys.argv[1]) as evaluate:
    found = [twice(evaluate)]
    open({str(tmp_path / "begun")!r}, "w").close()
    lost = lambda: evaluate._engine.counts.lost_workers
    until = time.monotonic() + 120
    while not lost() and time.monotonic() < until:
        found.append(twice(evaluate))
    found.append(twice(evaluate))
    pickle.dump((found, lost()), open({str(tmp_path / "found")!r}, "wb"))
"""
    with Cluster(tmp_path) as hosts:
        hosts.start("one", 1)
        hosts.start("two", 1)
        driver = hosts.popen("head", sys.executable, "-c", script, hosts.address)
        wait_for((tmp_path / "begun").exists)
        hosts.end("two")
        printed, _ = driver.communicate(timeout=180)
        assert driver.returncode == 0, printed
    found, lost = pickle.loads((tmp_path / "found").read_bytes())
    assert all(one == reference for one in found)
    assert lost


@pytest.mark.usefixtures("one_process")
def test_results_have_the_shapes_and_meaning_that_are_documented():
    with es_service.evaluator(CONFIG) as evaluate:
        assert evaluate.parameters == D
        result = evaluate(POLICIES[:5], episodes=4)
        assert result.fitness.shape == result.returns.shape == result.steps.shape == result.valid.shape == (5, 4)
        assert result.descriptor.shape == (5, 4, 2)
        assert (result.valid.all(), result.steps.max()) == (True, 200)
        assert len(np.unique(result.returns)) == 20
        np.testing.assert_array_equal(result.fitness, result.returns)
        low, high = np.transpose(evaluate.task.descriptor_bounds)
        assert ((low <= result.descriptor) & (result.descriptor <= high)).all()
        # The seed of the config is the default; fewer policies and episodes are a part of more.
        assert bits(evaluate(POLICIES[:5], episodes=4, seed=4)) == bits(result)
        assert evaluate(POLICIES[:2], episodes=1).returns.tolist() == result.returns[:2, :1].tolist()
        # Observation statistics: 0 and 1 change nothing, others do, and each policy can have its own.
        mean, std = no_statistics(5, 2)
        assert bits(evaluate(POLICIES[:5], episodes=4, observation_mean=mean, observation_std=std)) == bits(result)
        other = evaluate(POLICIES[:5], episodes=4, observation_mean=[0.5, -0.5], observation_std=[0.1, 0.1])
        assert not (other.returns == result.returns).any()
        mean[3], std[3] = (0.5, -0.5), 0.1
        mixed = evaluate(POLICIES[:5], episodes=4, observation_mean=mean, observation_std=std)
        np.testing.assert_array_equal(
            mixed.returns, np.where(np.arange(5)[:, None] == 3, other.returns, result.returns)
        )


@pytest.mark.usefixtures("one_process")
def test_initial_policies_are_those_of_a_run(tmp_path):
    """Generation 1 updates centre 0 alone."""
    choice = {"search.algorithm": "nsr_es", "search.centres": 2, "search.centre_choice": "round_robin"}
    config = api.load_config(CONFIG, choice)
    parts = api.run(config, tmp_path / "run").run.at().nodes
    centres = [parts[f"centres/{centre}"]["centre_D"] for centre in (0, 1)]
    with es_service.evaluator(config) as evaluate:
        np.testing.assert_array_equal(evaluate.initial(1), centres[1])
        moved = np.abs(evaluate.initial() - centres[0]).max()
        assert 0.0 < moved <= 2.0 * config.search.step.learning_rate


@pytest.mark.parametrize(
    ("arguments", "field", "sentence"),
    [
        ({"parameters": POLICIES[0]}, "parameters", rf"has the shape \({D},\); must be .* shape \(policies, {D}\)"),
        ({"parameters": POLICIES[:, 1:]}, "parameters", rf"has the shape \(100, {D - 1}\)"),
        ({"parameters": POLICIES[:0]}, "parameters", r"has the shape \(0, .* at least one policy"),
        ({"parameters": None}, "parameters", "is no array of numbers"),
        ({"parameters": [["a"] * D]}, "parameters", "is no array of numbers"),
        ({"parameters": [[0.0] * D, [0.0]]}, "parameters", "is no array of numbers"),
        (
            {"parameters": np.where(np.arange(100)[:, None] % 50 == 7, np.nan, POLICIES)},
            "parameters",
            "in 2 of 100 policies, the first of which is policy 7",
        ),
        ({"parameters": 1e300 * np.ones((1, D))}, "parameters", "infinite float32 numbers in 1 of 1"),
        ({"episodes": 0}, "episodes", "is 0; must be an integer from 1"),
        ({"episodes": 1.5}, "episodes", r"is 1\.5"),
        ({"episodes": True}, "episodes", "is True"),
        ({"seed": -1}, "seed", "is -1; must be an integer from 0"),
        ({"generation": 2**63}, "generation", f"is {2**63}"),
        ({"observation_mean": [0.0, 0.0]}, "observation_std", "is None, but the other"),
        ({"observation_std": [1.0, 1.0]}, "observation_mean", "is None, but the other"),
        ({"observation_mean": [0.0], "observation_std": [1.0]}, "observation_mean", r"has the shape \(1,\)"),
        ({"observation_mean": [0.0, np.inf], "observation_std": [1.0, 1.0]}, "observation_mean", "NaN or infinite"),
        ({"observation_mean": [0.0, 0.0], "observation_std": [1.0, 0.0]}, "observation_std", "not positive"),
    ],
)
def test_a_wrong_argument_is_an_error_that_names_it_and_the_next_call_works(one_evaluator, arguments, field, sentence):
    with pytest.raises(ConfigError, match=f"{field} .*{sentence}") as error:
        one_evaluator(**{"parameters": POLICIES} | arguments)
    assert (error.value.field, bool(error.value.allowed)) == (field, True)
    assert one_evaluator(POLICIES[:1]).valid.all()


@pytest.fixture(scope="module")
def one_evaluator():
    with ExitStack() as stack:
        with workers_in_this_process():
            evaluate = stack.enter_context(es_service.evaluator(CONFIG))
        yield evaluate


@pytest.mark.usefixtures("one_process")
def test_a_config_needs_no_search_and_no_budget_and_is_checked_nevertheless(reference):
    bare = {name: section for name, section in CONFIG.items() if name not in ("search", "budget")}
    for config in (bare, bare | {"search": {"pairs": 32}, "budget": {"env_steps": 9}, "map": {"enabled": False}}):
        with es_service.evaluator(config) as evaluate:
            assert twice(evaluate) == reference
    with pytest.raises(ConfigError, match=r"search\.algorithm: missing[^$]*budget: this run has no limit"):
        api.load_config(bare)
    wrong = bare | {"search": {"algorithm": "sgd", "sigmas": 1}, "budget": {"generations": 0}}
    with (
        pytest.raises(ConfigError, match=r"search\.sigmas[^$]*budget\.generations[^$]*search\.algorithm: sgd"),
        es_service.evaluator(wrong),
    ):
        pass


def test_a_wrong_config_or_engine_is_an_error_before_anything_starts():
    before = children()
    for given in ({"engine": "other"}, {"workers": 0}, {"workers": "many"}, {"engine": "inline", "address": "h:1"}):
        with pytest.raises(ConfigError, match="compute"), es_service.evaluator(CONFIG, **given):
            pass
    assert children() == before


def test_a_closed_evaluator_and_one_that_was_interrupted_say_so(monkeypatch):
    with es_service.evaluator(CONFIG) as evaluate:
        evaluate(POLICIES[:1])
    with pytest.raises(EvaluationError, match=r"this evaluator is closed; make another one with es_service\.evaluator"):
        evaluate(POLICIES[:1])
    send, error, before = ChildProcesses.send, KeyboardInterrupt(), children()

    def interrupted(*arguments):
        send(*arguments)
        raise error

    monkeypatch.setattr(ChildProcesses, "send", interrupted)
    with es_service.evaluator(CONFIG) as evaluate:
        with pytest.raises(KeyboardInterrupt):
            evaluate(POLICIES[:1])
        assert children() == before
        with pytest.raises(ServiceError, match=r"closed by an error during a call \(KeyboardInterrupt"):
            evaluate(POLICIES[:1])


def test_after_an_error_of_user_code_the_next_call_starts_other_workers():
    config = {
        "task": {"environment": "python:tests.workers.host_tasks:Narrow"},
        "policy": {"hidden": []},
        "compute": {"engine": "inline", "workers": 1},
    }
    before = children()
    with es_service.evaluator(config) as evaluate:
        good = np.zeros((1, evaluate.parameters))
        first = evaluate(good).fitness.tobytes()
        for _ in range(2):
            with pytest.raises(EvaluationError, match="the action is too large"):
                evaluate(good + 1.0)
            assert children() == before
        assert evaluate(good).fitness.tobytes() == first
        with pytest.raises(EvaluationError, match="the action is too large"):
            evaluate(good + 1.0)
    assert children() == before
    with pytest.raises(EvaluationError, match="this evaluator is closed"):
        evaluate(good)


def test_closing_waits_for_the_call_of_another_thread(monkeypatch):
    send, begun, free = ChildProcesses.send, Event(), Event()

    def slow(*arguments):
        begun.set()
        assert free.wait(60)
        send(*arguments)

    monkeypatch.setattr(ChildProcesses, "send", slow)
    with ThreadPoolExecutor(3) as threads:
        with es_service.evaluator(CONFIG) as evaluate:
            running = threads.submit(evaluate, POLICIES[:1])
            assert begun.wait(60)
            closing = threads.submit(evaluate.close)
            assert wait([closing, running], 0.2).done == set()
            free.set()
        assert running.result().valid.all()
        assert closing.result() is None
    with pytest.raises(EvaluationError, match="this evaluator is closed"):
        evaluate(POLICIES[:1])


def test_workers_outlive_the_thread_that_started_them():
    """Linux kills a child that is bound to its parent at the end of the thread that created it."""
    made = es_service.evaluator(CONFIG)
    with ThreadPoolExecutor(1) as thread:
        evaluate = thread.submit(made.__enter__).result()
        thread.submit(evaluate, POLICIES[:1]).result()  # now the worker is bound
    try:
        (worker,) = evaluate._engine.transport.process_ids().values()
        assert evaluate(POLICIES[:1]).valid.all()
        assert evaluate._engine.counts.lost_workers == 0
        assert worker in evaluate._engine.transport.process_ids().values()
    finally:
        made.__exit__(None, None, None)


@pytest.mark.parametrize("name", ["pyribs_scheduler", "evosax_strategy"])
def test_an_example_has_no_more_in_it_than_any_user_has(name):
    """No module of this repository but the package."""
    text = (EXAMPLES / f"{name}.py").read_text()
    assert "from tests" not in text
    assert "from es_service import" in text


@pytest.mark.long
def test_pyribs_fills_its_archive_and_gets_behind_the_walls():
    """The deceptive optimum, under the upper wall, is -126.4."""
    archive = importlib.import_module("tests.examples.pyribs_scheduler").search(120)
    assert len(archive) > 200
    assert archive.stats.obj_max > -60.0


@pytest.mark.slow
def test_a_strategy_of_evosax_reaches_the_deceptive_optimum():
    example = importlib.import_module("tests.examples.evosax_strategy")
    with es_service.evaluator(example.CONFIG) as evaluate:
        before = evaluate(evaluate.initial()[None], episodes=32).fitness.mean()
    mean, fitness = example.search(40)
    assert mean.shape == (D,)
    assert before < -150.0
    assert fitness > -130.0


def test_without_a_with_block_it_says_how_it_is_meant():
    with pytest.raises(TypeError, match=r"with evaluator\(\.\.\.\) as evaluate"):
        es_service.evaluator("point_maze_es")(np.zeros((1, 4482), np.float32))
