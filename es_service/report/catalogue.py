"""What there is to choose from: tasks, algorithms, presets."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from es_service.algorithms import ALGORITHMS
from es_service.config.presets import PRESETS, preset_table
from es_service.config.yaml_text import show
from es_service.protocol import TaskSpec


def print_catalogue(console: Console, known_tasks: Mapping[str, TaskSpec]) -> None:
    """Tables of tasks, algorithms, and of the keys on which presets differ."""
    tasks = Table(title="tasks (task.environment)", title_justify="left")
    for name in ("name", "observation", "action", "steps", "descriptor", "options"):
        tasks.add_column(name)
    for task in known_tasks.values():
        bounds = zip(task.descriptor_names, task.descriptor_bounds, strict=True)
        tasks.add_row(
            task.name,
            str(task.observation_size),
            str(task.action_size),
            str(task.episode_steps),
            ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in bounds),
            "; ".join(f"{name}: {' | '.join(values)}" for name, values in task.options.items()),
        )
    console.print(tasks)

    algorithms = Table(title="algorithms (search.algorithm)", title_justify="left")
    algorithms.add_column("name")
    algorithms.add_column("what it is")
    for name, factory in ALGORITHMS.items():
        algorithms.add_row(name, (factory.__doc__ or "").strip().splitlines()[0])
    console.print(algorithms)

    presets = Table(title="presets (search.preset): the keys on which they differ", title_justify="left")
    presets.add_column("key")
    for name in PRESETS:
        presets.add_column(name)
    for row in preset_table():
        presets.add_row(row.key, *(_value(getattr(row, name)) for name in PRESETS))
    console.print(presets)


def _value(value: object) -> str:
    """As one would type it in a config."""
    return f"{value:g}" if isinstance(value, float) else show(value)
