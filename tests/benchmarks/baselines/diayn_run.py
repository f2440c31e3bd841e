"""A run of DIAYN by QDax, whose environments step in XLA: it rewards skills that are told apart, and no return.

Axes: N environments, K skills.
"""

from __future__ import annotations

import functools
import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State, Wrapper
from qdax.baselines.diayn import DIAYN, DiaynConfig
from qdax.core.neuroevolution.buffers.buffer import QDTransition, ReplayBuffer
from qdax.core.neuroevolution.sac_td3_utils import do_iteration_fn, warmstart_buffer

from tests.benchmarks.baselines.policies import of_skills
from tests.benchmarks.baselines.run import SIZES, Facts, Found, Run, chosen_and_certified, relu_config
from workers.brax_view import TaskBraxEnv, wrap

SKILLS = 5
"""QDax's default."""
ENVIRONMENTS = 80
"""For each skill as many, and one update for 16 of them."""
UPDATES = ENVIRONMENTS // 16
BUFFER = 1_000_000


class DiaynRun(Run):
    """A learner with its environments. What it has found is the best of its skills, by their return."""

    chunk = 200 * ENVIRONMENTS

    def __init__(self, task: str, system: str, seed: int, folder: Path, buffer: int = BUFFER) -> None:
        """`buffer`: number of transitions that are kept, a multiple of `ENVIRONMENTS`."""
        sizes = SIZES[task]
        self._network = sizes.network
        self._first_steps = math.lcm(sizes.random_steps, ENVIRONMENTS)  # which divides the buffer
        self._config = relu_config(task, seed)
        view = TaskBraxEnv(task)
        length = view.task.episode_steps
        environments = _StateDescriptor(wrap(view, length))
        self._actions = view.action_size
        settings = DiaynConfig(
            batch_size=256,
            episode_length=length,
            discount=0.99,
            num_skills=SKILLS,
            critic_hidden_layer_size=self._network,
            policy_hidden_layer_size=self._network,
        )
        learner = DIAYN(settings, view.action_size)
        key, first = jax.random.split(jax.random.PRNGKey(seed))
        descriptors = len(view.task.descriptor_names)
        learnt = learner.init(key, view.action_size, view.observation_size, descriptors)
        inputs = view.observation_size + SKILLS
        transition = QDTransition.init_dummy(inputs, view.action_size, descriptors)
        play = functools.partial(
            learner.play_step_fn,
            skills=jnp.tile(jnp.eye(SKILLS), (ENVIRONMENTS // SKILLS, 1)),
            env=environments,
        )
        self._state = (
            learnt,
            jax.jit(environments.reset)(jax.random.split(first, ENVIRONMENTS)),
            Ring.init(buffer, transition),
        )
        self._steps = 0

        @functools.partial(jax.jit, static_argnums=1, donate_argnums=0)
        def learn(state: Any, iterations: int) -> Any:
            def once(state: Any, _: None) -> tuple[Any, None]:
                after = do_iteration_fn(
                    *state,
                    env_batch_size=ENVIRONMENTS,
                    grad_updates_per_step=UPDATES / ENVIRONMENTS,
                    play_step_fn=play,
                    update_fn=learner.update,
                )
                return after[:3], None

            return jax.lax.scan(once, state, length=iterations)[0]

        self._learn, self._play = learn, play
        self.facts = Facts(
            UPDATES / ENVIRONMENTS,
            self._network,
            f"{SKILLS} skills, batch 256, buffer 1e6, learning rate 3e-4, gamma 0.99, entropy learnt",
            ("qdax",),
        )
        super().__init__(task, system, seed, folder)

    @property
    def steps(self) -> int:
        """Environment steps of all sessions."""
        return self._steps

    def advance(self, steps: int) -> None:
        """Learn for so many environment steps; the first ones fill the buffer without an
        update."""
        if not self._steps:
            learnt, environments, buffer = self._state
            buffer, environments, learnt = warmstart_buffer(
                buffer, learnt, environments, self._play, self._first_steps, ENVIRONMENTS
            )
            self._state = learnt, environments, buffer
            self._steps = self._first_steps
        else:
            iterations = -(-steps // ENVIRONMENTS)
            self._state = jax.block_until_ready(self._learn(self._state, iterations))
            self._steps += iterations * ENVIRONMENTS

    def write(self, folder: Path) -> None:
        """Write networks, environments and buffer."""
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(self._state)]
        (folder / "learner.pkl").write_bytes(pickle.dumps((leaves, self._steps)))

    def read(self, folder: Path) -> None:
        """Go on from what `write` has written."""
        leaves, self._steps = pickle.loads((folder / "learner.pkl").read_bytes())
        self._state = jax.tree.unflatten(jax.tree.structure(self._state), [jnp.asarray(leaf) for leaf in leaves])

    def certified(self, episodes: int) -> Found:
        """The best of the skills, each with its mean action."""
        [layers] = self._state[0].policy_params["params"].values()
        return chosen_and_certified(of_skills(layers, SKILLS, self._actions), self._config, episodes)


class Ring(ReplayBuffer):
    """The buffer of QDax without its shift of all rows at each insertion, which is none if the sizes divide."""

    def insert(self, transitions: QDTransition) -> Ring:
        """Put transitions in the place of the oldest ones."""
        rows = transitions.flatten().reshape(-1, self.data.shape[-1])
        if self.buffer_size % len(rows):
            raise ValueError(f"{len(rows)} rows do not divide the {self.buffer_size} of the buffer")
        return self.replace(
            data=jax.lax.dynamic_update_slice_in_dim(self.data, rows, self.current_position, axis=0),
            current_position=(self.current_position + len(rows)) % self.buffer_size,
            current_size=jnp.minimum(self.current_size + len(rows), self.buffer_size),
        )


class _StateDescriptor(Wrapper):
    """Names the descriptor as QDax does."""

    def reset(self, rng: jax.Array) -> State:
        return _named(self.env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        return _named(self.env.step(state, action))


def _named(state: State) -> State:
    return replace(state, info=state.info | {"state_descriptor": state.info["descriptor"]})
