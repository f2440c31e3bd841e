"""What a stranger's run folder may not do: run code. `es_service/README.md` says whom the service trusts."""

import ast
import sys

import pytest
from typer.testing import CliRunner

from es_service import api
from es_service.cli.main import app
from es_service.config.tasks import Tasks
from tests.laws.test_imports import ROOT, files, module_of
from tests.system.session import SMALL

UNPICKLERS = {
    "es_service.protocol.wire": "messages between the driver and its own child processes",
    "es_service.dispatch.ray_engine": "answers of the workers in the cluster",
    "es_service.runs.scaling": "what it pickled itself, to measure how long it takes",
    "es_service.protocol.sent": "work from the driver",
    "workers.actor": "messages of the driver",
}
"""Module that unpickles -> what; each has it from a process of ours or from the cluster, and none from a run folder."""
PICKLERS = {
    "es_service.runs.export": "writes the archive of pyribs, which nothing here reads",
    "es_service.dispatch.ray_calls": "chunks and their subjects, which workers unpickle",
}
"""Module that may import pickle, only to write."""
SERIALIZERS = ("pickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve")
BUILTINS = {"eval", "exec", "compile", "__import__"}
UNPICKLING = {"load", "loads", "Unpickler"}


def dangers(module: str, source: str) -> list[str]:
    """A sentence for each thing in a module by which data could become code."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            for name in names:
                if name.split(".")[0] in SERIALIZERS and not (name == "pickle" and module in UNPICKLERS | PICKLERS):
                    found.append(f"{module}:{node.lineno} imports {name}")
                if name == "pickle" and isinstance(node, ast.ImportFrom):
                    found.append(f"{module}:{node.lineno} hides whose names these are: write `import pickle`")
                if name.split(".")[0] == "yaml":
                    found.append(f"{module}:{node.lineno} imports yaml: config/text.py reads YAML")
        elif isinstance(node, ast.Call):
            found += [f"{module}:{node.lineno} {danger}" for danger in _dangers_of_call(module, node)]
    return found


def _dangers_of_call(module: str, call: ast.Call) -> list[str]:
    name, found = ast.unparse(call.func), []
    if name in BUILTINS or name.endswith(".read_pickle"):
        found.append(f"calls {name}")
    if name in {f"pickle.{one}" for one in UNPICKLING} and module not in UNPICKLERS:
        found.append(f"calls {name}")
    for keyword in call.keywords:
        value = keyword.value.value if isinstance(keyword.value, ast.Constant) else ...
        if keyword.arg == "allow_pickle" and value is not False:
            found.append("allows NumPy to unpickle")
        if keyword.arg == "typ" and value in ("unsafe", "base"):
            found.append("reads YAML that can make any object")
        if keyword.arg == "shell" and value is not False:
            found.append("starts a shell")
    return found


@pytest.mark.parametrize("path", [*files("es_service"), *files("workers")], ids=module_of)
def test_data_do_not_become_code(path):
    assert dangers(module_of(path), path.read_text()) == []


@pytest.mark.parametrize(
    ("module", "source", "danger"),
    [
        ("es_service.store.reader", "import pickle", "imports pickle"),
        ("es_service.store.codec", "def f():\n    import marshal", "imports marshal"),
        ("es_service.report.data", "from shelve import open", "imports shelve"),
        ("es_service.runs.view", "import joblib.externals", "imports joblib"),
        ("es_service.runs.export", "pickle.load(stream)", "calls pickle.load"),
        ("es_service.runs.scaling", "from pickle import loads", "hides whose names"),
        ("es_service.store.codec", "np.load(file, allow_pickle=True)", "allows NumPy"),
        ("es_service.store.codec", "np.load(file, allow_pickle=chosen)", "allows NumPy"),
        ("es_service.runs.view", "pd.read_pickle(file)", "calls pd.read_pickle"),
        ("es_service.config.loading", "import yaml", "imports yaml"),
        ("es_service.config.text", "YAML(typ='unsafe')", "any object"),
        ("es_service.report.page", "eval(text)", "calls eval"),
        ("es_service.config.keys", "exec(text, {})", "calls exec"),
        ("es_service.runs.jobs", "subprocess.run(text, shell=True)", "starts a shell"),
    ],
)
def test_a_danger_is_named(module, source, danger):
    (found,) = dangers(module, source)
    assert found.startswith(f"{module}:")
    assert danger in found


@pytest.mark.parametrize("module", [*UNPICKLERS, *PICKLERS])
def test_a_module_that_may_import_pickle_does(module):
    path = ROOT / f"{module.replace('.', '/')}.py"
    assert "import pickle\n" in path.read_text()


@pytest.fixture
def executed(tmp_path, monkeypatch, one_process):
    """The file that importing the search of a user makes; the config of `run`, in the working folder, names it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    code = tmp_path / "strangers_search.py"
    code.write_text("from es_service.search.algorithms.nsra_es import nsra_es as search\n")
    search = SMALL["search"] | {"algorithm": "strangers_search:search"}
    api.run(SMALL | {"search": search, "budget": {"generations": 2}}, "run")
    sys.modules.pop("strangers_search")
    code.write_text(f"open({str(tmp_path / 'executed')!r}, 'w').close()\n{code.read_text()}")
    yield tmp_path / "executed"
    sys.modules.pop("strangers_search", None)


def test_what_only_reads_a_run_executes_nothing_that_the_run_names(executed, monkeypatch):
    def refuse(*_):
        raise AssertionError("a task was looked up, which imports it if it is a user's")

    monkeypatch.setattr(Tasks, "__getitem__", refuse)
    for words in ("status run", "digest run --parts", "report run", "export run --to csv", "export run --to npz"):
        result = CliRunner().invoke(app, words.split())
        assert result.exit_code == 0, result.output
    run = api.open_run("run")
    assert len(run.history) == 3
    assert run.policy("best")([0.0, 0.0]).shape == (2,)
    assert not executed.exists()


def test_what_continues_a_run_executes_what_the_run_names(executed):
    """So the guide says that only the run of somebody whom one trusts may be continued."""
    api.resume("run", {"budget.generations": 3}, on_notice=lambda notice: None)
    assert executed.exists()
