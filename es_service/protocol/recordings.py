"""Messages about recorded episodes, for replays: which episode, what was seen, and what the bodies look like.

Axes: T control steps of the episode, the reset included; L links; B descriptor dimensions; V vertices; F triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK, Centre, FloatArray
from es_service.protocol.noise import Domain, Keys, evaluation_reset_keys
from es_service.protocol.policies import POLICY_SLOTS


@dataclass(frozen=True)
class RecordRequest:
    """Request to record one evaluation episode of a policy."""

    centre: Centre
    """The policy with its statistics; its generation is part of the episode's address."""
    seed: int
    ask: int = 0
    policy: int | None = None
    """The rest of the address of its reset; see `protocol.noise.evaluation_reset_keys`."""
    episode: int = 0
    """Of a policy the first one, unless it was the only policy of its ask."""
    domain: Domain = Domain.EVALUATION_RESET

    @property
    def reset_key(self) -> Keys:
        return evaluation_reset_keys(
            self.seed, self.centre.generation, self.episode, self.ask, self.policy, self.domain
        )

    @property
    def slot(self) -> int:
        """Slot of the chunk in which the episode ran; with xla it matters."""
        if self.policy is None:
            return self.episode % EVALUATION_EPISODES_PER_CHUNK
        return (self.policy + self.episode) % POLICY_SLOTS


class Mesh(NamedTuple):
    vertices_V_3: FloatArray
    """In the frame of a shape, in metres."""
    triangles_F_3: NDArray[np.int32]


class Shape(NamedTuple):
    """A part of a body, as its task's MJCF describes it."""

    kind: str
    """plane, sphere, capsule, ellipsoid, cylinder, box or mesh."""
    link: int
    """The link that it moves with; -1 for the world."""
    size: tuple[float, ...]
    """As in MJCF: half-lengths of a box, radius and half-length of a capsule, half-lengths of a plane, 0 if it has no
    end; of a mesh half-lengths of the box around it."""
    position: tuple[float, ...]
    """In the frame of its link."""
    rotation: tuple[float, ...]
    """Quaternion (w, x, y, z) in the frame of its link."""
    colour: tuple[float, ...]
    """Red, green, blue and opacity, from 0 to 1."""
    mesh: int | None = None
    """Number of its mesh in the scene; None for the other kinds."""


@dataclass(frozen=True)
class Scene:
    """What the bodies of a task look like."""

    shapes: tuple[Shape, ...]
    meshes: tuple[Mesh, ...]
    notes: tuple[str, ...]
    """Sentences on what is not drawn, or not as it is."""
    step_s: float
    """Seconds of a control step in the task's own time."""


@dataclass(frozen=True)
class Recording:
    """One episode, step by step until it ended."""

    descriptor_T_B: FloatArray
    returns_T: FloatArray
    """Return so far."""
    poses_T_L_7: FloatArray | None
    """Position (x, y, z) and quaternion (w, x, y, z) of each link in the world; None if the task has no bodies."""
    fitness: float
    trace_T_B: FloatArray
    """The episode's trace, as evaluations have it; equal to an elite's stored trace if the bits are the same."""


@dataclass(frozen=True)
class Recordings:
    """The answer to several requests, in their order."""

    recordings: tuple[Recording, ...]
    scene: Scene | None
    """The bodies of the task; None if it has none."""
