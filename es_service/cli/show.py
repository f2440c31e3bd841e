"""The commands that only read and print: `digest`, `config` and `list`; and `help`, sections of the guides.

`--json` prints the content of the tables as data.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from rich.console import Console
from rich.markdown import Markdown
from rich.padding import Padding
from rich.table import Table

from es_service.cli.common import (
    JsonOption,
    RunsArgument,
    command,
    console,
    is_single,
    of_each,
    print_json,
    print_line,
    readable,
)
from es_service.config.given import first_sentence, shipped_configs, shipped_text
from es_service.config.keys import SECTIONS, unknown_key
from es_service.config.search import PRESETS, preset_table
from es_service.config.tasks import TASKS, tasks_of_suite
from es_service.config.text import did_you_mean, nearest, one_of, show
from es_service.config.values import DescribedKey, described_keys, methods_words
from es_service.errors import ConfigError
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import Option, allowed_text
from es_service.protocol.sources import SUITES
from es_service.search.algorithms import ALGORITHMS, OURS
from es_service.store.digest import checked_parts, digest_of


def catalogue_data(tasks: Mapping[str, TaskSpec]) -> dict[str, Any]:
    """What `list` shows: the shipped tasks, algorithms, presets and configs."""
    return {
        "tasks": [asdict(task) for task in tasks.values()],
        "algorithms": list(ALGORITHMS),
        "presets": [asdict(row) for row in preset_table(ALGORITHMS)],
        "configs": list(shipped_configs()),
    }


def digest_(
    folders: RunsArgument,
    parts: Annotated[bool, typer.Option("--parts", help="Also print a line for each part of the run.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check all data of a run and print a SHA-256 of everything deterministic in it; of several runs, a line each."""
    single = is_single(folders)

    def show(folder: Path) -> dict[str, Any]:
        part_digests, mixed = checked_parts(folder)
        whole = digest_of(part_digests)
        if not as_json:
            for name, value in part_digests.items() if parts else ():
                print(f"{value}  {name}")
            where = "" if single else f"  {folder}"
            print(f"{whole}{where}{'  mixed' if mixed else ''}", flush=True)
        return {**({} if single else {"run": str(folder)}), "digest": whole, "mixed": mixed, "parts": part_digests}

    problems: list[dict[str, str]] = []
    results = show(folders[0]) if single else [data for _, data in readable(of_each(folders, show), problems)]
    if as_json:
        print_json(results if single else [*results, *problems])
    if problems:
        raise typer.Exit(1)


