"""Whole episodes of Gymnasium's MuJoCo by MJX against Gymnasium's own environments: returns, lengths, descriptors.

Both sides have the same linear policies: 500 random ones, one for each episode, and one of a short training with ours.
Starts are those of each side, so the distributions are compared and not the episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import ks_2samp

from es_service.protocol.noise import Domain, stream_keys
from workers.environments import make_environment, mujoco_gym
from workers.environments.mujoco_gym_tasks import TASKS
from workers.simd.episodes.kernel import compile_kernel

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated")]
EPISODES, REPEATS = 500, 4
"""Episodes of Gymnasium, and how many of ours there are for each."""
STEPS = {"Ant-v5": 300}
"""Most steps of an episode, where they are fewer than Gymnasium's: C MuJoCo needs minutes for more."""
SEEN = 27
"""Most numbers of an observation that policies see, the first; the others are forces on the bodies of an ant."""
LEVEL = 0.01
"""Probability that one of all tests fails if both sides are the same (Bonferroni)."""
TESTS = len(TASKS) * 2 * 4
"""Kolmogorov-Smirnov tests of all tasks: with two kinds of policies each, of a return, a length and two descriptors."""
WITHIN = 0.2
"""Standard deviations within which the 90 % interval of a difference of means must lie."""


class Episodes(NamedTuple):
    """What N episodes ended with."""

    returns: np.ndarray
    length: np.ndarray
    descriptor: np.ndarray
    """[N, dimension]"""


def most_steps(name: str) -> int:
    return STEPS.get(name, TASKS[name].episode_steps)


def our_episodes(name: str) -> Callable[[np.ndarray, np.ndarray], Episodes]:
    """Function from policies [N, action, seen] and reset keys [N] to episodes."""
    environment = make_environment(f"mujoco:{name}", {})
    key, policy = jax.ShapeDtypeStruct((4,), np.uint32), jax.ShapeDtypeStruct(policy_shape(name), np.float32)

    def step(policy: Any, state: Any) -> tuple[Any, ...]:
        action = jnp.tanh(policy @ environment.observe(state)[: policy.shape[1]])
        state, reward, done = environment.step(state, action)
        return state, reward, done, environment.descriptor(state)

    begin = compile_kernel(environment.reset, key)
    advance = compile_kernel(step, policy, jax.eval_shape(environment.reset, key))

    def run(policies: np.ndarray, keys: np.ndarray) -> Episodes:
        state, alive = begin(keys), np.ones(len(keys), bool)
        total, length, ends = np.zeros(len(keys)), np.zeros(len(keys), int), None
        for _ in range(most_steps(name)):
            state, reward, done, descriptor = advance(policies.astype(np.float32), state)
            total, length = total + np.where(alive, reward, 0.0), length + alive
            ends = descriptor if ends is None else np.where(alive[:, None], descriptor, ends)
            alive &= ~done
            if not alive.any():
                break
        assert ends is not None
        return Episodes(total, length, ends)

    return run


def policy_shape(name: str) -> tuple[int, int]:
    """(numbers of an action, numbers of an observation that are seen)."""
    environment = gymnasium.make(name)
    assert environment.observation_space.shape is not None
    assert environment.action_space.shape is not None
    return environment.action_space.shape[0], min(SEEN, environment.observation_space.shape[0])


def episodes_of_gymnasium(name: str, policies: np.ndarray) -> Episodes:
    environment: Any = gymnasium.make(name).unwrapped
    low, high = environment.action_space.low, environment.action_space.high
    *_, places = next(iter(mujoco_gym._descriptors(environment.model).values()))
    rows = []
    for seed, policy in enumerate(policies):
        observation, _ = environment.reset(seed=seed)
        total, length, done = 0.0, 0, False
        while not done and length < most_steps(name):
            action = np.tanh(policy @ observation[: policy.shape[1]])
            observation, reward, done, _, _ = environment.step((low + high) / 2 + (high - low) / 2 * action)
            total, length = total + reward, length + 1
        rows.append((total, length, environment.data.qpos[places].copy()))
    return Episodes(*(np.array(column) for column in zip(*rows, strict=True)))


def trained(run: Callable[[np.ndarray, np.ndarray], Episodes], shape: tuple[int, int]) -> np.ndarray:
    """A policy after twelve updates by random search (Mania et al. 2018, arXiv:1803.07055), seed 0."""
    rng, policy = np.random.default_rng(0), np.zeros(shape)
    for generation in range(12):
        noise = rng.normal(0.0, 1.0, (64, *shape))
        keys = stream_keys(0, Domain.TRAINING_RESET, generation, np.arange(64))
        plus, minus = (run(policy + sign * 0.05 * noise, keys).returns for sign in (1.0, -1.0))
        weights = (plus - minus) / (np.concatenate([plus, minus]).std() + 1e-9)
        policy = policy + 0.05 * np.tensordot(weights, noise, 1) / np.sqrt(len(noise))
    return policy


def compare(name: str, kind: str, run: Callable[[np.ndarray, np.ndarray], Episodes], policies: np.ndarray) -> list[str]:
    """What differs, in words; prints each comparison."""
    many = np.repeat(policies, REPEATS, axis=0)
    ours = run(many, stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(len(many))))
    theirs, wrong = episodes_of_gymnasium(name, policies), []
    columns = {"return": (ours.returns, theirs.returns), "length": (ours.length, theirs.length)}
    for k in range(theirs.descriptor.shape[1]):
        columns[f"descriptor {k}"] = ours.descriptor[:, k], theirs.descriptor[:, k]
    for what, (our, their) in columns.items():
        assert np.isfinite(our).all(), what
        difference = our.reshape(-1, REPEATS).mean(1) - their
        spread, error = their.std() + 1e-9, difference.std() / np.sqrt(EPISODES)
        bound = (abs(difference.mean()) + 1.645 * error) / spread
        test = ks_2samp(our, their)
        print(f"{name} {kind} {what}: {our.mean():.4g} and {their.mean():.4g}, spread {spread:.3g}, "
              f"KS {test.pvalue:.2g}, means within {bound:.3f}")  # fmt: skip
        if test.pvalue < LEVEL / TESTS:
            wrong.append(f"{kind} {what}: KS p = {test.pvalue:.2g}")
        if bound > WITHIN and spread > 1e-6:
            wrong.append(f"{kind} {what}: means within {bound:.3f}")
    return wrong


def check(name: str) -> None:
    run, shape = our_episodes(name), policy_shape(name)
    rng = np.random.default_rng(1)
    random = rng.normal(0.0, 1.0, (EPISODES, *shape)) / np.sqrt(shape[1])
    wrong = compare(name, "random", run, random)
    wrong += compare(name, "trained", run, np.repeat(trained(run, shape)[None], EPISODES, axis=0))
    assert not wrong


def test_episodes_of_a_pendulum_are_gymnasiums():
    check("InvertedPendulum-v5")


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [name for name in TASKS if name != "InvertedPendulum-v5"])
def test_episodes_of_any_task_are_gymnasiums(name: str):
    check(name)
