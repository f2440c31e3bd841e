"""Record evaluation episodes for replays, in a separate process because this imports JAX.

    python -m workers.recording REQUESTS ANSWER

REQUESTS is a file with the pickled (WorkerSpec, [RecordRequest]); the pickled Recordings are written to ANSWER.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import evaluation_reset_keys
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from workers.environments import Environment, make_environment
from workers.viewer import shapes
from workers.xla_cache import xla_cache_settings


def record(spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
    """Record the requested episodes with the run's own rollout, so that they have the bits of the run's own."""
    environment = make_environment(spec.environment, spec.environment_options)
    if spec.rollout == "simd":
        from workers.simd.episodes import rollout as made_by
    else:
        from workers import rollout as made_by
    watched = {own: made_by.make_watched_rollout(environment, spec, own_weights=own) for own in (False, True)}
    viewer = environment.viewer
    recordings = tuple(_record(environment, watched, spec, request) for request in requests)
    return Recordings(
        recordings, shapes(viewer.model) if viewer is not None else (), viewer.step_s if viewer is not None else 0.0
    )


def _record(environment: Environment, watched, spec: WorkerSpec, request: RecordRequest) -> Recording:
    centre = request.centre
    key = evaluation_reset_keys(request.seed, centre.generation, request.episode, request.ask, request.policy)
    carry_T = watched[request.policy is not None](
        centre.parameters_D, centre.observation_mean_O, centre.observation_std_O, key, request.slot
    )
    end = int(np.asarray(carry_T.episode.steps).max()) + 1
    carry_T = jax.tree.map(lambda leaf: np.asarray(leaf)[:end], carry_T)
    poses = None
    if environment.viewer is not None:
        x = jax.jit(jax.vmap(environment.viewer.poses))(carry_T.state)
        poses = np.concatenate([np.asarray(x.pos), np.asarray(x.rot)], axis=-1)
    descriptor = jax.jit(jax.vmap(lambda state: jnp.asarray(environment.descriptor(state), jnp.float32)))
    return Recording(
        descriptor_T_B=np.asarray(descriptor(carry_T.state)),
        returns_T=carry_T.episode.returns,
        poses_T_L_7=poses,
        fitness=float(carry_T.episode.fitness[-1]),
        trace_T_B=carry_T.episode.trace_T_B[-1],
    )


def main(requests: Path, answer: Path) -> None:
    """Answer the requests of a file."""
    os.environ.update(xla_cache_settings())
    spec, wanted = pickle.loads(requests.read_bytes())
    answer.write_bytes(pickle.dumps(record(spec, wanted)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
