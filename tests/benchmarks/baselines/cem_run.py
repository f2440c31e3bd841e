"""A run of CEM-RL by evorl-jax, which has the GNU GPL: it is used as a program in its environment, and no part of it is
here.

Its environments step in XLA.
"""

from __future__ import annotations

import pickle
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import register_environment
from evorl.algorithms.erl.cemrl_td3.cemrl_origin import CEMRLWorkflow
from omegaconf import OmegaConf

from tests.benchmarks.baselines.policies import flat
from tests.benchmarks.baselines.run import SIZES, Facts, Found, Run, chosen_and_certified, relu_config
from workers.brax_view import TaskBraxEnv

MEMBERS = 10
LEARNERS = 5
"""Members of a generation that learn, from as many batches as the generation before had steps."""
BATCH = 100
RATE = 1e-3
NOISE = {"init": 1e-3, "final": 1e-5, "decay": 0.05}
"""Variance that is added to that of the elites, and how fast it falls."""


class CemRun(Run):
    """A search. What it has found is its centre, as the authors evaluate it: nothing is chosen.

    Settings are the authors', with the networks of the other systems; their code divides the variance of elites by the
    number of these, evorl's does not.
    """

    chunk = 1

    def __init__(self, task: str, system: str, seed: int, folder: Path, buffer: int = 1_000_000) -> None:
        """`buffer`: number of transitions that are kept."""
        sizes = SIZES[task]
        view = _WithActuator(task)
        name = f"es_service_{task}"
        register_environment(name, lambda: view)
        members_steps = MEMBERS * view.task.episode_steps
        self._config = relu_config(task, seed)
        layers = list(sizes.network)
        settings = {
            "env": {"env_type": "brax", "env_name": name, "max_episode_steps": view.task.episode_steps},
            "checkpoint": {"enable": False},
            "num_envs": 1,
            "normalize_obs": False,
            "discount": 0.99,
            "random_timesteps": 0,
            "batch_size": BATCH,
            "replay_buffer_capacity": buffer,
            "tau": 0.005,
            "exploration_epsilon": 0.1,
            "policy_noise": 0.2,
            "clip_policy_noise": 0.5,
            "actor_update_interval": 1,
            "critics_in_actor_loss": "first",
            "warmup_iters": max(1, 10_000 // members_steps),
            "pop_size": MEMBERS,
            "num_learning_offspring": LEARNERS,
            "num_elites": MEMBERS // 2,
            "cov_eps": NOISE,
            "weighted_update": True,
            "rank_weight_shift": 1.0,
            "mirror_sampling": False,
            "fitness_with_exploration": False,
            "episodes_for_fitness": 1,
            "rl_updates_frac": 1.0,
            "optimizer": {"lr": RATE, "grad_clip_norm": 0},
            "agent_network": {
                "norm_layer_type": "none",
                "num_critics": 2,
                "critic_hidden_layer_sizes": layers,
                "actor_hidden_layer_sizes": layers,
            },
            "num_eval_envs": 1,
            "eval_episodes": 1,
        }
        self._search = CEMRLWorkflow.build_from_config(OmegaConf.create(settings))
        self._state = self._search.setup(jax.random.PRNGKey(seed))
        self.facts = Facts(
            1.0 + LEARNERS,
            sizes.network,
            f"{MEMBERS} members, {LEARNERS} learn, batch {BATCH}, learning rate {RATE}, added variance "
            f"{NOISE['init']} to {NOISE['final']}",
            ("evorl-jax",),
        )
        super().__init__(task, system, seed, folder)

    @property
    def steps(self) -> int:
        """Environment steps of all sessions."""
        return int(self._state.metrics.sampled_timesteps)

    def advance(self, steps: int) -> None:
        """One generation, whatever the number of steps."""
        _, self._state = self._search.step(self._state)
        jax.block_until_ready(self._state)

    def write(self, folder: Path) -> None:
        """Write the state of the search, buffer included."""
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(self._state)]
        (folder / "search.pkl").write_bytes(pickle.dumps(leaves))

    def read(self, folder: Path) -> None:
        """Go on from what `write` has written."""
        leaves = pickle.loads((folder / "search.pkl").read_bytes())
        self._state = jax.tree.unflatten(jax.tree.structure(self._state), [jnp.asarray(leaf) for leaf in leaves])

    def certified(self, episodes: int) -> Found:
        """The centre."""
        [layers] = jax.tree.map(lambda array: np.asarray(array)[None], self._state.ec_opt_state.mean["params"]).values()
        return chosen_and_certified(flat(layers), self._config, episodes)


class _WithActuator(TaskBraxEnv):
    """The task with the range of its actions where evorl looks for it."""

    @cached_property
    def sys(self) -> Any:
        return SimpleNamespace(actuator=SimpleNamespace(ctrl_range=[[-1.0, 1.0]] * self.action_size))
