"""The environments of the other programs that `peers` measures: their packages, how they are made, how one is asked.

Each program has a virtual environment of its own, with this Python, since none goes together with another or with ours.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

THEIRS = Path(__file__).parent / "peers_theirs.py"
ENVIRONMENTS = {
    "qdax": (
        "absl-py==2.5.1 cloudpickle==3.1.2 decorator==5.3.1 dm-tree==0.1.10 etils==1.15.0 flask==3.1.3"
        " flask-cors==6.0.5 fsspec==2026.9.0 gast==0.7.0 glfw==2.11.0 grpcio==1.85.1 gym_notices==0.1.0"
        " huggingface_hub==2.4.0 humanize==4.17.0 importlib_resources==7.1.0 jinja2==3.1.6 joblib==1.6.0"
        " matplotlib==3.11.2 ml_collections==1.1.0 msgpack==1.2.4 nest_asyncio==1.6.0 opt_einsum==3.4.0 pillow==13.0.0"
        " pyopengl==3.1.10 pytinyrenderer==0.0.14 pyyaml==6.0.3 requests==2.34.2 rich==15.0.0 six==1.17.0"
        " tensorboardx==2.6.5 threadpoolctl==3.8.0 toolz==1.2.0 trimesh==5.2.0 typing_extensions==4.16.0 zipp==4.1.2",
        "qdax==0.4.1 brax==0.12.1 flax==0.8.5 optax==0.2.2 chex==0.1.86 ml_dtypes==0.4.0 tensorflow-probability==0.24.0"
        " mujoco==3.2.7 mujoco-mjx==3.2.7 orbax-checkpoint==0.5.20 tensorstore==0.1.63 scikit-learn==1.5.1"
        " jumanji==1.0.0 gym==0.26.2 dm_env==1.6 jaxopt==0.8.5",
        "jax==0.4.28 jaxlib==0.4.28 numpy==1.26.4 scipy==1.12.0",
    ),
    "mujoco": ("mujoco==4.0.0 gymnasium==1.4.0 numpy==2.4.6 imageio==2.38.1 packaging==26.3",),
    "evosax": ("evosax==0.3.2 jax==0.10.2 jaxlib==0.10.2 numpy==2.4.6",),
    "envpool": ("envpool==1.2.0 gymnasium==1.4.0 numpy==2.4.6",),
}
"""Folder of an environment -> packages of each call of pip, all calls but the first without dependencies.

No resolver finds QDax's set in reasonable time: the last QDax that has these tasks needs packages older than those
around them."""
NAMED = {
    "qdax": ("qdax", "brax", "jax"),
    "mujoco": ("mujoco", "gymnasium"),
    "evosax": ("evosax", "jax"),
    "envpool": ("envpool",),
}
"""Packages whose versions a row gives."""
OPTIONAL = ("envpool",)
"""Programs that are left out where they cannot be installed: they have wheels for some machines only, and no source."""


def python_of(folder: Path, name: str) -> Path:
    """The Python of an environment."""
    return folder / name / "bin" / "python"


def asked(command: Sequence[object], request: Mapping[str, Any], **variables: str) -> dict[str, Any]:
    """What a process answers to a request; raises RuntimeError with what it wrote if it fails."""
    with tempfile.TemporaryDirectory() as elsewhere:  # MuJoCo writes its warnings to the current folder
        done = subprocess.run(
            [*map(str, command), json.dumps(request)],
            cwd=elsewhere,
            env={**os.environ, "JAX_PLATFORMS": "cpu", **variables},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or f"it ended with {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def their_versions(folder: Path, name: str) -> dict[str, str]:
    """Versions of the packages of an environment; ends the program with a sentence if they are not as pinned."""
    pins = dict(pin.split("==") for pin in " ".join(ENVIRONMENTS[name]).split())
    python = python_of(folder, name)
    try:
        if not python.exists():
            raise RuntimeError("it does not exist")
        versions = asked([python, "-I", THEIRS], {"kind": "versions", "program": name, "packages": list(pins)})
        if wrong := [
            f"{package} {versions[package]}, not {pin}" for package, pin in pins.items() if versions[package] != pin
        ]:
            raise RuntimeError("it has " + ", ".join(wrong))
    except RuntimeError as error:
        why = str(error).splitlines()[-1]
        way_out = f"python -m tests.benchmarks.peers --build --environments {folder}"
        raise SystemExit(f"{folder / name} is not the environment of {name}: {why}\nTo build it: {way_out}") from None
    return versions


def there_are(folder: Path, name: str) -> bool:
    """Whether a program can be measured; says so if it is one that may be left out. See `their_versions`."""
    try:
        their_versions(folder, name)
    except SystemExit as why:
        if name not in OPTIONAL:
            raise
        print(f"{name} is left out: {str(why).splitlines()[0]}", flush=True)
        return False
    return True


def build(folder: Path) -> None:
    """Make the environments that are not there or cannot be used."""
    for name, calls in ENVIRONMENTS.items():
        try:
            their_versions(folder, name)
        except SystemExit:
            subprocess.run([sys.executable, "-m", "venv", "--clear", folder / name], check=True)
            pip = [python_of(folder, name), "-m", "pip", "install", "-qq"]
            for packages, alone in zip(calls, ([], *[["--no-deps"]] * 2), strict=False):
                subprocess.run([*pip, *alone, *packages.split()], check=name not in OPTIONAL)
            if not there_are(folder, name):
                continue
        print(f"{folder / name} is ready", flush=True)
