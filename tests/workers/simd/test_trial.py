"""A trial without folding: what is not finite in JAX and a number in simd is found, with its line."""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.noise import uniforms
from workers.environments import SHIPPED, describe_environment, make_environment
from workers.rollouts.backend import Examination
from workers.simd.episodes import trial


class _State(NamedTuple):
    place: Any
    best: Any


class Walk:
    """a point walks"""

    observation_size = action_size = 2
    episode_steps = 30
    descriptor_names, descriptor_bounds = ("x", "y"), ((-1.0, 1.0),) * 2

    def reset(self, key: Any) -> _State:
        return _State(uniforms(key, jnp.arange(2, dtype=jnp.uint32)) - 0.5, jnp.float32(jnp.inf))

    def observe(self, state: _State) -> Any:
        return state.place

    def step(self, state: _State, action: Any) -> tuple[_State, Any, Any]:
        state = state._replace(place=jnp.clip(state.place + 0.1 * action, -1.0, 1.0))
        return state, self.reward(state, action), self.done(state)

    def reward(self, state: _State, action: Any) -> Any:
        return state.place[0]

    def done(self, state: _State) -> Any:
        return False

    def descriptor(self, state: _State) -> Any:
        return state.place


class HiddenReward(Walk):
    """the issue's own"""

    def reward(self, state: _State, action: Any) -> Any:
        bonus = jnp.log(-1.0 - action[0] ** 2)  # begins
        return state.place[0] + 0.0 * bonus  # multiplies


class HiddenLater(Walk):
    """only after some steps with extreme actions, in the products of a matrix"""

    def reward(self, state: _State, action: Any) -> Any:
        fuel = jnp.stack([1.0, jnp.sqrt(0.99 - state.place[1])])
        return (jnp.array([[1.0, 0.0], [0.0, 1.0]]) @ fuel)[0]  # multiplies


class HiddenEnd(Walk):
    """NaN is below nothing"""

    def done(self, state: _State) -> Any:
        return 0.0 * jnp.sqrt(state.place[0]) < 0.5  # multiplies


class HiddenState(Walk):
    """in a loop, and only in the state"""

    def step(self, state: _State, action: Any) -> tuple[_State, Any, Any]:
        def add(_: Any, best: Any) -> Any:
            return best + 0.0 * jnp.arccos(1.5 + action[0] ** 2)  # multiplies

        return state._replace(best=jax.lax.fori_loop(0, 3, add, jnp.float32(0.0))), state.place[0], False


class HiddenReset(Walk):
    """the reset has it"""

    def reset(self, key: Any) -> _State:
        place = uniforms(key, jnp.arange(2, dtype=jnp.uint32)) - 0.5
        return _State(0.0 * jnp.sqrt(place), jnp.float32(0.0))  # multiplies


class HiddenInput(Walk):
    """an infinity that the state has on purpose is multiplied"""

    def reward(self, state: _State, action: Any) -> Any:
        return state.place[0] + 0.0 * state.best  # multiplies


class HiddenGoal(Walk):
    """objectives rank by it; where it is NaN in JAX and in simd, there is no goal"""

    has_goal = True

    def goal_distance(self, state: _State) -> Any:
        return 1.0 + 0.0 * jnp.log(state.place[0] - 2.0)  # multiplies


@pytest.mark.parametrize(
    ("kind", "what", "where"),
    [
        (HiddenGoal, "its goal_distance is NaN", "in the reset"),
        (HiddenReward, "its reward is NaN", "in step 1 with actions of 0"),
        (HiddenLater, "its reward is NaN", "with actions of 1"),
        (HiddenEnd, "its done depends on NaN", "in step 1 with actions "),
        (HiddenState, "its state.best is NaN", "in step 1 with actions "),
        (HiddenReset, "its observation[", "in the reset"),
        (HiddenInput, "its reward is NaN", "in step 1 with actions of 0"),
    ],
)
def test_a_product_with_0_that_jax_makes_nan_is_named_with_its_line(kind: type, what: str, where: str):
    task = describe_environment(f"{__name__}:{kind.__name__}")
    found = trial.examine(task)
    assert (found.unsupported, found.notes) == ("", ())
    assert found.hidden.startswith(what), found.hidden
    assert where in found.hidden
    lines, first = inspect.getsourcelines(kind)
    for number, line in enumerate(lines, first):
        if "# multiplies" in line or "# begins" in line:
            assert f"{__file__}:{number} (" in found.hidden
    assert trial.examine(task) == found, "it is found each time"


class SafeProduct(Walk):
    """what is not finite is discarded, guarded or stays in a state of which that is known"""

    def reward(self, state: _State, action: Any) -> Any:
        x = state.place[0]
        discarded = jnp.where(x > 0.0, 0.0 * jnp.log(jnp.maximum(x, 0.0)), 0.0) * 1.0
        chosen = jnp.where(x > 0.0, 0.0 * jnp.log(x), 0.0)
        mended = jnp.nan_to_num(0.0 * jnp.log(x), nan=0.0)
        return chosen + mended + 0.0 * jnp.minimum(state.best, 1.0) + 0.0 * discarded

    def step(self, state: _State, action: Any) -> tuple[_State, Any, Any]:
        state, reward, _ = super().step(state, action)
        return state._replace(best=jnp.minimum(state.best, jnp.inf)), reward, -0.0 * state.place[0] > 0.0


