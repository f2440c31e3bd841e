"""Tables of the available tasks, algorithms, presets and shipped configs."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from es_service.config.given import first_sentence, shipped_configs
from es_service.config.search import PRESETS, preset_table
from es_service.config.text import show
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import Option, allowed_text
from es_service.search.algorithms import ALGORITHMS


def print_catalogue(console: Console, known_tasks: Mapping[str, TaskSpec]) -> None:
    """Print tables of tasks, algorithms, the values of presets, and shipped configs."""
    tasks = _table("tasks (task.environment)")
    for task in known_tasks.values():
        tasks.add_row(task.name, _about(task))
    tasks.add_row("brax:NAME", "any environment of the installed Brax")
    tasks.add_row("mujoco:ID", "an environment of Gymnasium by MJX, such as mujoco:Ant-v5")
    tasks.add_row("gymnax:NAME", "an environment of gymnax 1.0, such as gymnax:CartPole-v1")
    tasks.add_row("playground:NAME", "an environment of MuJoCo Playground 0.2, such as playground:CartpoleBalance")
    tasks.add_row("gymnasium:ID", "an environment of Gymnasium, with Box or Discrete spaces")
    tasks.add_row("module:Class", "a task of your own in JAX; see workers/README.md")
    tasks.add_row("python:module:Class", "a task of your own in Python: an object with reset and step")
    tasks.add_row("function:module:name", "a function of parameters of your own, without a policy")
    console.print(tasks)

    algorithms = _table("algorithms (search.algorithm)")
    for name, method in ALGORITHMS.items():
        algorithms.add_row(name, method.summary)
    algorithms.add_row("module:function", "A search of your own; see es_service/search/algorithms/user_method.py.")
    console.print(algorithms)

    presets = Table(
        title="presets (search.preset): what they fill in where a config leaves it out", title_justify="left"
    )
    presets.add_column("key")
    for name in PRESETS:
        presets.add_column(name)
    for row in preset_table(ALGORITHMS):
        key = row.key if row.method is None else f"{row.key} of {row.method}"
        presets.add_row(key, *(_value(getattr(row, name)) for name in PRESETS))
    console.print(presets)

    configs = _table("configs (es-service run NAME, es-service config NAME)")
    for name, file in shipped_configs().items():
        configs.add_row(name, first_sentence(file.read_text()))
    console.print(configs)


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("name", no_wrap=True)
    table.add_column("description")
    return table


def _about(task: TaskSpec) -> str:
    bounds = zip(task.descriptor_names, task.descriptor_bounds, strict=True)
    lines = [
        task.summary,
        f"observation {task.observation_size}, action {task.action_size}, steps {task.episode_steps}",
        "descriptor: " + ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in bounds),
        *([f"success: {task.success}"] if task.success else []),
        *(f"option {name}: {_option(option)}" for name, option in task.options.items()),
    ]
    return "\n".join(lines)


def _option(option: Option) -> str:
    """What a config may set, the default first."""
    if option.choices:
        return " | ".join(map(show, option.choices))
    return f"{show(option.default)} ({allowed_text(option, show)})"


def _value(value: object) -> str:
    """A value as written in a config."""
    return f"{value:g}" if isinstance(value, float) else show(value)
