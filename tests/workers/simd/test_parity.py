"""One step of each task by simd and by xla, from random states: among walls, on the floor and in the air.

Float32 itself limits how near two right answers can be: springs as stiff as these turn the last bit of a position into
much of a velocity, the more the further an ant is from the origin. So outputs may differ by 1e-4 max(1, |x|), or by as
much as xla's own do when its inputs move by their last bit. Where they differ by more, the state must stand at a
switch: a contact begins, or another wall is the nearest, and xla's own answer jumps within 1e-5 of it.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

from es_service.protocol.noise import Domain, stream_keys
from tests.workers.steps import (
    Step,
    carried,
    control_step,
    environment_of,
    resets_of,
    steps_of,
    substep,
    substeps_of,
    whole,
)
from workers.environments import SHIPPED, ant, describe_environment
from workers.simd.episodes.kernel import compile_kernel

STEPS = 30
"""Random control steps after which states are taken, at the latest."""
WALLS = {"ant_maze": ant.MAZE_WALLS, "ant_trap": ant.TRAP_WALLS}


def random_states(name: str, count: int) -> tuple[Any, np.ndarray]:
    """(states [count, ...], actions, some of them beyond their limits)."""
    size = (SHIPPED[name] if name in SHIPPED else describe_environment(name)).action_size
    rng = np.random.default_rng(0)
    state = resets_of(name)(stream_keys(7, Domain.TRAINING_RESET, 0, np.arange(count)))
    if name in WALLS:
        state = near_walls(state, np.array(WALLS[name]), rng)
    going = np.ones(count, bool)
    for _ in range(STEPS):
        after = steps_of(name)(state, rng.uniform(-1, 1, (count, size)).astype(np.float32))[0]
        state = jax.tree.map(partial(where, going), after, state)
        going &= rng.random(count) > 0.1
    return state, rng.uniform(-1.2, 1.2, (count, size)).astype(np.float32)


def where(going: np.ndarray, new: Any, old: Any) -> np.ndarray:
    """New leaves for some states, old ones for the others."""
    return np.where(going.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def near_walls(state: Any, walls: np.ndarray, rng: np.random.Generator) -> Any:
    """Ants moved to within reach of a random place at a random wall."""
    count = len(state.q)
    start, end = walls[rng.integers(0, len(walls), count)].transpose(1, 0, 2)
    way = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    across = np.stack([-way[:, 1], way[:, 0]], 1) * rng.choice([-1, 1], (count, 1))
    place = start + rng.random((count, 1)) * (end - start) + across * rng.uniform(0.9, 1.6, (count, 1))
    return carried(state, place - state.q[:, :2])


def rows(tree: Any) -> np.ndarray:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([leaf.reshape(len(leaf), -1).astype(np.float64) for leaf in leaves], axis=1)


def difference(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Greatest of each state's outputs, of |x - y| / max(1, |y|); both infinite or NaN counts as equal."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(found - wanted) / np.maximum(1.0, np.abs(wanted))
    alike = ~np.isfinite(found) & ~np.isfinite(wanted)
    return np.where(alike, 0.0, np.nan_to_num(apart, nan=np.inf)).max(axis=1)


def moved(inputs: Any, rng: np.random.Generator, by: float | None) -> Any:
    """Every float moved to a neighbour, or by `by` max(1, |x|), up or down by chance."""

    def move(x: Any) -> np.ndarray:
        x = np.asarray(x)
        if x.dtype != np.float32:
            return x
        up = rng.random(x.shape) < 0.5
        if by is None:
            return np.nextafter(x, np.where(up, np.float32(np.inf), np.float32(-np.inf)))
        return (x + np.where(up, by, -by) * np.maximum(1.0, np.abs(x))).astype(np.float32)

    return jax.tree.map(move, inputs)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("point_maze", 1000),
        pytest.param("brax:inverted_double_pendulum", 256, marks=pytest.mark.slow),
        pytest.param("ant_maze", 256, marks=pytest.mark.long),
        pytest.param("ant_trap", 256, marks=pytest.mark.long),
        *(pytest.param(name, 1000, marks=pytest.mark.long) for name in ("ant_maze", "ant_trap")),
        *(
            pytest.param(f"brax:{name}", 1000, marks=pytest.mark.long)
            for name in ("ant", "halfcheetah", "hopper", "walker2d")
        ),
    ],
)
def test_simd_steps_as_xla_does(name: str, count: int, capsys: pytest.CaptureFixture[str]) -> None:
    inputs = random_states(name, count)
    said = [f"{name}: {compare(control_step(environment_of(name)), steps_of(name), inputs)}"]
    if name in WALLS:
        check_contacts(inputs[0])
    if name == "ant_trap" or (name in WALLS and count == 1000):
        said.append(f"{name}, one substep: {compare(substep(name), substeps_of(name), (whole(inputs[0]), inputs[1]))}")
    with capsys.disabled():
        print("", *said, sep="\n")


def compare(step: Step, xla: Step, inputs: tuple[Any, np.ndarray]) -> str:
    """Hold the compiled step against xla's; says how far apart they are."""
    kernel = compile_kernel(step, *jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), inputs))
    wanted = rows(xla(*inputs))
    assert np.isfinite(wanted).mean() > 0.99
    error = difference(rows(kernel(*inputs)), wanted)

    rng = np.random.default_rng(1)
    last_bit = np.max([difference(rows(xla(*moved(inputs, rng, None))), wanted) for _ in range(8)], axis=0)
    differs = error > np.maximum(1e-4, last_bit)
    jumps = np.max([difference(rows(xla(*moved(inputs, rng, 1e-5))), wanted) for _ in range(8)], axis=0)
    assert (jumps[differs] > 0.5 * error[differs]).all(), "where they differ xla's answer jumps, too"
    assert differs.mean() < 0.02
    return (
        f"greatest difference {error[~differs].max():.1e}, over 1e-4 in {(error > 1e-4).mean():.1%} of the states "
        f"(the inputs' last bits alone: {np.median(last_bit):.1e} in the median); at a switch {differs.mean():.1%}"
    )


def check_contacts(state: Any) -> None:
    """The states are worth something: many touch the floor, and many a wall."""
    push = np.abs(np.asarray(state.push.vel))
    assert (push[..., 2].max(axis=1) > 1.0).mean() > 0.3
    assert (push[..., :2].max(axis=(1, 2)) > 5.0).mean() > 0.1
