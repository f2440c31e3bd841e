"""The parts of Brax we use, imported in silence: it and what it imports announce what they lack and who maintains them.

Versions are pinned in constraints.txt, and tests hold our physics against Brax's.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Brax says nothing in here, while it is imported, loads a model or is traced."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


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
