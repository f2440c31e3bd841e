"""The command `help`: sections of the guides in the terminal, for whoever has a wheel and no clone."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.markdown import Markdown

from es_service.cli.printing import console, print_line
from es_service.config.text import did_you_mean, nearest
from es_service.errors import ConfigError

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


class Section(NamedTuple):
    """A heading of a guide, and what stands below it."""

    guide: str
    level: int
    heading: str
    """Without marks of code and links."""
    text: str
    """From the heading to the next one of the same or a higher level."""


def sections() -> list[Section]:
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
            found.append(Section(guide, level, plain, text[heading.start() : next(later, len(text))]))
    return found


def named(topic: str, of: list[Section]) -> list[Section]:
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
