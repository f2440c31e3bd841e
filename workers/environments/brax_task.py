"""Environments of the installed Brax as tasks with a named descriptor, such as `brax:halfcheetah`; Brax's own parts.

The environments are Brax's own, without wrappers: they have no automatic reset and no time limit. Actions are clipped
to [-1, 1], the range that Brax's environments expect.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import threading
import warnings
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from importlib import metadata
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Bounds, TaskSpec
from es_service.protocol.options import OptionValue, choice, option_values
from workers.environments import Environment, TaskError
from workers.viewer import Viewer

# The parts of Brax that are used here, imported without the messages that Brax and its dependencies print.
#
# Versions are pinned in constraints.txt, and tests compare the physics of the ants with Brax's.

WORKS_WITH = {"brax": ("0.14.",), "mujoco": ("3.17.", "4.0."), "mujoco-mjx": ("3.17.",)}
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


with quietly():
    from brax import envs

EPISODE_STEPS = 1000
"""Default length of an episode, that of Brax's own trainers."""
BACKENDS = ("spring", "generalized", "positional", "mjx")
"""Backends of Brax, in the order in which they are tried."""
FAR = 30.0
"""Bound of descriptors whose range is not specified, in metres or in the unit of the joint."""
JOINTS = 2
"""Most joints in the descriptor `final_joints`; they are the first joints of the model."""
TOUCH = 0.005
"""Distance from the floor, in metres, below which a foot counts as touching it."""


class _BraxState(NamedTuple):
    """State of a Brax environment and of the descriptor `feet_contact`."""

    brax: Any
    touched_F: Any
    """Number of control steps in which each foot touched the floor."""
    steps: Any


def describe(name: str, given: Mapping[str, OptionValue] = MappingProxyType({})) -> TaskSpec:
    """Description of Brax's environment `name` as a task.

    Args:
        given: values of options that are not the defaults; sizes and descriptors are those of the backend.

    Raises:
        TaskError: Brax has no such environment, or its observations are not flat.
    """
    backends = _backends(name)
    backend = choice(*backends)
    environment = _make_brax(name, str(option_values({"backend": backend}, given)["backend"]))
    with quietly():  # Brax's own `observation_size` would run a whole reset
        observation = jax.eval_shape(environment.reset, jax.random.key(0)).obs
    if len(getattr(observation, "shape", ())) != 1:
        raise TaskError(f"brax:{name} has observations {observation}; only one-dimensional arrays are supported")
    descriptors = _descriptors(environment.sys)
    names, bounds = next(iter(descriptors.values()))
    return TaskSpec(
        name=f"brax:{name}",
        observation_size=observation.shape[0],
        action_size=environment.action_size,
        episode_steps=EPISODE_STEPS,
        descriptor_names=names,
        descriptor_bounds=bounds,
        final_fitness=False,
        has_goal=False,
        options={"descriptor": choice(*descriptors), "backend": backend},
        descriptors=descriptors,
        summary=f"{type(environment).__name__} of Brax",
    )


def make(name: str, descriptor: str | None = None, backend: str | None = None) -> Environment:
    """Functions of Brax's environment `name`, with its first descriptor and backend unless others are named."""
    environment = _make_brax(name, backend or _backends(name)[0])
    system = environment.sys
    descriptor = descriptor or next(iter(_descriptors(system)))
    feet = _feet(system) if descriptor == "feet_contact" else []
    root = _root_coordinates(system)

    def reset(key: Any) -> _BraxState:
        with quietly():
            state = environment.reset(jax.random.wrap_key_data(key[:2], impl="threefry2x32"))
        state = jax.tree.map(jnp.asarray, state)
        return _BraxState(state, jnp.zeros(len(feet), jnp.float32), jnp.float32(0.0))

    def step(state: _BraxState, action: Any) -> tuple[_BraxState, Any, Any]:
        own = jax.tree.map(lambda x: x, state.brax)  # a copy, because Brax writes into the metrics of its argument
        with quietly():
            after = environment.step(own, jnp.clip(action, -1.0, 1.0))
        after = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), after, state.brax)
        touched_F = state.touched_F + _touching(system, after.pipeline_state.x, feet)
        return _BraxState(after, touched_F, state.steps + 1.0), after.reward, after.done > 0.5

    def describe_state(state: _BraxState) -> Any:
        physics = state.brax.pipeline_state
        match descriptor:
            case "final_xy":
                return physics.x.pos[0, :2]
            case "final_x":
                return physics.x.pos[0, :1]
            case "final_joints":
                return physics.q[root : root + JOINTS]
            case _:
                return state.touched_F / jnp.maximum(state.steps, 1.0)

    viewer = Viewer(system.mj_model, lambda state: state.brax.pipeline_state.x, float(environment.dt))
    return Environment(
        reset, lambda state: state.brax.obs, step, describe_state, lambda state: jnp.float32(jnp.nan), viewer=viewer
    )


