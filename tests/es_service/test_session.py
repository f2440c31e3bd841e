"""What a session makes of its config before anything starts."""

from __future__ import annotations

import re

import pytest

from es_service import api
from es_service.api import load_config
from es_service.cli.common import error_message
from es_service.config.sections import ComputeConfig, TaskConfig
from es_service.config.workload import chunks_at_once, chunks_of_phases, parallel_sentence
from es_service.dispatch.events import (
    Compiled,
    Result,
    StopWorker,
    Submit,
    Tick,
    WorkerLost,
    WorkerUp,
    WorkItem,
    key_of,
)
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import initial_state
from es_service.errors import ConfigError, StoreError
from es_service.runs import worker_count as counting
from es_service.runs.engine import dispatch_limits
from es_service.runs.session import initial_centres
from es_service.runs.worker_count import on_this_machine, worker_count
from tests.system.session import SMALL

CONFIG = {
    "task": {"environment": "point_maze"},
    "search": {"algorithm": "es"},
    "budget": {"generations": 1},
    "compute": {"workers": 1},
}
DEADLINES = {
    "compute.chunk_timeout_s": 5,
    "compute.compile_timeout_s": 8,
    "compute.first_chunk_timeout_s": 7,
    "compute.place_timeout_s": 15,
    "compute.no_worker_timeout_s": 20,
}
"""Too short for a run on a busy machine."""


def messages_after(*events) -> list[str]:
    """Why workers are stopped, and the run, over all events; (seconds, event)."""
    state, said = initial_state(dispatch_limits(load_config(CONFIG, DEADLINES))), []
    for now, event in events:
        said += [command.reason for command in handle(state, event, now) if isinstance(command, StopWorker)]
    return [*said, state.failed or ""]


def test_messages_of_deadlines_name_the_keys_that_set_them():
    work = Submit(tuple(WorkItem(item_id, "train") for item_id in "abcd"))
    late = messages_after((0.0, work), (10.0, Tick()))
    assert late[0] == "did not come up within 10 s (half of compute.no_worker_timeout_s)"
    gone = messages_after((0.0, work), (1.0, WorkerUp(0)), (2.0, WorkerLost(0, "")), (12.0, Tick()), (22.0, Tick()))
    assert "no worker was up for 20 s (compute.no_worker_timeout_s) while" in gone[-1]
    assert "no worker got a place for 15 s (compute.place_timeout_s)" in messages_after((0.0, work), (15.0, Tick()))[-1]
    assert messages_after((0.0, work), (1.0, WorkerUp(0)), (9.0, Tick()))[0] == (
        "did not finish compiling for work item a within 8 s (compute.compile_timeout_s)"
    )
    compiled = [(1.0, WorkerUp(0)), (7.0, Compiled(0, "train", 6.0))]
    assert messages_after((0.0, work), *compiled, (14.0, Tick()))[0] == (
        "no answer to work item a within 7 s of computing (compute.first_chunk_timeout_s)"
    )
    answers = [*compiled, (7.1, Result(0, "a", 1)), (7.2, Result(0, "b", 1))]
    assert messages_after((0.0, work), *answers, (12.2, Tick()))[0] == (
        "no answer to work item c within 5 s of computing (at least compute.chunk_timeout_s)"
    )


def test_keys_that_messages_name_exist():
    limits = vars(dispatch_limits(load_config(CONFIG, DEADLINES)))
    times = {name for name in limits if re.search(r"_time(out|_limit)_s$|^time_", name)}
    assert {"start_timeout_s", "chunk_timeout_s", "time_limit_s", "no_worker_timeout_s"} < times
    for limit in times:
        (section, key), *others = re.findall(r"(compute|task)\.(\w+)", key_of(limit))
        assert not others
        assert key in {"compute": ComputeConfig, "task": TaskConfig}[section].model_fields


def test_a_run_that_has_lost_its_start_does_not_start_anywhere_else(tmp_path):
    search = {"algorithm": "es", "init_from": str(tmp_path)}
    config = load_config(CONFIG | {"search": search}, new=False)
    with pytest.raises(StoreError, match="which it has lost"):
        initial_centres(config, None)


def configured(workers: int, **compute: object):
    return load_config(CONFIG | {"compute": {"workers": workers, **compute}})


def test_no_more_workers_start_than_have_work(monkeypatch):
    """Except for a search of the user's own, which may ask for any number of policies."""
    monkeypatch.setattr(counting, "cores", lambda: 16)
    config = configured(40)
    chunks = chunks_at_once(config)
    assert chunks < 40
    assert (worker_count(config), worker_count(configured(2)), worker_count(config, 39)) == (chunks, 2, 39)
    assert worker_count(configured(5000, engine="ray", address="auto")) == 5000, "the engine cuts, to whole actors"
    own = load_config(
        CONFIG
        | {"search": {"algorithm": "tests.examples.repelling_centres:repelling_centres"}, "compute": {"workers": 40}}
    )
    assert worker_count(own) == 40


