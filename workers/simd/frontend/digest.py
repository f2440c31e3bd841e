"""Hashes of jaxprs, by which compiled kernels are found in the cache on disk."""

from __future__ import annotations

import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from workers.simd.graph.unsupported import refusing


def partitionable() -> bool:
    """JAX's setting that says which of two ways random numbers are made of threefry keys."""
    config: Any = jax.config
    return config.jax_threefry_partitionable


@refusing()
def jaxpr_digest(closed: ClosedJaxpr) -> str:
    """Hash of everything that a jaxpr computes: its equations, their parameters and its constants.

    Names of variables do not change it.

    Raises:
        UnsupportedError: the text of a parameter or constant is not the same in every process.
    """
    digests: dict[int, str] = {}

    def of_closed(closed_jaxpr: ClosedJaxpr) -> str:
        hasher = hashlib.sha256(of_jaxpr(closed_jaxpr.jaxpr).encode())
        for constant in closed_jaxpr.consts:
            hasher.update(of_value(constant).encode())
        return hasher.hexdigest()

    def of_jaxpr(jaxpr: Jaxpr) -> str:
        if id(jaxpr) in digests:
            return digests[id(jaxpr)]
        numbers: dict[Any, int] = {}

        def name(atom: Any) -> str:
            if isinstance(atom, Literal):
                return f"{of_value(atom.val)}:{atom.aval}"
            return f"{numbers.setdefault(atom, len(numbers))}:{atom.aval}"

        lines = [" ".join(map(name, [*jaxpr.constvars, *jaxpr.invars]))]
        for equation in jaxpr.eqns:
            parameters = [f"{key}={of_value(value)}" for key, value in sorted(equation.params.items()) if key != "name"]
            if equation.primitive.name.startswith("random_"):
                parameters.append(f"partitionable={partitionable()}")
            lines.append(f"{list(map(name, equation.outvars))} {equation.primitive.name} {parameters} "
                         f"{list(map(name, equation.invars))}")  # fmt: skip
        lines.append(" ".join(map(name, jaxpr.outvars)))
        digests[id(jaxpr)] = hashlib.sha256("\n".join(lines).encode()).hexdigest()
        return digests[id(jaxpr)]

    def of_value(value: Any) -> str:
        if isinstance(value, ClosedJaxpr):
            return of_closed(value)
        if isinstance(value, Jaxpr):
            return of_jaxpr(value)
        if isinstance(value, tuple | list):
            return f"({','.join(map(of_value, value))})"
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
                return f"{value.dtype}{of_value(jax.random.key_data(jnp.asarray(value)))}"
            array = np.asarray(value)
            return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
        if callable(value):
            return ""  # a rule for derivatives, which kernels do not use
        if " at 0x" in (text := repr(value)):
            raise ValueError(f"a parameter whose text contains an address and differs between processes: {text}")
        return text

    return of_closed(closed)
