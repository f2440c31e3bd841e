"""Helpers of tests of whole episodes: targets, tasks, arguments, and the episodes of simd and of xla."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

import workers.xla
from es_service.protocol.messages import PolicySpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, stream_keys
from tests.helpers import spec
from tests.workers.simd.emulated import arm_targets
from workers.environments import SHIPPED, make_environment
from workers.episode import Episodes
from workers.policy import initial_parameters
from workers.simd.backend.target import ISAS, NoVectorsError, host_target
from workers.simd.episodes import rollout


def targets() -> list[Any]:
    """Targets of this processor, the widest first."""
    found = []
    for isa in ISAS:
        try:
            found.append(host_target(isa))
        except NoVectorsError:
            continue
    return found


def every_target() -> list[Any]:
    """Targets of this processor and, as parameters of a test, of Arm."""
    return [*targets(), *arm_targets()]


def task_spec(task: str, **changes: Any) -> WorkerSpec:
    size = SHIPPED[task]
    hidden = (64, 64) if task == "point_maze" else (256, 256)
    shape = PolicySpec((size.observation_size, *hidden, size.action_size))
    return spec(environment=task, policy=shape, episode_steps=size.episode_steps, **changes)


def arguments(worker_spec: WorkerSpec, scale: float = 1.0, generation: int = 1, sigma: float = 0.05) -> tuple[Any, ...]:
    """Arguments of a training rollout, with a random policy as the centre and statistics that are not trivial."""
    shape, pairs = worker_spec.policy, np.arange(worker_spec.chunk_pairs)
    centre_D = scale * initial_parameters(shape, "unit_columns", 5)
    rng = np.random.default_rng(generation)
    mean_O = rng.normal(0, 0.1, shape.widths[0]).astype(np.float32)
    std_O = rng.uniform(0.5, 2.0, shape.widths[0]).astype(np.float32)
    keys = stream_keys(3, Domain.PARAMETER_NOISE, generation, pairs)
    resets = stream_keys(
        3, Domain.TRAINING_RESET, generation, pairs[:, None, None], np.arange(2)[None, :, None], np.arange(1)
    )
    actions = stream_keys(
        3, Domain.ACTION_NOISE, generation, pairs[:, None, None], np.arange(2)[None, :, None], np.arange(1)
    )
    return centre_D, np.float32(sigma / NORMAL_STD), mean_O, std_O, keys, resets, actions


def both(worker_spec: WorkerSpec, *given: Any) -> tuple[Episodes, Episodes]:
    """(episodes of simd, episodes of xla) for the same arguments."""
    ours = rollout.make_training_rollout(make_environment(worker_spec.environment, {}), worker_spec)(*given)
    return ours, by_xla(worker_spec, *given)


_XLA: dict[str, Any] = {}
"""Rollouts by xla, each traced and compiled once; that of an ant takes ten seconds."""


def by_xla(worker_spec: WorkerSpec, *given: Any) -> Episodes:
    """Episodes of xla."""
    key = repr(worker_spec)
    if key not in _XLA:
        environment = make_environment(worker_spec.environment, {})
        _XLA[key] = workers.xla.make_training_rollout(environment, worker_spec)
    return jax.tree.map(np.asarray, _XLA[key](*given))
