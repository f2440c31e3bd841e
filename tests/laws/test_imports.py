"""Who may import whom. The rules keep the driver light and the workers free of the driver."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LEAVES = {f"es_service.{name}" for name in ("protocol", "noise", "wire", "platform_info", "process_environment")}
JOINERS = {"api.py", "bench.py", "cli.py", "doctor.py", "run_view.py", "session.py", "tasks.py"}
"""Files of es_service that know both sides: the Python interface and the command line. `run_view` is the interface's
reading half (a policy runs in NumPy), `doctor` the command's."""
RAY_USERS = {"ray_cluster.py", "jobs.py"}
"""Files of es_service that import Ray, inside the functions that need it: all others are given the module."""


def imports(path: Path) -> set[str]:
    """Absolute names of the modules a file imports, `from x import y` as both x and x.y."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write absolute imports"
            found |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def is_project_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


@pytest.mark.parametrize("path", files("workers"), ids=str)
def test_workers_import_only_the_leaves_of_es_service(path):
    used = {name for name in imports(path) if name.startswith("es_service") and is_project_module(name)}
    assert used - {"es_service"} <= LEAVES


@pytest.mark.parametrize("leaf", sorted(LEAVES))
def test_leaves_import_nothing_of_the_project(leaf):
    used = imports(ROOT / f"{leaf.replace('.', '/')}.py")
    assert not {name for name in used if name.split(".")[0] in ("es_service", "workers", "jax")}


@pytest.mark.parametrize("path", files("es_service"), ids=str)
def test_only_the_interfaces_join_both_sides(path):
    used = {name.split(".")[0] for name in imports(path)}
    assert not used & ({"brax", "jax"} if path.name in RAY_USERS else {"ray", "brax", "jax"})
    if str(path.relative_to(ROOT / "es_service")) not in JOINERS:
        assert "workers" not in used


def test_a_driver_process_loads_no_jax():
    """Start-up time and memory of the driver depend on it, and so does independence of the caller's JAX."""
    code = "import sys, es_service.api, es_service.cli; sys.exit(any(m in sys.modules for m in ('jax', 'ray', 'brax')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_importing_the_package_imports_no_more_than_it_must():
    code = "import sys, es_service; sys.exit('pandas' in sys.modules or 'es_service.api' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
