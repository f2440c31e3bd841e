"""Tasks by name, where the name is asked of another process."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.cli.bench import bench_rollouts
from es_service.config import tasks
from es_service.config.tasks import TASKS, task_of
from es_service.config.workload import config_warnings
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import ConfigError
from es_service.protocol.messages import TrainingChunk, with_subject
from es_service.protocol.noise import uniforms
from es_service.protocol.options import Option
from es_service.search.algorithms import ALGORITHMS
from tests.es_service.config_examples import load_config
from tests.examples.beam import beam
from tests.helpers import SPEC, centre, random_parameters
from workers.describe import does_not_repeat
from workers.environments import SHIPPED, TaskError, describe_environment, make_environment
from workers.rollouts import BACKENDS

HERE = __name__


def test_the_field_of_a_problem_is_the_key_that_names_it():
    """What the user's function raised comes with its frames in the user's files."""
    task = {"environment": "python:tests.workers.host_tasks:CornerMaze", "descriptor": "tests.examples.beam:beam"}
    with pytest.raises(ConfigError) as caught:
        load_config(
            {"task": task, "search": {"algorithm": "es"}, "budget": {"generations": 1}},
            tasks=TASKS,
            algorithms=ALGORITHMS,
            rollouts=BACKENDS,
        )
    assert caught.value.field == "task.descriptor"
    assert "cannot unpack" in str(caught.value)
    assert "beam.py" in str(caught.value)
    with pytest.raises(ConfigError, match="function:beam has one colon; must be function:module:name"):
        TASKS["function:beam"]


class Still:
    """a point stays where it is"""

    observation_size = action_size = 2
    episode_steps = 5
    descriptor_names = ("x", "y")
    descriptor_bounds = ((0.0, 1.0), (0.0, 1.0))

    def observe(self, state):
        return state

    def step(self, state, action):
        return state, state[0], jnp.array(False)

    def descriptor(self, state):
        return state


class TakesItForJax(Still):
    """its key is passed to jax.random"""

    def reset(self, key):
        return jax.random.uniform(jax.random.split(key)[0], (2,))


class MakesOne(Still):
    """its key is made a key of JAX"""

    def reset(self, key):
        return jax.random.uniform(jax.random.wrap_key_data(key[:2]), (2,))


class UsesItTwice(Still):
    """its key is passed to jax.random and to our generator"""

    def reset(self, key):
        return jnp.stack([jax.random.uniform(key), uniforms(key, jnp.uint32(0))])


class FailsAnyway(Still):
    """its reset has another fault"""

    def reset(self, key):
        return uniforms(key, jnp.arange(2, dtype=jnp.uint32)) + jnp.zeros(3)


class Longer(Still):
    """an option changes what a run takes from the class"""

    options = {"steps": Option(5, low=1)}  # noqa: RUF012

    def __init__(self, steps=5):
        self.episode_steps = steps


def test_an_attribute_that_the_constructor_changes_is_refused_and_not_ignored():
    assert make_environment(f"{HERE}:Longer", {"steps": 5}) is not None
    with pytest.raises(TaskError, match=r"its constructor changes episode_steps \(5 -> 20\)"):
        make_environment(f"{HERE}:Longer", {"steps": 20})


def _loaded(task: dict, **compute):
    settings = {"task": task, "search": {"algorithm": "es"}, "budget": {"generations": 1}, "compute": compute}
    return load_config(settings, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS)


@pytest.mark.slow
def test_the_options_of_a_run_decide_which_rollouts_can_compute_its_task():
    name = "tests.es_service.xla_tasks:SometimesTransformed"
    chosen = {"environment": name, "options": {"transforms": True}}
    config = _loaded(chosen)
    assert config.compute.rollout == "xla"
    (warning,) = config_warnings(config, task_of(config), BACKENDS)
    assert warning.startswith(f"compute.rollout: xla is used because simd cannot run {name}: the primitive fft (at ")
    with pytest.raises(ConfigError, match=r"simd cannot run .*: the primitive fft .*; must be auto or xla"):
        _loaded(chosen, rollout="simd")
    for options in ({}, {"transforms": False}):
        assert _loaded({"environment": name, "options": options}).compute.rollout == "simd"
    with pytest.raises(ConfigError, match=r"task.options.transforms: 5 is not allowed"):
        _loaded({"environment": name, "options": {"transforms": 5}})


def test_what_a_trial_finds_of_a_task_holds_for_the_options_of_the_run():
    """Shapes, and whether it repeats itself."""
    with pytest.raises(TaskError, match=r"observe has the shape \(3,\), not \(2,\)"):
        describe_environment(f"{HERE}:Widened", {"options": {"size": 3}})
    assert describe_environment(f"{HERE}:Widened", {"options": {"size": "no number"}}).observation_size == 2
    task = describe_environment(f"python:{HERE}:Counting")
    assert (does_not_repeat(task, {"counts": False}), does_not_repeat(task, {"counts": True})) == (
        "",
        "after another episode",
    )


class Widened(Still):
    """an option changes the number of observations"""

    options = {"size": Option(2, low=1)}  # noqa: RUF012

    def __init__(self, size=2):
        self.size = size

    def reset(self, key):
        return jnp.zeros(self.size)

    def descriptor(self, state):
        return state[:2]


class Plain:
    """a task of Python objects"""

    observation_size = action_size = 1
    episode_steps = 3

    def reset(self, seed):
        return np.zeros(1)

    def step(self, action):
        return np.zeros(1), 0.0, False


class Counting(Plain):
    """an option lets it count its episodes"""

    options = {"counts": (False, True)}  # noqa: RUF012

    def __init__(self, counts=False):
        self.counts, self.episodes = counts, 0

    def reset(self, seed):
        self.episodes += self.counts
        return np.full(1, self.episodes)


class Named(Still):
    """attributes and methods with names of its own"""

    def reset(self, key):
        return uniforms(key, jnp.arange(2, dtype=jnp.uint32))


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        (
            "discrete_actions",
            True,
            r"discrete_actions = True has no effect on a task in JAX: .* policy.output to argmax",
        ),
        (
            "action_bounds",
            (0.0, 1.0),
            r"action_bounds = \(0.0, 1.0\) has no effect on a task in JAX: .* clip and scale",
        ),
    ],
)
def test_what_only_tasks_of_python_objects_declare_is_refused_in_jax(name, value, found, monkeypatch):
    monkeypatch.setattr(Named, name, value, raising=False)
    with pytest.raises(TaskError, match=rf"{HERE}:Named: {found}"):
        describe_environment(f"{HERE}:Named")
    monkeypatch.setattr(Named, name, False if value is True else None)
    assert describe_environment(f"{HERE}:Named").notes == ()


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("wals", "walls"),
        ("Goal", "goal"),
        ("goalDistance", "goal_distance"),
        ("succes", "success"),
        ("final_fitnes", "final_fitness"),
        ("leats_reward", "least_reward"),
        ("option", "options"),
        ("action_space", "action_size"),
        ("max_episode_steps", "episode_steps"),
    ],
)
def test_a_name_that_is_nearly_that_of_an_attribute_is_noted(name, meant, monkeypatch):
    for task, kind in ((f"{HERE}:Named", Named), (f"python:{HERE}:Plain", Plain)):
        monkeypatch.setattr(kind, name, 1, raising=False)
        (note,) = describe_environment(task).notes
        assert note.startswith(f"{task}: {name} has no effect, ")
        assert f"did you mean {meant}?" in note


def test_beside_the_attribute_itself_a_similar_name_is_its_author_s_own(monkeypatch):
    monkeypatch.setattr(Named, "goals", ((0.0, 1.0), (1.0, 1.0)), raising=False)
    assert "did you mean goal?" in describe_environment(f"{HERE}:Named").notes[0]
    monkeypatch.setattr(Named, "goal", (0.0, 1.0), raising=False)
    assert describe_environment(f"{HERE}:Named").notes == ()


def test_names_of_its_own_are_nobody_s_business(monkeypatch):
    own = ("_wals", "goal_x", "moves", "wall_height", "reward", "rewards", "distance_to_goal", "best_reward", "is_done",
           "final_state", "observation", "actions", "metadata", "render_mode", "spec", "rng", "render")  # fmt: skip
    for name in own:
        monkeypatch.setattr(Named, name, 1, raising=False)
        monkeypatch.setattr(Plain, name, lambda self: 1, raising=False)
    assert describe_environment(f"{HERE}:Named").notes == describe_environment(f"python:{HERE}:Plain").notes == ()


def test_a_misspelt_attribute_that_a_class_needs_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.delattr(Still, "descriptor_names")
    monkeypatch.setattr(Still, "descriptor_name", ("x", "y"), raising=False)
    with pytest.raises(TaskError, match=r"Named has no descriptor_names \(but descriptor_name\); workers/environments"):
        describe_environment(f"{HERE}:Named")


def test_a_misspelt_attribute_of_a_function_is_noted(monkeypatch):
    name = "function:tests.examples.beam:beam"
    assert describe_environment(name).notes == ()
    monkeypatch.setattr(beam, "starts", (1.0, 1.0, 0.01), raising=False)
    (note,) = describe_environment(name).notes
    assert "did you mean start?" in note


@pytest.mark.slow
def test_a_current_folder_with_modules_of_our_names_is_nobody_s_business(tmp_path, monkeypatch):
    """Neither where a task is described, nor where rollouts are measured, nor where they are run."""
    for name in ("workers", "es_service", "jax"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="pathlib:Path has no observation_size"):
        TASKS["pathlib:Path"]
    row = next(bench_rollouts(["point_maze"], policies=[False], rollouts=["xla"], batches=[8], seconds=0.0))
    assert row["batch"] == 8
    with inline_engine(SPEC, Limits(1, max_start_failures=1)) as engine:
        assert len(engine.evaluate(with_subject(centre(random_parameters()), [TrainingChunk(1, 0)]))) == 1


def test_a_reset_that_takes_its_key_for_one_of_jax_is_told_how_to_make_one():
    """Both before the run, by the driver, and in a worker."""
    sentence = (
        r"reset\(key\) passes its key to jax\.random.*noise\.uniforms\(key.*jax\.random\.wrap_key_data\(key\[:2\]\)"
    )
    with pytest.raises(TaskError, match=f"TakesItForJax: .*{sentence}"):
        describe_environment(f"{HERE}:TakesItForJax")
    keys_2_4 = np.arange(8, dtype=np.uint32).reshape(2, 4)
    with pytest.raises(TaskError, match=sentence):
        jax.jit(jax.vmap(make_environment(f"{HERE}:TakesItForJax", {}).reset))(keys_2_4)
    with pytest.raises(TaskError, match=f"UsesItTwice: .*{sentence}"):
        describe_environment(f"{HERE}:UsesItTwice")
    with pytest.raises(TaskError, match="FailsAnyway cannot be traced by JAX: TypeError"):
        describe_environment(f"{HERE}:FailsAnyway")
    states_2_2 = jax.vmap(make_environment(f"{HERE}:MakesOne", {}).reset)(keys_2_4)
    assert len(np.unique(states_2_2)) == 4
    assert describe_environment(f"{HERE}:MakesOne").name == f"{HERE}:MakesOne"


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("gym:CartPole-v1", r"did you mean gymnasium:CartPole-v1\?"),
        ("python:CartPole-v1", r"did you mean gymnasium:CartPole-v1\?"),
        ("robots.arms:Arm-v0", r"did you mean gymnasium:robots.arms:Arm-v0\?"),
        ("python:robots.arms.Arm", "such as python:robots.arms:Arm$"),
        ("python:Arm", "such as python:my_module:Arm$"),
        ("function:", "such as function:my_module:name$"),
        (f"python:{HERE}:Pliant", rf"has no class Pliant; did you mean {HERE}:Plain\?"),
        (f"{HERE}:still", rf"has no class still; did you mean {HERE}:Still\?"),
        ("function:tests.examples.beam:baem", r"has no function baem; did you mean tests.examples.beam:beam\?"),
        (f"{HERE}:Zqx", "has no class Zqx$"),
        (
            "tests.examples.beam:beam",
            r"beam is a function and no class; did you mean function:tests.examples.beam:beam\?$",
        ),
        ("python:tests.examples.beam:beam", r"no class; did you mean function:tests.examples.beam:beam\?$"),
        (f"function:{HERE}:Plain", rf"its objects are no functions; did you mean python:{HERE}:Plain\?$"),
        (f"{HERE}:Plain", rf"has no .*observe, .*; if it simulates in Python, did you mean python:{HERE}:Plain\?"),
    ],
)
def test_what_a_name_may_mean_is_suggested(name, found):
    with pytest.raises(TaskError, match=found):
        describe_environment(name)


@pytest.mark.parametrize(
    ("method", "value", "found"),
    [
        (
            "step",
            lambda self, state, action: None,
            r"step returned None \(is a `return` missing\?\); it must return \(",
        ),
        ("step", lambda self, state, action: (state, 0.0), r"step returned \(\*, \*\); it must return \(state, reward"),
        (
            "step",
            lambda self, state, action: (state, None, False),
            r"step returned \(\*, None, \*\); its reward and done must not be None",
        ),
        ("observe", lambda self, state: None, r"observe returned None \(is a `return` missing\?\); it must return one"),
        ("descriptor", lambda self, state: [state[0]] * 2, r"descriptor returned \[\*, \*\]; it must return one array"),
        ("success", lambda self, state, before: None, r"success returned None \(is a `return` missing"),
        ("goal_distance", lambda self, state: None, r"goal_distance returned None \(is a `return` missing"),
    ],
)
def test_what_a_method_in_jax_does_not_return_is_said_in_one_sentence(method, value, found, monkeypatch):
    monkeypatch.setattr(Named, method, value, raising=False)
    with pytest.raises(TaskError, match=rf"^{HERE}:Named: {found}[^\n]*$"):
        describe_environment(f"{HERE}:Named")


def test_a_constructor_that_needs_arguments_is_refused_in_one_sentence(monkeypatch):
    monkeypatch.setattr(Named, "__init__", lambda self, length: None)
    monkeypatch.setattr(Plain, "__init__", lambda self, length: None)
    for name in (f"{HERE}:Named", f"python:{HERE}:Plain"):
        with pytest.raises(
            TaskError, match=r"cannot be called with no arguments \(.*length.*\); give each[^\n]*$"
        ) as caught:
            describe_environment(name)
        assert "\n" not in str(caught.value)
    monkeypatch.setattr(Plain, "__init__", lambda self: None + 1)
    with pytest.raises(TaskError, match=r"TypeError: unsupported operand[^$]*test_tasks.py"):
        describe_environment(f"python:{HERE}:Plain")


@pytest.mark.parametrize(("key", "known"), [("task.environment", TASKS), ("search.algorithm", ALGORITHMS)])
def test_what_is_defined_in_a_notebook_belongs_into_a_file(key, known):
    with pytest.raises(ConfigError, match=r"put it in a file, such as my_maze\.py .*name it my_maze:MyMaze"):
        known["__main__:MyMaze"]
    for given, told in (
        (Still, f"name it as text: {HERE}:Still"),
        (type("MyMaze", (), {"__module__": "__main__"}), "my_maze:MyMaze"),
    ):
        section, name = key.split(".")
        with pytest.raises(ConfigError, match=told) as caught:
            load_config({section: {name: given}}, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS)
        assert caught.value.problems[0].field == key


def test_what_a_library_defines_is_described_once_for_all_processes(tmp_path, monkeypatch):
    """Until the code or a version changes; what users define is asked for in each process."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    asked: list[str] = []
    fields = json.loads(json.dumps(dataclasses.asdict(SHIPPED["ant_trap"])))
    monkeypatch.setattr(tasks, "_ask_for_description", lambda name, settings: asked.append(name) or fields)

    def described(*names: str) -> list[str]:
        """Names of the tasks that a process asks for which looks these up."""
        tasks._described.cache_clear()
        asked.clear()
        assert all(TASKS[name] == SHIPPED["ant_trap"] for name in names)
        return asked

    try:
        libraries, users = ["brax:ant", "mujoco:Ant-v5"], [f"{HERE}:Named", f"python:{HERE}:Plain"]
        assert described(*libraries, *users) == [*libraries, *users]
        assert described(*libraries, *users) == users
        entry = next((tmp_path / "es-service" / "kernels").iterdir())
        entry.write_bytes(entry.read_bytes()[:-1])
        assert len(described(*libraries)) == 1
        monkeypatch.setattr(tasks, "worker_sources", lambda: {"workers/other.py": "0"})
        assert described(*libraries) == libraries
        assert described(*libraries) == []
    finally:
        tasks._described.cache_clear()
