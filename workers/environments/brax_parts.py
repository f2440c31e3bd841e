"""The parts of Brax we use, imported in silence: it and what it imports announce what they lack and who maintains them.

Versions are pinned in constraints.txt, and tests hold our physics against Brax's.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import threading
import warnings
from collections.abc import Iterator
from importlib import metadata
from typing import Any

from workers.environments import TaskError

WORKS_WITH = {"brax": "0.14.", "mujoco": "4.0.", "mujoco-mjx": "3.17."}
"""Beginnings of the versions our physics has been held against Brax's with; each MJX release may break Brax."""


def check_versions() -> None:
    """Raise TaskError where another version of Brax or MuJoCo is installed, or none."""
    for package, version in WORKS_WITH.items():
        try:
            installed = metadata.version(package)
        except metadata.PackageNotFoundError:
            installed = "none"
        if not installed.startswith(version):
            raise TaskError(
                f"{package} {installed} is installed, and {package} {version}* is what works: "
                "pip install -c constraints.txt brax mujoco mujoco-mjx"
            )


_ONE_THREAD = threading.RLock()


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Brax says nothing in here, while it is imported, loads a model or is traced.

    One thread at a time, as what is changed for that, and what callers change of Brax in here, is the whole process's.
    """
    mujoco: Any = importlib.import_module("mujoco")
    with _ONE_THREAD:
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: None)  # it would write them into a file where we are
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                yield
        finally:
            mujoco.set_mju_user_warning(before)


check_versions()
with quietly():
    from brax import com, kinematics
    from brax import contact as brax_contact
    from brax.base import Contact, Motion, System, Transform
    from brax.io import mjcf
    from brax.spring import collisions, pipeline
    from brax.spring.base import State

__all__ = [
    "Contact",
    "Motion",
    "State",
    "System",
    "Transform",
    "brax_contact",
    "check_versions",
    "collisions",
    "com",
    "kinematics",
    "load",
    "pipeline",
    "quietly",
]


def load(xml: str) -> System:
    """Brax's System of a MuJoCo model."""
    with quietly():
        return mjcf.loads(xml)
