"""Which module may import which: the folders of es_service are layers, and a layer imports only layers below it.

The rules keep the driver light and the workers free of the driver.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import pytest

from es_service.search.algorithms import OURS
from workers.rollouts import BACKENDS

ROOT = Path(__file__).parents[2]
LAYERS = (
    "cli",
    "asking",
    "api",
    "watch",
    "gymnasium",
    "environments",
    "report",
    "runs",
    "dispatch",
    "store",
    "loop",
    "search",
    "config",
    "errors",
    "protocol",
    "logs",
)
"""From the user's side down."""
LOWEST = ("protocol", "logs")
"""Layers that import nothing of the project."""
ENTRIES = {"es_service.__init__": "asking", "es_service.__main__": "cli"}
"""Module outside the layers -> the layer whose rules it follows."""
JOINERS = {
    "es_service.asking",
    "es_service.gymnasium",
    "es_service.environments.brax_env",
    "es_service.environments.vector",
    "es_service.runs.engine",
    "es_service.runs.snapshot",
    "es_service.runs.verification",
    "es_service.runs.scaling",
    "es_service.runs.session",
    "es_service.config.tasks",
    "es_service.cli.doctor",
}
"""Modules of es_service that know both sides: they may import `workers`."""
RAY_USERS = {"es_service.dispatch.ray_cluster", "es_service.runs.jobs"}
"""Modules of es_service that import Ray, inside the functions that need it: all others are given the module."""
COMMANDS = {"es_service.cli.session": ["polish"], "es_service.protocol.errors": ["polish"]}
"""Module -> words that mean a command there, and not the method of this name."""
OTHER_MEANINGS = {
    "workers.compiling": {"xla"},
    "es_service.asking": {"asked"},
    "es_service.cli.show": {"simd"},
    "es_service.store.lock": {"host"},
    "es_service.runs.run_status": {"host"},
    "es_service.watch.server": {"host"},
}
"""Module -> words that mean a guide, a folder, a machine or an argument there, and not the rollouts of these names."""


def module_of(path: Path) -> str:
    """Dotted name of a file; a package's own is `package.__init__`."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def imports(source: str) -> set[str]:
    """Absolute names of the modules a file imports, `from x import y` as both x and x.y."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "write absolute imports"
            found |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def layer_of(module: str) -> str:
    """The layer that a module of es_service is in; empty for the package itself."""
    return module.split(".")[1] if "." in module else ""


def wrong_arrows(module: str, source: str) -> list[str]:
    """A sentence for every import that the law forbids to a module of the project."""
    found = []
    used = {name for name in imports(source) if name.split(".")[0] in ("es_service", "workers", "jax", "brax", "ray")}
    here = ENTRIES.get(module) or (layer_of(module) if module.startswith("es_service.") else "workers")
    for name in sorted(used):
        package, there = name.split(".")[0], layer_of(name)
        if package == "es_service" and there in LAYERS:
            if here == "workers":
                if there != "protocol":
                    found.append(f"{module} imports {name}: workers import of es_service only protocol")
            elif here in LOWEST:
                if there != here:
                    found.append(f"{module} imports {name}: {here} imports nothing of the project")
            elif LAYERS.index(there) < LAYERS.index(here):
                found.append(f"{module} imports {name}: {there} is above {here}; a layer imports only those below it")
        elif package == "workers" and here != "workers":
            if here in LOWEST:
                found.append(f"{module} imports {name}: {here} imports nothing of the project")
            elif module not in JOINERS:
                found.append(f"{module} imports {name}: of es_service only {', '.join(sorted(JOINERS))} import workers")
        elif package in ("jax", "brax") and here != "workers":
            found.append(f"{module} imports {name}: the driver loads no JAX and no Brax")
        elif package == "ray" and here != "workers" and module not in RAY_USERS:
            found.append(f"{module} imports {name}: only {', '.join(sorted(RAY_USERS))} import Ray")
    return found


@pytest.mark.parametrize("path", [*files("es_service"), *files("workers")], ids=module_of)
def test_imports_go_down(path):
    assert wrong_arrows(module_of(path), path.read_text()) == []


