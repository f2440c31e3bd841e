"""Our tasks as environments of Brax, for programs that train on these, and a wrapper with a random start each episode.

Brax's own `AutoResetWrapper` returns to the first state of each environment for ever, so that training on N
environments sees N starts. `wrap`, to be given to trainers as `wrap_env_fn`, has resets of the task instead.

Axes: N environments, O observation, A action, B descriptor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp

from es_service.protocol.messages import TaskSpec
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import OptionValue, defaults_of
from workers.environments import make_environment
from workers.environments.brax_task import quietly
from workers.lanes import task_named
from workers.lanes.blocks import LaneResults, lane_functions

with quietly():
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

_KEYS = "reset_key"
"""Entry of `info` with the key of an environment's next reset."""


class TaskBraxEnv(Env):
    """A task as an environment of Brax: one environment in JAX, which Brax's wrappers batch.

    `info` has `descriptor` [B], `success` and, if the task has a goal, `goal_distance`. Under a wrapper that resets,
    these are still of the end of the episode in the step that ends it. Actions outside of [-1, 1] are clipped. There is
    no limit of steps but that of the wrapper; the task's own is `task.episode_steps`. The physics are those of simd,
    but the last bits are those of the caller's XLA.
    """

    def __init__(self, task: str, *, task_options: Mapping[str, OptionValue] | None = None) -> None:
        """Make the functions of the task.

        Args:
            task: a shipped task (point_maze, ant_maze, ant_trap), `brax:NAME`, `mujoco:ID`, or module:Class of a class
                in JAX.
            task_options: options of the task, such as {"start": "corner"}.

        Raises:
            TaskError: there is no such task or option.
        """
        chosen = dict(task_options or {})
        self.task: TaskSpec = task_named(task, chosen)
        options = defaults_of(self.task.options) | chosen
        self._backend = str(options.get("backend", "spring"))
        self._functions = lane_functions(make_environment(task, options))

    def reset(self, rng: jax.Array) -> State:
        """The start of an episode, which depends on the key alone."""
        carry: Any
        carry, seen = self._functions.begin(jax.random.bits(rng, (KEY_WORDS,), jnp.uint32))
        return State(carry, seen.observation, jnp.float32(0.0), jnp.float32(0.0), {}, self._info(seen))

    def step(self, state: State, action: jax.Array) -> State:
        """The state after an action [A]."""
        carry, seen = self._functions.step(cast(Any, state.pipeline_state), action)
        return replace(
            state,
            pipeline_state=cast(Any, carry),
            obs=seen.observation,
            reward=seen.reward,
            done=seen.done.astype(jnp.float32),
            info=state.info | self._info(seen),
        )

    @property
    def observation_size(self) -> int:
        return self.task.observation_size

    @property
    def action_size(self) -> int:
        return self.task.action_size

    @property
    def backend(self) -> str:
        """The option `backend` of a task of Brax; of others the physics of the shipped ants."""
        return self._backend

    def _info(self, seen: LaneResults) -> dict[str, Any]:
        distance = {"goal_distance": seen.goal_distance} if self.task.has_goal else {}
        return {"descriptor": seen.descriptor, "success": seen.success} | distance


class RandomResets(Wrapper):
    """Begins a new episode, with a start that no earlier one had, in each of N environments whose episode has ended.

    It has the place and the conventions of Brax's `AutoResetWrapper`. All environments are reset if one has to be,
    since XLA computes whole batches.
    """

    def reset(self, rng: jax.Array) -> State:
        """States of N environments from as many keys."""
        first, later = _split(rng)
        state = self.env.reset(first)
        return replace(state, info=state.info | {_KEYS: later})

    def step(self, state: State, action: jax.Array) -> State:
        """States after actions [N, A]; an environment whose episode ends has its next start as observation."""
        info = dict(state.info)
        keys = info.pop(_KEYS)
        if "steps" in info:
            info["steps"] = jnp.where(state.done > 0.5, jnp.zeros_like(info["steps"]), info["steps"])
        after = self.env.step(replace(state, done=jnp.zeros_like(state.done), info=info), action)
        is_over_N = after.done > 0.5

        def reset(keys: jax.Array) -> tuple[Any, Any, jax.Array]:
            now, later = _split(keys)
            start = self.env.reset(now)

            def chosen(new: Any, old: Any) -> Any:
                return jnp.where(is_over_N.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            begun = (start.pipeline_state, start.obs, later)
            return jax.tree.map(chosen, begun, (after.pipeline_state, after.obs, keys))

        def go_on(keys: jax.Array) -> tuple[Any, Any, jax.Array]:
            return after.pipeline_state, after.obs, keys

        carry, obs, keys = jax.lax.cond(is_over_N.any(), reset, go_on, keys)
        return replace(after, pipeline_state=carry, obs=obs, info=after.info | {_KEYS: keys})


def wrap(env: Env, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: None = None) -> Wrapper:
    """What `brax.envs.training.wrap` returns, with `RandomResets`; for the argument `wrap_env_fn` of Brax's trainers.

    Raises:
        ValueError: a `randomization_fn` is given, which would change a system that our tasks do not have.
    """
    if randomization_fn is not None:
        raise ValueError("randomization_fn must be None: the tasks have no brax.System whose constants it could change")
    return RandomResets(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


def _split(keys_N: jax.Array) -> tuple[jax.Array, jax.Array]:
    both = jax.vmap(jax.random.split)(keys_N)
    return both[:, 0], both[:, 1]