@pytest.mark.slow
def test_a_note_says_how_many_workers_start_where_not_all_have_work(tmp_path):
    notices: list[str] = []
    few = {"search.pairs": 16, "search.evaluation_episodes": 20, "compute.max_workers_per_core": 4}
    api.run(load_config(CONFIG, {**few, "compute.workers": 3}), tmp_path / "run", on_notice=notices.append)
    assert [notice.partition(",")[0] for notice in notices] == ["compute.workers: 2 of 3 start"]


def test_without_on_notice_a_notice_is_a_line_on_stderr(tmp_path, monkeypatch, capsys, one_process):
    monkeypatch.delattr("es_service.runs.session.print")  # which makes it an error in tests
    folder = api.run(SMALL | {"budget": {"generations": 1}}, tmp_path / "run").run.folder
    assert capsys.readouterr() == ("", "")
    api.fork(folder, out=tmp_path / "fork")
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("note: no generation was run")
    assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "chunks", "keys"),
    [
        ({"search.pairs": 512}, 8, "search.pairs and compute.chunk_pairs change that"),
        (
            {"search.pairs": 512, "compute.gradient_block_pairs": 8},
            64,
            "search.pairs and compute.gradient_block_pairs change that",
        ),
        ({"search.pairs": 16, "search.evaluation_episodes": 60}, 4, "search.evaluation_episodes changes that"),
    ],
)
def test_the_largest_phase_of_a_generation_says_how_many_workers_have_work(settings, chunks, keys):
    config = load_config(CONFIG, settings)
    assert chunks_at_once(config) == max(chunks_of_phases(config).values()) == chunks
    sentence = parallel_sentence(config)
    assert f"has {chunks} chunks of work at a time" in sentence
    assert sentence.endswith(f"; {keys}")


@pytest.mark.parametrize("engine", ["inline", "ray"])
def test_more_workers_on_this_machine_than_its_cores_can_be_meant_to_run_are_refused(
    engine, monkeypatch, tmp_path, one_process
):
    """Before anything is written: the way out of a refused resume is not refused again."""
    monkeypatch.setattr(counting, "cores", lambda: 2)
    assert worker_count(configured(8, engine=engine), 9) == 8
    assert worker_count(configured(20, engine=engine, max_workers_per_core=10), 1000) == 20
    assert worker_count(configured(5000, engine="ray", address="auto"), 1000) == 5000
    folder = tmp_path / "run"
    with pytest.raises(ConfigError, match=r"5000 workers are too many for this machine, which has 2 cores") as error:
        api.run(configured(5000, engine=engine), folder)
    assert (error.value.field, error.value.value, error.value.allowed) == ("compute.workers", 5000, "at most 8")

    again = f"es-service run CONFIG --out {folder}"
    assert error_message(error.value).splitlines()[1:] == [
        f"  to start one worker for each core: {again} --set compute.workers=auto",
        f"  to use the cores of a Ray cluster: {again} --address HOST:PORT --set compute.workers=5000",
    ]
    assert not folder.exists()
    api.run(configured(1), folder)
    before = (folder / "config.yaml").read_text()
    with pytest.raises(ConfigError, match="must be at most 8") as error:
        api.resume(folder, ["compute.workers=9", f"compute.engine={engine}"])
    assert f" resume {folder} --engine {engine} --set compute.workers=auto\n" in error_message(error.value)
    assert error_message(error.value).endswith(f" resume {folder} --address HOST:PORT --set compute.workers=9")
    assert (folder / "config.yaml").read_text() == before


def test_workers_without_ray_are_as_many_as_the_gpus_have_room_for(monkeypatch):
    def on_gpus(share, workers="auto"):
        return load_config(CONFIG, {"compute.worker_resources.gpu": share, "compute.workers": workers})

    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    assert [worker_count(on_gpus(share), 9) for share in (2, 1, 0.5)] == [1, 2, 4]
    assert worker_count(on_gpus(0.5, workers=3), 9) == 3
    with pytest.raises(ConfigError, match="3 workers are too many for this machine, whose GPUs have room for 2"):
        worker_count(on_gpus(1, workers=3))
    with pytest.raises(ConfigError, match=r"gpu: each worker is to have 3, but this machine has too few NVIDIA GPUs"):
        worker_count(on_gpus(3))


def test_episodes_of_a_run_on_gpus_are_computed_on_the_cpu_where_there_is_none(monkeypatch):
    config = load_config(CONFIG, {"compute.worker_resources.gpu": 1}).model_dump(mode="json")
    for visible, gpus in (("0", 1), ("", 0)):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        assert on_this_machine(config)["compute.worker_resources.gpu"] == gpus