@pytest.mark.parametrize(
    ("module", "source", "sentence"),
    [
        ("es_service.store.lock", "from es_service.cli.common import command", "cli is above store"),
        ("es_service.loop.driver", "from es_service.store import writer", "store is above loop"),
        ("es_service.config.model", "import es_service.search.novelty", "search is above config"),
        ("es_service.search.novelty", "def f():\n    from es_service.loop import budget", "loop is above search"),
        ("es_service.protocol.wire", "from es_service.errors import StoreError", "protocol imports nothing"),
        ("es_service.__main__", "from workers import worker", "import workers"),
        ("es_service.api", "import workers", "import workers"),
        ("workers.worker", "from es_service.config.model import RunConfig", "only protocol"),
        ("es_service.runs.view", "import jax.numpy", "no JAX"),
        ("es_service.runs.session", "import ray", "import Ray"),
    ],
)
def test_a_wrong_arrow_is_named(module, source, sentence):
    (arrow,) = {one.rpartition(": ")[2]: one for one in wrong_arrows(module, source)}.values()
    assert arrow.startswith(f"{module} imports ")
    assert sentence in arrow


def test_the_loop_knows_no_method_by_name():
    methods = {f"es_service.search.algorithms.{name}" for name in OURS}
    assert not {name for path in files("es_service/loop") for name in imports(path.read_text())} & methods


def names_in(source: str, names: Collection[str]) -> list[str]:
    """The names that a file has as string literals, apart from docstrings and descriptions of keys."""
    tree = ast.parse(source)
    texts = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "description"}
    constants = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in texts]
    return [node.value for node in constants if node.value in names]


@pytest.mark.parametrize("path", [*files("es_service"), *files("workers")], ids=module_of)
def test_no_module_knows_a_method_by_name_but_its_own(path):
    """What the rest of the service has to know of a method is declared in its settings."""
    own = path.stem if path.parent.name == "algorithms" else None
    assert set(names_in(path.read_text(), OURS)) <= {own, *COMMANDS.get(module_of(path), ())}


def test_a_name_is_found():
    source = (
        '"""memes"""\nif name in ("es", "other"):\n    """ars"""\n    Field(description="ars")\n    f(x={"me_es": 1})'
    )
    assert names_in(source, OURS) == ["es", "me_es"]
    assert names_in('run if spec.rollout == "simd" else "other"', BACKENDS) == ["simd"]


@pytest.mark.parametrize("path", [*files("es_service"), *files("workers")], ids=module_of)
def test_no_module_knows_a_rollout_by_name_but_its_own(path):
    """What the rest of the service has to know of a rollout is declared in its object."""
    module = module_of(path)
    own = {name for name in BACKENDS if f"{module}.".startswith((f"workers.rollouts.{name}.", f"workers.{name}."))}
    assert set(names_in(path.read_text(), BACKENDS)) <= own | OTHER_MEANINGS.get(module, set())


@pytest.mark.parametrize(
    "path",
    [path for path in files("es_service") if layer_of(module_of(path)) not in ("cli", "__main__")],
    ids=module_of,
)
def test_no_message_below_the_command_line_shows_a_command(path):
    """An error has its way out as data, of which the command line makes a command."""
    tree = ast.parse(path.read_text())
    documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    shown = [text.value for text in texts if id(text) not in documents]
    command = re.compile(r"es-service (run|resume|fork|status|list)|[ `]--(?!xla_)[a-z]")
    assert not list(filter(command.search, shown))


def test_every_file_of_es_service_is_in_a_layer():
    assert {path.name for path in (ROOT / "es_service").glob("*.py")} == {
        "__init__.py",
        "__main__.py",
        "api.py",
        "asking.py",
        "errors.py",
        "gymnasium.py",
        "logs.py",
    }
    layers = {path.parent.name for path in (ROOT / "es_service").glob("*/*.py")}
    assert layers <= set(LAYERS)


def test_a_driver_process_loads_no_jax():
    """Start-up time and memory of the driver depend on it, and so does independence of the caller's JAX."""
    code = "import sys, es_service.api, es_service.cli.main; assert not {'jax', 'ray', 'brax'} & sys.modules.keys()"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_importing_the_package_imports_no_more_than_it_must():
    code = "import sys, es_service; sys.exit('pandas' in sys.modules or 'es_service.api' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
