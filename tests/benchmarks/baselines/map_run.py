"""A run of PGA-ME or QD-PG: QDax's emitters ask for policies and learn from transitions, our workers run the episodes.

Axes: N policies of a generation, T steps of an episode, K steps of all episodes.
"""

from __future__ import annotations

import functools
import pickle
import sys
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from qdax.core.containers.archive import score_euclidean_novelty
from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
from qdax.core.emitters.mutation_operators import isoline_variation
from qdax.core.map_elites import MAPElites
from qdax.core.neuroevolution.buffers.buffer import QDTransition
from qdax.core.neuroevolution.networks.networks import MLP

import es_service
from es_service.protocol.messages import TaskSpec
from es_service.runs.evaluator import Transitions
from tests.benchmarks.baselines.policies import flat
from tests.benchmarks.baselines.run import SIZES, Facts, Found, Run, chosen_and_certified, relu_config

for _missing in ("", ".envs", ".envs.base_env"):  # of old Brax; QDax 0.5 needs it for one annotation
    sys.modules.setdefault(f"qdax.tasks.brax.v1{_missing}", types.ModuleType(f"qdax.tasks.brax.v1{_missing}"))
sys.modules["qdax.tasks.brax.v1.envs.base_env"].__dict__.setdefault("QDEnv", object)

from qdax.core.emitters.dpg_emitter import DiversityPGConfig  # noqa: E402
from qdax.core.emitters.pga_me_emitter import PGAMEConfig, PGAMEEmitter  # noqa: E402
from qdax.core.emitters.qdpg_emitter import QDPGEmitter, QDPGEmitterConfig  # noqa: E402
from qdax.core.emitters.qpg_emitter import QualityPGConfig  # noqa: E402

BATCH = 100
"""Policies of a generation."""
BUFFER = 1_000_000
CRITIC_STEPS = 300
GREEDY_STEPS = CRITIC_STEPS // 2
POLICY_STEPS = {"pga_me": 10, "qd_pg": 100}
"""Steps of the policy gradient for each offspring that has them: of the authors of PGA-ME, and of QDax."""
ISO, LINE = 0.005, 0.05
CELLS = (32, 32)
TOP = 10
"""Elites from which selection episodes choose, those with the highest fitness, as for our runs."""
ACCEPTANCE = {"point_maze": 0.1, "ant_maze": 2.0, "ant_trap": 1.0}
"""QD-PG: least distance between states in its archive, in the task's units; QDax's own for PointMaze."""
STATES = {"point_maze": 2_000, "ant_maze": 2_000, "ant_trap": 10_000}
"""QD-PG: size of that archive, QDax's own for AntTrap; in PointMaze no 700 states have that distance, and in AntMaze no
1,700. With 10,000, the distances to the 300,000 states of a generation in AntMaze do not fit into 24 GB."""
NEIGHBOURS = 5


class MapRun(Run):
    """A search with a map. What it has found is the best of the fittest elites."""

    chunk = 1

    def __init__(self, task: str, system: str, seed: int, folder: Path, buffer: int = BUFFER) -> None:
        """`buffer`: number of transitions that are kept, at least those of a generation."""
        self._config = relu_config(task, seed)
        network = SIZES[task].network
        self._evaluating = es_service.evaluator(self._config, transitions=True)
        self._evaluate = self._evaluating.__enter__()
        spec = self._evaluate.task
        self._episode_steps = spec.episode_steps
        self._policy = MLP((*network, spec.action_size), kernel_init=_LECUN, final_activation=jnp.tanh)
        emitter, batches = _emitter(task, system, self._policy, spec, network, buffer)
        self._search = MAPElites(None, emitter, lambda repertoire: {})
        self._ask, self._tell = jax.jit(self._search.ask), jax.jit(self._search.tell)
        self._observation_size = spec.observation_size
        low, high = np.asarray(spec.descriptor_bounds).T
        self._centroids = compute_euclidean_centroids(CELLS, low.tolist(), high.tolist())
        self._key = jax.random.PRNGKey(seed)
        self._steps, self._generation = 0, 0
        self._repertoire: Any = None
        self._emitter: Any = None
        self.facts = Facts(
            batches / (BATCH * spec.episode_steps),
            network,
            f"{BATCH} policies a generation, {CRITIC_STEPS} critic steps, {POLICY_STEPS[system]} steps an offspring, "
            f"batch 256, iso {ISO}, line {LINE}, {CELLS[0] * CELLS[1]} cells",
            ("qdax",),
        )
        super().__init__(task, system, seed, folder)

    @property
    def steps(self) -> int:
        """Environment steps of all sessions."""
        return self._steps

    def advance(self, steps: int) -> None:
        """One generation, whatever the number of steps; the first one is of random policies."""
        self._key, first, second = jax.random.split(self._key, 3)
        if self._repertoire is None:
            keys = jax.random.split(first, BATCH)
            asked, extra = jax.vmap(self._policy.init, in_axes=(0, None))(keys, jnp.zeros(self._observation_size)), {}
        else:
            asked, extra = self._ask(self._repertoire, self._emitter, first)
        result = self._evaluate(flat(asked["params"]), generation=self._generation)
        transitions = result.transitions
        assert transitions is not None
        scores = {"transitions": transitions_of(transitions, BATCH * self._episode_steps)}
        fitness_N, descriptor_N = result.fitness[:, 0], result.descriptor[:, 0]
        if self._repertoire is None:
            self._repertoire, self._emitter, _ = self._search.init_ask_tell(
                asked, fitness_N, descriptor_N, self._centroids, second, scores
            )
        else:
            self._repertoire, self._emitter, _ = self._tell(
                asked, fitness_N, descriptor_N, self._repertoire, self._emitter, scores, extra
            )
        jax.block_until_ready(self._emitter)
        self._steps += int(result.steps.sum())
        self._generation += 1

    def write(self, folder: Path) -> None:
        """Write map, networks and buffers."""
        arrays = jax.tree.map(np.asarray, (self._repertoire, self._emitter, self._key))
        (folder / "search.pkl").write_bytes(pickle.dumps((arrays, self._steps, self._generation)))

    def read(self, folder: Path) -> None:
        """Go on from what `write` has written."""
        arrays, self._steps, self._generation = pickle.loads((folder / "search.pkl").read_bytes())
        self._repertoire, self._emitter, self._key = jax.tree.map(jnp.asarray, arrays)

    def certified(self, episodes: int) -> Found:
        """The best of the fittest elites; the map has -inf where there is none."""
        self._evaluating.__exit__(None, None, None)
        fitness = np.asarray(self._repertoire.fitnesses).reshape(-1)
        fittest = [cell for cell in np.argsort(-fitness, kind="stable")[:TOP] if np.isfinite(fitness[cell])]
        elites = jax.tree.map(lambda array: np.asarray(array)[fittest], self._repertoire.genotypes["params"])
        return chosen_and_certified(flat(elites), self._config, episodes)


