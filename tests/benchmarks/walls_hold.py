"""Do walls hold for whole episodes? Two thousand ants per task, beside walls, driven as hard as their motors go.

    python -m tests.benchmarks.walls_hold                          # all rows of results/walls_hold.csv
    python -m tests.benchmarks.walls_hold ant_trap --physics mujoco    # only those

Half of the ants take a random action every step, half turn every motor fully one way or the other for half a second, in
Brax's springs and, where a task has it, in MuJoCo's physics. Episodes are computed by simd. Not a benchmark of speed:
it lives here because it takes too long for a test. `tests/workers/test_ant_walls.py` and `test_ant_mujoco.py` drive
fewer steps, with forces from outside or thrown at walls.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

EPISODES = 2000
STEPS = {"ant_maze": 3000, "ant_trap": 1000, "ant_u_maze": 1000, "ant_big_maze": 1000, "ant_hardest_maze": 1000}
PHYSICS = ("spring", "mujoco", "mujoco_euler")
HAVE_MUJOCO = ("ant_maze", "ant_trap")
"""Tasks that have all of these; the others have springs."""
DRIVES = ("random", "full torque")
HELD = 10
"""Steps for which motors remain fully turned, half a second."""
RESULTS = Path(__file__).parent / "results" / "walls_hold.csv"
KEY = ["task", "physics", "drive"]
DEEPEST_M = 0.1


class Record(NamedTuple):
    """What was seen in an episode until now."""

    deepest: Any
    """Metres by which a collider was inside a wall; negative: outside."""
    off_middle: Any
    """Greatest distance of the torso from the middle of AntMaze's arena, along x or y."""
    pocket: Any
    """Greatest reward of AntMaze in the pocket left of its goal."""
    highest: Any
    """Greatest height of the torso."""
    crossed: Any
    finite: Any


def watch(job: tuple[str, str, str]) -> dict[str, Any]:
    """A row of the table: whole episodes of a task in some physics with a drive, all side by side."""
    import jax
    import jax.numpy as jnp

    from es_service.protocol.noise import Domain, stream_keys
    from tests.wall_watch import WALLS, colliders, crosses, depth, places_beside_walls
    from workers.environments import ant, ant_tasks
    from workers.environments.goal_maze import WALLS_MET
    from workers.simd.episodes.kernel import compile_kernel

    name, physics, drive = job
    walls, count = WALLS[name], EPISODES // len(DRIVES)
    of_cells = name in ant_tasks.MAZES
    made = ant.make_ant(walls, near=WALLS_MET) if of_cells else ant.ant_in(physics, walls)

    def begin(key: Any, xy: Any) -> tuple[Any, Record]:
        nothing = jnp.float32(-jnp.inf)
        record = Record(nothing, nothing, nothing, nothing, crossed=jnp.bool_(False), finite=jnp.bool_(True))
        return made.reset(key, (xy[0], xy[1])), record

    def advance(begun: tuple[Any, Record], action: Any) -> tuple[Any, Record]:
        state, record = begun
        after = made.step(state, action)
        x, y, height = after.q[:3]
        in_pocket = (x < 10) & (x > 0) & (y < -15)
        reward = -jnp.hypot(x - ant_tasks.MAZE_GOAL[0], y - ant_tasks.MAZE_GOAL[1])
        return after, Record(
            jnp.maximum(record.deepest, depth(colliders(made.viewer.poses(after)), walls)),
            jnp.maximum(record.off_middle, jnp.abs(after.q[:2] - ant.MIDDLE).max()),
            jnp.maximum(record.pocket, jnp.where(in_pocket, reward, -jnp.inf)),
            jnp.maximum(record.highest, height),
            record.crossed | crosses(state.q[:2], after.q[:2], walls),
            record.finite & jnp.isfinite(after.q).all() & jnp.isfinite(after.qd).all(),
        )

    seed = DRIVES.index(drive)
    keys, places = (
        stream_keys(seed, Domain.EVALUATION_RESET, 0, np.arange(count)),
        places_beside_walls(name, count, seed),
    )
    start = compile_kernel(begin, keys[0], places[0])
    begun = start(keys, places)
    step = compile_kernel(advance, jax.eval_shape(begin, keys[0], places[0]), np.zeros(8, np.float32))
    rng, action_N = np.random.default_rng(seed), np.zeros(0)
    for number in range(STEPS[name]):
        if drive == "random" or number % HELD == 0:
            drawn_N = rng.uniform(-1.0, 1.0, (count, 8)).astype(np.float32)
            action_N = drawn_N if drive == "random" else np.sign(drawn_N)
        begun = step(begun, action_N)
    seen, of_maze = begun[1], name == "ant_maze"
    return {
        "task": name,
        "physics": physics,
        "drive": drive,
        "episodes": count,
        "steps": STEPS[name],
        "touched_a_wall": int((seen.deepest > 0).sum()),
        "deepest_m": round(float(seen.deepest.max()), 4),
        "deeper_than_0.1_m": int((seen.deepest > DEEPEST_M).sum()),
        "crossed_a_wall": int(seen.crossed.sum()),
        "left_the_arena": int((seen.off_middle > ant.HALF).sum()) if of_maze else "",
        "not_finite": int((~seen.finite).sum()),
        "highest_torso_m": round(float(seen.highest.max()), 2),
        "best_reward_in_pocket": round(float(seen.pocket.max()), 3) if of_maze else "",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=list(STEPS), metavar="TASK")
    parser.add_argument("--physics", nargs="+", default=PHYSICS, choices=PHYSICS)
    given = parser.parse_args()
    os.environ |= {"JAX_PLATFORMS": "cpu"}  # for the processes below
    jobs = [
        job
        for job in itertools.product(given.tasks, given.physics, DRIVES)
        if job[0] in HAVE_MUJOCO or job[1] == "spring"
    ]
    found = pd.read_csv(RESULTS, dtype=str).set_index(KEY)
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0)), maxtasksperchild=1) as pool:
        for row in pool.imap(watch, jobs, chunksize=1):
            print(row, flush=True)
            new = pd.DataFrame([row]).astype(str).set_index(KEY)
            found = pd.concat([found[~found.index.isin(new.index)], new])
            found.reset_index().to_csv(RESULTS, index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
