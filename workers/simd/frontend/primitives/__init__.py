"""What each of JAX's primitives means for arrays of nodes. To support another one, add a rule to a module and a test.

A rule is `f(tracer, equation, *arrays of nodes) -> array of nodes`, or a list where the primitive has several outputs.
`equation` has the primitive's parameters and the types of what goes in and out. A rule raises UnsupportedError for what
it cannot do.
"""

from workers.simd.frontend.primitives import arithmetic, choices, control, reductions, structure
from workers.simd.frontend.primitives.registry import PRIMITIVES

__all__ = ["PRIMITIVES", "arithmetic", "choices", "control", "reductions", "structure"]
