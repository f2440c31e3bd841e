"""The table of primitives, into which modules enter their rules."""

from __future__ import annotations

from collections.abc import Callable

from workers.simd.frontend.tracer import Rule

PRIMITIVES: dict[str, Rule] = {}
"""Name of JAX's primitive -> its rule."""


def primitive(*names: str) -> Callable[[Rule], Rule]:
    """Enter a rule under the names of primitives."""

    def enter(rule: Rule) -> Rule:
        PRIMITIVES.update(dict.fromkeys(names, rule))
        return rule

    return enter
