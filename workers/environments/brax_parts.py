"""The parts of Brax that are used here, imported without the messages that Brax and its dependencies print.

Versions are pinned in constraints.txt, and tests compare the physics of the ants with Brax's.
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

WORKS_WITH = {"brax": ("0.14.",), "mujoco": ("3.16.", "3.17.", "4.0."), "mujoco-mjx": ("3.16.", "3.17.")}
"""Prefixes of the versions with which the physics was compared with Brax's; each MJX release may break Brax."""


def check_versions() -> None:
    """Raise TaskError if Brax or MuJoCo is not installed in the supported version."""
    for package, versions in WORKS_WITH.items():
        try:
            installed = metadata.version(package)
            actual = f"{package} {installed} is installed"
        except metadata.PackageNotFoundError:
            installed, actual = "", f"{package} is not installed"
        if not installed.startswith(versions):
            required = " or ".join(f"{prefix}*" for prefix in versions)
            raise TaskError(
                f"{actual}, but {package} {required} is required: pip install -c constraints.txt brax mujoco mujoco-mjx"
            )


_ONE_THREAD = threading.RLock()


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Context manager in which Brax prints nothing while it is imported, loads a model or is traced.

    Only one thread can enter at a time, because the settings changed here, and the parts of Brax that callers replace
    inside, belong to the whole process.
    """
    mujoco: Any = importlib.import_module("mujoco")
    with _ONE_THREAD:
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: None)  # by default, warnings go to a file in the current folder
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
    """Brax's system of a MuJoCo model."""
    with quietly():
        return mjcf.loads(xml)