def config_(
    name: Annotated[
        str, typer.Argument(help="Name of a shipped config, as `list` shows it; with --keys, a key or section.")
    ] = "",
    keys: Annotated[bool, typer.Option("--keys", help="Describe the keys of configs instead.")] = False,
    as_page: Annotated[bool, typer.Option("--markdown", help="With --keys, print a page of Markdown.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Print a shipped config, which you can save as a file and edit, or what keys mean."""
    if not keys:
        if as_json or as_page:
            raise ConfigError("--json and --markdown are for --keys; a shipped config is YAML already")
        print(shipped_text(name), end="")
        return
    everything = described_keys(OURS)
    rows = [row for row in everything if f"{row.key}.".startswith(f"{name}." if name else "")]
    if not rows:
        problem = unknown_key(name, [row.key for row in everything], None)
        raise ConfigError(problem.sentence, field=name, suggestion=problem.suggestion)
    if as_json:
        print_json([row._asdict() for row in rows])
        return
    if as_page:
        print(keys_page(rows), end="")
        return
    for row in rows:
        print_line(console, f"{row.key} = {row.default}", style="bold")
        of_methods = f" A key of {words}." if (words := methods_words(row.methods, OURS)) else ""
        console.print(Padding(f"{row.meaning} Must be {row.allowed}.{of_methods}", (0, 0, 0, 4)))


PAGE_OF_KEYS = """\
# Every key of a config

This page is the output of `es-service config --keys --markdown`, which reads the descriptions of the keys in the code.
`es-service config --keys search.step` shows a part of it.

The default is in parentheses. A key whose default is `required` must be set. A default with a slash depends on
`search.preset`: the first value is that of `literature`, the second that of `uber`. Some methods have other defaults.
"""


def keys_page(rows: Iterable[DescribedKey]) -> str:
    """A page of Markdown: what the class of each section says, and a line for each key, by the methods that have it."""
    grouped: dict[str, dict[tuple[str, ...], list[DescribedKey]]] = {}
    for row in rows:
        grouped.setdefault(row.key.split(".")[0], {}).setdefault(row.methods, []).append(row)
    parts = [PAGE_OF_KEYS]
    for section, by_methods in grouped.items():
        about = [f"{SECTIONS[section].__doc__}\n"] if section in SECTIONS else []
        parts += [f"## {section}\n", *about]
        for methods, group in by_methods.items():
            words = methods_words(methods, OURS)
            heading = [f"### {section}: keys of {words}\n"] if words else []
            lines = [f"- **`{row.key}`** ({row.default}): {row.meaning} *Must be {row.allowed}.*\n" for row in group]
            parts += [*heading, "".join(lines)]
    return "\n".join(parts)


def list_(
    suite: Annotated[
        str | None,
        typer.Option(metavar="NAME", help=f"Show the environments of an installed suite: {', '.join(SUITES)}."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show tasks, algorithms, presets and shipped configs, or the environments of a suite."""
    if suite is not None:
        list_suite(suite, as_json)
    elif as_json:
        print_json(catalogue_data(TASKS))
    else:
        print_catalogue(console, TASKS)


LIBRARIES = ("brax", "gymnasium", "mujoco")
"""Prefixes of tasks that are those of a library, and not of a suite."""


def list_suite(suite: str, as_json: bool) -> None:
    """Print the names of a suite's environments, and then their sizes, each as soon as it is known."""
    if suite in LIBRARIES:
        what = f"{suite} is no suite, and has environments of its own by {suite}:NAME"
        raise ConfigError(f"--suite {suite}: {what}; {command('help', 'other_suites')} has them")
    if suite not in SUITES:
        hint = did_you_mean(suite, SUITES)
        raise ConfigError(f"--suite {suite}: there is no such suite; must be {one_of(SUITES)}{hint}")

    def show_names(names: Sequence[str]) -> None:
        if not as_json:
            print_line(console, f"{len(names)} environments: {', '.join(names)}\n")

    rows = []
    for name, task in tasks_of_suite(suite, show_names):
        rows.append(asdict(task) if isinstance(task, TaskSpec) else {"name": name, "problem": task})
        if not as_json:
            print_line(console, name, style="bold")
            console.print(Padding(task if isinstance(task, str) else _about(task), (0, 0, 0, 4)))
    if as_json:
        print_json(rows)


def print_catalogue(console: Console, known_tasks: Mapping[str, TaskSpec]) -> None:
    """Print tables of tasks, algorithms, the values of presets, and shipped configs."""
    tasks = _table("tasks (task.environment)")
    for task in known_tasks.values():
        tasks.add_row(task.name, _about(task))
    tasks.add_row("brax:NAME", "any environment of the installed Brax")
    tasks.add_row("mujoco:ID", "an environment of Gymnasium by MJX, such as mujoco:Ant-v5")
    for name in SUITES:
        tasks.add_row(f"{name}:NAME", f"an environment of {name}; {command('list', '--suite', name)} shows them")
    tasks.add_row("gymnasium:ID", "an environment of Gymnasium, with Box or Discrete spaces")
    tasks.add_row("module:Class", "a task of your own in JAX; see workers/own_tasks.md")
    tasks.add_row("python:module:Class", "a task of your own in Python: an object with reset and step")
    tasks.add_row("function:module:name", "a function of parameters of your own, without a policy")
    console.print(tasks)

    algorithms = _table("algorithms (search.algorithm)")
    for name, method in ALGORITHMS.items():
        algorithms.add_row(name, method.summary)
    algorithms.add_row("evosax:NAME", "An optimiser of evosax, such as evosax:CMA_ES; see configs/own_searches.md.")
    algorithms.add_row("module:function", "A search of your own; see es_service/search/algorithms/method.py.")
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


DESCRIPTOR_OF_SUITE = "a list of places in an observation and names of measures, or module:function"
"""What the only option without a default may be, of the tasks that are listed."""


def _option(option: Option) -> str:
    """What a config may set, the default first."""
    if option.choices:
        return " | ".join(map(show, option.choices))
    if option.default is None:
        return f"null ({DESCRIPTOR_OF_SUITE})"
    return f"{show(option.default)} ({allowed_text(option, show)})"


def _value(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else show(value)


# The command `help`: sections of the guides in the terminal, for whoever has a wheel and no clone.

PACKAGE = Path(__file__).parents[1]
CLONE = PACKAGE.parent
GUIDES = {
    "using": (PACKAGE / "guides" / "using.md",),
    "tutorial": (PACKAGE / "guides" / "tutorial.md",),
    "certify": (PACKAGE / "guides" / "certify.md",),
    **{
        name: tuple(folder / f"{file}.md" for folder in (CLONE / "configs", PACKAGE / "shipped_configs"))
        for name, file in {
            "configs": "README",
            "which_method": "which_method",
            "methods": "methods",
            "parts": "parts",
            "keys": "keys",
            "sweeps": "sweeps",
            "own_searches": "own_searches",
            "other_libraries": "other_libraries",
        }.items()
    },
    "workers": (CLONE / "workers" / "README.md",),
    "own_tasks": (CLONE / "workers" / "own_tasks.md",),
    "other_suites": (CLONE / "workers" / "other_suites.md",),
    "policies": (CLONE / "workers" / "policies.md",),
    "docker": (CLONE / "docker" / "README.md", PACKAGE / "launch_files" / "README.md"),
    "es_service": (PACKAGE / "README.md",),
    "simd": (CLONE / "workers" / "simd" / "README.md",),
}
"""Guide -> its file in a clone, and in an installed package where that is another."""


class GuideSection(NamedTuple):
    """A heading of a guide, and what stands below it."""

    guide: str
    level: int
    heading: str
    """Without marks of code and links."""
    text: str
    """From the heading to the next one of the same or a higher level."""


def sections() -> list[GuideSection]:
    """Of all guides that are here, in their order."""
    found = []
    for guide, files in GUIDES.items():
        text = next((file.read_text() for file in files if file.exists()), "")
        outside_of_code = re.sub(r"^```.*?^```", lambda block: re.sub(r"\S", "-", block[0]), text, flags=re.M | re.S)
        headings = [*re.finditer(r"^(#+) (.*)$", outside_of_code, re.MULTILINE)]
        for number, heading in enumerate(headings):
            level = len(heading[1])
            later = (other.start() for other in headings[number + 1 :] if len(other[1]) <= level)
            plain = re.sub(r"`|\[([^\]]*)\]\([^)]*\)", r"\1", heading[2])
            found.append(GuideSection(guide, level, plain, text[heading.start() : next(later, len(text))]))
    return found


def named(topic: str, of: list[GuideSection]) -> list[GuideSection]:
    """Sections whose headings have all words of a topic, the shortest heading first."""
    words = topic.lower().split()
    found = [section for section in of if all(word in section.heading.lower() for word in words)]
    return sorted(found, key=lambda section: len(section.heading))


def help_(
    topic: Annotated[
        list[str] | None,
        typer.Argument(metavar="[TOPIC]", help="Words of a section's heading, or a guide; default: list all sections."),
    ] = None,
) -> None:
    """Print a section of the guides."""
    everything, words = sections(), " ".join(topic or ())
    if not words:
        for section in everything:
            if section.level <= 2:
                print_line(console, f"{'  ' * section.level}{section.heading}", "bold" if section.level == 1 else None)
        return
    found = [section for section in everything if section.guide == words] or named(words, everything)
    if not found:
        known = [section.heading for section in everything]
        near = nearest(words, known)
        raise ConfigError(
            f"help {words}: no heading of the guides has these words{did_you_mean(words, known)}; `es-service help` "
            "lists them",
            suggestion=near and f"es-service help {near}",
        )
    if console.is_terminal:
        console.print(Markdown(found[0].text))
    else:
        print(found[0].text, end="")
    if others := [section.heading for section in found[1:] if section.guide != words]:
        print_line(console, f"\nother sections: {'; '.join(others)}")
