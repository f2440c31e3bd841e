"""AntMaze and AntTrap from above, with the ways of a few random policies.

python -m tests.benchmarks.task_pictures      # writes results/ant_maze.png and results/ant_trap.png
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from es_service.protocol.messages import PolicySpec
from es_service.protocol.noise import Domain, stream_keys
from workers.environments import SHIPPED, ant_maze, ant_trap, make_environment
from workers.environments.walls import WALL_RADIUS
from workers.policies.policy import act, split_layers

RESULTS = Path(__file__).parent / "results"
POLICIES, STEPS = 8, 600


def ways(name: str) -> np.ndarray:
    """Torso positions of one episode of each of some random policies, [policies, steps + 1, 2]; NaN after the end."""
    task, environment = SHIPPED[name], make_environment(name, {})
    shape = PolicySpec((task.observation_size, 32, task.action_size))
    parameters = np.random.default_rng(0).normal(size=(POLICIES, shape.parameters)).astype(np.float32) * 0.6

    def episode(parameters_D, key):
        layers = split_layers(shape, parameters_D)

        def step(carry, _):
            state, alive = carry
            state, _, done = environment.step(state, act(jnp, shape, layers, None, environment.observe(state))[0])
            return (state, alive & ~done), jnp.where(alive, state.q[:2], jnp.nan)

        state = environment.reset(key)
        return jnp.concatenate([state.q[None, :2], jax.lax.scan(step, (state, True), None, STEPS)[1]])

    keys = stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(POLICIES))
    return np.asarray(jax.jit(jax.vmap(episode))(jnp.asarray(parameters), keys))


def draw(name: str, module: ModuleType, bounds: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """Walls as thick as they are, start, goal, ways."""
    figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
    axes.set(xlim=bounds[0], ylim=bounds[1], aspect="equal", xlabel="x, metres", ylabel="y, metres", title=name)
    for (x0, y0), (x1, y1) in module.WALLS:
        along = np.linspace(0.0, 1.0, 200)[:, None]
        for x, y in np.array([x0, y0]) + along * np.array([x1 - x0, y1 - y0]):
            axes.add_patch(plt.Circle((x, y), WALL_RADIUS, color="#444444"))
    for way in ways(name):
        axes.plot(*way.T, linewidth=1.0)
    axes.plot(*module.START, "o", color="black", label="start")
    if hasattr(module, "GOAL"):
        axes.plot(*module.GOAL, "*", color="#2e9e4f", markersize=14, label="goal")
    axes.legend(loc="upper left")
    figure.savefig(RESULTS / f"{name}.png", dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    draw("ant_maze", ant_maze, ((-37, 42), (-37, 42)))
    draw("ant_trap", ant_trap, ((-10, 20), (-15, 15)))
