"""The compiler's README shows what the compiler does: its example is run, and what it prints is compared."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).parents[3]
README = ROOT / "workers" / "simd" / "README.md"
TRACED_BY = f'jax=={jax.__version__}; python_version < "3.12"'
"""Other versions of JAX name the variables of a jaxpr differently, and use other primitives for the same function."""


@pytest.mark.skipif(
    TRACED_BY not in (ROOT / "constraints.txt").read_text().splitlines(),
    reason="the guide shows another version's jaxpr",
)
def test_the_step_that_is_followed_through_all_stages_comes_out_as_shown() -> None:
    examples = re.findall(r"```python\n(.*?)```\n```text\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(examples) == README.read_text().count("```python") >= 4
    names: dict[str, object] = {}
    for program, shown in examples:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(program, names)
        assert said.getvalue().rstrip() == shown.rstrip(), program
