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
from numpy.typing import NDArray

from workers.simd import cache as kernel_cache
from workers.simd import loops
from workers.simd.emit import emit
from workers.simd.graph import live
from workers.simd.operations import OPERATIONS
from workers.simd.target import Target, compile_object, compiler_version, host_target, load_object
from workers.simd.trace import trace_jaxpr

Words = NDArray[np.uint32]
"""[block, word, lane]: what kernels read and write; floats and integers by their bits, truth as 0 or 1."""
ALIGNMENT = 64
OWN_VERSION = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py")))
).hexdigest()
"""Of this compiler: a hash of its source, as it was imported."""


class Facts(NamedTuple):
    """What compiling took; seconds."""

    jaxpr_s: float
    """JAX's own tracing, which xla needs as well."""
    trace_s: float
    """From the jaxpr to the scalar graph. 0 from the cache."""
    emit_s: float
    compile_s: float
    """LLVM's part. From the cache: hashing the jaxpr, finding and reading."""
    asked: int
    """Scalar operations of the function, loops' bodies once; 0 from the cache."""
    computed: int
    """Those that are left of them."""
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
        return sum(int(np.prod(aval.shape)) for aval in self.in_avals)

    @property
    def words_out(self) -> int:
        """Words of a lane that come out."""
        return sum(int(np.prod(aval.shape)) for aval in self.out_avals)

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
        words = self.pack(leaves, lanes)
        out = aligned((len(words), self.words_out, self.target.width))
        self.run(words, out)
        return jax.tree.unflatten(self.out_tree, self.unpack(out, lanes))

    def pack(self, leaves: list[Any], lanes: int) -> Words:
        """Leaves [lane, ...] as words; lanes that fill the last block repeat the last."""
        width = self.target.width
        blocks = -(-lanes // width)
        columns = []
        for leaf, aval in zip(leaves, self.in_avals, strict=True):
            array = np.asarray(leaf)
            assert array.dtype == aval.dtype, (array.dtype, aval)
            assert array.shape == (lanes, *aval.shape), (array.shape, aval)
            array = array.astype(np.uint32) if array.itemsize < 4 else np.ascontiguousarray(array).view(np.uint32)
            columns.append(array.reshape(lanes, int(np.prod(aval.shape))))
        rows = np.concatenate([np.zeros((lanes, 0), np.uint32), *columns], axis=1)
        filled = rows[np.minimum(np.arange(blocks * width), lanes - 1)] if lanes else rows
        words = aligned((blocks, rows.shape[1], width))
        words[:] = filled.reshape(blocks, width, -1).transpose(0, 2, 1)
        return words

    def unpack(self, out: Words, lanes: int) -> list[NDArray]:
        """Leaves [lane, ...] of words that came out."""
        rows = out.transpose(0, 2, 1).reshape(len(out) * out.shape[2], out.shape[1])[:lanes]
        ends = np.cumsum([int(np.prod(aval.shape)) for aval in self.out_avals], dtype=np.int64)
        found = []
        for column, aval in zip(np.split(rows, ends, axis=1)[:-1], self.out_avals, strict=True):
            column = np.ascontiguousarray(column)
            array = column.astype(aval.dtype) if aval.dtype.itemsize < 4 else column.view(aval.dtype)
            found.append(array.reshape(lanes, *aval.shape))
        return found


def aligned(shape: tuple[int, ...]) -> Words:
    """An empty array of words that vectors can be read from."""
    size = 4 * int(np.prod(shape))
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(np.uint32).reshape(shape)


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
    folder = folder or kernel_cache.cache_folder()
    started = time.perf_counter()
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    jaxpr_s = time.perf_counter() - started
    started = time.perf_counter()
    versions = f"{target} {compiler_version()} {OWN_VERSION} {loops.UNROLLED_OPERATIONS}"
    key = hashlib.sha256(f"{jaxpr_digest(closed)} {versions}".encode()).hexdigest()
    code = kernel_cache.load(folder, key) if folder else None
    facts = Facts(jaxpr_s, 0.0, 0.0, time.perf_counter() - started, 0, 0, len(code or b""), True)
    if code is None:
        code, facts = _compile(closed, target, jaxpr_s)
        if folder:
            kernel_cache.save(folder, key, code)
    address, alive = load_object(code, target)
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(address)
    leaves, out_tree = jax.tree.flatten(shape)
    return Kernel(
        target=target,
        in_tree=jax.tree.structure(arguments),
        in_avals=tuple(variable.aval for variable in closed.jaxpr.invars),
        out_tree=out_tree,
        out_avals=tuple(leaves),
        facts=facts,
        _function=call,
        _alive=alive,
    )


def _compile(closed: ClosedJaxpr, target: Target, jaxpr_s: float) -> tuple[bytes, Facts]:
    started = time.perf_counter()
    graph, inputs, outputs = trace_jaxpr(closed)
    traced = time.perf_counter()
    text = emit(graph, outputs, inputs, target.width)
    emitted = time.perf_counter()
    code = compile_object(text, target)
    compiled = time.perf_counter()
    computed = sum(graph.keys[node][0] in OPERATIONS for node in live(graph, outputs))
    seconds = (jaxpr_s, traced - started, emitted - traced, compiled - emitted)
    return code, Facts(*seconds, graph.asked, computed, len(code), False)


def jaxpr_digest(closed: ClosedJaxpr) -> str:
    """A hash of everything a jaxpr computes: its equations, their parameters and its constants; not names of variables.

    Raises:
        ValueError: a parameter has no text that is the same in every process.
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
