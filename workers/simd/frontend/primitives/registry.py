"""The table of primitives, in which the modules of this package register their rules."""

from __future__ import annotations

from collections.abc import Callable

from workers.simd.frontend.tracer import Rule

PRIMITIVES: dict[str, Rule] = {}
"""Rules by the name of JAX's primitive."""


def primitive(*names: str) -> Callable[[Rule], Rule]:
    """Decorator that registers a rule under the names of primitives."""

    def enter(rule: Rule) -> Rule:
        PRIMITIVES.update(dict.fromkeys(names, rule))
        return rule

    return enter