class EndsBefore(Walk):
    """what follows the end does not count"""

    def done(self, state: _State) -> Any:
        return True

    def reward(self, state: _State, action: Any) -> Any:
        return 0.0 * jnp.log(jnp.where(jnp.isinf(state.best), 1.0, -1.0))

    def step(self, state: _State, action: Any) -> tuple[_State, Any, Any]:
        return state._replace(best=0.0 * action[0]), self.reward(state, action), True


class DrawnByJax(Walk):
    """simd cannot compile the reset"""

    def reset(self, key: Any) -> _State:
        key = jax.random.wrap_key_data(key[:2])
        return _State(jax.random.uniform(key, (2,)), jnp.float32(0.0))


@pytest.mark.parametrize("kind", [Walk, SafeProduct, EndsBefore, DrawnByJax])
def test_what_a_choice_discards_is_not_found_and_is_remembered_as_right(kind: type, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    task = describe_environment(f"{__name__}:{kind.__name__}")
    assert trial.examine(task) == Examination()
    monkeypatch.setattr(trial, "try_out", lambda *_: Examination(hidden="tried again"))
    assert trial.examine(task) == Examination()
    monkeypatch.setattr(trial, "OWN_VERSION", "another compiler")
    assert trial.examine(task).hidden == "tried again"


class NotFinite(Walk):
    """JAX and simd agree"""

    def reward(self, state: _State, action: Any) -> Any:
        return jnp.log(state.place[0] - 2.0)  # begins


class FarObservation(Walk):
    """an infinite observation may be clipped"""

    def observe(self, state: _State) -> Any:
        return state.place / 0.0


def test_what_is_not_finite_anyway_is_noted_with_its_line_and_an_observation_may_be_infinite():
    found = trial.examine(describe_environment(f"{__name__}:NotFinite"))
    (note,) = found.notes
    assert found.hidden == ""
    assert note.startswith(f"{__name__}:NotFinite: its reward is NaN in step 1 with actions of 0: what {__file__}:")
    assert note.endswith(" (NotFinite.reward) computes is not finite; such episodes are invalid")
    assert trial.examine(describe_environment(f"{__name__}:FarObservation")) == Examination()


def test_a_fault_of_the_trial_is_told_and_hinders_nobody(monkeypatch: pytest.MonkeyPatch):
    def fails(*_: Any, **__: Any) -> Any:
        raise KeyError("add")

    monkeypatch.setattr(trial, "evaluate", fails)
    monkeypatch.setattr(trial.cache, "cache_folder", lambda: None)
    found = trial.examine(describe_environment(f"{__name__}:Walk"))
    assert found.unsupported == found.hidden == ""
    assert "a fault of es-service's compiler, please report it (KeyError: 'add')" in found.notes[0]


def test_a_step_that_is_too_large_is_not_tried(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(trial, "MOST_NODES", 10)
    monkeypatch.setattr(trial.cache, "cache_folder", lambda: None)
    assert trial.examine(describe_environment(f"{__name__}:NotFinite")) == Examination()


BRAX = ("ant", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_double_pendulum", "inverted_pendulum",
        "pusher", "reacher", "walker2d")  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        "point_maze",
        *(pytest.param(f"ant_{name}", marks=pytest.mark.long) for name in ("maze", "trap")),
        *(pytest.param(f"brax:{name}", marks=pytest.mark.long) for name in BRAX),
    ],
)
def test_nothing_is_found_in_tasks_that_we_ship_and_in_those_of_brax(name: str):
    task = SHIPPED[name] if name in SHIPPED else describe_environment(name)
    assert trial.try_out(task, make_environment(name, {})) == Examination()


def test_what_a_trial_computes_is_what_jax_computes():
    """The half of JAX, bit for bit but for the order of sums; that of simd has 0 in place of NaN."""
    environment = make_environment(f"{__name__}:HiddenReward", {})
    steps = [(words, values, traced) for traced, words, values, step in
             trial._tried(describe_environment(f"{__name__}:HiddenReward"), environment) if step]  # fmt: skip
    words, values, traced = steps[0]
    state = _State(words[:2].T.view(np.float32), words[2].view(np.float32))
    after, reward_L, _ = jax.vmap(environment.step)(state, words[3:].T.view(np.float32))
    found_L = values[traced.places("reward")[0]].view(np.float32)
    assert np.isnan(found_L[: trial.LANES]).all()
    assert np.isnan(reward_L).all()
    np.testing.assert_allclose(found_L[trial.LANES :], after.place[trial.LANES :, 0], rtol=1e-6)
    np.testing.assert_allclose(values[traced.places("state")[:2]].view(np.float32).T, after.place, rtol=1e-6)
