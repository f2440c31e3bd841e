"""The compiler's README shows what the compiler does: its example is run, and what it prints is compared."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

README = Path(__file__).parents[3] / "workers" / "simd" / "README.md"


def test_the_step_that_is_followed_through_all_stages_comes_out_as_shown() -> None:
    examples = re.findall(r"```python\n(.*?)```\n```text\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(examples) == README.read_text().count("```python") >= 4
    names: dict[str, object] = {}
    for program, shown in examples:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(program, names)
        assert said.getvalue().rstrip() == shown.rstrip(), program
