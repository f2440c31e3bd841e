"""The consoles on which commands print.

Names, values and errors of a user are printed as they are: nothing in them is taken for a style or an emoji.
"""

from __future__ import annotations

from rich.console import Console


def text_console(*, stderr: bool = False, width: int | None = None) -> Console:
    """A console that prints text as it is; `width` is that of the terminal by default."""
    return Console(stderr=stderr, width=width, markup=False, emoji=False, highlight=False)


console = text_console()
errors = text_console(stderr=True)


def print_line(console: Console, text: str, style: str | None = None) -> None:
    """Print text without wrapping or cutting its lines, so that folders and commands can be copied."""
    console.print(text, style=style, soft_wrap=True)