def _make_brax(name: str, backend: str) -> Any:
    with quietly():
        return envs.get_environment(name, backend=backend)


def _backends(name: str) -> tuple[str, ...]:
    """Backends with which Brax can build an environment.

    Raises:
        TaskError: Brax has no such environment, or cannot build it with any backend.
    """
    known = sorted(set(envs._envs) - {"fast"})  # Brax has no public list of names; "fast" is without physics
    if name not in known:
        near = get_close_matches(name, known, n=1)
        hint = f"; did you mean brax:{near[0]}?" if near else ""
        raise TaskError(f"brax:{name} is not in the installed Brax, which has {', '.join(known)}{hint}")
    backends, reasons = [], []
    for backend in BACKENDS:
        try:
            _make_brax(name, backend)
        except (ValueError, NotImplementedError) as error:
            reasons.append(f"{backend}: {error}")
        else:
            backends.append(backend)
    if not backends:
        raise TaskError(f"brax:{name} cannot be built with any backend: {'; '.join(reasons)}")
    return tuple(backends)


def _descriptors(system: Any) -> dict[str, tuple[tuple[str, ...], Bounds]]:
    """Descriptors that a system supports: name -> (names of the dimensions, bounds). The first is the default."""
    descriptors: dict[str, tuple[tuple[str, ...], Bounds]] = {}
    far = (-FAR, FAR)
    root = _root_coordinates(system)
    if system.link_types[0] == "f":
        descriptors["final_xy"] = ("x", "y"), (far, far)
    if root:
        descriptors["final_x"] = ("x",), (far,)
    if feet := _feet(system):
        descriptors["feet_contact"] = (
            tuple(f"foot_{number}" for number in range(1, len(feet) + 1)),
            ((0.0, 1.0),) * len(feet),
        )
    if joints := min(JOINTS, system.q_size() - root):
        descriptors["final_joints"] = tuple(f"joint_{number}" for number in range(1, joints + 1)), (far,) * joints
    return descriptors


def _root_coordinates(system: Any) -> int:
    """Number of leading coordinates that are the position of a moving base instead of joints; 0 for a fixed base."""
    link_type = system.link_types[0]
    if link_type == "f":
        return 7  # position and quaternion
    return int(link_type) if np.asarray(system.dof.motion.vel)[: int(link_type), 0].any() else 0


def _feet(system: Any) -> list[int]:
    """Links without children that have a part that can touch the floor, in the order of the model."""
    links = range(system.num_links())
    leaves = [link for link in links if link not in system.link_parents]
    bodies, contact_types = np.asarray(system.geom_bodyid), np.asarray(system.geom_contype)
    touchable = set((bodies[(contact_types | np.asarray(system.geom_conaffinity)) != 0] - 1).tolist())
    has_floor = -1 in touchable
    return [link for link in leaves if has_floor and link in touchable]


def _touching(system: Any, x: Transform, feet: list[int]) -> Any:
    """Array [F] that is 1.0 for each foot that touches the floor and 0.0 for others."""
    if not feet:
        return jnp.zeros(0, jnp.float32)
    with quietly():
        contact = brax_contact.get(system, x)
    assert contact is not None
    near = contact.dist < TOUCH
    of_world, of_ant = (jnp.asarray(link) for link in contact.link_idx)
    touches = [
        (near & (((of_world == -1) & (of_ant == foot)) | ((of_ant == -1) & (of_world == foot)))).any() for foot in feet
    ]
    return jnp.stack(touches).astype(jnp.float32)
