"""Whole episodes of tasks by MJX against C MuJoCo behind Gymnasium's interface: returns, lengths, descriptors.

The tasks are Gymnasium's own, and AntMaze and AntTrap with `physics: mujoco`. Both sides have the same linear policies:
500 random ones, one for each episode, and one of a short training with ours. Starts are those of each side, so the
distributions are compared and not the episodes.
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
from workers.environments import SHIPPED, Environment, make_environment, mujoco_gym
from workers.environments.mujoco_gym_tasks import TASKS
from workers.simd.episodes.kernel import compile_kernel

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated")]
EPISODES, REPEATS = 500, 4
"""Episodes of Gymnasium, and how many of ours there are for each."""
STEPS = {"Ant-v5": 300, "ant_maze": 1000}
"""Most steps of an episode, where they are fewer than the task's: C MuJoCo needs minutes for more."""
SIGMA = {"Ant-v5": 0.01}
"""Perturbations of the training, and its step, where they are not 0.05: an ant that stands falls over with more."""
SEEN = 27
"""Most numbers of an observation that policies see, the first; the others are forces on the bodies of an ant."""
LEVEL = 0.01
"""Probability that one of all tests fails if both sides are the same (Bonferroni)."""
ANTS = {"ant_maze": "AntMazeMujoco-v0", "ant_trap": "AntTrapMujoco-v0"}
"""Our tasks, and their names in C MuJoCo."""
TESTS = (len(TASKS) + len(ANTS)) * 2 * 4
"""Kolmogorov-Smirnov tests of all tasks: with two kinds of policies each, of a return, a length and two descriptors."""
WITHIN = 0.2
"""Standard deviations within which the 90 % interval of a difference of means must lie."""


class Episodes(NamedTuple):
    """What N episodes ended with."""

    returns: np.ndarray
    length: np.ndarray
    descriptor: np.ndarray
    """[N, dimension]"""


class Pair(NamedTuple):
    """A task by MJX and the same in C MuJoCo."""

    name: str
    ours: Environment
    theirs: Any
    descriptor: Callable[[Any, dict[str, Any]], np.ndarray]
    """Function from their environment and its `info` to the descriptor of an episode that ends there."""
    most_steps: int

    @property
    def policy_shape(self) -> tuple[int, int]:
        """(numbers of an action, numbers of an observation that are seen)."""
        observations, actions = self.theirs.observation_space, self.theirs.action_space
        return actions.shape[0], min(SEEN, observations.shape[0])


def pair_of(name: str) -> Pair:
    if name in ANTS:
        theirs = gymnasium.make(f"es_service.gymnasium:es_service/{ANTS[name]}").unwrapped
        ours, steps = make_environment(name, {"physics": "mujoco"}), STEPS.get(name, SHIPPED[name].episode_steps)
        return Pair(name, ours, theirs, lambda _, info: info["descriptor"], steps)
    theirs, ours = gymnasium.make(name).unwrapped, make_environment(f"mujoco:{name}", {})
    *_, places = next(iter(mujoco_gym._descriptors(theirs.model).values()))
    steps = STEPS.get(name, TASKS[name].episode_steps)
    return Pair(name, ours, theirs, lambda environment, _: environment.data.qpos[places].copy(), steps)


def our_episodes(pair: Pair) -> Callable[[np.ndarray, np.ndarray], Episodes]:
    """Function from policies [N, action, seen] and reset keys [N] to episodes."""
    environment = pair.ours
    key, policy = jax.ShapeDtypeStruct((4,), np.uint32), jax.ShapeDtypeStruct(pair.policy_shape, np.float32)

    def step(policy: Any, state: Any) -> tuple[Any, ...]:
        action = jnp.tanh(policy @ environment.observe(state)[: policy.shape[1]])
        state, reward, done = environment.step(state, action)
        return state, reward, done, environment.descriptor(state)

    begin = compile_kernel(environment.reset, key)
    advance = compile_kernel(step, policy, jax.eval_shape(environment.reset, key))

    def run(policies: np.ndarray, keys: np.ndarray) -> Episodes:
        state, alive = begin(keys), np.ones(len(keys), bool)
        total, length, ends = np.zeros(len(keys)), np.zeros(len(keys), int), None
        for _ in range(pair.most_steps):
            state, reward, done, descriptor = advance(policies.astype(np.float32), state)
            total, length = total + np.where(alive, reward, 0.0), length + alive
            ends = descriptor if ends is None else np.where(alive[:, None], descriptor, ends)
            alive &= ~done
            if not alive.any():
                break
        assert ends is not None
        return Episodes(total, length, ends)

    return run


