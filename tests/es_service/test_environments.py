"""Our tasks as environments of Gymnasium: one environment has the bits that it has among many, on any processor."""

from __future__ import annotations

import copy
import importlib
import pickle
import subprocess
import sys
import warnings
from functools import partial
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_match import check_environments_match
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from es_service.environments import drawing
from es_service.environments.vector import TaskEnv, TaskVectorEnv
from es_service.errors import ServiceError
from es_service.gymnasium import id_of
from es_service.protocol.noise import Domain, stream_keys
from tests.workers.simd.rollouts import targets
from tests.workers.steps import environment_of
from workers import lanes
from workers.environments import SHIPPED, TaskError
from workers.simd.episodes import kernel

POLE = "tests.examples.cart_pole:CartPole"
"""A task whose episodes end by themselves."""


def same(one: Any, other: Any, name: str = "") -> None:
    """Both have the same bits, whatever they are made of."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), name
        for key in one:
            same(one[key], other[key], f"{name}.{key}")
    elif isinstance(one, tuple | list):
        for index, pair in enumerate(zip(one, other, strict=True)):
            same(*pair, f"{name}[{index}]")
    elif isinstance(one, np.ndarray) and one.dtype == object:
        same(list(one), list(other), name)
    elif one is None:
        assert other is None, name
    else:
        assert np.asarray(one).dtype == np.asarray(other).dtype, name
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), name


def actions_of(envs: Any, steps: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(-1.5, 1.5, envs.action_space.shape).astype(np.float32) for _ in range(steps)]


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
@pytest.mark.parametrize("task", ["point_maze", POLE])
def test_many_are_as_many_single_ones_in_each_mode(task, mode):
    limit = 13
    single = partial(gymnasium.make, "es_service/Task-v0", max_episode_steps=limit, task=task, disable_env_checker=True)
    theirs = SyncVectorEnv([single] * 5, autoreset_mode=mode)
    ours = TaskVectorEnv(task, 5, max_episode_steps=limit, autoreset_mode=mode)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    for options in (None, {"reset_mask": np.array([True, False, True, False, False])}):
        for seed in (11, None, [5, None, 7, None, 9]):
            same(*(envs.reset(seed=seed, options=options and dict(options)) for envs in (ours, theirs)))
    ends = set()
    for number, actions in enumerate(actions_of(ours, 45)):
        found = ours.step(actions)
        same(found, theirs.step(actions), f"step {number}")
        over = found[2] | found[3]
        ends |= {(int(term), int(trunc)) for term, trunc in zip(found[2], found[3], strict=True)}
        if mode == AutoresetMode.DISABLED and over.any():
            same(*(envs.reset(options={"reset_mask": over.copy()}) for envs in (ours, theirs)))
    assert (0, 1) in ends
    assert ((1, 0) in ends) == (task == POLE)


@pytest.mark.parametrize("task", ["point_maze", pytest.param("ant_trap", marks=pytest.mark.long)])
def test_an_environment_depends_neither_on_the_others_nor_on_threads_nor_on_the_width_of_vectors(task, monkeypatch):
    steps, lane = 12, 3

    def seen(envs: TaskVectorEnv, lane: int) -> list[bytes]:
        """Of an environment with seed 20."""
        found = [envs.reset(seed=[20 if number == lane else number for number in range(envs.num_envs)])[0][lane]]
        rng = np.random.default_rng(1)
        for actions in actions_of(envs, steps, seed=envs.num_envs):
            actions[lane] = rng.uniform(-1, 1, actions.shape[1])
            observation, reward, _, _, info = envs.step(actions)
            found += [observation[lane], reward[lane], info["descriptor"][lane]]
        return [np.asarray(one).tobytes() for one in found]

    expected = seen(TaskVectorEnv(task, 1, max_episode_steps=5), 0)
    for target in targets():
        monkeypatch.setattr(kernel, "host_target", lambda target=target: target)
        lanes.kernels.cache_clear()
        for count, threads in ((4, 1), (70, 1), (70, 3), (200, 2)):
            envs = TaskVectorEnv(task, count, max_episode_steps=5, threads=threads)
            assert seen(envs, lane) == expected
            envs.close()
    lanes.kernels.cache_clear()


@pytest.mark.parametrize("task", ["point_maze", pytest.param("ant_trap", marks=pytest.mark.long)])
def test_steps_are_those_of_the_task(task):
    """The functions that xla and simd compile for runs, in JAX."""
    envs, functions = TaskVectorEnv(task, 3), environment_of(task)
    observation, info = envs.reset(seed=[4, 9, 4])
    keys = stream_keys(0, Domain.ENVIRONMENT_RESET, 0, np.array([4, 9, 4], np.uint64), np.zeros(3, np.int64))
    states = jax.vmap(functions.reset)(keys)
    step, observe = jax.jit(jax.vmap(functions.step)), jax.jit(jax.vmap(functions.observe))
    for actions in actions_of(envs, 3):
        np.testing.assert_allclose(observation, observe(states), atol=2e-4)
        states, rewards, _ = step(states, actions)
        observation, reward, _, _, info = envs.step(actions)
        np.testing.assert_allclose(reward, rewards, atol=2e-3)
        np.testing.assert_allclose(info["descriptor"], jax.vmap(functions.descriptor)(states), atol=2e-4)


def test_the_state_goes_on_in_other_environments():
    envs, others = (TaskVectorEnv(POLE, 20, max_episode_steps=9) for _ in range(2))
    envs.reset(seed=3)
    actions = actions_of(envs, 30)
    for one in actions[:10]:
        envs.step(one)
    others.set_state(envs.get_state())
    for one in actions[10:]:
        same(envs.step(one), others.step(one))
    last = TaskVectorEnv(POLE, 20, max_episode_steps=9)
    last.set_state(envs.get_state())
    some = np.arange(20) == 3
    same(*(one.reset(options={"reset_mask": some.copy()}) for one in (envs, last)))
    with pytest.raises(ValueError, match=r"state has words of shape \(20, 5\), but 3 environments of "):
        TaskVectorEnv(POLE, 3).set_state(envs.get_state())
    single, other = TaskEnv("point_maze"), TaskEnv("point_maze")
    single.reset(seed=1)
    other.set_state(single.get_state())
    same(single.step([0.5, -0.5]), other.step([0.5, -0.5]))


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_state_after_an_automatic_reset_goes_on_in_any_mode(mode):
    envs = TaskVectorEnv("point_maze", 2, max_episode_steps=3, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=3)
    first, second, third, fourth = actions_of(envs, 4)
    for one in (first, second, third):
        envs.step(one)
    other = TaskVectorEnv("point_maze", 2, max_episode_steps=3, autoreset_mode=mode)
    other.set_state(envs.get_state())
    same(envs.step(fourth), other.step(fourth))


@pytest.mark.parametrize("task", SHIPPED)
def test_each_shipped_task_is_registered_with_its_length_and_passes_gymnasium_s_check(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gymnasium.spec(id_of(task)).max_episode_steps == SHIPPED[task].episode_steps
        if task != "point_maze":
            return  # a step of an ant takes seconds to compile, and Gymnasium's check makes no use of what it is
        envs = gymnasium.make_vec(f"es_service.gymnasium:{id_of(task)}", num_envs=3, threads=2)
        assert envs.unwrapped.max_episode_steps == 200
        statistics = RecordEpisodeStatistics(envs)
        statistics.reset(seed=0)
        for actions in actions_of(envs, 200):
            info = statistics.step(actions)[-1]
        assert (info["episode"]["l"] == 200).all()
        warnings.filterwarnings("ignore", ".*A Box observation space (minimum|maximum) value is")
        check_env(gymnasium.make(id_of(task), render_mode="rgb_array").unwrapped)


def test_an_environment_that_cannot_be_drawn_passes_gymnasium_s_check():
    """Its descriptor is no place, so it has no mode of drawing that the check could try."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*A Box observation space (minimum|maximum) value is")
        warnings.filterwarnings("ignore", ".*No render modes was declared in the environment")
        check_env(gymnasium.make("es_service/Task-v0", task=POLE, max_episode_steps=30).unwrapped)
    assert many(POLE).metadata["render_modes"] == []


