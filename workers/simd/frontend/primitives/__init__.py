"""Rules of JAX's primitives for arrays of nodes. To support another primitive, add a rule to a module, and a test.

A rule is `f(tracer, equation, *arrays of nodes) -> array of nodes`, or a list of arrays if the primitive has several
outputs. `equation` has the primitive's parameters and the types of its inputs and outputs. A rule raises
UnsupportedError for cases that it does not support.
"""

from workers.simd.frontend.primitives import axes, control, elementwise, indexing, linear, random

__all__ = ["axes", "control", "elementwise", "indexing", "linear", "random"]