def episodes_of_c(pair: Pair, policies: np.ndarray) -> Episodes:
    """Episodes in C MuJoCo, of a policy each."""
    environment, rows = pair.theirs, []
    low, high = environment.action_space.low, environment.action_space.high
    for seed, policy in enumerate(policies):
        observation, info = environment.reset(seed=seed)
        total, length, done = 0.0, 0, False
        while not done and length < pair.most_steps:
            action = np.tanh(policy @ observation[: policy.shape[1]])
            observation, reward, done, _, info = environment.step((low + high) / 2 + (high - low) / 2 * action)
            total, length = total + reward, length + 1
        rows.append((total, length, pair.descriptor(environment, info)))
    return Episodes(*(np.array(column) for column in zip(*rows, strict=True)))


def trained(run: Callable[[np.ndarray, np.ndarray], Episodes], shape: tuple[int, int], sigma: float) -> np.ndarray:
    """A policy after twelve updates by random search (Mania et al. 2018, arXiv:1803.07055), seed 0."""
    rng, policy = np.random.default_rng(0), np.zeros(shape)
    for generation in range(12):
        noise = rng.normal(0.0, 1.0, (64, *shape))
        keys = stream_keys(0, Domain.TRAINING_RESET, generation, np.arange(64))
        plus, minus = (run(policy + sign * sigma * noise, keys).returns for sign in (1.0, -1.0))
        weights = (plus - minus) / (np.concatenate([plus, minus]).std() + 1e-9)
        policy = policy + sigma * np.tensordot(weights, noise, 1) / np.sqrt(len(noise))
    return policy


def compare(
    pair: Pair, kind: str, run: Callable[[np.ndarray, np.ndarray], Episodes], policies: np.ndarray
) -> list[str]:
    """What differs, in words; prints each comparison."""
    many = np.repeat(policies, REPEATS, axis=0)
    ours = run(many, stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(len(many))))
    theirs, wrong = episodes_of_c(pair, policies), []
    columns = {"return": (ours.returns, theirs.returns), "length": (ours.length, theirs.length)}
    for k in range(theirs.descriptor.shape[1]):
        columns[f"descriptor {k}"] = ours.descriptor[:, k], theirs.descriptor[:, k]
    for what, (our, their) in columns.items():
        assert np.isfinite(our).all(), what
        difference = our.reshape(-1, REPEATS).mean(1) - their
        spread, error = their.std() + 1e-9, difference.std() / np.sqrt(EPISODES)
        bound = (abs(difference.mean()) + 1.645 * error) / spread
        test = ks_2samp(our, their)
        print(f"{pair.name} {kind} {what}: {our.mean():.4g} and {their.mean():.4g}, spread {spread:.3g}, "
              f"KS {test.pvalue:.2g}, means within {bound:.3f}")  # fmt: skip
        if test.pvalue < LEVEL / TESTS:
            wrong.append(f"{kind} {what}: KS p = {test.pvalue:.2g}")
        if bound > WITHIN and spread > 1e-6:
            wrong.append(f"{kind} {what}: means within {bound:.3f}")
    return wrong


def check(name: str) -> None:
    pair = pair_of(name)
    run, shape = our_episodes(pair), pair.policy_shape
    rng = np.random.default_rng(1)
    random = rng.normal(0.0, 1.0, (EPISODES, *shape)) / np.sqrt(shape[1])
    wrong = compare(pair, "random", run, random)
    policy = trained(run, shape, SIGMA.get(name, 0.05))
    wrong += compare(pair, "trained", run, np.repeat(policy[None], EPISODES, axis=0))
    assert not wrong


@pytest.mark.long
def test_episodes_of_a_pendulum_are_gymnasiums():
    check("InvertedPendulum-v5")


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [name for name in (*TASKS, *ANTS) if name != "InvertedPendulum-v5"])
def test_episodes_of_any_task_are_those_of_c_mujoco(name: str):
    check(name)
