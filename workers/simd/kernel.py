"""A JAX function of one environment, compiled for many: the stages together, and what was compiled before kept."""

from __future__ import annotations

import ctypes
import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from workers.simd import cache as kernel_cache
from workers.simd.emit import emit
from workers.simd.graph import live
from workers.simd.operations import OPERATIONS
from workers.simd.primitives.registry import refusing
from workers.simd.target import Target, compile_object, compiler_version, host_target, load_object
from workers.simd.trace import trace_jaxpr
from workers.simd.words import ALIGNMENT, Words, aligned, pack, unpack, words_of

OWN_VERSION = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py")))
).hexdigest()
"""Of this compiler: a hash of its source, as it was imported."""


class Facts(NamedTuple):
    """What compiling took and gave."""

    jaxpr_s: float
    """Seconds of JAX's own tracing, which xla needs as well."""
    computed: int
    """Scalar operations that are left after folding, loops' bodies once; 0 from the cache."""
    code_bytes: int
    cached: bool


@dataclass(frozen=True)
class Kernel:
    """A compiled function. Calls may run at the same time in several threads: they hold no lock and no state."""

    target: Target
    in_tree: Any
    in_avals: tuple[Any, ...]
    out_tree: Any
    out_avals: tuple[Any, ...]
    facts: Facts
    _function: Callable[[int, int, int], None]
    _alive: Any

    @property
    def words_in(self) -> int:
        """Words of a lane that go in: all elements of all leaves."""
        return sum(map(words_of, self.in_avals))

    @property
    def words_out(self) -> int:
        """Words of a lane that come out."""
        return sum(map(words_of, self.out_avals))

    def run(self, words: Words, out: Words) -> None:
        """Compute [block, words_in, width] -> [block, words_out, width]; both aligned to 64 bytes, as `aligned` makes
        them. Releases the GIL."""
        blocks = len(words)
        assert words.shape == (blocks, self.words_in, self.target.width), words.shape
        assert out.shape == (blocks, self.words_out, self.target.width), out.shape
        for array in (words, out):
            assert array.dtype == np.uint32
            assert array.flags.c_contiguous
            assert array.size == 0 or array.ctypes.data % ALIGNMENT == 0
        assert out.flags.writeable
        assert words is not out
        self._function(words.ctypes.data, out.ctypes.data, blocks)

    def __call__(self, *arguments: Any) -> Any:
        """The function of pytrees whose leaves have one more axis in front, of lanes; NumPy arrays come back."""
        leaves, tree = jax.tree.flatten(arguments)
        assert tree == self.in_tree, f"{tree} is not what was compiled for: {self.in_tree}"
        lanes = len(leaves[0]) if leaves else 1
        for leaf, aval in zip(leaves, self.in_avals, strict=True):
            array = np.asarray(leaf)
            assert array.dtype == aval.dtype, (array.dtype, aval)
            assert array.shape == (lanes, *aval.shape), (array.shape, aval)
        words = pack(leaves, self.target.width)
        out = aligned((len(words), self.words_out, self.target.width))
        self.run(words, out)
        return jax.tree.unflatten(self.out_tree, unpack(out, self.out_avals, lanes))


def compile_kernel(
    function: Callable[..., Any], *arguments: Any, target: Target | None = None, folder: Path | None = None
) -> Kernel:
    """Compile a pure JAX function of one environment.

    Args:
        arguments: pytrees of arrays or ShapeDtypeStructs, without the axis of lanes.
        target: what for; this machine's widest vectors if None.
        folder: of compiled kernels; the user's cache if None.

    Raises:
        UnsupportedError: the function has something that cannot be compiled. NoVectorsError: the processor has no
            AVX2 or FMA.
    """
    target = target or host_target()
    started = time.perf_counter()
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    jaxpr_s = time.perf_counter() - started
    computed, cached = 0, True

    def compile_now() -> bytes:
        nonlocal computed, cached
        graph, inputs, outputs = trace_jaxpr(closed)
        computed, cached = sum(graph.keys[node][0] in OPERATIONS for node in live(graph, outputs)), False
        return compile_object(emit(graph, outputs, inputs, target.width), target)

    code, address, alive = _cached(jaxpr_digest(closed), compile_now, target, folder)
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(address)
    leaves, out_tree = jax.tree.flatten(shape)
    return Kernel(
        target=target,
        in_tree=jax.tree.structure(arguments),
        in_avals=tuple(variable.aval for variable in closed.jaxpr.invars),
        out_tree=out_tree,
        out_avals=tuple(leaves),
        facts=Facts(jaxpr_s, computed, len(code), cached),
        _function=call,
        _alive=alive,
    )


def load_compiled(name: str, text: Callable[[], str], target: Target, folder: Path | None = None) -> tuple[int, object]:
    """(address of `kernel`, what must stay alive as long as it is used) of code given as LLVM IR.

    Args:
        name: tells what it computes, in full: what has the same name is not compiled again.
        folder: of compiled kernels; the user's cache if None.
    """
    return _cached(name, lambda: compile_object(text(), target), target, folder)[1:]


def _cached(
    name: str, compile_now: Callable[[], bytes], target: Target, folder: Path | None
) -> tuple[bytes, int, object]:
    folder = folder or kernel_cache.cache_folder()
    versions = f"{target} {compiler_version()} {OWN_VERSION}"
    key = hashlib.sha256(f"{name} {versions}".encode()).hexdigest()
    code = kernel_cache.load(folder, key) if folder else None
    if code is None:
        code = compile_now()
        if folder:
            kernel_cache.save(folder, key, code)
    return code, *load_object(code, target)


@refusing()
def jaxpr_digest(closed: ClosedJaxpr) -> str:
    """A hash of everything a jaxpr computes: its equations, their parameters and its constants; not names of variables.

    Raises:
        UnsupportedError: a parameter or constant has no text that is the same in every process.
    """
    digests: dict[int, str] = {}

    def of_closed(one: ClosedJaxpr) -> str:
        hasher = hashlib.sha256(of_jaxpr(one.jaxpr).encode())
        for constant in one.consts:
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
            array = np.asarray(value)
            return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
        if callable(value):
            return ""  # rules for derivatives
        if " at 0x" in (text := repr(value)):
            raise ValueError(text)
        return text

    return of_closed(closed)
