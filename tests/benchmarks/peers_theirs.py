"""One measurement of another program, by its public interface, in an environment of its own; `peers` starts it.

    ENVIRONMENT/bin/python -I tests/benchmarks/peers_theirs.py '{"kind": "evosax es", "pairs": 64, ...}'

Prints one line of JSON. This file imports nothing of es-service, and what it measures only where it is measured, since
each program has its own environment.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

NEEDED = {
    "qdax": ("qdax.tasks.brax_envs", "qdax.core.map_elites", "qdax.core.emitters.mees_emitter"),
    "mujoco": ("mujoco.rollout", "gymnasium"),
    "evosax": ("evosax.algorithms",),
    "envpool": ("envpool", "gymnasium"),
}
"""Modules without which an environment is not the one of its program."""
FRAME_SKIP = 5
"""Physics steps of a control step of gymnasium's ant (`MujocoEnv(frame_skip=5)`)."""


def versions(program: str, packages: Sequence[str]) -> dict[str, str]:
    """Versions of packages; raises ImportError if the program cannot be used."""
    for module in NEEDED[program]:
        importlib.import_module(module)
    return {package: metadata.version(package) for package in packages}


def per_second(
    call: Callable[[], object], units: int, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Units per second of a call that makes so many, again and again for about `seconds`; the first call, which
    compiles, does not count."""
    call()
    calls, start = 0, clock()
    while clock() - start < seconds or not calls:
        call()
        calls += 1
    return calls * units / (clock() - start)


def _qdax_task(task: str, steps: int, hidden: int) -> tuple[Any, Any, Callable]:
    """Environment, policy network and scoring function, whose episodes begin with a reset of their own."""
    import jax
    from qdax.tasks.brax_envs import create_default_brax_task_components

    environment, network, score, _ = create_default_brax_task_components(
        task, jax.random.PRNGKey(0), steps, (hidden, hidden), deterministic=False
    )
    return environment, network, score


def qdax_rollouts(task: str, steps: int, hidden: int, batch: int, seconds: float) -> dict[str, Any]:
    """Environment steps per second of QDax's scoring function: `batch` policies, one episode each.

    Transitions are not returned, so that XLA need not keep them.
    """
    import jax
    import jax.numpy as jnp

    environment, network, score = _qdax_task(task, steps, hidden)
    keys = jax.random.split(jax.random.PRNGKey(1), batch)
    policies = jax.vmap(network.init, in_axes=(0, None))(keys, jnp.zeros(environment.observation_size))
    scored = jax.jit(lambda policies, key: score(policies, key)[:2])
    rate = per_second(lambda: jax.block_until_ready(scored(policies, keys[0])), batch * steps, seconds)
    system = getattr(environment.unwrapped, "sys", None)  # PointMaze has none: it is no physics
    return {
        "env_steps_per_second": rate,
        "simulated_s_per_second": rate * float(system.config.dt) if system else None,
        "settings": f"batch {batch}",
    }


def qdax_me_es(pairs: int, generations: int, cells: Sequence[int]) -> dict[str, Any]:
    """Milliseconds per generation of ME-ES on PointMaze, all of whose generations are one compiled loop.

    A first loop of as many generations does not count.
    """
    import jax
    import jax.numpy as jnp
    from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
    from qdax.core.emitters.mees_emitter import MEESConfig, MEESEmitter
    from qdax.core.map_elites import MAPElites

    steps = 200
    environment, network, score = _qdax_task("pointmaze", steps, 64)
    emitter = MEESEmitter(MEESConfig(sample_number=2 * pairs), 2 * generations, score, num_descriptors=2)
    search = MAPElites(score, emitter, lambda repertoire: {"best": repertoire.fitnesses.max()})
    first = jax.vmap(network.init, in_axes=(0, None))(
        jax.random.split(jax.random.PRNGKey(1), 1), jnp.zeros(environment.observation_size)
    )
    centroids = compute_euclidean_centroids(tuple(cells), -1.0, 1.0)
    taken = _loop_seconds(search, search.init(first, centroids, jax.random.PRNGKey(2)), generations)
    return {
        "env_steps_per_second": generations * (2 * pairs + 1) * steps / taken,
        "ms_per_generation": 1000 * taken / generations,
        "settings": f"{2 * pairs} samples, {generations} generations",
    }


def qdax_map_elites(batch: int, generations: int, cells: Sequence[int]) -> dict[str, Any]:
    """Milliseconds per generation of MAP-Elites with iso+line variation on PointMaze, likewise."""
    import jax
    import jax.numpy as jnp
    from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
    from qdax.core.emitters.mutation_operators import isoline_variation
    from qdax.core.emitters.standard_emitters import MixingEmitter
    from qdax.core.map_elites import MAPElites

    steps = 200
    environment, network, score = _qdax_task("pointmaze", steps, 64)
    vary = functools.partial(isoline_variation, iso_sigma=0.005, line_sigma=0.05)
    emitter = MixingEmitter(lambda policies, key: (policies, key), vary, variation_percentage=1.0, batch_size=batch)
    search = MAPElites(score, emitter, lambda repertoire: {"best": repertoire.fitnesses.max()})
    first = jax.vmap(network.init, in_axes=(0, None))(
        jax.random.split(jax.random.PRNGKey(1), batch), jnp.zeros(environment.observation_size)
    )
    centroids = compute_euclidean_centroids(tuple(cells), -1.0, 1.0)
    taken = _loop_seconds(search, search.init(first, centroids, jax.random.PRNGKey(2)), generations)
    return {
        "env_steps_per_second": generations * batch * steps / taken,
        "ms_per_generation": 1000 * taken / generations,
        "settings": f"batch {batch}, {generations} generations",
    }


def _loop_seconds(search: Any, carry: Any, generations: int) -> float:
    """Seconds of a compiled loop of generations, after one of as many that does not count."""
    import jax

    loop = jax.jit(lambda carry: jax.lax.scan(search.scan_update, carry, (), length=generations)[0])
    carry = jax.block_until_ready(loop(carry))
    start = time.perf_counter()
    jax.block_until_ready(loop(carry))
    return time.perf_counter() - start


def mujoco_ant(integrator: str, cores: int, batch: int, control_steps: int, seconds: float) -> dict[str, Any]:
    """Steps per second of gymnasium's ant with random actions, each held for a control step, `cores` threads.

    The model's own integrator is RK4, which evaluates the dynamics four times in a step.
    """
    import gymnasium
    import mujoco
    import numpy as np
    from mujoco.rollout import rollout

    path = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "ant.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    random = np.random.default_rng(0)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    starts = np.zeros((batch, mujoco.mj_stateSize(model, kind)))
    data = mujoco.MjData(model)
    for start in starts:
        mujoco.mj_resetData(model, data)
        data.qpos += random.uniform(-0.1, 0.1, model.nq)
        mujoco.mj_getState(model, data, start, kind)
    controls = random.uniform(-1, 1, (batch, control_steps, model.nu)).repeat(FRAME_SKIP, axis=1)
    threads = [mujoco.MjData(model) for _ in range(cores)]
    rate = per_second(
        lambda: rollout(model, threads, starts, controls, persistent_pool=True), batch * control_steps, seconds
    )
    return {
        "env_steps_per_second": rate,
        "physics_steps_per_second": rate * FRAME_SKIP,
        "simulated_s_per_second": rate * FRAME_SKIP * model.opt.timestep,
        "settings": f"{cores} threads, batch {batch}, steps of {model.opt.timestep} s",
    }


ANT = "Ant-v5"
ANT_STEP_S = 0.05
"""Seconds of a control step of `Ant-v5`: five of 0.01 s."""


def _steps(envs: Any, count: int, seconds: float, clock: Callable[[], float] = time.perf_counter) -> float:
    """Steps a second of `count` environments side by side, which reset themselves, with random actions drawn before."""
    import numpy as np

    size = envs.action_space.shape[-1]
    actions = np.random.default_rng(0).uniform(-1, 1, (20, count, size)).astype(np.float32)
    envs.reset()

    def call() -> None:
        for action in actions:
            envs.step(action)

    return per_second(call, len(actions) * count, seconds)


def gymnasium_steps(mode: str, count: int, seconds: float) -> dict[str, Any]:
    """Steps per second of gymnasium's own ant in one of its vector environments: one process, or one for each ant."""
    import gymnasium

    envs = gymnasium.make_vec(ANT, num_envs=count, vectorization_mode=mode)
    rate = _steps(envs, count, seconds)
    envs.close()
    settings = f"{ANT}, {mode}, {count} environments"
    return {"env_steps_per_second": rate, "simulated_s_per_second": rate * ANT_STEP_S, "settings": settings}


def envpool_steps(
    cores: int, count: int, seconds: float, task: str = ANT, of_processor: bool = False
) -> dict[str, Any]:
    """Steps per second of EnvPool's environments with a thread per core, through gymnasium's interface.

    Args:
        of_processor: whether seconds are those of the processor, of all threads, instead of the clock's.
    """
    import envpool

    envs = envpool.make(task, env_type="gymnasium", num_envs=count, num_threads=cores)
    rate = _steps(envs, count, seconds, time.process_time if of_processor else time.perf_counter)
    settings = f"{task}, {cores} threads, {count} environments"
    return {
        "env_steps_per_second": rate,
        "simulated_s_per_second": rate * ANT_STEP_S if task == ANT else None,
        "settings": settings,
    }


def evosax_es(pairs: int, parameters: int, generations: int) -> dict[str, Any]:
    """Milliseconds per generation of OpenAI-ES's `ask` and `tell` in one compiled loop, for a fitness that costs
    nothing."""
    import jax
    import jax.numpy as jnp
    from evosax.algorithms import Open_ES

    search = Open_ES(population_size=2 * pairs, solution=jnp.zeros(parameters))
    params = search.default_params

    def generation(state: Any, key: Any) -> tuple[Any, None]:
        ask, tell = jax.random.split(key)
        population, state = search.ask(ask, state, params)
        return search.tell(tell, population, population[:, 0], state, params)[0], None

    keys = jax.random.split(jax.random.PRNGKey(1), generations)
    state = search.init(keys[0], jnp.zeros(parameters), params)
    loop = jax.jit(lambda state: jax.lax.scan(generation, state, keys)[0])
    rate = per_second(lambda: jax.block_until_ready(loop(state)), generations, 1.0)
    return {"ms_per_generation": 1000 / rate, "settings": f"{2 * pairs} members, {parameters} parameters"}


KINDS: Mapping[str, Callable[..., dict[str, Any]]] = {
    "qdax rollouts": qdax_rollouts,
    "qdax me_es": qdax_me_es,
    "qdax map_elites": qdax_map_elites,
    "mujoco ant": mujoco_ant,
    "gymnasium steps": gymnasium_steps,
    "envpool steps": envpool_steps,
    "evosax es": evosax_es,
    "versions": versions,
}


def main() -> None:
    asked = json.loads(sys.argv[1])
    print(json.dumps(KINDS[asked.pop("kind")](**asked)))


if __name__ == "__main__":
    main()
