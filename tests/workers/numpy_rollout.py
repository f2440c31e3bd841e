"""A rollout that the service does not ship: PointMaze in Python and NumPy, one episode after another, without JAX.

`NO_JAX` is the content of a `sitecustomize.py` with which no new process has JAX; with `REGISTERING` each has this
rollout, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from es_service.protocol.episodes import OF_STEPS
from es_service.protocol.messages import SIGNS, TRACE_POINTS, PolicySpec, TaskSpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, evaluation_reset_keys, normal_integers, normals, uniforms
from es_service.protocol.policies import explicit
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from tests.references import point_maze
from workers.compiling import Compilable
from workers.policy import act, action, drawn_action, normalise, split_layers
from workers.rollouts.backend import ChunkFunctions, Episodes, RolloutBackend

NO_JAX = """
import sys

class NoJax:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jax", "jaxlib", "brax", "llvmlite"):
            raise ImportError(f"{name} is not needed")

sys.meta_path.insert(0, NoJax())
"""
REGISTERING = f"""{NO_JAX}
from tests.workers.numpy_rollout import NumPy
from workers.rollouts import BACKENDS
BACKENDS["numpy"] = NumPy()
"""


class NumPy(RolloutBackend):
    """Scalars in float64 for the maze, NumPy for the policy."""

    name = "numpy"
    compile_s = (1, 1)
    chunk_pairs = (1, 2)

    def why_not(self, task: TaskSpec, policy: PolicySpec) -> str:
        """It knows one task, and no memory."""
        if task.name != "point_maze":
            return "it knows no other task than point_maze"
        return "a policy of it has no memory" if policy.memory else ""

    def chunk_functions(self, spec: WorkerSpec) -> ChunkFunctions:
        """Loops over the episodes of a chunk."""

        def training(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
            def member(p: int, sign: float, s: int) -> list[Episodes]:
                noise_D = normal_integers(np, noise_keys_P[p], np.arange(centre_D.size, dtype=np.uint32))
                parameters_D = centre_D + np.float32(sign) * unit * noise_D.astype(np.float32)
                keys_E = zip(reset_keys_P_S_E[p, s], action_keys_P_S_E[p, s], strict=True)
                return [episode(spec, parameters_D, mean_O, std_O, *keys)[0] for keys in keys_E]

            def pair(p: int) -> Episodes:
                return stacked([stacked(member(p, sign, s)) for s, sign in enumerate(SIGNS)])

            return stacked([pair(p) for p in range(len(noise_keys_P))])

        def evaluation(centre_D, mean_O, std_O, reset_keys_E, wanted_E):
            return stacked([episode(spec, centre_D, mean_O, std_O, key)[0] for key in reset_keys_E])

        def policies(given, mean_L_O, std_L_O, policy_L, reset_keys_L):
            lanes = zip(explicit(given)[policy_L], mean_L_O, std_L_O, reset_keys_L, strict=True)
            return stacked([episode(spec, *lane)[0] for lane in lanes])

        def gradient_sum(weights_P, noise_keys_P):
            return sum(
                weight * normals(key, spec.policy.parameters)
                for weight, key in zip(weights_P, noise_keys_P, strict=True)
            )

        return ChunkFunctions(*(Compilable(f, lambda *_: None) for f in (training, evaluation, policies, gradient_sum)))

    def record(self, spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
        """The same loop, of which it keeps the places."""

        def one(request: RecordRequest) -> Recording:
            centre = request.centre
            key = evaluation_reset_keys(request.seed, centre.generation, request.episode, request.ask, request.policy)
            of_policy = (centre.parameters_D, centre.observation_mean_O, centre.observation_std_O)
            found, places_T_B, rewards_T = episode(spec, *of_policy, key)
            returns_T = np.cumsum([0.0, *rewards_T], dtype=np.float32)
            return Recording(places_T_B, returns_T, None, float(found.fitness), found.trace_T_B)

        return Recordings(tuple(map(one, requests)), None)

    def random_steps(self, task: TaskSpec, options: Mapping[str, Any], batch: int, steps: int) -> Callable[[int], int]:
        """Steps of each environment of the batch, one after another."""

        def call(number: int) -> int:
            rng = np.random.default_rng(number)
            for actions_T_A in rng.uniform(-1.0, 1.0, (batch, steps, 2)):
                x, y = 0.0, -0.9
                for action_A in actions_T_A:
                    x, y, _, _ = point_maze.step(x, y, action_A)
            return batch * steps

        return call


def episode(
    spec: WorkerSpec, parameters_D: Any, mean_O: Any, std_O: Any, reset_key: Any, action_key: Any = None
) -> tuple[Episodes, Any, list[float]]:
    """(results, places [T + 1, B] from the reset on, rewards) of an episode; with an action key, one of training."""
    layers, start = split_layers(spec.policy, parameters_D), uniforms(reset_key, np.arange(2, dtype=np.uint32))
    x, y = -0.1 + 0.2 * float(start[0]), -1.0 + 0.3 * float(start[1])
    places, rewards, seen, actions, done = [(x, y)], [], [], [], False
    while len(rewards) < spec.episode_steps and not done:
        seen.append(np.array([x, y], np.float32))
        outputs, _ = act(np, spec.policy, layers, None, normalise(np, seen[-1], mean_O, std_O, spec.observation_clip))
        action_A = action(np, spec.policy.output, outputs)
        if action_key is not None:
            coordinates_A = np.arange(2, dtype=np.uint32) + np.uint32(2 * len(rewards))
            noise_A = normal_integers(np, action_key, coordinates_A).astype(np.float32)
            drawn_A = drawn_action(np, spec.policy.output, outputs, action_key, coordinates_A)
            action_A = drawn_A + np.float32(spec.action_noise / NORMAL_STD) * noise_A
        x, y, reward, done = point_maze.step(x, y, (float(action_A[0]), float(action_A[1])))
        places.append((x, y))
        actions.append(action_A)
        rewards.append(reward)
    places_T_B, returns, shifted_T_O = np.array(places, np.float32), np.float32(sum(rewards)), np.array(seen) - mean_O
    points = min(TRACE_POINTS, spec.episode_steps + 1)
    at_T = np.minimum(np.arange(points) * spec.episode_steps // (points - 1), len(rewards))
    none = mean_O[:0]
    sums = (none, none) if action_key is None else (shifted_T_O.sum(axis=0), np.square(shifted_T_O).sum(axis=0))

    def padded(steps: Any) -> Any:
        array = np.array(steps, np.float32)
        return np.concatenate([array, np.full((spec.episode_steps - len(array), *array.shape[1:]), 7.0, np.float32)])

    named = {
        "success": np.bool_(done),
        "last_reward": np.float32(rewards[-1]),
        "first_observation": places_T_B[0],
        "last_observation": places_T_B[-1],
        "observation": padded(seen),
        "action": padded(actions),
        "reward": padded(rewards),
        "done": np.array([*[False] * (len(rewards) - 1), done, *[False] * (spec.episode_steps - len(rewards))]),
        "step_descriptor": padded(places[1:]),
    }
    found = Episodes(
        fitness=np.float32(rewards[-1]) if spec.fitness == "final" else returns,
        returns=returns,
        descriptor=places_T_B[-1],
        steps=np.int32(len(rewards)),
        goal_distance=np.array([-rewards[-1], -max(rewards)], np.float32),
        shifted_sum_O=sums[0],
        shifted_square_sum_O=sums[1],
        trace_T_B=places_T_B[at_T if action_key is None else at_T[:0]],
        outputs={name: named[name] for name in spec.outputs if name not in OF_STEPS},
        of_steps={name: named[name] for name in spec.outputs if name in OF_STEPS},
    )
    return found, places_T_B, rewards


def stacked(episodes: Sequence[Episodes]) -> Episodes:
    """Episodes along a new first axis."""
    arrays = (np.stack(arrays) for arrays in zip(*(one[:-4] for one in episodes), strict=True))
    named = (
        {name: np.stack([one[field][name] for one in episodes]) for name in episodes[0][field]} for field in (-4, -3)
    )
    return Episodes._make([*arrays, *named, None, ()])
