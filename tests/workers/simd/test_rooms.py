"""The compiler's folders: who may import whom, and that half of it needs no JAX."""

from __future__ import annotations

import ast
import hashlib
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from workers.simd.backend.native import OWN_VERSION

ROOT = Path(__file__).parents[3]
COMPILER = ROOT / "workers" / "simd"
BELOW = {
    "graph": set(),
    "backend": {"graph"},
    "frontend": {"graph"},
    "episodes": {"graph", "backend", "frontend"},
    "gpu": {"graph", "backend", "frontend", "episodes"},
}
"""Folder -> those it may import from, besides itself."""
NEEDS = {"graph": {"numpy"}, "backend": {"numpy", "llvmlite"}, "frontend": {"numpy", "jax", "es_service"}}
"""Folder -> what it may import besides the compiler; episodes may import what they like. Of es_service, workers import
the protocol alone, by another test."""


def module_of(path: Path) -> str:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix(".__init__")


MODULES = {module_of(path): path for path in sorted(COMPILER.rglob("*.py"))}


def imports(path: Path) -> set[str]:
    """Modules that a file imports, wherever in it: in functions, and for types alone."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write absolute imports"
            named = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= named & MODULES.keys() | ({str(node.module)} if named - MODULES.keys() else set())
    return found


def loaded(module: str) -> set[str]:
    """Modules of the compiler that importing a module loads: those it names, and the packages that they are in."""
    parts = [name.split(".") for name in imports(MODULES[module])]
    names = {".".join(name[:end]) for name in parts for end in range(1, len(name) + 1)}
    return {name for name in names & MODULES.keys() if not f"{module}.".startswith(f"{name}.")}


def folder_of(module: str) -> str:
    """graph, backend, ...; empty for the compiler's own __init__."""
    return ".".join(module.split(".")[2:3])


def test_no_two_modules_import_each_other_by_any_way_round() -> None:
    assert len(MODULES) > 25
    tuple(TopologicalSorter({module: loaded(module) for module in MODULES}).static_order())  # raises CycleError


@pytest.mark.parametrize("module", MODULES)
def test_folders_import_only_downward(module: str) -> None:
    folder = folder_of(module)
    assert folder in BELOW or module == "workers.simd"
    used = {folder_of(name) for name in loaded(module)} - {""}
    assert used <= BELOW.get(folder, set()) | {folder}
    if folder in NEEDS:
        tops = {name.split(".")[0] for name in imports(MODULES[module])} - {"workers"}
        assert tops - sys.stdlib_module_names <= NEEDS[folder]


def test_the_compiler_s_version_is_of_all_its_files() -> None:
    sources = b"".join(path.read_bytes() for path in MODULES.values())
    assert hashlib.sha256(sources).hexdigest() == OWN_VERSION


WITHOUT_JAX = """
import ctypes, importlib, pkgutil, sys
from pathlib import Path

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jax", "jaxlib", "brax"):
            raise ImportError(f"{name} is not installed")

sys.meta_path.insert(0, Missing())
for folder in ("graph", "backend"):
    package = importlib.import_module(f"workers.simd.{folder}")
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        importlib.import_module(found.name)
try:
    import workers.simd.frontend.trace
except ImportError:
    pass
else:
    sys.exit("JAX was found after all")

import numpy as np
from workers.simd.backend.emit import emit
from workers.simd.backend.native import load_compiled
from workers.simd.backend.target import host_target
from workers.simd.backend.native import aligned
from workers.simd.graph.folding import FoldingGraph

graph, target = FoldingGraph(), host_target()
x, y = graph.input("f", 0), graph.input("f", 1)
loop = graph.loop(3, [x])
outputs = graph.close(loop, [graph.op("add", graph.op("mul", loop.carries[0], y), graph.f(1.0))])
native = load_compiled("hand", lambda: emit(graph, outputs, 2, target), target, Path(sys.argv[1]))
words, out = aligned((1, 2, target.width)), aligned((1, 1, target.width))
words.view(np.float32)[0, 0] = np.arange(target.width)
words.view(np.float32)[0, 1] = 2.0
ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(native.address)(
    words.ctypes.data, out.ctypes.data, 1
)
assert np.array_equal(out.view(np.float32)[0, 0], 8.0 * np.arange(target.width) + 7.0), out.view(np.float32)
"""


def test_graphs_become_machine_code_where_there_is_no_jax(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_JAX, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
