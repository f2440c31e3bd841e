"""What is exported while a driver works, and how damaged exports are found."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest

from es_service import api
from es_service.config.resolution import policy_spec_of
from es_service.errors import NotInRunError, StoreError
from es_service.protocol.options import ParameterSpec
from es_service.runs.certification import certify_run
from es_service.runs.export import arrays, export, tables
from es_service.runs.onnx import about, model_card, onnx_model
from es_service.runs.snapshot import Policy
from es_service.store import reader
from tests.database import execute
from tests.run_examples import write_run
from workers.environments import SHIPPED

pytestmark = pytest.mark.usefixtures("workers_here")
FIRST, LAST = 2, 8
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 10},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "me_es", "pairs": 16},
    "compute": {"engine": "inline", "workers": 1},
    "budget": {"generations": FIRST},
}


@pytest.fixture
def run(tmp_path):
    return api.run(api.load_config(CONFIG), tmp_path / "run").run


def go_on(run):
    return api.resume(run.folder, [f"budget.generations={run.generation + 1}"])


def after_a_generation(run, read):
    def read_later(*arguments):
        go_on(run)
        return read(*arguments)

    return read_later


POLICIES = [
    {},
    {"hidden": [], "bias": False, "output": "linear"},
    {"hidden": [7, 5], "activation": "relu", "output": "argmax"},
    {"output": "categorical"},
    {"output": "gaussian"},
    {"memory": 3},
    {"memory": 6, "hidden": [5], "bias": False, "output": "argmax"},
]


@pytest.mark.parametrize("kind", POLICIES)
@pytest.mark.parametrize("clip", [None, 1.5])
def test_a_model_has_the_actions_of_its_policy(kind, clip):
    """By onnxruntime, for episodes side by side, step by step."""
    rng = np.random.default_rng(0)
    values = {"hidden": [8], "activation": "tanh", "output": "tanh", "bias": True, "memory": None, **kind}
    spec = policy_spec_of({f"policy.{name}": value for name, value in values.items()}, 4, 3)
    parameters_D, mean_O = (rng.normal(size=size).astype(np.float32) for size in (spec.parameters, 4))
    policy = Policy(spec, parameters_D, mean_O, np.float32([0.5, 1.0, 2.0, 3.0]), clip)
    session = onnxruntime.InferenceSession(onnx_model(policy, {"task": "t"}).SerializeToString())
    assert session.get_modelmeta().custom_metadata_map == {"task": "t"}
    act, memory = policy.start(), np.zeros((16, spec.memory), np.float32)
    for _ in range(5):
        observation = rng.normal(0.0, 3.0, (16, 4)).astype(np.float32)
        given = {"observation": observation} | ({"memory": memory} if spec.memory else {})
        action, *after = session.run(None, given)
        np.testing.assert_allclose(action, act(observation), atol=2e-6)
        assert action.shape == (16, 3)
        memory = after[0] if spec.memory else memory


def test_exported_models_have_a_card_whose_code_runs(run, tmp_path, monkeypatch):
    certify_run(run.folder, episodes=8)
    files = {file.name: file for file in export(run, "onnx", tmp_path)}
    assert list(files) == ["certified.onnx", "best.onnx", "centre.onnx", "model_card.md", "SHA256SUMS"]
    card = files["model_card.md"].read_text()
    [value] = api.open_run(run.folder).certified.return_mean
    assert f"**{value:.6g}** (95 % interval" in card
    assert "| numpy |" in card
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(card.partition("```python\n")[2].partition("```")[0], names)  # as users copy it
    observation = np.zeros((1, run.policy_spec.widths[0]), np.float32)
    np.testing.assert_allclose(names["action"], run.policy("certified")(observation), atol=1e-6)


def test_what_actions_stand_for_is_exported(tmp_path):
    bounded = replace(SHIPPED["point_maze"], action_bounds=((-2.0, 2.0), (0.0, 1.0)))
    run = api.open_run(write_run(tmp_path / "bounded", task=bounded))
    row = "| actions | -1 and 1 stand for the environment's [-2.0, 0.0] and [2.0, 1.0]: `low + (action + 1) / 2"
    assert row in model_card(run, ["best.onnx"], None)
    assert about(run, None)["action_low"] == "[-2.0, 0.0]"
    assert (arrays(run)["action_low"].tolist(), arrays(run)["action_high"].tolist()) == ([-2.0, 0.0], [2.0, 1.0])
    chosen = replace(SHIPPED["point_maze"], discrete_actions=True)
    run = api.open_run(write_run(tmp_path / "chosen", task=chosen))
    assert "the environment's is `action.argmax()`" in model_card(run, ["best.onnx"], None)
    assert "action_low" not in arrays(run)


def test_parameters_of_a_function_are_no_policy(tmp_path):
    named = ParameterSpec(("a", "b"), ((0.0, 1.0), (-1.0, 1.0)), (0.5, 0.0))
    run = api.open_run(write_run(tmp_path / "run", task=replace(SHIPPED["point_maze"], parameters=named)))
    with pytest.raises(NotInRunError, match="has no policies, since its task is a function; csv and npz have its"):
        export(run, "onnx", tmp_path / "out")


@pytest.mark.slow
def test_an_export_is_of_one_generation_although_one_more_is_stored_before_each_look(run, tmp_path, monkeypatch):
    same = api.run(api.load_config(CONFIG), tmp_path / "same").run
    expected = {}
    for generation in range(FIRST, LAST):
        expected[generation] = dict(tables(same)) | arrays(same)
        go_on(same)
    for name in ("read_parts", "read_history_columns"):
        monkeypatch.setattr(reader, name, after_a_generation(run, getattr(reader, name)))
    found_tables, found_arrays = dict(tables(run)), arrays(run)
    assert FIRST + 2 < run.generation < LAST
    at = found_tables["history"]["generation"].iloc[-1]
    assert found_tables["history"]["centre_fitness_mean"].equals(expected[at]["history"]["centre_fitness_mean"])
    for name in ("novelty", "map"):
        assert found_tables[name].equals(expected[at][name])
    assert any(
        all(
            np.array_equal(array, of_one[name], equal_nan=array.dtype.kind == "f")
            for name, array in found_arrays.items()
        )
        for of_one in expected.values()
    )


def test_a_run_that_lost_its_newest_history_row_is_not_exported_as_of_the_generation_before(run, tmp_path):
    execute(run.folder, "DELETE FROM history WHERE generation = ?", run.generation)
    for use in (lambda: export(run, "csv", tmp_path), lambda: list(tables(run)), lambda: arrays(run)):
        with pytest.raises(StoreError, match=f"the history after generation {FIRST - 1} is missing"):
            use()


def failed(folder):
    """Files of which sha256sum says that they have changed or are missing."""
    done = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=folder, capture_output=True, text=True, check=False)
    return {line.partition(":")[0] for line in done.stdout.splitlines() if not line.endswith(": OK")}


def test_a_damaged_export_is_found_by_sha256sum(run, tmp_path):
    """NumPy reads an array of a damaged npz file without a word if its header has become that of a shorter one."""
    files = {file.name for to in ("csv", "npz", "parquet") for file in export(run, to, tmp_path / "export")}
    assert "policies.npz" in files
    assert "SHA256SUMS" in files
    assert failed(tmp_path / "export") == set()
    for name in files - {"SHA256SUMS"}:
        content = (tmp_path / "export" / name).read_bytes()
        (tmp_path / "export" / name).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        assert failed(tmp_path / "export") == {name}
        (tmp_path / "export" / name).write_bytes(content)
    (tmp_path / "export" / "map.csv").unlink()
    (tmp_path / "export" / "SHA256SUMS").write_bytes((tmp_path / "export" / "SHA256SUMS").read_bytes() + b"\xff\0  x\n")
    export(run, "npz", tmp_path / "export")
    assert failed(tmp_path / "export") == set(), "what is gone or no file is left out"


@pytest.mark.parametrize("to", ["csv", "parquet", "npz", "ribs", "tensorboard"])
def test_links_of_a_strangers_run_are_not_written_through(tmp_path, to):
    folder, victim = write_run(tmp_path / "run"), tmp_path / "victim"
    export(api.open_run(folder), to, tmp_path / "names")
    names = [path.name for path in (tmp_path / "names").iterdir()]
    victim.mkdir()
    (folder / "export").mkdir()
    for name in names:
        (victim / name).write_text("thesis")
        (folder / "export" / name).symlink_to(victim / name)
    written = export(api.open_run(folder), to, folder / "export")
    assert all(path.is_file() and not path.is_symlink() for path in written)
    assert {path.name: path.read_text() for path in victim.iterdir()} == dict.fromkeys(names, "thesis")
    shutil.rmtree(folder / "export")
    (folder / "export").symlink_to(victim)
    with pytest.raises(StoreError, match=r"export is a link that leads out of .*run; name the folder to write into"):
        export(api.open_run(folder), to, folder / "export")
    assert len([*victim.iterdir()]) == len(names)
