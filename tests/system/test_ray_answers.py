"""What Ray's actors answer and raise: the same bits as inline, and errors. All tests share one Ray."""

from __future__ import annotations

import os
import pickle
import signal
from pathlib import Path

import pytest

import es_service
from es_service import Stop, api
from es_service.dispatch import ray_cluster as module
from es_service.dispatch.events import Limits
from es_service.dispatch.ray_cluster import connect, disconnect
from es_service.dispatch.ray_engine import Actors, ray_engine
from es_service.errors import EvaluationError
from es_service.protocol.messages import TrainingChunk, with_subject
from es_service.protocol.policies import Recipes
from es_service.protocol.process_environment import worker_environment
from es_service.protocol.sent import Received
from es_service.store.digest import digest_parts
from tests.helpers import centre, random_parameters, spec, workers_in_this_process
from tests.system import test_evaluator, test_map_elites
from tests.system.test_ray import CONFIG, run
from workers.actor import WorkerActor

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("one_ray"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # Ray leaves files and processes to the garbage collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def one_ray():
    """A Ray with eight CPUs and two GPUs, which it takes our word for: it only counts them. Engines find it started,
    and leave it so; their actors end with them."""
    import ray

    start = ray.init
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray, "init", lambda **options: start(**options | {"num_gpus": 2}))
        started = connect(None, gpus=True, cpus=8)
        patch.setattr(module, "connect", lambda *_, **__: started)
        patch.setattr(module, "disconnect", lambda *_, **__: None)
        yield
    disconnect(started, forget=True)


@pytest.mark.parametrize("rollout", ["simd", pytest.param("xla", marks=pytest.mark.long)])
def test_an_actor_with_two_cores_gives_the_same_bits_and_is_replaced_as_a_whole(tmp_path, monkeypatch, rollout):
    """It is killed in mid-generation. With simd its cores are threads, with xla child processes, which end with it."""
    straight = tmp_path / "straight"
    with workers_in_this_process():
        run(straight, engine="inline", workers=1, rollout=rollout)
    strikes, send, children = [5], Actors.send, []

    def send_and_strike(self, worker, key, attempt, work):
        send(self, worker, key, attempt, work)
        if strikes and key.kind == "TrainingChunk" and key.generation == strikes[0]:
            strikes.pop()
            pid = self.places()[worker].pid
            for of_thread in Path(f"/proc/{pid}/task").glob("*/children"):
                children.extend(of_thread.read_text().split())
            os.kill(pid, signal.SIGKILL)

    monkeypatch.setattr(Actors, "send", send_and_strike)
    cores = {"worker_resources": {"cpu": 2}, "workers": 2}
    outcome = run(tmp_path / "run", on_notice=lambda notice: None, rollout=rollout, **cores)
    assert digest_parts(tmp_path / "run") == digest_parts(straight)
    assert outcome.run.history["lost_workers"].sum() == 1
    assert set(outcome.run.history["workers"]) == {2}, "cores, not actors"
    assert len(children) >= (2 if rollout == "xla" else 0)
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Digest of the run that one worker in this process computes."""
    folder = tmp_path_factory.mktemp("reference") / "run"
    with workers_in_this_process():
        run(folder, engine="inline", workers=1)
    return digest_parts(folder)


def test_a_run_that_is_stopped_by_its_caller_goes_on_inline(tmp_path, reference):
    config = api.load_config(CONFIG, ["compute.workers=2"])
    outcome = api.run(
        config, tmp_path / "run", on_generation=lambda row: Stop("enough") if row["generation"] == 2 else 0
    )
    assert (outcome.reason, outcome.run.generation) == ("enough", 2)
    with workers_in_this_process():
        api.resume(tmp_path / "run", {"compute.engine": "inline", "compute.workers": 1})
    assert digest_parts(tmp_path / "run") == reference


def test_policies_have_the_same_bits_as_inline(tmp_path):
    with workers_in_this_process():
        api.run(api.load_config(test_map_elites.config_of()), tmp_path / "inline")
    config = api.load_config(test_map_elites.config_of(engine="ray", workers=2))
    other = api.run(config, tmp_path / "ray", on_notice=pytest.fail).run
    assert digest_parts(other.folder) == digest_parts(tmp_path / "inline")
    assert set(other.history["workers"]) == {2}


def test_an_evaluator_has_the_same_bits_as_inline():
    with workers_in_this_process(), es_service.evaluator(test_evaluator.CONFIG) as evaluate:
        expected = test_evaluator.twice(evaluate)
    with es_service.evaluator(test_evaluator.CONFIG, engine="ray", workers=2) as evaluate:
        assert test_evaluator.twice(evaluate) == expected
    with workers_in_this_process():
        expected = test_evaluator.all_steps()
    assert test_evaluator.all_steps(engine="ray", workers=2) == expected


def test_workers_that_raise_while_starting_stop_the_run_with_their_error():
    with (
        pytest.raises(EvaluationError, match=r"no_such_task(.|\n)*no worker started in 3 consecutive attempts"),
        ray_engine(spec(environment="no_such_task"), Limits(1, restart_backoff_s=0.0), actor=WorkerActor) as engine,
    ):
        engine.evaluate(with_subject(centre(random_parameters()), [TrainingChunk(1, 0)]))


def test_a_chunk_that_raises_everywhere_stops_the_run_with_its_error():
    wrong = random_parameters(size=3)  # parameters of another network
    with (
        pytest.raises(EvaluationError, match=r"TypeError(.|\n)*TrainingChunk 0 of generation 1 failed in 2 attempts"),
        ray_engine(spec(), Limits(1, max_attempts=2), actor=WorkerActor) as engine,
    ):
        engine.evaluate(with_subject(centre(wrong), [TrainingChunk(1, 0)]))


class Mirror(WorkerActor):
    """An actor that answers each chunk with the environment its worker would have, and Ray's name for its GPU."""

    def build(self, given: bytes | None = None) -> str:
        self._received = Received(2**20, Recipes.made)
        return "a mirror's"

    def compile(self, item: bytes, *arrays: bytes) -> float:
        return 0.0

    def run(self, item: bytes, *arrays: bytes) -> bytes:
        import ray

        ids = ray.get_runtime_context().get_accelerator_ids()["GPU"]
        answer = os.getpid(), ids, worker_environment(os.environ, self._gpus)
        return pickle.dumps(([answer for _ in self._unpacked(item, arrays)], None, 0.0))


def mirrored(workers: int, gpus: float = 0.0) -> list[tuple[int, list[str], dict[str, str]]]:
    with ray_engine(spec(), Limits(workers), actor=Mirror, gpus=gpus) as engine:
        answers = engine.evaluate(
            with_subject(centre(random_parameters()), [TrainingChunk(1, chunk) for chunk in range(16)])
        )
    return list({answer[0]: answer for answer in answers}.values())


def test_workers_without_a_gpu_see_none_and_use_the_cpu():
    for _, ids, environment in mirrored(2):
        assert ids == []
        assert (environment["CUDA_VISIBLE_DEVICES"], environment["JAX_PLATFORMS"]) == ("", "cpu")


def test_two_workers_share_one_gpu_and_its_memory():
    found = mirrored(4, gpus=0.5)
    assert found
    for _, ids, environment in found:
        assert ids == [environment["CUDA_VISIBLE_DEVICES"]]
        assert environment["JAX_PLATFORMS"] == "cuda"
        assert environment["XLA_CLIENT_MEM_FRACTION"] == "0.45"
