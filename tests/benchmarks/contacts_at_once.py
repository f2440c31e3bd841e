"""How many contacts of MuJoCo's ants should be solved at once, before all places are? Control steps a second.

    python -m tests.benchmarks.contacts_at_once         # three minutes of a core on which nothing else computes

Ants among the walls of AntMaze, with the integrator Euler. Their actions are drawn in each control step, or each joint
pushes with all its force in one direction that is drawn once. Then they soon lie, as ants of many policies do. The
compiled steps of each choice take turns in one process, whose processor time is measured, with the states after 300
control steps. Printed are medians of five rounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pandas as pd

from es_service.protocol.machine import cpu_kind
from es_service.protocol.noise import Domain, stream_keys
from workers.environments.ant import MAZE_WALLS
from workers.environments.ant_mujoco import make_ant
from workers.environments.ant_tasks import MAZE_START
from workers.simd.episodes.kernel import compile_kernel

CHOICES = ((4,), (4, 8), (5, 8), (6, 10), (8,))
ANTS, STEPS, ROUNDS, ROUND_STEPS = 128, 300, 5, 20


Step = Callable[[Any, Any], Any]


def main() -> None:
    rng, steps = np.random.default_rng(0), dict[tuple[int, ...], Step]()
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(ANTS))
    for at_once in CHOICES:
        ant = make_ant(MAZE_WALLS, "Euler", at_once)
        new = compile_kernel(lambda key, ant=ant: ant.reset(key, MAZE_START), keys[0])(keys)
        first = jax.tree.map(lambda leaf: leaf[0], new)
        steps[at_once] = compile_kernel(ant.step, first, np.zeros(8, np.float32))
    drawn = rng.uniform(-1.0, 1.0, (STEPS, ANTS, 8)).astype(np.float32)
    actions = {"drawn": drawn, "kept": np.sign(drawn[:1]).repeat(STEPS, axis=0)}

    def driven(step: Step, state: Any, actions: np.ndarray) -> Any:
        for action in actions:
            state = step(state, action)
        return state

    states = {name: driven(steps[4, 8], new, of) for name, of in actions.items()}
    rows = []
    for _ in range(ROUNDS):
        for at_once, step in steps.items():
            for name, state in states.items():
                began = time.process_time()
                driven(step, state, actions[name][:ROUND_STEPS])
                rate = ANTS * ROUND_STEPS / (time.process_time() - began)
                rows.append({"at once": str(at_once), "actions": name, "steps/s": rate})
    rates = pd.DataFrame(rows).groupby(["actions", "at once"])["steps/s"].median().round(-2)
    print(cpu_kind(), rates.unstack("actions").to_string(), sep="\n")


if __name__ == "__main__":
    main()