_LECUN = jax.nn.initializers.lecun_uniform()


def transitions_of(found: Transitions, rows: int) -> QDTransition:
    """Transitions as QDax has them, in so many rows.

    QDax compiles for one number of rows, and episodes that end early leave some free: these repeat others. A step to
    which no bootstrap belongs is marked as truncated, which QDax's loss leaves out. The descriptor before the first
    step, which workers do not give, is that after it.
    """
    steps = found.steps.reshape(-1)
    last_K = np.zeros(len(found.reward), bool)
    last_K[np.cumsum(steps) - 1] = True
    first_K = np.roll(last_K, 1)
    before_K_B = np.roll(found.descriptor, 1, axis=0)
    before_K_B[first_K] = found.descriptor[first_K]
    given = {
        "obs": found.observation,
        "next_obs": found.next_observation(),
        "rewards": found.reward,
        "dones": found.done.astype(np.float32),
        "truncations": (last_K & ~found.done).astype(np.float32),
        "actions": found.action,
        "state_desc": before_K_B,
        "next_state_desc": found.descriptor,
    }
    chosen = np.resize(np.arange(len(found.reward)), rows)
    return QDTransition(**{name: jnp.asarray(values[chosen]) for name, values in given.items()})


def _emitter(
    task: str, system: str, policy: MLP, spec: TaskSpec, network: tuple[int, ...], buffer: int
) -> tuple[Any, int]:
    """The emitter of a system, and the number of batches that it learns from in a generation."""
    environment: Any = types.SimpleNamespace(
        observation_size=spec.observation_size,
        action_size=spec.action_size,
        state_descriptor_length=len(spec.descriptor_names),
    )
    settings: dict[str, Any] = {
        "num_critic_training_steps": CRITIC_STEPS,
        "num_pg_training_steps": POLICY_STEPS[system],
        "replay_buffer_size": buffer,
        "critic_hidden_layer_size": network,
    }
    critic = CRITIC_STEPS + GREEDY_STEPS
    if system == "pga_me":
        variation = functools.partial(isoline_variation, iso_sigma=ISO, line_sigma=LINE)
        emitter = PGAMEEmitter(PGAMEConfig(env_batch_size=BATCH, **settings), policy, environment, variation)
        return emitter, critic + (BATCH // 2 - 1) * POLICY_STEPS[system]
    quality, diversity, mutated = 34, 33, 33
    config = QDPGEmitterConfig(
        QualityPGConfig(env_batch_size=quality, **settings),
        DiversityPGConfig(
            env_batch_size=diversity,
            archive_acceptance_threshold=ACCEPTANCE[task],
            archive_max_size=STATES[task],
            **settings,
        ),
        ISO,
        LINE,
        mutated,
    )
    novelty = functools.partial(score_euclidean_novelty, num_nearest_neighb=NEIGHBOURS, scaling_ratio=1.0)
    offspring = quality - 1 + diversity - 1
    return QDPGEmitter(config, policy, environment, novelty), 2 * critic + offspring * POLICY_STEPS[system]
