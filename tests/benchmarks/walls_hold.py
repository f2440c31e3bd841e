"""Do walls hold for whole episodes? Two thousand ants per task, beside walls, driven as hard as their motors go.

    python -m tests.benchmarks.walls_hold            # 11 minutes on two cores; rewrites results/walls_hold.csv

Half of the ants take a random action every step, half turn every motor fully one way or the other for half a second.
Not a benchmark of speed: it lives here because it takes too long for a test. `tests/workers/test_ant_walls.py` drives
fewer steps, with forces from outside.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
from pathlib import Path
from typing import Any

import numpy as np

EPISODES, BLOCK = 2000, 50
STEPS = {"ant_maze": 3000, "ant_trap": 1000, "ant_u_maze": 1000, "ant_big_maze": 1000, "ant_hardest_maze": 1000}
DRIVES = ("random", "full torque")
RESULTS = Path(__file__).parent / "results" / "walls_hold.csv"
DEEPEST_M = 0.1


def watch(name: str, drive: str, seed: int) -> dict[str, Any]:
    """One block of whole episodes; runs in a process of its own setting."""
    import jax
    import jax.numpy as jnp

    from es_service.protocol.noise import Domain, stream_keys
    from tests.wall_watch import WALLS, colliders, crosses, depth, places_beside_walls
    from workers.environments import ant, ant_tasks, goal_maze
    from workers.environments.ant import make_ant

    if (name, drive) not in _compiled:
        walls = WALLS[name]
        ant = make_ant(walls, near=goal_maze.WALLS_MET if name in ant_tasks.MAZES else None)

        def episode(start_key, xy, key):
            def body(step, carry):
                state, record = carry
                if drive == "random":
                    action = jax.random.uniform(jax.random.fold_in(key, step), (8,), minval=-1, maxval=1)
                else:
                    action = jnp.sign(jax.random.uniform(jax.random.fold_in(key, step // 10), (8,)) - 0.5)
                moved = ant.step(state, action)
                x, y = moved.q[:2]
                in_pocket = (x < 10) & (x > 0) & (y < -15) & (name == "ant_maze")
                reward = -jnp.hypot(x - ant_tasks.MAZE_GOAL[0], y - ant_tasks.MAZE_GOAL[1])
                now = {
                    "deepest": jnp.maximum(record["deepest"], depth(colliders(ant.system, moved), walls)),
                    "crossed": record["crossed"] | crosses(state.q[:2], moved.q[:2], walls),
                    "finite": record["finite"] & jnp.isfinite(moved.q).all() & jnp.isfinite(moved.qd).all(),
                    "off_middle": jnp.maximum(record["off_middle"], jnp.abs(moved.q[:2] - ant.MIDDLE).max()),
                    "pocket": jnp.maximum(record["pocket"], jnp.where(in_pocket, reward, -jnp.inf)),
                    "highest": jnp.maximum(record["highest"], moved.q[2]),
                }
                return moved, now

            nothing = jnp.float32(-jnp.inf)
            record = dict.fromkeys(("deepest", "off_middle", "pocket", "highest"), nothing)
            record |= {"crossed": jnp.array(False), "finite": jnp.array(True)}
            state = ant.reset(start_key, (xy[0], xy[1]))
            return jax.lax.fori_loop(0, STEPS[name], body, (state, record))[1]

        _compiled[name, drive] = jax.jit(jax.vmap(episode))
    start_keys = stream_keys(seed, Domain.EVALUATION_RESET, 0, np.arange(BLOCK))
    keys = jax.random.split(jax.random.PRNGKey(seed), BLOCK)
    records = _compiled[name, drive](start_keys, places_beside_walls(name, BLOCK, seed), keys)
    return {"task": name, "drive": drive, **{what: np.asarray(values) for what, values in records.items()}}


_compiled: dict[tuple[str, str], Any] = {}


def _watch(job: tuple[str, str, int]) -> dict[str, Any]:
    return watch(*job)


def main() -> None:
    os.environ |= {"PJRT_NPROC": "1", "JAX_PLATFORMS": "cpu"}  # for the processes below
    rows = []
    blocks = EPISODES // len(DRIVES) // BLOCK
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        for name in STEPS:
            for number, drive in enumerate(DRIVES):
                jobs = [(name, drive, number * blocks + block) for block in range(blocks)]
                results = list(pool.imap(_watch, jobs))
                joined = {what: np.concatenate([block[what] for block in results]) for what in results[0] if what not in
                          ("task", "drive")}  # fmt: skip
                rows.append({
                    "task": name,
                    "drive": drive,
                    "episodes": joined["finite"].size,
                    "steps": STEPS[name],
                    "touched_a_wall": int((joined["deepest"] > 0).sum()),
                    "deepest_m": round(float(joined["deepest"].max()), 4),
                    "deeper_than_0.1_m": int((joined["deepest"] > DEEPEST_M).sum()),
                    "crossed_a_wall": int(joined["crossed"].sum()),
                    "left_the_arena": int((joined["off_middle"] > 37.5).sum()) if name == "ant_maze" else "",
                    "not_finite": int((~joined["finite"]).sum()),
                    "highest_torso_m": round(float(joined["highest"].max()), 2),
                    "best_reward_in_pocket": round(float(joined["pocket"].max()), 3) if name == "ant_maze" else "",
                })  # fmt: skip
                print(rows[-1], flush=True)
    with RESULTS.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
