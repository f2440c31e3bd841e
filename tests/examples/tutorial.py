"""The tutorial as a notebook, made of its text: `python -m tests.examples.tutorial` writes tutorial.ipynb anew."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
TEXT = ROOT / "es_service" / "guides" / "tutorial.md"
NOTEBOOK = Path(__file__).with_name("tutorial.ipynb")
BLOCK = re.compile(r"^```(python|bash)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def cells() -> list[tuple[str, str]]:
    """(kind, source) of each cell: Markdown, or the lines of a Python block, or commands of the shell."""
    text, found, end = TEXT.read_text(), [], 0
    for block in BLOCK.finditer(text):
        found += [("markdown", text[end : block.start()]), (block[1], block[2])]
        end = block.end()
    return [(kind, source.strip()) for kind, source in [*found, ("markdown", text[end:])]]


def notebook() -> str:
    """The content of the notebook's file, without outputs: those of the text are in its Markdown."""
    made: list[dict[str, Any]] = []
    for number, (kind, source) in enumerate(cells()):
        if kind == "bash":
            source = "\n".join(f"!{line}" for line in source.splitlines())
        cell = {"cell_type": "markdown" if kind == "markdown" else "code", "id": f"cell-{number}", "metadata": {}}
        cell["source"] = source.splitlines(keepends=True)
        made.append(cell if kind == "markdown" else cell | {"execution_count": None, "outputs": []})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return json.dumps({"cells": made, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(notebook())
