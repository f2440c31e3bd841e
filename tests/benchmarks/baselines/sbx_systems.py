"""The systems that sbx learns: TD3, SAC, and SAC with the intrinsic reward of random network distillation (RND).

Settings are those of Fujimoto et al. 2018 (TD3), Haarnoja et al. 2018 (SAC) and Burda et al. 2018 (RND), as far as they
name one; networks are those of the tables of our own methods.

Axes: N environments, O observation, F features of RND.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import NDArray
from sbx import SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnvWrapper

from es_service.environments.sb3 import SB3VecEnv
from tests.benchmarks.baselines.run import SIZES, Sizes

BUFFER = 1_000_000
"""Transitions that are kept."""


def td3(envs: Any, sizes: Sizes, seed: int, buffer: int) -> Any:
    """TD3 with exploration noise of 0.1."""
    actions = envs.action_space.shape[0]
    noise = NormalActionNoise(np.zeros(actions), np.full(actions, 0.1))
    return TD3("MlpPolicy", envs, action_noise=noise, **_settings(sizes, seed, buffer))


def sac(envs: Any, sizes: Sizes, seed: int, buffer: int) -> Any:
    """SAC whose entropy coefficient is learnt."""
    return SAC("MlpPolicy", envs, **_settings(sizes, seed, buffer))


def _settings(sizes: Sizes, seed: int, buffer: int) -> dict[str, Any]:
    return {
        "learning_rate": 3e-4,
        "buffer_size": buffer,
        "learning_starts": sizes.random_steps,
        "batch_size": 256,
        "gamma": 0.99,
        "tau": 0.005,
        "train_freq": 1,
        "gradient_steps": sizes.updates,
        "policy_kwargs": {"net_arch": list(sizes.network)},
        "seed": seed,
        "device": "cpu",
    }


class Distillation(VecEnvWrapper):
    """Adds to each reward how badly a network predicts the features that a random network has of the observation.

    The error is divided by its running standard deviation and multiplied with WEIGHT. Observations are normalised by
    running statistics and clipped to [-5, 5], as in the paper. The predictor does one update with the observations of
    each step. Rewards lie in the learner's buffer as they were when they were seen, since a fresh error for each batch
    would need the learner's code.
    """

    WEIGHT = 0.5
    FEATURES, HIDDEN, RATE = 64, 128, 1e-4

    def __init__(self, envs: Any, seed: int) -> None:
        super().__init__(envs)
        size = envs.observation_space.shape[0]
        target, predictor = (_network(key, size) for key in jax.random.split(jax.random.PRNGKey(seed)))
        optimiser = optax.adam(self.RATE)
        self._count, self._mean_O, self._square_O = 1e-4, np.zeros(size), np.ones(size)
        self._errors = (1e-4, 0.0, 1.0)
        self._predictor, self._state = predictor, optimiser.init(predictor)

        @jax.jit
        def errors(predictor: Any, x_N_O: Any) -> Any:
            return jnp.mean((_features(predictor, x_N_O) - _features(target, x_N_O)) ** 2, axis=1)

        @jax.jit
        def learnt(predictor: Any, state: Any, x_N_O: Any) -> tuple[Any, Any]:
            changes, state = optimiser.update(jax.grad(lambda weights: errors(weights, x_N_O).mean())(predictor), state)
            return optax.apply_updates(predictor, changes), state

        self._error_of, self._learnt = errors, learnt

    def reset(self) -> NDArray[np.float32]:
        """Reset the environments."""
        return self.venv.reset()

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:
        """Step the environments; an observation that ended an episode is that end, not the next beginning."""
        observation_N_O, reward_N, done_N, infos = self.venv.step_wait()
        reached_N_O = observation_N_O.copy()
        for lane in np.flatnonzero(done_N):
            reached_N_O[lane] = infos[lane]["terminal_observation"]
        self._count, self._mean_O, self._square_O = _merged(
            (self._count, self._mean_O, self._square_O), reached_N_O.astype(np.float64)
        )
        deviation_O = np.sqrt(self._square_O / self._count) + 1e-8
        x_N_O = np.clip((reached_N_O - self._mean_O) / deviation_O, -5.0, 5.0).astype(np.float32)
        error_N = np.asarray(self._error_of(self._predictor, x_N_O), np.float64)
        self._errors = _merged(self._errors, error_N)
        self._predictor, self._state = self._learnt(self._predictor, self._state, x_N_O)
        extra_N = self.WEIGHT * error_N / (np.sqrt(self._errors[2] / self._errors[0]) + 1e-8)
        return observation_N_O, (reward_N + extra_N).astype(np.float32), done_N, infos

    def get_state(self) -> Any:
        """What it has learnt, to be pickled."""
        arrays = jax.tree.map(np.asarray, (self._predictor, self._state))
        return arrays, (self._count, self._mean_O, self._square_O), self._errors

    def set_state(self, state: Any) -> None:
        """Go on from what `get_state` has returned."""
        (self._predictor, self._state), (self._count, self._mean_O, self._square_O), self._errors = state


def _network(key: Any, size: int) -> list[tuple[Any, Any]]:
    widths = (size, Distillation.HIDDEN, Distillation.HIDDEN, Distillation.FEATURES)
    keys = jax.random.split(key, len(widths) - 1)
    return [
        (jax.random.normal(layer_key, (before, after)) * np.sqrt(2.0 / before), jnp.zeros(after))
        for layer_key, before, after in zip(keys, widths[:-1], widths[1:], strict=True)
    ]


def _features(layers: Any, x_N_O: Any) -> Any:
    for weights, biases in layers[:-1]:
        x_N_O = jax.nn.relu(x_N_O @ weights + biases)
    weights, biases = layers[-1]
    return x_N_O @ weights + biases


def _merged(before: tuple[float, Any, Any], values_N: NDArray[np.float64]) -> tuple[float, Any, Any]:
    """(count, mean, sum of squared differences) of what came before and of new values. Source: Chan et al. 1983."""
    count, mean, square = before
    new, total = values_N.mean(axis=0), count + len(values_N)
    step = new - mean
    square = square + ((values_N - new) ** 2).sum(axis=0) + step**2 * (count * len(values_N) / total)
    return total, mean + step * (len(values_N) / total), square


@dataclass(frozen=True)
class System:
    """A learner, and what its environments are wrapped with."""

    learner: Callable[[Any, Sizes, int, int], Any]
    is_wrapped: bool
    settings: str


_BOTH = "batch 256, buffer 1e6, learning rate 3e-4, gamma 0.99"
SYSTEMS: Mapping[str, System] = {
    "td3": System(td3, False, f"{_BOTH}, exploration noise 0.1"),
    "sac": System(sac, False, f"{_BOTH}, entropy learnt"),
    "rnd": System(sac, True, f"{_BOTH}, SAC, intrinsic reward {Distillation.WEIGHT} x normalised error"),
}


def made(system: str, task: str, seed: int, buffer: int = BUFFER) -> tuple[Any, SB3VecEnv, Distillation | None]:
    """A new learner, its environments, and their wrapper if it has one."""
    sizes, chosen = SIZES[task], SYSTEMS[system]
    envs = SB3VecEnv(task, sizes.environments)
    wrapper = Distillation(envs, seed) if chosen.is_wrapped else None
    return chosen.learner(wrapper or envs, sizes, seed, buffer), envs, wrapper
