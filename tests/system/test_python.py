"""What a program or a notebook can do with runs: end them, show them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from jupyter_client.manager import start_new_kernel

import es_service
from es_service import Stop
from es_service.errors import StartError
from tests.examples import optuna_pruning
from tests.system.processes import ROOT
from tests.system.session import SMALL

pytestmark = pytest.mark.usefixtures("workers_here")


def row_of(generation: int, answer: object):
    """A function that answers at one generation, and the list of the generations with which it was called."""
    seen: list[int] = []

    def on_generation(row):
        seen.append(row["generation"])
        return answer if row["generation"] == generation else None

    return on_generation, seen


@pytest.fixture(scope="module")
def whole(tmp_path_factory, workers_here):
    """Digest of an uninterrupted run of six generations."""
    return es_service.run(of(6), tmp_path_factory.mktemp("whole") / "run").run.digest()


def of(generations: int, **compute) -> dict:
    return SMALL | {"budget": {"generations": generations}, "compute": SMALL["compute"] | compute}


def test_stop_ends_a_run_after_its_commit_and_the_run_can_go_on(tmp_path, whole):
    on_generation, seen = row_of(2, Stop("pruned"))
    outcome = es_service.run(of(6), tmp_path / "run", on_generation=on_generation)
    assert (outcome.reason, outcome.run.generation, seen) == ("pruned", 2, [0, 1, 2])
    on_generation, seen = row_of(4, Stop("again"))
    outcome = es_service.resume(tmp_path / "run", on_generation=on_generation)
    assert (outcome.reason, outcome.run.generation, seen) == ("again", 4, [3, 4])
    outcome = es_service.run_or_resume(of(6), tmp_path / "run")
    assert "6 generations" in outcome.reason
    assert outcome.run.digest() == whole


def test_stop_ends_forks_and_runs_that_start_or_continue(tmp_path):
    for generation in (0, 3):
        on_generation, _ = row_of(generation, Stop("enough"))
        outcome = es_service.run_or_resume(of(6), tmp_path / "run", on_generation=on_generation)
        assert (outcome.reason, outcome.run.generation) == ("enough", generation)
    on_generation, seen = row_of(4, Stop("enough"))
    outcome = es_service.fork(
        tmp_path / "run", {"search.sigma": 0.1}, out=Path(tmp_path, "fork"), on_generation=on_generation
    )
    assert (outcome.reason, outcome.run.generation, seen) == ("enough", 4, [4])


def test_an_error_of_another_start_in_a_callback_leaves_what_the_run_has_computed(tmp_path):
    """Workers that cannot start take a run along only if it has not begun."""

    def start_another(row):
        if row["generation"] == 2:
            raise StartError("another cluster cannot be joined")

    with pytest.raises(StartError, match="another cluster"):
        es_service.run(SMALL, tmp_path / "run", on_generation=start_another)
    assert es_service.open_run(tmp_path / "run").generation == 2


@pytest.mark.parametrize("answer", [True, "enough", False, Stop])
def test_other_answers_have_no_effect(tmp_path, answer):
    on_generation, seen = row_of(1, answer)
    assert "2 generations" in es_service.run(of(2), tmp_path / "run", on_generation=on_generation).reason
    assert seen == [0, 1, 2]


@pytest.fixture
def shown(tmp_path, monkeypatch):
    """What a cell outputs in a real kernel: (kind of message, its content)."""
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    manager, client = start_new_kernel(cwd=str(tmp_path))

    def shown(cell: str) -> list[tuple[str, dict]]:
        messages: list[dict] = []
        answer = client.execute_interactive(cell, timeout=300, output_hook=messages.append)["content"]
        assert answer["status"] == "ok", answer
        kinds = ("stream", "display_data", "update_display_data", "execute_result")
        return [(one["msg_type"], one["content"]) for one in messages if one["msg_type"] in kinds]

    yield shown
    client.stop_channels()
    manager.shutdown_kernel(now=True)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_notebook_shows_the_progress_unless_it_is_told_each_generation_or_not_to(shown):
    """One output of the cell, which changes in place and ends with the last generation."""
    outputs = shown(f"from es_service import fork, resume, run, run_or_resume\nrun({of(3)}, 'a');")
    assert [kind for kind, _ in outputs[:2]] == ["display_data", "update_display_data"]
    assert {kind for kind, _ in outputs[1:]} == {"update_display_data"}
    assert len({content["transient"]["display_id"] for _, content in outputs}) == 1
    assert "a: starting workers" in outputs[0][1]["data"]["text/html"]
    assert "centre fitness" in outputs[-1][1]["data"]["text/html"]
    assert [line.split()[1] for line in outputs[-1][1]["data"]["text/plain"].splitlines() if " ± " in line] == list(
        "0123"
    )
    calls = (f"run_or_resume({of(4)}, 'a')", "fork('a', {'budget.generations': 5}, out='b')")
    assert all("centre fitness" in shown(f"{call};")[-1][1]["data"]["text/html"] for call in calls)
    assert "no generation was run" in shown("resume('b');")[-1][1]["data"]["text/html"]
    for told in ("progress=False", "on_generation=print"):
        assert shown(f"resume('b', {told});") == []


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_the_example_of_a_notebook_shows_what_it_has_stored(shown):
    """Each of its cells runs, and shows the same kinds of things as when the notebook was stored."""
    cells = json.loads((ROOT / "tests/examples/notebook.ipynb").read_text())["cells"]
    for number, cell in enumerate(one for one in cells if one["cell_type"] == "code"):
        code = "".join(cell["source"])
        found = [content for kind, content in shown(code) if kind != "update_display_data"]
        assert [set(one["data"]) for one in found] == [set(one["data"]) for one in cell["outputs"]], code
        assert cell["execution_count"] == number + 1


def test_other_programs_print_nothing(tmp_path, capfd):
    es_service.run(of(1), tmp_path / "run")
    assert capfd.readouterr() == ("", "")


def test_the_example_with_optuna_prunes_runs_which_are_stored_as_far_as_they_came(tmp_path):
    study = optuna_pruning.search(6, 10, tmp_path)
    kinds = {trial.number: trial.state.name for trial in study.trials}
    assert {"COMPLETE", "PRUNED"} == set(kinds.values())
    for trial in study.trials:
        run = es_service.open_run(tmp_path / str(trial.number))
        assert run.history["centre_fitness_mean"].to_dict() == trial.intermediate_values
        assert (run.generation == 10) == (kinds[trial.number] == "COMPLETE")
    assert study.best_value > study.trials[0].intermediate_values[0]