class Lane(gymnasium.Env[Any, Any]):
    """Environment 3 of seven, among others that get actions and seeds of their own."""

    def __init__(self, task: str, limit: int) -> None:
        self.envs = TaskVectorEnv(
            task, 7, max_episode_steps=limit, autoreset_mode=AutoresetMode.DISABLED, render_mode="rgb_array"
        )
        self.observation_space, self.action_space = self.envs.single_observation_space, self.envs.single_action_space
        self.render_mode, self.others = "rgb_array", np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.envs.reset(seed=[seed if lane == 3 else 100 + lane for lane in range(7)])
        return observation[3], self._info(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        actions = self.others.uniform(-1, 1, self.envs.action_space.shape)
        actions[3] = action
        observation, reward, terminated, truncated, info = self.envs.step(actions)
        others = (terminated | truncated) & (np.arange(7) != 3)
        if others.any() and not (terminated | truncated)[3]:
            self.envs.reset(options={"reset_mask": others})
        return observation[3], float(reward[3]), bool(terminated[3]), bool(truncated[3]), self._info(info)

    def render(self) -> Any:
        return self.envs.frame(3)

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        mine = {name: array[3] for name, array in info.items() if not name.startswith("_")}
        return mine | {"success": bool(mine["success"])}


def test_gymnasium_says_that_one_among_many_and_a_single_one_match():
    settings = {"max_episode_steps": 20, "disable_env_checker": True, "render_mode": "rgb_array"}
    single = gymnasium.make("es_service/PointMaze-v0", **settings)
    check_environments_match(Lane("point_maze", 20), single, num_steps=70, seed=5)


WRAPPERS: dict[str, Any] = {
    "statistics": RecordEpisodeStatistics,
    "observations": vector.NormalizeObservation,
    "rewards": vector.NormalizeReward,
    "clipped": vector.ClipAction,
    "flat": vector.FlattenObservation,
    "float64": partial(vector.DtypeObservation, dtype=np.float64),
    "rescaled": partial(vector.RescaleAction, min_action=np.float32(-2.0), max_action=np.float32(2.0)),
    "lists": vector.DictInfoToList,
}


OF_OBSERVATIONS = ("observations", "flat", "float64")
"""Wrappers that Gymnasium has for other modes than SAME_STEP only."""


@pytest.mark.parametrize(
    ("wrapper", "mode"),
    [(name, AutoresetMode.NEXT_STEP) for name in WRAPPERS]
    + [(name, AutoresetMode.SAME_STEP) for name in WRAPPERS if name not in OF_OBSERVATIONS],
)
def test_gymnasium_s_wrappers_do_to_them_what_they_do_to_single_ones(wrapper, mode):
    single = partial(gymnasium.make, "es_service/Task-v0", max_episode_steps=30, task=POLE, disable_env_checker=True)
    theirs = WRAPPERS[wrapper](SyncVectorEnv([single] * 3, autoreset_mode=mode))
    ours = WRAPPERS[wrapper](TaskVectorEnv(POLE, 3, max_episode_steps=30, autoreset_mode=mode))
    same(*(envs.reset(seed=2) for envs in (ours, theirs)))
    for number, actions in enumerate(actions_of(ours, 60)):
        found = [list(envs.step(actions)) for envs in (ours, theirs)]
        if wrapper == "statistics":  # it measures time, too
            for one in found:
                one[4].get("episode", {}).pop("t", None)
        same(*found, f"step {number}")


@pytest.mark.slow
def test_a_caller_s_mode_of_jax_changes_no_bit():
    program = """
import jax
jax.config.update("jax_enable_x64", True)
from tests.es_service.test_environments import seen
print(seen().hex())
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not jax.config.jax_enable_x64
    assert said.stdout == f"{seen().hex()}\n"


def seen() -> bytes:
    """The observations of a few steps."""
    envs = TaskVectorEnv("point_maze", 3)
    steps = [envs.reset(seed=0)[0], *(envs.step(actions)[0] for actions in actions_of(envs, 5))]
    return b"".join(one.tobytes() for one in steps)


def test_an_environment_without_a_seed_has_a_random_one_and_its_episodes_go_on():
    envs = TaskVectorEnv("point_maze", 2)
    first, again = envs.reset()[0], TaskVectorEnv("point_maze", 2).reset()[0]
    assert not np.array_equal(first, again)
    assert not np.array_equal(first[0], first[1])
    envs.reset(seed=1)
    second = envs.reset()[0]
    envs.reset(seed=1)
    assert np.array_equal(envs.reset()[0], second)


def test_the_options_of_a_task_are_its_own():
    corner = TaskVectorEnv("point_maze", 2, task_options={"start": "corner"}).reset(seed=0)[0]
    np.testing.assert_allclose(corner, [[0.9, -0.9]] * 2)


def many(task="point_maze", count=2, **settings: Any) -> TaskVectorEnv:
    return TaskVectorEnv(task, count, **settings)


MASK = {"reset_mask": np.zeros(2, bool)}
OF_BOOLS = "0 true values; must have one value for each of the 2 environments, and at least one true"


@pytest.mark.parametrize(
    ("call", "error", "sentence"),
    [
        (lambda: many("point_mase"), ServiceError, "'point_mase' is not shipped; choose among point_maze, ant_maze"),
        (lambda: many("gymnasium:Ant-v5"), TaskError, "'gymnasium:Ant-v5' is a Python object, no task in JAX"),
        (
            lambda: many("function:tests.examples.beam:beam"),
            TaskError,
            "is a function of parameters, which has no step",
        ),
        (lambda: many("brax:aunt"), TaskError, "did you mean brax:ant"),
        (lambda: many(task_options={"begin": 1}), TaskError, "no option 'begin'; its options: start"),
        (lambda: many(task_options={"start": "Corner"}), TaskError, "start = 'Corner' is not allowed; must be"),
        (lambda: many(task_options={"start": 3}), TaskError, "start = 3 is not allowed; must be 'default' or"),
        (lambda: many(task_options=5), TaskError, "task_options = 5 is no mapping"),
        (lambda: many(count=0), ValueError, "num_envs = 0; must be at least 1"),
        (lambda: many(threads=0), ValueError, "threads = 0; must be at least 1"),
        (lambda: many(max_episode_steps=2.5), ValueError, r"max_episode_steps = 2\.5; must be at least 1, and a whole"),
        (lambda: many().reset(seed=[1.5, 2]), ValueError, r"seed = \[1\.5, 2\]; must be a whole number, or"),
        (lambda: many().reset(seed="12"), ValueError, "seed = '12'; must be a whole number, or"),
        (lambda: many(max_episode_steps=0), ValueError, "max_episode_steps = 0; must be at least 1"),
        (
            lambda: many(render_mode="human"),
            ValueError,
            "must be None or 'rgb_array'.* since MuJoCo's renderer needs Op",
        ),
        (
            lambda: many(POLE, render_mode="rgb_array"),
            ValueError,
            r"\(place angle\); choose another one with task_opti",
        ),
        (lambda: many().frame(0), ValueError, "render_mode = None; must be 'rgb_array' for pictures"),
        (lambda: many(render_mode="rgb_array").frame(2), ValueError, "index = 2; must be from 0 to 1"),
        (lambda: many().step(np.zeros((2, 2))), ResetNeeded, "call reset before step"),
        (lambda: many().get_state(), ResetNeeded, "call reset before get_state"),
        (lambda: TaskEnv("point_maze").get_state(), ResetNeeded, "call reset before get_state"),
        (lambda: many().reset(seed=[1]), ValueError, "a list of 1; must have one for each of the 2"),
        (lambda: many().reset(seed=-1), ValueError, r"seed = -1; must be from 0 to 2\*\*63 - 1"),
        (lambda: many().reset(options={"reset_mask": [True]}), TypeError, "is list; must be a NumPy"),
        (lambda: many().reset(options=MASK), ValueError, OF_BOOLS),
        (lambda: TaskEnv("point_maze").step([0.0]), ValueError, r"the shape \(1,\); must be \(2,\)"),
        (lambda: TaskEnv("point_maze").step([0.0, 0.0]), ResetNeeded, "call reset before step"),
    ],
)
def test_a_wrong_argument_is_an_error_that_says_what_is_allowed(call, error, sentence):
    with pytest.raises(error, match=sentence):
        call()


@pytest.mark.parametrize("made", [lambda: many(), lambda: TaskEnv("point_maze")])
def test_closed_environments_do_not_step(made):
    envs = made()
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    state = envs.get_state()
    envs.close()
    for call in (
        envs.reset,
        envs.get_state,
        lambda: envs.step(envs.action_space.sample()),
        lambda: envs.set_state(state),
    ):
        with pytest.raises(ClosedEnvironmentError, match="closed; make"):
            call()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_what_cannot_be_copied_says_how_to_make_another(copied):
    with pytest.raises(TypeError, match=r"point_maze hold machine code .* give them with set_state what get_state"):
        copied(many()._lanes)
    if copied is not copy.copy:
        with pytest.raises(TypeError, match="cannot be copied"):
            copied(TaskEnv("point_maze"))


def test_observations_are_new_arrays_unless_one_is_asked_for_that_is_reused():
    for copies in (True, False):
        envs = TaskVectorEnv("point_maze", 3, max_episode_steps=4, copy=copies)
        first = envs.reset(seed=0)[0]
        before = first.copy()
        found = [envs.step(actions) for actions in actions_of(envs, 5)]
        assert np.array_equal(first, before) == copies
        assert (first is found[0][0]) == (not copies)
        if copies:
            expected = found
    same([one[1:] for one in found], [one[1:] for one in expected])  # what an episode ended with is never reused
    same(found[-1][0], expected[-1][0])


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_pictures_show_where_an_environment_is_and_the_way_of_its_episode(mode):
    settings = {"render_mode": "rgb_array", "max_episode_steps": 9}
    envs = TaskVectorEnv("point_maze", 2, autoreset_mode=mode, **settings)
    single = partial(gymnasium.make, "es_service/PointMaze-v0", disable_env_checker=True, **settings)
    theirs = SyncVectorEnv([single] * 2, autoreset_mode=mode)
    envs.reset(seed=3)
    theirs.reset(seed=3)
    for number, actions in enumerate([np.full((2, 2), [1.0, 0.0])] * 14):
        info = envs.step(actions)[-1]
        theirs.step(actions)
        same(envs.render(), theirs.render(), f"step {number}")
        picture = envs.frame(1)
        rows, columns = np.nonzero((picture == drawing.HERE).all(axis=-1))
        place = (np.array([columns.mean(), 255 - rows.mean()]) + 0.5) / 256 * 2.12 - 1.06
        np.testing.assert_allclose(place, info["descriptor"][1], atol=0.03)
    ways = [(picture == drawing.WAY).all(axis=-1).sum() for picture in envs.render()]
    assert all(0 < pixels < 100 for pixels in ways)  # that of the new episode only
    walls = (picture == drawing.WALL).all(axis=-1)
    assert walls[int((1.06 + 0.495) / 2.12 * 256), 150]  # the lower wall, from x = -0.5 to 1
    assert not walls[int((1.06 + 0.495) / 2.12 * 256), 30]
    envs.set_state(envs.get_state())
    assert not (envs.frame(0) == drawing.HERE).all(axis=-1).any()


def test_a_finished_episode_is_not_stepped_where_the_caller_resets():
    envs = TaskVectorEnv("point_maze", 2, max_episode_steps=1, autoreset_mode="Disabled")
    envs.reset(seed=0)
    envs.step(np.zeros((2, 2)))
    with pytest.raises(ResetNeeded, match="the episode of environment 0 is over; reset it"):
        envs.step(np.zeros((2, 2)))


def test_the_service_does_not_import_it():
    loaded = "import sys, es_service.api; print([name for name in sys.modules if name.startswith('gymnasium')])"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert importlib.import_module("es_service.gymnasium").id_of("ant_trap") == "es_service/AntTrap-v0"
